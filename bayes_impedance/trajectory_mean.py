"""Prior mean of the desired trajectory and its time derivatives (docs/model.md §1).

μ_xd and its first two time derivatives, for `equilibrium` (the hand itself), `reference` (a column of the
log), `trial_average` (the mean over repetitions at equal phase) and `constant`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline

from bayes_impedance.config import DesiredTrajectoryPrior
from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

Array = NDArray[np.float64]

SPLINE_DEGREE = 5  # so that the second derivative of the average is itself smooth


@dataclass(frozen=True)
class Instant:
    """Motion at one instant of a stream; fields as those of `PreparedTrial`, of one sample."""

    name: str
    group: str
    source: str
    position: Array
    velocity: Array
    acceleration: Array
    phase: Array | None
    phase_velocity: Array | None
    phase_acceleration: Array | None
    reference: Array | None
    reference_velocity: Array | None
    reference_acceleration: Array | None


@dataclass(frozen=True)
class TrajectoryMean:
    """μ_xd as learned from training trials; call `derivatives` for any trial of a known group."""

    prior: DesiredTrajectoryPrior
    averages: Mapping[str, BSpline]
    constants: Mapping[str, Array]

    @classmethod
    def from_training(cls, prior: DesiredTrajectoryPrior, log: PreparedLog) -> TrajectoryMean:
        """Averages or constants of each group of `log`, where the mean is of that kind.

        Raises:
            ConfigurationError: `value` lacks an axis.
            LogError: a group covers too little of the phase for its average.
        """
        averages: dict[str, BSpline] = {}
        constants: dict[str, Array] = {}
        for group, members in log.by_group.items():
            trials = [log.trials[i] for i in members]
            if prior.mean == "trial_average":
                averages[group] = _average(trials, prior.average_knots)
            elif prior.mean == "constant":
                constants[group] = _constant(prior, log.axes, trials)
        return cls(prior, averages, constants)

    def derivatives(self, trial: PreparedTrial | Instant) -> Array:
        """μ_xd, dμ_xd/dt, d²μ_xd/dt² at each sample, `(3, n, axes)` [m, m/s, m/s²].

        Raises:
            LogError: the trial lacks the reference, or belongs to a group without training trials.
        """
        hand = np.stack([trial.position, trial.velocity, trial.acceleration])
        if self.prior.mean == "equilibrium":
            return hand
        if self.prior.mean == "reference":
            return self._reference(trial)
        known = self.averages if self.prior.mean == "trial_average" else self.constants
        if trial.group not in known:
            raise LogError(
                f"{trial.source}, trial {trial.name}: expected a group among the training groups "
                f"({', '.join(known)}), whose {self.prior.mean.replace('_', ' ')} is known, got group "
                f"'{trial.group}'; train on a trial of that group too"
            )
        if self.prior.mean == "constant":
            result = np.zeros_like(hand)
            result[0] = self.constants[trial.group]
            return result
        return self._trial_average(trial)

    def _reference(self, trial: PreparedTrial | Instant) -> Array:
        parts = (trial.reference, trial.reference_velocity, trial.reference_acceleration)
        if any(part is None for part in parts):
            raise LogError(
                f"{trial.source}, trial {trial.name}: expected a reference column for "
                "desired_trajectory.mean: reference, found none; name it in log.columns.reference, or choose "
                "another mean"
            )
        return np.stack([part for part in parts if part is not None])

    def _trial_average(self, trial: PreparedTrial | Instant) -> Array:
        # One function of phase, with the sample's own φ̇ and φ̈: μ'φ̇ and μ''φ̇² + μ'φ̈.
        phase, rate, change = phase_derivatives(trial)
        spline = self.averages[trial.group]
        first, second = spline(phase, 1), spline(phase, 2)
        return np.stack(
            [spline(phase), first * rate[:, None], second * rate[:, None] ** 2 + first * change[:, None]]
        )


def phase_derivatives(trial: PreparedTrial | Instant) -> tuple[Array, Array, Array]:
    """φ, φ̇ and φ̈ of a trial, `(n,)` each [1, 1/s, 1/s²].

    Raises:
        LogError: the trial has no phase.
    """
    if trial.phase is None or trial.phase_velocity is None or trial.phase_acceleration is None:
        raise LogError(
            f"{trial.source}, trial {trial.name}: expected a phase column, found none; name it in "
            "log.columns.phase, set preprocessing.phase.source to path or warping, or choose another trajectory_input"
        )
    return trial.phase, trial.phase_velocity, trial.phase_acceleration


def _average(trials: list[PreparedTrial], knots: int) -> BSpline:
    """Least-squares spline over phase through the positions of every repetition of a group."""
    phase = np.concatenate([phase_derivatives(trial)[0] for trial in trials])
    position = np.concatenate([trial.position for trial in trials])
    order = np.argsort(phase, kind="stable")
    phase, position = phase[order], position[order]
    interior = np.linspace(phase[0], phase[-1], knots + 2)[1:-1]
    vector = np.concatenate(
        [np.full(SPLINE_DEGREE + 1, phase[0]), interior, np.full(SPLINE_DEGREE + 1, phase[-1])]
    )
    try:
        return make_lsq_spline(phase, position, vector, k=SPLINE_DEGREE)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise LogError(
            f"group '{trials[0].group}': expected samples between any two of the {knots} knots of the trial "
            f"average over phase {phase[0]:.3g} to {phase[-1]:.3g}, found an empty stretch among "
            f"{phase.size} samples; lower desired_trajectory.average_knots"
        ) from error


def _constant(prior: DesiredTrajectoryPrior, axes: tuple[str, ...], trials: list[PreparedTrial]) -> Array:
    if prior.value is None:
        return np.asarray(np.concatenate([trial.position for trial in trials]).mean(axis=0))
    missing = [axis for axis in axes if axis not in prior.value]
    if missing:
        raise ConfigurationError(
            f"desired_trajectory.value: expected a position [m] for each of {', '.join(axes)}, found none for "
            f"{', '.join(missing)}; add it, or leave value out to use the mean of the training positions"
        )
    return np.array([prior.value[axis] for axis in axes])  # type: ignore[index]
