"""Penalised least squares, plain or in two stages; what is chosen is chosen by leaving out one repetition at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Weights of a penalty that are tried, relative to one sample.
WEIGHTS = tuple(10.0**exponent for exponent in range(-8, 5, 2))
#: Relative to the mean square of a regressor: keeps what never moved at zero, and changes nothing else.
RIDGE = 1e-10


@dataclass(frozen=True)
class Regression:
    """Coefficients b of u = X b + ε, `(p,)`.

    `left_out` `(repetitions, p)`: the same without each repetition in turn; `covariance` `(p, p)`: that of b for
    independent residuals of variance `residual_variance`, the mean square of what is left of each repetition when the
    others predict it; `weights`: those of the penalties.
    """

    coefficients: Array
    left_out: Array
    covariance: Array
    residual_variance: float
    weights: tuple[float, ...]

    @property
    def jackknife(self) -> Array:
        """Covariance of b, `(p, p)`, from its scatter when repetitions are left out: residuals of one may correlate."""
        count = len(self.left_out)
        deviation = self.left_out - self.left_out.mean(axis=0)
        return np.asarray((count - 1) / count * deviation.T @ deviation)


def fit(
    design: Array,
    force: Array,
    repetition: NDArray[np.int64],
    penalties: Sequence[Array],
    instruments: Array | None = None,
) -> Regression:
    """Regression of `force` `(n,)` on `design` X `(n, p)` in the metric of `penalties` P_j `(p, p)`.

        b = (X̂ᵀX̂ + n Σ_j λ_j P_j)⁻¹ X̂ᵀu,    X̂ = Z (ZᵀZ)⁻¹ ZᵀX,

    with `instruments` Z `(n, q)`, else X̂ = X. The weights λ_j are those of `WEIGHTS` with which u − X̂ b of a repetition
    is least when all else, both stages, is estimated from the others. X̂ and not X, for in a closed loop the best
    prediction of u from X is not the one by the arm.
    """
    labels = np.arange(repetition.max() + 1)
    parts = [repetition == label for label in labels]
    z = design if instruments is None else instruments
    zz, zx = (np.stack([z[part].T @ other[part] for part in parts]) for other in (z, design))
    zu = np.stack([z[part].T @ force[part] for part in parts])
    square = np.array([force[part] @ force[part] for part in parts])

    def moments(zz: Array, zx: Array, zu: Array) -> tuple[Array, Array, Array]:
        """First stage (ZᵀZ)⁻¹ZᵀX, X̂ᵀX̂ and X̂ᵀu."""
        if instruments is None:
            return np.broadcast_to(np.eye(design.shape[1]), zz.shape), zz, zu
        first = np.linalg.solve(zz + _ridge(zz), zx)
        return np.asarray(first), first.mT @ zz @ first, (first.mT @ zu[..., None])[..., 0]

    first, gram, moment = moments(zz.sum(0) - zz, zx.sum(0) - zx, zu.sum(0) - zu)
    # The repetition that is left out, seen through the first stage of the others.
    own_gram, own_moment = first.mT @ zz @ first, (first.mT @ zu[..., None])[..., 0]
    n = len(force)

    def left_out(weights: tuple[float, ...]) -> Array:
        penalty = n * np.einsum("j,jpq->pq", weights, np.stack(penalties))
        return np.asarray(np.linalg.solve(gram + penalty + _ridge(gram), moment[..., None])[..., 0])

    def loss(weights: tuple[float, ...]) -> float:
        b = left_out(weights)
        fitted = np.einsum("gp,gpq,gq->g", b, own_gram, b)
        return float((square - 2.0 * (b * own_moment).sum(-1) + fitted).sum())

    weights = min(product(WEIGHTS, repeat=len(penalties)), key=loss)
    _, gram_all, moment_all = moments(zz.sum(0), zx.sum(0), zu.sum(0))
    precision = gram_all + n * np.einsum("j,jpq->pq", weights, np.stack(penalties)) + _ridge(gram_all)
    others = left_out(weights)
    residual = force - np.einsum("np,np->n", design, others[repetition])
    variance = float(np.mean(residual**2))
    return Regression(
        np.linalg.solve(precision, moment_all), others, variance * np.linalg.inv(precision), variance, weights
    )


def _ridge(gram: Array) -> Array:
    """Diagonal matrices that make Gram matrices `(…, p, p)` regular where a regressor is zero throughout."""
    diagonal = np.diagonal(gram, axis1=-2, axis2=-1)
    # A regressor that is zero needs a number all the same.
    floor = diagonal.max(axis=-1, keepdims=True)
    return np.asarray(RIDGE * np.where(diagonal > 0, diagonal, floor)[..., None] * np.eye(gram.shape[-1]))
