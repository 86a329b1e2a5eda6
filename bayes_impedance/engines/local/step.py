"""One step of a loop: a sample into the cells near it, or a prediction from them, in one compiled call.

To hand a kernel's numbers from Python to a compiled function takes microseconds, which a call for each cell would pay
again. Cells come as a tuple whose length is part of its type: fill it up to one length, and one version serves.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bayes_impedance.engines.compiled.covariance import variances
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.local.cell import Cell, Sums, learn, moments

Floats = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def learn_near(
    numbers: KernelNumbers,
    noise: Floats,
    novelty: float,
    cells: tuple[Cell, ...],
    sums: tuple[Sums, ...],
    count: int,
    x: Floats,
    residual: Floats,
) -> None:
    """Teach the first `count` of `cells` one sample in place; see `cell.learn`."""
    own = prior_variances(numbers, x)[:, 0]
    for i in range(count):
        learn(numbers, noise, novelty, cells[i], sums[i], x, own, residual)


@njit(cache=True, nogil=True, error_model="numpy")
def predict_near(
    numbers: KernelNumbers, cells: tuple[Cell, ...], weights: Floats, x: Floats
) -> tuple[Floats, Floats]:
    """Deviations and variances `(axes, 3)` at `x` `(axes, D)` of the mixture of the first cells, one for each weight.

    A variance is that of the mixture: the spread of the members' means is in it.
    """
    prior = prior_variances(numbers, x)
    means, variances_ = np.empty((weights.size, *prior.shape)), np.empty((weights.size, *prior.shape))
    for i in range(weights.size):
        moments(numbers, cells[i], x, prior, means[i], variances_[i])
    mean, variance = np.zeros(prior.shape), np.zeros(prior.shape)
    total = weights.sum()
    for i in range(weights.size):
        mean += weights[i] / total * means[i]
    for i in range(weights.size):
        variance += weights[i] / total * (variances_[i] + (means[i] - mean) ** 2)
    return mean, variance


@njit(cache=True, nogil=True, error_model="numpy")
def prior_variances(numbers: KernelNumbers, x: Floats) -> Floats:
    """Of force (without noise), x_d and ẋ_d at `x` `(axes, D)`, `(axes, 3)` [N², m², m²/s²]."""
    prior = np.empty((x.shape[0], 3))
    for axis in range(x.shape[0]):
        variances(numbers, axis, x[axis], prior[axis])
    return prior
