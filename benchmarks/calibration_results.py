"""Whether NUTS, SVI and Laplace draw from the posterior: `make results` writes results/calibration.json.

Simulation-based calibration of one small problem, whose stiffness and damping are functions of phase: truths from
the prior, a recording of each, its posterior by each method, and the ranks of the truths.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from bayes_impedance import load_config
from bayes_impedance.calibration.draw import Settings
from bayes_impedance.calibration.run import Calibration, calibrate
from bayes_impedance.config import Config
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import repeated_motion
from benchmarks.results import Results, commit

SEED, THINNED = 0, 99
#: Truths of each method: a fit of a guide takes as long as its chain would.
DRAWS = {"nuts": 200, "svi": 200, "laplace": 200}
#: Two repetitions of 18 samples [s, Hz].
REPETITIONS, DURATION, RATE = 2, 4.0, 4.5
PROBLEM = (
    "engine.impedance=map",
    "engine.inducing=3",
    "model.desired_trajectory.mean=reference",
    "model.desired_trajectory.kernel=matern52",
    "model.desired_trajectory.sd={median: 0.02, log_sd: 0.5}",
    "model.desired_trajectory.length_scale.phase={median: 0.2, log_sd: 0.3}",
    "model.stiffness.level={median: 200, log_sd: 0.5}",
    "model.stiffness.log_sd={median: 0.3, fixed: true}",
    "model.stiffness.length_scale.phase={median: 0.3, fixed: true}",
    "model.damping.level={median: 15, log_sd: 0.5}",
    "model.damping.log_sd={median: 0.3, fixed: true}",
    "model.damping.length_scale.phase={median: 0.3, fixed: true}",
    "model.mass.level={median: 1.5, log_sd: 0.5}",
    "model.residual=null",
    "model.noise_sd={median: 0.2, log_sd: 0.5}",
    "training.gradient_tolerance=0.01",
)
#: One chain a draw: chains of one draw do not run side by side, and starts are near each other.
ITERATIONS = ("sampling.chains=1", "sampling.warmup=100", "sampling.draws=200", "sampling.steps=500")


def configuration(method: str, overrides: Sequence[str] = ()) -> Config:
    """The small problem, drawn from by `method`."""
    return load_config("phase", [*PROBLEM, *ITERATIONS, f"sampling.method={method}", *overrides])


def motion() -> PreparedLog:
    """Along one axis."""
    return repeated_motion(REPETITIONS, DURATION, RATE, axes=("x",), seed=SEED)


def settings(method: str) -> Settings:
    """Of the calibration of a method."""
    return Settings(configuration(method), motion(), seed=SEED, thinned=THINNED)


def figures(calibration: Calibration) -> Results:
    """Its JSON, to as many digits as are looked at."""
    found = calibration.as_json()
    for entry in found["quantities"].values():
        entry |= {key: float(f"{entry[key]:.4g}") for key in ("p", "mean_z", "sd_z")}
    return found


def main(folder: Path | None = None) -> None:
    """Calibrate every method and write the committed JSON; a `folder` keeps what is done, and continues from it."""
    found: Results = {}
    for method, draws in DRAWS.items():
        calibration = calibrate(
            settings(method),
            draws,
            None if folder is None else folder / method,
            processes=os.cpu_count() or 1,
        )
        found[method] = figures(calibration)
        print(method, *calibration.remarks(), sep="\n  ", flush=True)
        for one in calibration.uniformity:
            print(f"  {one.name}: p {one.p:.3g}, {one.verdict}", flush=True)
    commit("calibration", SEED, found)


if __name__ == "__main__":
    main()
