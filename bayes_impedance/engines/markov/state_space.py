"""Matérn processes as linear stochastic differential equations, in states without dimension.

With λ = √(2ν)/ℓ the state of a process of SD σ is (f, f'/λ, f''/λ²)/σ, as many of them as ν + ½. Over a step z = λΔ ≥ 0
it moves by F(z) = e^{Az}, and its stationary covariance P∞ is a constant (Hartikainen and Särkkä 2010, §3).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: √(2ν) of a Matérn process of so many states.
RATE = {1: 1.0, 2: math.sqrt(3.0), 3: math.sqrt(5.0)}


@njit(cache=True, nogil=True, inline="always")
def transition_1(z):  # type: ignore[no-untyped-def]
    """F(z) for ν = 1/2."""
    return np.exp(-z)


@njit(cache=True, nogil=True, inline="always")
def transition_2(z):  # type: ignore[no-untyped-def]
    """F(z) for ν = 3/2, row by row."""
    e = np.exp(-z)
    return e * (1.0 + z), e * z, -e * z, e * (1.0 - z)


@njit(cache=True, nogil=True, inline="always")
def transition_3(z):  # type: ignore[no-untyped-def]
    """F(z) for ν = 5/2, row by row."""
    e = np.exp(-z)
    half = 0.5 * z * z
    return (
        (e * (1.0 + z + half), e * (z + z * z), e * half),
        (-e * half, e * (1.0 + z - z * z), e * (z - half)),
        (e * (half - z), e * (z * z - 3.0 * z), e * (1.0 - 2.0 * z + half)),
    )


@njit(cache=True, nogil=True)
def move(size, z, i, mean, matrix, forward):  # type: ignore[no-untyped-def]
    """`mean` ← F mean, `matrix` ← F matrix Fᵀ for the block of `size` states at `i`; with Fᵀ for F unless `forward`.

    Rows and columns of other blocks are multiplied once and mirrored, so that the matrix stays symmetric.
    """
    states = mean.shape[0]
    if size == 3:
        f = transition_3(z)
        (a, b, c), (d, e, g), (h, k, m) = f
        if not forward:
            b, d, c, h, g, k = d, b, h, c, k, g
        x, y, w = mean[i], mean[i + 1], mean[i + 2]
        mean[i] = a * x + b * y + c * w
        mean[i + 1] = d * x + e * y + g * w
        mean[i + 2] = h * x + k * y + m * w
        for j in range(states):
            x, y, w = matrix[i, j], matrix[i + 1, j], matrix[i + 2, j]
            matrix[i, j] = a * x + b * y + c * w
            matrix[i + 1, j] = d * x + e * y + g * w
            matrix[i + 2, j] = h * x + k * y + m * w
        x, y, w = matrix[i, i], matrix[i, i + 1], matrix[i, i + 2]
        matrix[i, i] = a * x + b * y + c * w
        matrix[i, i + 1] = d * x + e * y + g * w
        matrix[i, i + 2] = h * x + k * y + m * w
        x, y, w = matrix[i + 1, i], matrix[i + 1, i + 1], matrix[i + 1, i + 2]
        matrix[i + 1, i + 1] = d * x + e * y + g * w
        matrix[i + 1, i + 2] = h * x + k * y + m * w
        x, y, w = matrix[i + 2, i], matrix[i + 2, i + 1], matrix[i + 2, i + 2]
        matrix[i + 2, i + 2] = h * x + k * y + m * w
        matrix[i + 1, i] = matrix[i, i + 1]
        matrix[i + 2, i] = matrix[i, i + 2]
        matrix[i + 2, i + 1] = matrix[i + 1, i + 2]
    elif size == 2:
        a, b, d, e = transition_2(z)
        if not forward:
            b, d = d, b
        x, y = mean[i], mean[i + 1]
        mean[i], mean[i + 1] = a * x + b * y, d * x + e * y
        for j in range(states):
            x, y = matrix[i, j], matrix[i + 1, j]
            matrix[i, j], matrix[i + 1, j] = a * x + b * y, d * x + e * y
        x, y = matrix[i, i], matrix[i, i + 1]
        matrix[i, i], matrix[i, i + 1] = a * x + b * y, d * x + e * y
        x, y = matrix[i + 1, i], matrix[i + 1, i + 1]
        matrix[i + 1, i], matrix[i + 1, i + 1] = matrix[i, i + 1], d * x + e * y
    else:
        a = transition_1(z)
        mean[i] *= a
        for j in range(states):
            matrix[i, j] *= a
        matrix[i, i] *= a
    if size < states:
        for j in range(states):
            if j < i or j >= i + size:
                for n in range(size):
                    matrix[j, i + n] = matrix[i + n, j]


@njit(cache=True, nogil=True)
def add_stationary(size, i, vector, product):  # type: ignore[no-untyped-def]
    """`product` += P∞ `vector`, for the block of `size` states at `i`."""
    if size == 3:
        product[i] += vector[i] - vector[i + 2] / 3.0
        product[i + 1] += vector[i + 1] / 3.0
        product[i + 2] += vector[i + 2] - vector[i] / 3.0
    else:
        for n in range(size):
            product[i + n] += vector[i + n]


@njit(cache=True, nogil=True)
def step_gradient(size, i, mean, matrix, adjoint, information):  # type: ignore[no-untyped-def]
    """∂L/∂z of F(z) on the block at `i`, tr(…) with dF/dz = A F, from what is after the step.

    `mean` m, `matrix` D; `adjoint` μ = ∂L/∂m and `information` Λ = −∂²L/∂m², so ∂L/∂D = ½(μμᵀ − Λ):
    μᵀ A (m + D μ) − Σ_ij Λ_ij (A D)_ij over the rows i of the block.
    """
    states = mean.shape[0]
    total = 0.0
    if size == 3:
        a, b, c = adjoint[i], adjoint[i + 1], adjoint[i + 2]
        x, y, w = mean[i], mean[i + 1], mean[i + 2]
        total = a * y + b * w - c * (x + 3.0 * (y + w))
        for j in range(states):
            x, y, w = matrix[i, j], matrix[i + 1, j], matrix[i + 2, j]
            m = adjoint[j]
            total += (a * m - information[i, j]) * y + (b * m - information[i + 1, j]) * w
            total -= (c * m - information[i + 2, j]) * (x + 3.0 * (y + w))
    elif size == 2:
        a, b = adjoint[i], adjoint[i + 1]
        x, y = mean[i], mean[i + 1]
        total = a * y - b * (x + 2.0 * y)
        for j in range(states):
            x, y = matrix[i, j], matrix[i + 1, j]
            m = adjoint[j]
            total += (a * m - information[i, j]) * y - (b * m - information[i + 1, j]) * (x + 2.0 * y)
    else:
        a = adjoint[i]
        total = -a * mean[i]
        for j in range(states):
            total -= (a * adjoint[j] - information[i, j]) * matrix[i, j]
    return total
