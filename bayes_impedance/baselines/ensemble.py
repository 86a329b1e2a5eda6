"""Ensemble least squares: impedance from how repetitions of one intention differ at equal phase.

Per axis, with hand position x and force u of the human on the robot,

    u = c(φ) − K(φ) x − D(φ) ẋ − M ẍ + ε.

The intention of the person, K x_d + D ẋ_d + M ẍ_d, is presumed to be one function c of phase φ in all repetitions of a
group, so that their differences at equal phase are those of the arm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from bayes_impedance.baselines.instruments import perturbed_motion, perturbs_every_axis
from bayes_impedance.baselines.phase_basis import PhaseBasis
from bayes_impedance.baselines.regression import Regression, fit
from bayes_impedance.baselines.samples import (
    PredictedForce,
    Repetitions,
    check_force,
    members,
    motion_of,
    phase_of,
    predict_trials,
)
from bayes_impedance.config import Config
from bayes_impedance.errors import LogError
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

Array = NDArray[np.float64]

#: Splines of c: even knots, 20 spans. Columns times φ̇, φ̇² and φ̈, for c of repetitions of different pace, cost more
#: scatter than they save bias: unseen repetitions of generated motion are predicted worse with them.
OFFSET_SPLINES = 23
#: Weight of second differences of c, relative to one sample: matters only at phases without any. A weight that predicts
#: unseen repetitions best would smooth c more, and what it then lacks of K x_d would be taken from K.
SMOOTHING = 1e-6
#: Splines of each entry of K and D.
IMPEDANCE_SPLINES = 8
#: Repetitions from which on standard errors are those of the jackknife.
ENOUGH_REPETITIONS = 4
#: Phases [1] over which a path is averaged.
PATH = np.linspace(0.0, 1.0, 201)


@dataclass(frozen=True)
class Estimate:
    """A matrix of the impedance and its standard errors, `(n, axes, axes)` [unit of the quantity].

    Row: axis of the force; column: axis of the motion.
    """

    value: Array
    standard_error: Array


@dataclass(frozen=True)
class EnsembleEstimate:
    """Impedance of a group: one `Regression` for each axis of force.

    `instrumented`: two-stage least squares with the recorded perturbation, else plain least squares. `clustered`:
    standard errors by the jackknife over `repetitions`, else, where these are fewer than `ENOUGH_REPETITIONS`, those
    for independent residuals, which are too small.
    """

    regressions: tuple[Regression, ...]
    columns: tuple[tuple[int, ...], ...]
    centre: Array
    splines: tuple[PhaseBasis, PhaseBasis]
    instrumented: bool
    repetitions: int

    @property
    def clustered(self) -> bool:
        """Whether standard errors allow for residuals that correlate within a repetition."""
        return self.repetitions >= ENOUGH_REPETITIONS

    def stiffness(self, phase: Array = PATH) -> Estimate:
        """K at `phase` `(n,)` [N/m]."""
        return self._along(0, phase)

    def damping(self, phase: Array = PATH) -> Estimate:
        """D at `phase` `(n,)` [Ns/m]."""
        return self._along(1, phase)

    def mass(self, phase: Array = PATH) -> Estimate:
        """M [kg], the same at every `phase` `(n,)`."""
        return self._along(2, phase)

    def averages(self) -> tuple[Estimate, Estimate, Estimate]:
        """K [N/m], D [Ns/m] and M [kg] averaged over phase, `(1, axes, axes)` each."""
        return tuple(self._entries(order, self._weights(order, PATH).mean(0)[None]) for order in range(3))  # type: ignore[return-value]

    def predict(self, trial: PreparedTrial) -> PredictedForce:
        """Mean c − K x − D ẋ − M ẍ; variance: that of left-out repetitions, and of the coefficients."""
        means, deviations = [], []
        for regression, axes in zip(self.regressions, self.columns, strict=True):
            x = _design(
                phase_of(trial), motion_of(trial)[:, list(axes)] - self.centre[list(axes)], self.splines
            )
            known = np.einsum("np,pq,nq->n", x, regression.covariance, x)
            means.append(x @ regression.coefficients)
            deviations.append(np.sqrt(regression.residual_variance + known))
        return PredictedForce(np.stack(means, axis=1), np.stack(deviations, axis=1))

    def _along(self, order: int, phase: Array) -> Estimate:
        return self._entries(order, self._weights(order, phase))

    def _weights(self, order: int, phase: Array) -> Array:
        return np.ones((len(phase), 1)) if order == 2 else self.splines[1](phase)

    def _entries(self, order: int, weights: Array) -> Estimate:
        """The matrix whose entries are `weights` `(n, size)` times their coefficients."""
        axes = len(self.regressions)
        value, error = np.zeros((2, len(weights), axes, axes))
        for a, (regression, columns) in enumerate(zip(self.regressions, self.columns, strict=True)):
            covariance = regression.jackknife if self.clustered else regression.covariance
            for i, c in enumerate(columns):
                block = self._block(order, i, len(columns))
                value[:, a, c] = weights @ regression.coefficients[block]
                variance = np.einsum("np,pq,nq->n", weights, covariance[block, block], weights)
                error[:, a, c] = np.sqrt(variance.clip(0.0))
        return Estimate(value, error)

    def _block(self, order: int, axis: int, axes: int) -> slice:
        """Coefficients of one entry of K, D or M, in the order of `_design`."""
        start, size = self.splines[0].size, self.splines[1].size
        if order == 2:
            start += 2 * axes * size + axis
            return slice(start, start + 1)
        start += (2 * axis + order) * size
        return slice(start, start + size)


class EnsembleModel:
    """Ensemble least squares of every group of a log.

    `coupled`: K, D and M are full and not presumed symmetric, else they are diagonal. c and the entries of K and D are
    cubic splines over phase. First differences of those of K and D are penalised, so that they are constant where
    nothing speaks for a change; the weight is the one that predicts left-out repetitions best (`fit`).

    Where every trial records a perturbation, along every axis, it serves as instrument. On a robot that answers force
    by motion, ẍ holds the force of the same instant, and plain least squares would put something of the robot's law in
    the place of the arm's (docs/model.md §6).

    Raises:
        LogError: no force, no phase, or fewer than two repetitions in a group.
    """

    def __init__(
        self,
        config: Config,
        log: PreparedLog,
        coupled: bool = True,
        offset_splines: int = OFFSET_SPLINES,
        impedance_splines: int = IMPEDANCE_SPLINES,
    ) -> None:
        check_repetitions(log)
        splines = (PhaseBasis(offset_splines), PhaseBasis(impedance_splines))
        #: Group → estimate.
        self.groups: Mapping[str, EnsembleEstimate] = {
            group: _estimate(config, log.axes, trials, coupled, splines)
            for group, trials in members(log).items()
        }

    def predict(self, log: PreparedLog) -> PredictedForce:
        """Force of `log`, whose own forces are not looked at.

        Raises:
            LogError: a trial has no phase, or belongs to a group that was not trained on.
        """
        return predict_trials(self.groups, log)


def check_repetitions(log: PreparedLog) -> None:
    """Refuse what an ensemble cannot be estimated from.

    Raises:
        LogError: no force, no phase, or fewer than two repetitions of known force in a group.
    """
    check_force(log)
    for group, trials in members(log).items():
        count = Repetitions.of(trials).count
        if count < 2:
            raise LogError(
                f"group '{group}': expected at least two repetitions of known force, whose differences at equal phase "
                f"tell of the arm, found {count}; record more, or leave the ensemble out"
            )


def _estimate(
    config: Config,
    axes: tuple[str, ...],
    trials: Sequence[PreparedTrial],
    coupled: bool,
    splines: tuple[PhaseBasis, PhaseBasis],
) -> EnsembleEstimate:
    samples = Repetitions.of(trials)
    # Around its middle, so that the offset does not have to be a large multiple of the stiffness.
    centre = np.zeros((len(axes), 3))
    centre[:, 0] = samples.motion[..., 0].mean(axis=0)
    motion = samples.motion - centre
    instrumented = perturbs_every_axis(trials)
    instruments = None
    if instrumented:
        caused = [perturbed_motion(trial, axes, config)[trial.observed] for trial in trials]
        instruments = np.concatenate(caused)
    everything = tuple(range(len(axes)))
    columns = tuple(everything if coupled else (a,) for a in everything)
    regressions = tuple(
        fit(
            _design(samples.phase, motion[:, list(chosen)], splines),
            samples.force[:, a],
            samples.index,
            *_penalties(motion[:, list(chosen)], splines),
            None if instruments is None else _design(samples.phase, instruments[:, list(chosen)], splines),
        )
        for a, chosen in enumerate(columns)
    )
    return EnsembleEstimate(regressions, columns, centre, splines, instrumented, samples.count)


def _design(phase: Array, motion: Array, splines: tuple[PhaseBasis, PhaseBasis]) -> Array:
    """Regressors `(n, p)`: splines of c; for each axis those of K times −x and of D times −ẋ; −ẍ of each axis."""
    offset, impedance = (basis(phase) for basis in splines)
    products = [-impedance * motion[:, [a], order] for a in range(motion.shape[1]) for order in range(2)]
    return np.hstack([offset, *products, -motion[..., 2]])


def _penalties(motion: Array, splines: tuple[PhaseBasis, PhaseBasis]) -> tuple[Array, Array]:
    """Quadratic forms [N²] of c, and of K and D, whose differences of coefficients count times rms x and rms ẋ."""
    offset, impedance = splines
    axes = motion.shape[1]
    changes = [
        np.mean(motion[:, a, order] ** 2) * impedance.penalty(1) for a in range(axes) for order in range(2)
    ]
    free = np.zeros((axes, axes))
    rest = block_diag(*changes, free)
    return (
        block_diag(SMOOTHING * offset.penalty(2), np.zeros_like(rest)),
        block_diag(np.zeros((offset.size, offset.size)), rest),
    )
