"""Samples of a log as the estimators read them, and what they refuse."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import LogError
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PredictedForce:
    """Mean and SD of a new measurement of force, `(n, axes)` [N], trial after trial."""

    mean: Array
    sd: Array


class Estimated(Protocol):
    """What is known of a group once it is trained."""

    def predict(self, trial: PreparedTrial) -> PredictedForce:
        """Force of one trial."""


@dataclass(frozen=True)
class Repetitions:
    """Samples of known force: one row a sample, `index` `(n,)` says to which repetition it belongs.

    `phase` `(n,)` [1]; `motion` `(n, axes, 3)`: position, velocity, acceleration [m, m/s, m/s²]; `force` `(n, axes)`
    [N].
    """

    phase: Array
    motion: Array
    force: Array
    index: NDArray[np.int64]

    @classmethod
    def of(cls, trials: Sequence[PreparedTrial]) -> Repetitions:
        """Observed samples of trials with phase and force; repetitions are counted through all trials."""
        known = [trial.observed for trial in trials]
        labels = np.concatenate(
            [
                np.stack([np.full(trial.n_samples, i), trial.repetition], axis=1)[chosen]
                for i, (trial, chosen) in enumerate(zip(trials, known, strict=True))
            ]
        )
        forces = [trial.force for trial in trials if trial.force is not None]
        return cls(
            np.concatenate([phase_of(trial)[chosen] for trial, chosen in zip(trials, known, strict=True)]),
            np.concatenate([motion_of(trial)[chosen] for trial, chosen in zip(trials, known, strict=True)]),
            np.concatenate([force[chosen] for force, chosen in zip(forces, known, strict=True)]),
            np.unique(labels, axis=0, return_inverse=True)[1].reshape(-1),
        )

    @property
    def count(self) -> int:
        """Number of repetitions."""
        return int(self.index.max(initial=-1)) + 1


def motion_of(trial: PreparedTrial) -> Array:
    """Position, velocity and acceleration, `(n, axes, 3)` [m, m/s, m/s²]."""
    return np.stack([trial.position, trial.velocity, trial.acceleration], axis=-1)


def phase_of(trial: PreparedTrial) -> Array:
    """Phase of each sample, `(n,)` [1].

    Raises:
        LogError: the trial has none.
    """
    if trial.phase is None:
        raise LogError(
            f"{trial.source}, trial {trial.name}: expected a phase column, for this estimate knows the force of a "
            "repetition by its phase, found none; name it in log.columns.phase, or leave this baseline out"
        )
    return trial.phase


def members(log: PreparedLog) -> dict[str, list[PreparedTrial]]:
    """Group → its trials."""
    return {group: [trial for trial in log.trials if trial.group == group] for group in log.groups}


def check_force(log: PreparedLog) -> None:
    """Refuse a training log without force.

    Raises:
        LogError: a trial has none.
    """
    if any(trial.force is None for trial in log.trials):
        raise LogError("expected a log with force to train on, found none; name log.columns.force")


def check_groups(known: Collection[str], log: PreparedLog) -> None:
    """Refuse trials of a group that no estimate is known of.

    Raises:
        LogError: names the first.
    """
    for trial in log.trials:
        if trial.group not in known:
            raise LogError(
                f"{trial.source}, trial {trial.name}: expected a group whose impedance was estimated "
                f"({', '.join(known)}), got group '{trial.group}'; train on a trial of that group too, or leave the "
                "estimators out"
            )


def predict_trials(groups: Mapping[str, Estimated], log: PreparedLog) -> PredictedForce:
    """Force of every trial by its group, one after another.

    Raises:
        LogError: a trial belongs to a group that no estimate is known of.
    """
    check_groups(groups, log)
    parts = [groups[trial.group].predict(trial) for trial in log.trials]
    return PredictedForce(
        np.concatenate([part.mean for part in parts]), np.concatenate([part.sd for part in parts])
    )
