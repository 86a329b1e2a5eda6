"""What a plan promises and what fits then deliver: `make results` writes results/planning.json.

The simulated arm, low and high, traces a figure of eight of 4 s in perturbed repetitions, seen by the shipped
configuration `admittance` at 12.5 Hz. Planned: the relative width of the 90 % interval of stiffness over a grid of
designs. Checked: other seeds of a few designs, each trained on whole, against the plan: width, scatter over seeds,
error against the truth, and coverage of the truth. Widths of scatter and error are 3.29 of their log-SDs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from bayes_impedance import ImpedanceModel, load_config
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.planning import Plan, plan, relative_width
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace
from benchmarks.results import Results, commit

ARMS = ("low", "high")
REPETITIONS = (2, 3, 4, 6, 8, 12)
PERTURBATIONS = (0.5, 1.0, 2.0, 5.0)  # [N]
MOTIONS = 2
CHECKED_REPETITIONS = (3, 6)
CHECKED_PERTURBATIONS = (1.0, 5.0)  # [N]
SEEDS = range(100, 105)
WANTED = 0.3
#: A Gaussian's 90 % interval in SDs.
INTERVAL = 3.29
PHASES = np.linspace(0.05, 0.95, 40)
LATENTS = (Latent.STIFFNESS, Latent.DAMPING, Latent.MASS)

CONFIG = load_config("admittance", ["training.restarts=1", "preprocessing.rate=12.5"])


def experiment(arm: str, perturbation: float, repetitions: int = 1) -> Experiment:
    """One round of a figure of eight a trial."""
    person = Subject(arm, arm_with(arm), Pace(repetition=4.0))
    return Experiment([person], FigureEight(), repetitions, 1, BandLimitedForce(perturbation))


def planned(arm: str, perturbation: float) -> Plan:
    """Every number of repetitions at one perturbation."""
    model = ImpedanceModel(CONFIG)
    return plan(experiment(arm, perturbation), model, REPETITIONS, [perturbation], motions=MOTIONS)


def fitted(arm: str, perturbation: float, repetitions: int, seed: int) -> Results:
    """One session trained on whole, by axis: widths, coverage, error of the path average and log errors by phase."""
    untrained = ImpedanceModel(CONFIG)
    log = untrained.prepare(simulate(experiment(arm, perturbation, repetitions), seed))
    model = untrained.fit(log)
    after = model.posterior(log, latents=LATENTS)[Latent.STIFFNESS]
    before = untrained.posterior(log, latents=LATENTS)[Latent.STIFFNESS]
    found: Results = {}
    for a, axis in enumerate(log.axes):
        truth = np.concatenate([trial.truth[f"stiffness_{axis}{axis}"] for trial in log.trials])
        estimate = after.quantile(0.5)[:, a]
        inside = (after.quantile(0.05)[:, a] < truth) & (truth < after.quantile(0.95)[:, a])
        found[axis] = {
            "width": relative_width(after, a),
            "untrained_width": relative_width(before, a),
            "coverage": float(inside.mean()),
            "bias": float(estimate.mean() / truth.mean() - 1.0),
            "log_error": _by_phase(log, np.log(estimate / truth)),
        }
    return found


def _by_phase(log: PreparedLog, values: NDArray[np.float64]) -> list[float]:
    """Average over the trials of what was interpolated at PHASES."""
    starts = np.cumsum([0, *(trial.n_samples for trial in log.trials)])
    lines = [
        np.interp(PHASES, trial.phase, values[start : start + trial.n_samples])
        for trial, start in zip(log.trials, starts, strict=False)
        if trial.phase is not None
    ]
    return np.mean(lines, axis=0).tolist()


def delivered(fits: Sequence[Results], promised: Plan, repetitions: int, perturbation: float) -> Results:
    """What fits of one design make of its plan, by axis."""
    found: Results = {}
    for axis in promised.axes:
        line = promised.along(Latent.STIFFNESS, axis, perturbation)
        width = next(entry.width for entry in line if entry.repetitions == repetitions)
        own = [fit[axis] for fit in fits]
        errors = np.array([entry["log_error"] for entry in own])
        found[axis] = {
            "planned_width": width,
            **{
                name: float(np.mean([entry[name] for entry in own]))
                for name in ("width", "untrained_width", "coverage", "bias")
            },
            "scatter_width": float(INTERVAL * np.sqrt(errors.var(axis=0, ddof=1).mean())),
            "error_width": float(INTERVAL * np.sqrt(np.square(errors).mean())),
        }
    return found


def widths(promised: Plan) -> Results:
    """Planned widths by quantity, axis and number of repetitions, at one perturbation."""
    return {
        f"{latent.value}_{axis}": {
            str(entry.repetitions): entry.width
            for entry in promised.along(latent, axis, promised.perturbations[0])
        }
        for latent in LATENTS
        for axis in promised.axes
    }


def unexplained(arm: str, perturbation: float) -> Results:
    """SD of the force that a model without coupling cannot explain, by axis [N].

    Part of it is caused by the other axis, Σ_j W_j,xy e_y, the rest is the residual force of the truth.
    """
    log = ImpedanceModel(CONFIG).prepare(simulate(experiment(arm, perturbation, max(REPETITIONS)), SEEDS[0]))
    found: Results = {}
    for axis, other in (("x", "y"), ("y", "x")):
        coupling, residual = [], []
        for trial in log.trials:
            b = log.axes.index(other)
            hand = {
                "position": trial.position,
                "velocity": trial.velocity,
                "acceleration": trial.acceleration,
            }
            errors = [trial.truth[f"desired_{name}_{other}"] - value[:, b] for name, value in hand.items()]
            matrices = [trial.truth[f"{latent.value}_xy"] for latent in LATENTS]
            coupling.append(np.sum([w * e for w, e in zip(matrices, errors, strict=True)], axis=0))
            residual.append(trial.truth[f"residual_force_{axis}"])
        found[axis] = {
            "coupling": float(np.concatenate(coupling).std()),
            "residual": float(np.concatenate(residual).std()),
        }
    return found


def main() -> None:
    """Compute everything and write the committed JSON."""
    designs = [(arm, p) for arm in ARMS for p in PERTURBATIONS]
    checks = [(arm, p, r) for arm in ARMS for p in CHECKED_PERTURBATIONS for r in CHECKED_REPETITIONS]
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        fits = {check: [pool.submit(fitted, *check, seed) for seed in SEEDS] for check in checks}
        plans = dict(zip(designs, pool.map(planned, *zip(*designs, strict=True)), strict=True))
        figures: Results = {"motions": MOTIONS, "seeds": len(SEEDS), "wanted_width": WANTED}
        for arm in ARMS:
            figures[arm] = {
                f"{p:g} N": {
                    "smallest": plans[arm, p].smallest(WANTED)[p],
                    "verdicts": sorted({entry.support.value for entry in plans[arm, p].expectations}),
                    "planned": widths(plans[arm, p]),
                    "unexplained_force": unexplained(arm, p),
                    "delivered": {
                        str(r): delivered([fit.result() for fit in fits[arm, p, r]], plans[arm, p], r, p)
                        for r in CHECKED_REPETITIONS
                        if (arm, p, r) in fits
                    },
                }
                for p in PERTURBATIONS
            }
    commit("planning", SEEDS[0], figures)


if __name__ == "__main__":
    main()
