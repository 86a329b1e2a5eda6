"""An extended Kalman filter for stiffness, damping and desired position of one axis.

    u = k (x_d − x) − d ẋ − m ẍ + ε

with random walks log k, log d and x_d, and a known mass m.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.baselines.ensemble import OFFSET_SPLINES
from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.baselines.samples import (
    PredictedForce,
    Repetitions,
    check_force,
    check_groups,
    members,
    motion_of,
    phase_of,
    predict_trials,
)
from bayes_impedance.baselines.track import MEMORY, Start, Track
from bayes_impedance.config import Config
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

Array = NDArray[np.float64]

#: log k and log d stay within so many SDs of where they start: a linearised step can throw them anywhere.
FARTHEST = 5.0
#: Weight of differences between splines of the average x_d, relative to one sample: matters only where there is none.
SMOOTHING = 1e-6


class ExtendedKalmanFilter:
    """States log k, log d and x_d of each axis, along the trials of each group in turn.

    log k and log d start at the medians of the configuration with their spread; within `memory` [s] they walk as far as
    the process along the path may differ from its level (`log_sd`). x_d starts each trial at the hand, with the SD of
    the desired trajectory, and walks as far between two samples as the hand does (rms over training). The mass and the
    SD of ε are the medians of the configuration.

    Presumed: that the forces of ẋ_d and ẍ_d are small, else x_d stands for x_d + (d ẋ_d + m ẍ_d) / k; and that the
    force is nearly linear in the states within their SDs. One force a sample cannot tell k from x_d; what does is the
    walk that x_d is presumed to take, so the SDs are only as good as that.

    Raises:
        LogError: the training log has no force.
    """

    def __init__(self, config: Config, log: PreparedLog, memory: float = MEMORY) -> None:
        check_force(log)
        self._start = Start.of(config)
        self._groups = {
            group: _learn(_Walk.of(config, self._start, trials, memory), trials)
            for group, trials in members(log).items()
        }

    def filter(self, log: PreparedLog) -> tuple[Track, ...]:
        """Tracks of every trial of `log`, from the start: exp of the mean of log k and log d, SDs to first order.

        Raises:
            LogError: no force, or a group that was not trained on.
        """
        check_force(log)
        check_groups(self._groups, log)
        runs = {group: self._groups[group].walk.run(trials) for group, trials in members(log).items()}
        return tuple(_track(trial, next(runs[trial.group])) for trial in log.trials)

    def predict(self, log: PreparedLog) -> PredictedForce:
        """Force of `log`, whose own forces are not looked at.

        At phases of the training log: k and d at its end, and x_d the average of its estimates at equal phase. The
        variance is the mean square of what the average of the other repetitions leaves of each, and that of k and d.
        Elsewhere, and where there is no phase, x_d is presumed to be with the hand: mean 0, SD the rms training force.

        Raises:
            LogError: no phase where the training log has it, or a group that was not trained on.
        """
        return predict_trials(self._groups, log)


@dataclass(frozen=True)
class _State:
    """Mean `(axes, 3)` and covariance `(axes, 3, 3)` of log k, log d, x_d."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class _Walk:
    """Start of k and d, and variances: per second of each state `(axes, 3)`, of x_d at first, of noise [N²]."""

    start: Start
    rate: Array
    position_variance: float
    noise_variance: float

    @classmethod
    def of(cls, config: Config, start: Start, trials: Sequence[PreparedTrial], memory: float) -> _Walk:
        steps = np.concatenate([np.diff(trial.position, axis=0) for trial in trials])
        duration = sum(float(np.ptp(trial.time)) for trial in trials)
        position = np.square(steps).sum(axis=0) / duration if duration > 0 else np.zeros(steps.shape[1])
        process = np.tile(start.process_spread[:2] ** 2 / memory, (len(position), 1))
        model = config.model
        return cls(
            start, np.column_stack([process, position]), model.desired_trajectory.sd.median**2,
            model.noise_sd.median**2,
        )  # fmt: skip

    @property
    def mass(self) -> float:
        """m [kg]."""
        return float(self.start.level[2])

    def run(self, trials: Sequence[PreparedTrial]) -> Iterator[list[_State]]:
        """States after each sample, trial after trial; k and d carry over."""
        axes = len(self.rate)
        mean = np.zeros((axes, 3))
        mean[:, :2] = np.log(self.start.level[:2])
        covariance = np.zeros((axes, 3, 3))
        covariance[:, [0, 1], [0, 1]] = self.start.spread[:2] ** 2
        low = np.log(self.start.level[:2]) - FARTHEST * self.start.spread[:2]
        high = np.log(self.start.level[:2]) + FARTHEST * self.start.spread[:2]
        for trial in trials:
            mean, covariance = mean.copy(), covariance.copy()
            mean[:, 2] = trial.position[0]
            covariance[:, 2, :] = covariance[:, :, 2] = 0.0
            covariance[:, 2, 2] = self.position_variance
            motion, known = motion_of(trial), trial.observed
            steps = np.diff(trial.time, prepend=trial.time[0])
            states = []
            for i in range(trial.n_samples):
                covariance = covariance + steps[i] * self.rate[..., None] * np.eye(3)
                if known[i] and trial.force is not None:
                    mean, covariance = self._update(mean, covariance, motion[i], trial.force[i])
                    mean[:, :2] = mean[:, :2].clip(low, high)
                states.append(_State(mean, covariance))
            yield states

    def force(self, mean: Array, motion: Array) -> Array:
        """k (x_d − x) − d ẋ − m ẍ [N] of states `(…, 3)` under motion `(…, 3)`."""
        k, d = np.exp(mean[..., 0]), np.exp(mean[..., 1])
        value: Array = k * (mean[..., 2] - motion[..., 0]) - d * motion[..., 1] - self.mass * motion[..., 2]
        return value

    def slope(self, mean: Array, motion: Array) -> Array:
        """Derivative of the force by the states, `(…, 3)`."""
        k, d = np.exp(mean[..., 0]), np.exp(mean[..., 1])
        return np.stack([k * (mean[..., 2] - motion[..., 0]), -d * motion[..., 1], k], axis=-1)

    def _update(self, mean: Array, covariance: Array, motion: Array, force: Array) -> tuple[Array, Array]:
        h = self.slope(mean, motion)
        cross = (covariance @ h[..., None])[..., 0]
        gain = cross / ((h * cross).sum(-1) + self.noise_variance)[:, None]
        left = np.eye(3) - gain[..., None] * h[:, None, :]
        # Joseph's form, which stays positive semidefinite.
        covariance = left @ covariance @ left.mT + self.noise_variance * gain[..., None] * gain[:, None, :]
        return mean + gain * (force - self.force(mean, motion))[:, None], covariance


