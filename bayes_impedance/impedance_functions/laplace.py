"""Laplace's approximation: the curvature of a log density at its mode, and the evidence that follows from it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Of central differences of a gradient, in units of a prior SD or of a logarithm.
STEP = 1e-3
#: Directions of less curvature than this share of the largest are not determined by anything.
LEAST_CURVATURE = 1e-12


def precision(
    gradient: Callable[[Array], Array], mode: Array, free: NDArray[np.bool_], one_sided: bool = False
) -> Array:
    """Minus the Hessian of a log density over its free coordinates, `(free, free)`, by central differences.

    `one_sided` differences take half as long, and err by `STEP` times half the third derivative: enough to find the way
    to a mode, not to say how sure one is of it.
    """
    places = np.flatnonzero(free)
    here = gradient(mode) if one_sided else None
    rows = []
    for place in places:
        step = np.zeros_like(mode)
        step[place] = STEP
        if here is None:
            rows.append((gradient(mode - step) - gradient(mode + step))[places] / (2.0 * STEP))
        else:
            rows.append((here - gradient(mode + step))[places] / STEP)
    hessian = np.array(rows).reshape(len(places), len(places))
    return np.asarray(0.5 * (hessian + hessian.T))


def covariance(hessian: Array) -> Array:
    """Inverse of a precision, with directions of no or negative curvature at that of the prior, 1."""
    values, vectors = np.linalg.eigh(hessian)
    safe = np.where(values > LEAST_CURVATURE * max(values.max(initial=0.0), 1.0), values, 1.0)
    return np.asarray((vectors / safe) @ vectors.T)


def log_determinant(hessian: Array) -> float:
    """log det of the precision of whitened variables.

    Eigenvalues below that of the prior, 1, count as 1: rounding, or a likelihood that is not concave there.
    """
    return float(np.log(np.maximum(np.linalg.eigvalsh(hessian), 1.0)).sum())
