"""Penalised least squares, plain or in two stages; what is chosen is chosen by leaving out one repetition at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Weights of a penalty that are tried, relative to one sample.
WEIGHTS = tuple(10.0**exponent for exponent in range(-8, 5))
#: Relative to the mean square of a regressor: keeps what never moved at zero, and changes nothing else.
RIDGE = 1e-10


@dataclass(frozen=True)
class Regression:
    """Coefficients b of u = X b + ε, `(p,)`.

    `left_out` `(repetitions, p)`: the same without each repetition in turn; `covariance` `(p, p)`: that of b for
    independent residuals of variance `residual_variance`, the mean square of what is left of each repetition when the
    others predict it; `weight`: that of the penalty.
    """

    coefficients: Array
    left_out: Array
    covariance: Array
    residual_variance: float
    weight: float

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
    fixed: Array,
    chosen: Array,
    instruments: Array | None = None,
) -> Regression:
    """Regression of `force` `(n,)` on `design` X `(n, p)` with penalties P_0 and P, `fixed` and `chosen` `(p, p)`.

        b = (X̂ᵀX̂ + n P_0 + n λ P)⁻¹ X̂ᵀu,    X̂ = Z (ZᵀZ)⁻¹ ZᵀX,

    with `instruments` Z `(n, q)`, else X̂ = X. The weight λ is that of `WEIGHTS` with which u − X̂ b of a repetition is
    least when all else, both stages, is estimated from the others. X̂ and not X, for in a closed loop the best
    prediction of u from X is not the one by the arm.
    """
    parts = [repetition == label for label in range(repetition.max() + 1)]
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

    def left_out(weight: float) -> Array:
        precision = gram + n * (fixed + weight * chosen) + _ridge(gram)
        return np.asarray(np.linalg.solve(precision, moment[..., None])[..., 0])

    def loss(weight: float) -> float:
        b = left_out(weight)
        fitted = np.einsum("gp,gpq,gq->g", b, own_gram, b)
        return float((square - 2.0 * (b * own_moment).sum(-1) + fitted).sum())

    weight = min(WEIGHTS, key=loss)
    others = left_out(weight)
    residual = force - np.einsum("np,np->n", design, others[repetition])
    variance = float(np.mean(residual**2))
    _, gram_of_all, moment_of_all = moments(zz.sum(0), zx.sum(0), zu.sum(0))
    precision: Array = gram_of_all + n * (fixed + weight * chosen) + _ridge(gram_of_all)
    coefficients: Array = np.asarray(np.linalg.solve(precision, moment_of_all))
    covariance: Array = np.asarray(variance * np.linalg.inv(precision))
    return Regression(coefficients, others, covariance, variance, weight)


def _ridge(gram: Array) -> Array:
    """Diagonal matrices that make Gram matrices `(…, p, p)` regular where a regressor is zero throughout."""
    diagonal = np.diagonal(gram, axis1=-2, axis2=-1)
    # A regressor that is zero needs a number all the same.
    floor = diagonal.max(axis=-1, keepdims=True)
    return np.asarray(RIDGE * np.where(diagonal > 0, diagonal, floor)[..., None] * np.eye(gram.shape[-1]))
