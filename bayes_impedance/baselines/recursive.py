"""Recursive least squares with exponential forgetting: one stiffness and one damping at a time, along the log.

Per axis, with hand position x and force u of the human on the robot,

    u = c − k x − d ẋ − m ẍ + ε.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.baselines.ensemble import OFFSET_SPLINES
from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.baselines.samples import (
    PredictedForce,
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

#: SD of noise is taken to be at least this share of the one configured.
LEAST_NOISE = 1e-3


class RecursiveLeastSquares:
    """Least squares in which a sample counts exp(−age / `memory`), along the trials of each group in turn.

    The offset c is a cubic spline over phase that all repetitions share where every trial has phase, else a constant of
    each trial. Parameters start at the medians of the configuration with their spread, which is never forgotten: so the
    estimate stays bounded where nothing excites it.

    Presumed: that x_d and the pace of repetitions enter by c alone, and that the residual force is white; where it is
    not, the SDs of parameters are too small. On a robot that answers force by motion, estimates tend to the robot's law
    (docs/model.md §6).

    Raises:
        LogError: the training log has no force.
    """

    def __init__(self, config: Config, log: PreparedLog, memory: float = MEMORY) -> None:
        check_force(log)
        self._start = Start.of(config)
        self._memory = memory
        self._groups = {group: self._learn(config, trials) for group, trials in members(log).items()}

    def filter(self, log: PreparedLog) -> tuple[Track, ...]:
        """Tracks of every trial of `log`, from the start, with the noise that training found.

        x_d is c / k, the equilibrium of the spring alone, which presumes d ẋ_d + m ẍ_d to be small beside k x_d.

        Raises:
            LogError: no force, no phase where the training log has it, or a group that was not trained on.
        """
        check_force(log)
        check_groups(self._groups, log)
        regressors = {group: self._groups[group].regressors for group in log.groups}
        runs = {group: self._run(regressors[group], trials) for group, trials in members(log).items()}
        return tuple(_track(trial, next(runs[trial.group]), regressors[trial.group]) for trial in log.trials)

    def predict(self, log: PreparedLog) -> PredictedForce:
        """Force of `log`, whose own forces are not looked at, with the parameters at the end of training.

        Without phase the offset is the average of those of the training trials. Variance: the mean square of what this
        prediction leaves of the training forces, and that of the parameters.

        Raises:
            LogError: no phase where the training log has it, or a group that was not trained on.
        """
        return predict_trials(self._groups, log)

    def _learn(self, config: Config, trials: Sequence[PreparedTrial]) -> _Learned:
        regressors = _Regressors.of(self._start, config, trials)
        # Once with the noise of the configuration, to learn what is left; once with what was left.
        left = self._end(regressors, trials).residual_variance
        # Forces that fit to the last digit would leave nothing to divide by.
        least = (LEAST_NOISE * config.model.noise_sd.median) ** 2
        return self._end(replace(regressors, noise=np.maximum(left, least)), trials)

    def _end(self, regressors: _Regressors, trials: Sequence[PreparedTrial]) -> _Learned:
        """Parameters after the last sample, and what they leave of all forces."""
        ends = [states[-1] for states in self._run(regressors, trials)]
        mean, covariance = ends[-1].mean.copy(), ends[-1].covariance.copy()
        if regressors.basis is None:
            mean[:, 0] = np.mean([end.mean[:, 0] for end in ends], axis=0)
            # How offsets of trials differ is in the residual.
            covariance[:, 0, :] = covariance[:, :, 0] = 0.0
        left = [
            (trial.force - regressors.predict(trial, mean))[trial.observed]
            for trial in trials
            if trial.force is not None
        ]
        return _Learned(regressors, mean, covariance, np.mean(np.square(np.concatenate(left)), axis=0))

    def _run(self, regressors: _Regressors, trials: Sequence[PreparedTrial]) -> Iterator[list[_State]]:
        """States after each sample, trial after trial."""
        information = np.zeros_like(regressors.prior)
        vector = np.zeros(information.shape[:2])
        for trial in trials:
            if regressors.basis is None:
                information, vector = _without_offset(information, vector, regressors)
            rows, known = regressors(trial), trial.observed
            steps = np.diff(trial.time, prepend=trial.time[0])
            states = []
            for i in range(trial.n_samples):
                kept = np.exp(-steps[i] / self._memory)
                information, vector = kept * information, kept * vector
                if known[i] and trial.force is not None:
                    h = rows[:, i] / regressors.noise[:, None]
                    information = information + rows[:, i, :, None] * h[:, None, :]
                    vector = vector + h * trial.force[i][:, None]
                covariance = np.linalg.inv(information + regressors.prior)
                states.append(
                    _State((covariance @ (vector + regressors.prior_vector)[..., None])[..., 0], covariance)
                )
            yield states


@dataclass(frozen=True)
class _State:
    """Mean `(axes, p)` and covariance `(axes, p, p)` of c, k, d, m."""

    mean: Array
    covariance: Array


@dataclass(frozen=True)
class _Regressors:
    """Rows that multiply the parameters; their prior precision `(axes, p, p)`, and variance of noise `(axes,)` [N²].

    `centre` `(axes,)` [m] is taken from positions, so that c is a force near the middle of the motion.
    """

    basis: PhaseBasis | None
    centre: Array
    prior: Array
    prior_vector: Array
    noise: Array

    @classmethod
    def of(cls, start: Start, config: Config, trials: Sequence[PreparedTrial]) -> _Regressors:
        basis = PhaseBasis(OFFSET_SPLINES) if all(trial.phase is not None for trial in trials) else None
        position = np.concatenate([trial.position for trial in trials])
        force = np.concatenate([trial.force[trial.observed] for trial in trials if trial.force is not None])
        # c = k x_d + …, and x_d is about where the hand is.
        offset_sd = np.hypot(start.level[0] * position.std(axis=0), np.sqrt(np.mean(force**2, axis=0)))
        size = 1 if basis is None else basis.size
        sd = np.hstack(
            [np.tile(offset_sd[:, None], size), np.tile(start.level * start.spread, (len(offset_sd), 1))]
        )
        prior = sd[..., None] ** -2.0 * np.eye(size + 3)
        mean = np.concatenate([np.zeros(size), start.level])
        noise = np.full(len(offset_sd), config.model.noise_sd.median**2)
        return cls(basis, position.mean(axis=0), prior, prior @ mean, noise)

    def offset(self, trial: PreparedTrial) -> Array:
        """Columns of c, `(n, size)`."""
        return np.ones((trial.n_samples, 1)) if self.basis is None else self.basis(phase_of(trial))

    def __call__(self, trial: PreparedTrial) -> Array:
        """Rows `(axes, n, p)`."""
        motion = motion_of(trial)
        motion[..., 0] -= self.centre
        offset = self.offset(trial)
        return np.stack([np.hstack([offset, -motion[:, a]]) for a in range(motion.shape[1])])

    def predict(self, trial: PreparedTrial, mean: Array) -> Array:
        """Force `(n, axes)` [N] with parameters `mean` `(axes, p)`."""
        return np.einsum("anp,ap->na", self(trial), mean)


@dataclass(frozen=True)
class _Learned:
    """Parameters of a group at the end of training."""

    regressors: _Regressors
    mean: Array
    covariance: Array
    residual_variance: Array

    def predict(self, trial: PreparedTrial) -> PredictedForce:
        rows = self.regressors(trial)
        uncertain = np.einsum("anp,apq,anq->na", rows, self.covariance, rows)
        return PredictedForce(
            self.regressors.predict(trial, self.mean), np.sqrt(self.residual_variance + uncertain)
        )


def _without_offset(information: Array, vector: Array, regressors: _Regressors) -> tuple[Array, Array]:
    """What samples tell of k, d and m when the offset of their trial is integrated out."""
    precision = information[:, 0, 0] + regressors.prior[:, 0, 0]
    column = information[:, 1:, 0]
    reduced, rest = np.zeros_like(information), np.zeros_like(vector)
    reduced[:, 1:, 1:] = (
        information[:, 1:, 1:] - column[:, :, None] * column[:, None, :] / precision[:, None, None]
    )
    rest[:, 1:] = (
        vector[:, 1:] - column * ((vector[:, 0] + regressors.prior_vector[:, 0]) / precision)[:, None]
    )
    return reduced, rest


def _track(trial: PreparedTrial, states: Sequence[_State], regressors: _Regressors) -> Track:
    mean = np.stack([state.mean for state in states])
    covariance = np.stack([state.covariance for state in states])
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    size = mean.shape[-1] - 3
    offset = regressors.offset(trial)
    c, k = np.einsum("np,nap->na", offset, mean[..., :size]), mean[..., size]
    # x_d = c / k, to first order in both.
    slope = np.concatenate(
        [offset[:, None, :] / k[..., None], -(c / k**2)[..., None], np.zeros((*k.shape, 2))], axis=-1
    )
    spread = np.einsum("nap,napq,naq->na", slope, covariance, slope)
    return Track(
        trial.time, k, np.sqrt(variance[..., size]), mean[..., size + 1], np.sqrt(variance[..., size + 1]),
        regressors.centre + c / k, np.sqrt(spread),
    )  # fmt: skip
