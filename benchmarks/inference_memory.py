"""Peak memory of a posterior, in a process of its own: `python -m benchmarks.inference_memory many|long SIZE`.

`many`: SIZE groups of 60 samples, given their own forces. `long`: a log of SIZE samples, given 200 other forces.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import replace

import numpy as np

from bayes_impedance.config import Config, load_config
from bayes_impedance.features import FeatureMap
from bayes_impedance.model import Fit, ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import TrainingReport

CONFIG = load_config("phase", ["model.desired_trajectory.mean=reference"])


def groups_of(samples: int, count: int, rate: float = 25.0) -> PreparedLog:
    """Groups of one repetition each, along two axes; every fourth has a motion and force of its own."""
    drawn = [
        draw_force(CONFIG, repeated_motion(1, samples / rate, rate, seed=seed), seed).trials[0]
        for seed in range(4)
    ]
    trials = [replace(drawn[g % 4], name=str(g), group=f"g{g}") for g in range(count)]
    return PreparedLog(("x", "y"), tuple(trials))


def trained_on(log: PreparedLog, config: Config = CONFIG) -> ImpedanceModel:
    """Hyperparameters at their medians, and the log kept: what a posterior costs does not depend on more."""
    model = build_force_model(config, FeatureMap(config, log.axes))
    report = TrainingReport((), (0, 0), (0.0, 0.0), (0.0, 0.0), {}, False, log.n_samples)
    return ImpedanceModel(config, Fit(model, log, report))


def problem_of(kind: str, size: int) -> tuple[ImpedanceModel, PreparedLog]:
    """The model, and the log whose posterior is asked for."""
    if kind == "many":
        log = groups_of(60, size)
        return trained_on(log), log
    model = trained_on(groups_of(200, 1))
    motion = repeated_motion(1, size / 25.0, 25.0, seed=9, group="g0")
    return model, motion


def _peak() -> float:
    """Largest resident size until now [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main(kind: str, size: int) -> None:
    """Print the peak beyond what was there before and what the posterior holds, and the size of the latter [MB]."""
    small, motion = problem_of("many", 2)
    small.posterior(motion)
    model, log = problem_of(kind, size)
    before, start = _peak(), time.perf_counter()
    posterior = model.posterior(log, given="training" if kind == "long" else "both")
    seconds = time.perf_counter() - start
    arrays = [
        array
        for marginal in posterior.marginals.values()
        for array in (marginal.location, marginal.scale, marginal.prior_location, marginal.prior_scale)
    ]
    held = sum(np.asarray(array).nbytes for array in arrays) / 1e6
    print(json.dumps({"beyond_mb": _peak() - before - held, "result_mb": held, "seconds": seconds}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
