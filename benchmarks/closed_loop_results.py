"""What the Jacobian of the closed loop is worth: `make results` writes results/closed_loop.json.

One axis of an arm (100 N/m, 9 Ns/m, 1.2 kg) holds an admittance-controlled device (2 kg, 6 Ns/m) that perturbs it with
1, 2 and 5 N; ten seeds each. Estimates are averages along the path, with the shipped configuration `admittance`, three
ways: with the Jacobian and the acceleration from the law of the device, with the Jacobian and the measured
acceleration, and without a device.
"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from bayes_impedance import ImpedanceModel, load_config
from bayes_impedance.simulation.device import Admittance
from bayes_impedance.simulation.one_axis import ConstantImpedance, held_device
from benchmarks.results import Results, commit

PERTURBATIONS = (1.0, 2.0, 5.0)  # [N]
SEEDS = range(10)
WAYS = {
    "jacobian": ["device.acceleration=law"],
    "jacobian_measured_acceleration": ["device.acceleration=measured"],
    "without_jacobian": ["device=null"],
}
ARM = ConstantImpedance()
TRUTH = {"stiffness": ARM.stiffness, "damping": ARM.damping, "mass": ARM.mass}


def estimate(way: str, perturbation: float, seed: int) -> dict[str, float]:
    """Path averages of stiffness [N/m], damping [Ns/m] and mass [kg] from one simulated session."""
    log = held_device(ARM, Admittance(), perturbation, seed=seed)
    config = load_config("admittance", ["training.restarts=1", *WAYS[way]])
    model = ImpedanceModel(config).fit(log)
    posterior = model.posterior(model.fitted.log)
    return {name: float(posterior[name].mean.mean()) for name in TRUTH}


def summary(estimates: list[dict[str, float]]) -> Results:
    """Mean over seeds, its relative bias, the SD over seeds, and the largest relative error of a seed."""
    found: Results = {}
    for name, truth in TRUTH.items():
        values = np.array([estimate[name] for estimate in estimates])
        found[name] = {
            "mean": float(values.mean()),
            "bias": float(values.mean() / truth - 1.0),
            "sd": float(values.std(ddof=1)),
            "largest_error": float(np.abs(values / truth - 1.0).max()),
        }
    return found


def main() -> None:
    """Compute everything and write the committed JSON."""
    cases = [(way, p, seed) for p in PERTURBATIONS for way in WAYS for seed in SEEDS]
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        estimates = dict(zip(cases, pool.map(estimate, *zip(*cases, strict=True)), strict=True))
    figures: Results = {"truth": TRUTH, "seeds": len(SEEDS)}
    for way in WAYS:
        figures[way] = {
            f"{p:g} N": summary([estimates[way, p, seed] for seed in SEEDS]) for p in PERTURBATIONS
        }
    commit("closed_loop", SEEDS[0], figures)


if __name__ == "__main__":
    main()
