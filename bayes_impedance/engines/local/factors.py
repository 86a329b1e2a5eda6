"""Triangular factors that grow by a row and learn by a rotation, compiled; each costs O(B²).

The factor of what never changes is a lower triangular L, A = L Lᵀ, that of what learns an upper one U, A = UᵀU, so that
every inner loop runs along a row. Of each the first `count` rows and columns are in use.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def solve(lower: Floats, count: int, b: Floats) -> None:
    """b ← L⁻¹ b in place."""
    for k in range(count):
        value = b[k]
        for i in range(k):
            value -= lower[k, i] * b[i]
        b[k] = value / lower[k, k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def solve_transposed(upper: Floats, count: int, b: Floats) -> None:
    """b ← U⁻ᵀ b in place."""
    for k in range(count):
        value = b[k] / upper[k, k]
        b[k] = value
        for i in range(k + 1, count):
            b[i] -= value * upper[k, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def solve_three(lower: Floats, count: int, b: Floats) -> None:
    """`solve` for three right-hand sides, the rows of `b` `(3, B)`: the factor is read once, in half of the time."""
    one, two, three = b[0], b[1], b[2]
    for k in range(count):
        first, second, third = one[k], two[k], three[k]
        for i in range(k):
            first -= lower[k, i] * one[i]
            second -= lower[k, i] * two[i]
            third -= lower[k, i] * three[i]
        one[k], two[k], three[k] = first / lower[k, k], second / lower[k, k], third / lower[k, k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def solve_transposed_three(upper: Floats, count: int, b: Floats) -> None:
    """`solve_transposed` for three right-hand sides, the rows of `b` `(3, B)`."""
    one, two, three = b[0], b[1], b[2]
    for k in range(count):
        first, second, third = one[k] / upper[k, k], two[k] / upper[k, k], three[k] / upper[k, k]
        one[k], two[k], three[k] = first, second, third
        for i in range(k + 1, count):
            one[i] -= first * upper[k, i]
            two[i] -= second * upper[k, i]
            three[i] -= third * upper[k, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def rotate(upper: Floats, count: int, d: Floats, x: Floats, y: float) -> None:
    """One observation y = x·w + N(0, 1): UᵀU gains x xᵀ and Uᵀd gains x y; `x` is used up.

    Givens rotations of the rows of [U d] and [x y]: nothing is subtracted, so that rounding does not pile up.
    """
    for k in range(count):
        r = math.sqrt(upper[k, k] * upper[k, k] + x[k] * x[k])
        c, s = upper[k, k] / r, x[k] / r
        upper[k, k] = r
        for i in range(k + 1, count):
            value = upper[k, i]
            upper[k, i] = c * value + s * x[i]
            x[i] = c * x[i] - s * value
        value = d[k]
        d[k] = c * value + s * y
        y = c * y - s * value


@njit(cache=True, nogil=True, error_model="numpy")
def factorise(matrix: Floats, count: int, upper: Floats) -> None:
    """`upper` ← U with UᵀU = I + `matrix`, in the first `count` rows and columns."""
    for k in range(count):
        upper[k, k] = 1.0 + matrix[k, k]
        for i in range(k + 1, count):
            upper[k, i] = matrix[k, i]
    for k in range(count):
        pivot = math.sqrt(upper[k, k])
        upper[k, k] = pivot
        for i in range(k + 1, count):
            upper[k, i] /= pivot
        for j in range(k + 1, count):
            value = upper[k, j]
            for i in range(j, count):
                upper[j, i] -= value * upper[k, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def squared_norm(b: Floats, count: int) -> float:
    """Σ b_k²."""
    total = 0.0
    for k in range(count):
        total += b[k] * b[k]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def inner(a: Floats, b: Floats, count: int) -> float:
    """Σ a_k b_k."""
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total
