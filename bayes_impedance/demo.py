"""The main job from end to end: record, train, infer, evaluate, draw; the truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayes_impedance.config import Config, load_config
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace
from bayes_impedance.writer import write_log

REPETITIONS = 5
#: Of the path [m]: here stiffness and mass of the arm hardly couple the axes, which the model takes as independent.
CENTRE = (0.275, 0.2)


@dataclass(frozen=True)
class Recording:
    """A simulated experiment: files for training and for testing, with the configuration that reads them."""

    training: Path
    testing: Path
    config: Config


def experiment(trials: int = REPETITIONS, round_duration: float = 4.0) -> Experiment:
    """A person who traces a figure of eight once a trial, on a device that perturbs the hand with 2 N."""
    return Experiment(
        [Subject("0", arm_with("low"), Pace(round_duration))],
        FigureEight(CENTRE, width=0.12, height=0.08),
        trials,
        repetitions=1,
        perturbation=BandLimitedForce(2.0),
    )


def record(folder: Path, seed: int = 0) -> Recording:
    """Write `training.csv` (four repetitions) and `testing.csv` (a fifth) into `folder`, the truth beside."""
    log = simulate(experiment(), seed)
    training, testing = folder / "training.csv", folder / "testing.csv"
    write_log(log.select(range(REPETITIONS - 1)), training)
    write_log(log.select([REPETITIONS - 1]), testing)
    # Half the usual rate: the perturbation ends at 4 Hz, and the demo should end within a minute.
    return Recording(training, testing, load_config("admittance", ["preprocessing.rate=12.5"]))


def truth_errors(posterior_of: Callable[[str], np.ndarray], log: PreparedLog) -> dict[str, float]:
    """Mean relative error of stiffness, damping and mass against the truth in `log`, by parameter and axis."""
    errors = {}
    for name in ("stiffness", "damping", "mass"):
        estimate = posterior_of(name)
        for a, axis in enumerate(log.axes):
            key = f"{name}_{axis}{axis}"
            truth = np.concatenate([trial.truth[key] for trial in log.trials])
            errors[key] = float(np.mean(np.abs(estimate[:, a] - truth) / truth))
    return errors
