"""The mode of impedance functions and hyperparameters, and the Laplace approximation about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.impedance_functions import laplace
from bayes_impedance.impedance_functions.density import Density
from bayes_impedance.impedance_functions.evidence import log_variation_prior, occam, update_variation
from bayes_impedance.impedance_functions.tilted import TiltedDensity

Array = NDArray[np.float64]

#: Turns of mode and evidence, and the change of a hyperparameter's logarithm below which they end.
TURNS, SETTLED = 10, 0.05
#: Iterations before the curvature is looked at, in whose coordinates a climb is several times as short.
FIRST = 150
#: What a step costs that leads where the likelihood overflows [nats].
OUTSIDE = 1e6
#: Pairs of steps that L-BFGS keeps: the curvature of weights ranges over five decades.
MEMORY = 30
RELATIVE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Mode:
    """A maximum of a `Density`: `point` `(size,)` and the covariance `(free, free)` of its free coordinates about it.

    `log_evidence` of the forces at the hyperparameters, the functions integrated out by Laplace's method, and
    `log_posterior`, which has the hyperpriors' log density in it, without constants [nats].
    """

    point: Array
    log_evidence: float
    log_posterior: float
    covariance: Array
    iterations: int
    evaluations: int
    outcome: str


def find_mode(
    density: Density,
    start: Array,
    max_iterations: int,
    gradient_tolerance: float,
    progress: Callable[[int, float], None] | None = None,
) -> Mode:
    """Climb from `start`, and learn how functions vary, in turns; the model keeps the hyperparameters found.

    Raises:
        NotPositiveDefiniteError: the likelihood is not finite somewhere on the way.
    """

    def vary(point: Array, precision: Array) -> tuple[Array, float]:
        return update_variation(density, point, precision)

    point, precision, climb = take_turns(
        density, start, max_iterations, gradient_tolerance, progress, vary, TURNS, SETTLED, rough=True
    )
    return _mode(density, point, precision, climb)


def take_turns(
    density: TiltedDensity,
    start: Array,
    max_iterations: int,
    gradient_tolerance: float,
    progress: Callable[[int, float], None] | None,
    vary: Callable[[Array, Array], tuple[Array, float]],
    turns: int,
    settled: float,
    rough: bool,
) -> tuple[Array, Array, Climb]:
    """Hyperparameters of greatest evidence and the mode of the weights there, with the precision of both.

    Mode and evidence take turns; `vary` changes what the density does not hold, and says where the mode then is and how
    far that moved. After at most `turns`, or where a turn moves no hyperparameter by `settled`, they end. `rough`:
    whether curvature by one-sided differences, in half the time, does for `vary` and the search; that which comes back
    is exact.

    Raises:
        NotPositiveDefiniteError: the likelihood is not finite somewhere on the way.
    """
    climb = Climb(density, gradient_tolerance, progress)
    point = climb(start, None, min(FIRST, max_iterations))
    for _ in range(turns):
        before = point[density.weight_count :]
        precision = _precision(density, point, rough)
        density.tilt, density.anchor = occam(density, point, precision), None
        point, moved = vary(point, precision)
        density.anchor = point
        point = climb(point, laplace.covariance(precision), max_iterations)
        if max(moved, np.max(np.abs(point[density.weight_count :] - before), initial=0.0)) < settled:
            break
    else:
        climb.outcome = f"STOP: {turns} TURNS OF MODE AND EVIDENCE HAVE NOT SETTLED"
    return point, _precision(density, point), climb


def find_weights(
    density: Density, start: Array, scale: Array | None, max_iterations: int, gradient_tolerance: float
) -> Mode:
    """Climb from `start` over the weights alone, at its hyperparameters.

    `scale`: a covariance `(weights, weights)` that is known from other forces, and tells in which steps to climb.

    Raises:
        NotPositiveDefiniteError: the likelihood is not finite somewhere on the way.
    """
    density.free[density.weight_count :] = False
    climb = Climb(density, gradient_tolerance, None)
    point = start
    if scale is None:
        point = climb(start, None, min(FIRST, max_iterations))
        scale = laplace.covariance(_precision(density, point, one_sided=True))
    point = climb(point, scale, max_iterations)
    return _mode(density, point, _precision(density, point), climb)


def _mode(density: Density, point: Array, precision: Array, climb: Climb) -> Mode:
    joint, _ = density.joint(point)
    count = density.weight_count
    marginal = joint - 0.5 * laplace.log_determinant(precision[:count, :count])
    with torch.no_grad():
        beside, variation = float(density.log_hyperpriors()), float(log_variation_prior(density))
    return Mode(
        point=point,
        log_evidence=marginal - beside,
        log_posterior=marginal + variation,
        covariance=laplace.covariance(precision),
        iterations=climb.iterations,
        evaluations=climb.evaluations,
        outcome=climb.outcome,
    )


def _precision(density: TiltedDensity, point: Array, one_sided: bool = False) -> Array:
    # Not of the tilted density: the cost of steps away from the anchor is no knowledge.
    return laplace.precision(lambda at: density.joint(at)[1], point, density.free, one_sided)


class Climb:
    """L-BFGS, in coordinates in which the curvature that is known is one."""

    def __init__(
        self, density: TiltedDensity, gradient_tolerance: float, progress: Callable[[int, float], None] | None
    ) -> None:
        self.density, self.gradient_tolerance, self.progress = density, gradient_tolerance, progress
        self.iterations = self.evaluations = 0
        self.outcome = ""

    def __call__(self, start: Array, scale: Array | None, max_iterations: int) -> Array:
        """The maximum near `start`; `scale` is a covariance `(free, free)` that tells in which steps to climb."""
        places = np.flatnonzero(self.density.free)
        root: Array = np.asarray(np.eye(len(places)) if scale is None else np.linalg.cholesky(scale))
        best = -np.inf

        def at(step: Array) -> Array:
            point = start.copy()
            point[places] += root @ step
            return point

        def objective(step: Array) -> tuple[float, Array]:
            nonlocal best
            self.evaluations += 1
            try:
                value, gradient = self.density(at(step))
            except NotPositiveDefiniteError:
                if not np.isfinite(best):
                    raise
                return OUTSIDE - best, np.zeros_like(step)
            best = max(best, value)
            return -value, -root.T @ gradient[places]

        def count(_: Array) -> None:
            self.iterations += 1
            if self.progress is not None:
                self.progress(self.iterations, best)

        found = minimize(  # type: ignore[call-overload] # the stubs want a tuple of one length
            objective,
            np.zeros(len(places)),
            jac=True,
            method="L-BFGS-B",
            callback=count,
            options={
                "maxiter": max_iterations,
                "maxcor": MEMORY,
                "ftol": RELATIVE_TOLERANCE,
                "gtol": self.gradient_tolerance,
            },
        )
        self.outcome = str(found.message)
        return at(found.x)