@dataclass(frozen=True)
class _Learned:
    """k and d of a group at the end of training; `average` `(size, axes)`: splines of x_d, None without phase."""

    walk: _Walk
    end: _State
    basis: PhaseBasis
    average: Array | None
    phases: tuple[float, float]
    residual_variance: Array
    force_variance: Array

    def predict(self, trial: PreparedTrial) -> PredictedForce:
        shape = trial.position.shape
        idle = PredictedForce(np.zeros(shape), np.broadcast_to(np.sqrt(self.force_variance), shape))
        if self.average is None:
            return idle
        phase, motion = phase_of(trial), motion_of(trial)
        states = np.broadcast_to(self.end.mean, (*shape, 3)).copy()
        states[..., 2] = self.basis(phase) @ self.average
        slope = self.walk.slope(states, motion)[..., :2]
        uncertain = np.einsum("nap,apq,naq->na", slope, self.end.covariance[:, :2, :2], slope)
        seen = ((phase >= self.phases[0]) & (phase <= self.phases[1]))[:, None]
        return PredictedForce(
            np.where(seen, self.walk.force(states, motion), idle.mean),
            np.where(seen, np.sqrt(self.residual_variance + uncertain), idle.sd),
        )


def _learn(walk: _Walk, trials: Sequence[PreparedTrial]) -> _Learned:
    tracks = list(walk.run(trials))
    end, basis = tracks[-1][-1], PhaseBasis(OFFSET_SPLINES)
    force = np.concatenate([trial.force[trial.observed] for trial in trials if trial.force is not None])
    force_variance = np.mean(force**2, axis=0)
    if any(trial.phase is None for trial in trials):
        return _Learned(walk, end, basis, None, (0.0, 0.0), force_variance, force_variance)
    samples = Repetitions.of(trials)
    desired = np.concatenate(
        [
            np.stack([state.mean[:, 2] for state in states])[trial.observed]
            for trial, states in zip(trials, tracks, strict=True)
        ]
    )
    splines = basis(samples.phase)
    left = np.empty_like(samples.force)
    for repetition in range(samples.count):
        own = samples.index == repetition
        # A single repetition has no others.
        others = ~own if samples.count > 1 else own
        states = np.broadcast_to(end.mean, (own.sum(), *end.mean.shape)).copy()
        states[..., 2] = splines[own] @ _average(splines[others], desired[others], basis)
        left[own] = samples.force[own] - walk.force(states, samples.motion[own])
    return _Learned(
        walk, end, basis, _average(splines, desired, basis),
        (float(samples.phase.min()), float(samples.phase.max())), np.mean(left**2, axis=0), force_variance,
    )  # fmt: skip


def _average(splines: Array, values: Array, basis: PhaseBasis) -> Array:
    """Least-squares splines through `values` `(n, axes)`; constant where there are none."""
    gram = splines.T @ splines + SMOOTHING * len(splines) * basis.penalty(1)
    return np.asarray(np.linalg.solve(gram, splines.T @ values))


def _track(trial: PreparedTrial, states: Sequence[_State]) -> Track:
    mean = np.stack([state.mean for state in states])
    sd = np.sqrt(np.stack([np.diagonal(state.covariance, axis1=-2, axis2=-1) for state in states]))
    k, d = np.exp(mean[..., 0]), np.exp(mean[..., 1])
    return Track(trial.time, k, k * sd[..., 0], d, d * sd[..., 1], mean[..., 2], sd[..., 2])
