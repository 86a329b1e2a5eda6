"""The main job from end to end: record, train, infer, evaluate, draw; the truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.config import Config, load_config
from bayes_impedance.posterior import Marginal, Posterior
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace
from bayes_impedance.writer import write_log

Array = NDArray[np.float64]

MATRICES = ("stiffness", "damping", "mass")
REPETITIONS = 5
#: Of the path [m]: here posture couples the axes, in mass most of all.
CENTRE = (0.03, 0.37)


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
    return Recording(training, testing, load_config("arm", []))


def truth_errors(posterior: Posterior) -> dict[str, float]:
    """Mean relative error of the diagonals of stiffness, damping and mass against the truth in the log, by entry."""
    errors: dict[str, float] = {}
    for name in MATRICES:
        found = _beside_truth(posterior, posterior[name], [axis + axis for axis in posterior.axes])
        errors |= {key: float(np.mean(np.abs(mean - truth) / truth)) for key, (mean, truth) in found.items()}
    return errors


def coupling_errors(posterior: Posterior) -> dict[str, float]:
    """Mean absolute error of what couples axes in stiffness [N/m], damping [Ns/m] and mass [kg], by entry."""
    errors: dict[str, float] = {}
    for marginal in posterior.couplings.values():
        found = _beside_truth(posterior, marginal, posterior.pairs)
        errors |= {key: float(np.mean(np.abs(mean - truth))) for key, (mean, truth) in found.items()}
    return errors


def _beside_truth(
    posterior: Posterior, marginal: Marginal, entries: Sequence[str]
) -> dict[str, tuple[Array, Array]]:
    """Posterior mean and truth of each entry, `(samples,)` each, by name: stiffness_xx."""
    names = [f"{marginal.latent.value}_{entry}" for entry in entries]
    truths = [np.concatenate([trial.truth[name] for trial in posterior.log.trials]) for name in names]
    return dict(zip(names, zip(marginal.mean.T, truths, strict=True), strict=True))
