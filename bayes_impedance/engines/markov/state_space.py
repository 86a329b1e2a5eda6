"""Matérn processes as linear stochastic differential equations, in states without dimension.

With λ = √(2ν)/ℓ the state of a process of SD σ is (f, f'/λ, f''/λ²)/σ, as many of them as ν + ½. Over a step z = λΔ ≥ 0
it moves by F(z) = e^{Az}, and its stationary covariance P∞ is a constant (Hartikainen and Särkkä 2010, §3).

All is compiled into its callers. Numba's cache sees only that their own files are unchanged: after an edit here, delete
the caches (`*.nbi`) beside this file.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

#: √(2ν) of a Matérn process of so many states.
RATE = {1: 1.0, 2: math.sqrt(3.0), 3: math.sqrt(5.0)}


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def transition_2(z):  # type: ignore[no-untyped-def]
    """F(z) for ν = 3/2, row by row."""
    e = np.exp(-z)
    return e * (1.0 + z), e * z, -e * z, e * (1.0 - z)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def transition_3(z):  # type: ignore[no-untyped-def]
    """F(z) for ν = 5/2, row by row."""
    e = np.exp(-z)
    half = 0.5 * z * z
    return (
        (e * (1.0 + z + half), e * (z + z * z), e * half),
        (-e * half, e * (1.0 + z - z * z), e * (z - half)),
        (e * (half - z), e * (z * z - 3.0 * z), e * (1.0 - 2.0 * z + half)),
    )


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def move(size, z, i, mean, matrix, forward):  # type: ignore[no-untyped-def]
    """`mean` ← F mean, `matrix` ← F matrix Fᵀ for the block of `size` states at `i`; with Fᵀ for F unless `forward`.

    Only rows and columns of the block change; the columns mirror the rows, so that the matrix stays symmetric.
    """
    if size == 3:
        _move_3(z, i, mean, matrix, forward)
    elif size == 2:
        _move_2(z, i, mean, matrix, forward)
    else:
        e = np.exp(-z)
        mean[i] *= e
        for j in range(mean.shape[0]):
            matrix[i, j] *= e
        matrix[i, i] *= e
    for j in range(mean.shape[0]):
        if j < i or j >= i + size:
            for k in range(i, i + size):
                matrix[j, k] = matrix[k, j]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _move_3(z, i, mean, matrix, forward):  # type: ignore[no-untyped-def]
    (a, b, c), (d, e, f), (g, h, k) = transition_3(z)
    if not forward:
        b, d, c, g, f, h = d, b, g, c, h, f
    x, y, w = mean[i], mean[i + 1], mean[i + 2]
    mean[i], mean[i + 1] = a * x + b * y + c * w, d * x + e * y + f * w
    mean[i + 2] = g * x + h * y + k * w
    for j in range(mean.shape[0]):
        x, y, w = matrix[i, j], matrix[i + 1, j], matrix[i + 2, j]
        matrix[i, j] = a * x + b * y + c * w
        matrix[i + 1, j] = d * x + e * y + f * w
        matrix[i + 2, j] = g * x + h * y + k * w
    x, y, w = matrix[i, i], matrix[i, i + 1], matrix[i, i + 2]
    matrix[i, i] = a * x + b * y + c * w
    matrix[i, i + 1] = d * x + e * y + f * w
    matrix[i, i + 2] = g * x + h * y + k * w
    x, y, w = matrix[i + 1, i], matrix[i + 1, i + 1], matrix[i + 1, i + 2]
    matrix[i + 1, i + 1] = d * x + e * y + f * w
    matrix[i + 1, i + 2] = g * x + h * y + k * w
    x, y, w = matrix[i + 2, i], matrix[i + 2, i + 1], matrix[i + 2, i + 2]
    matrix[i + 2, i + 2] = g * x + h * y + k * w
    matrix[i + 1, i], matrix[i + 2, i] = matrix[i, i + 1], matrix[i, i + 2]
    matrix[i + 2, i + 1] = matrix[i + 1, i + 2]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _move_2(z, i, mean, matrix, forward):  # type: ignore[no-untyped-def]
    a, b, c, d = transition_2(z)
    if not forward:
        b, c = c, b
    x, y = mean[i], mean[i + 1]
    mean[i], mean[i + 1] = a * x + b * y, c * x + d * y
    for j in range(mean.shape[0]):
        x, y = matrix[i, j], matrix[i + 1, j]
        matrix[i, j], matrix[i + 1, j] = a * x + b * y, c * x + d * y
    x, y = matrix[i, i], matrix[i, i + 1]
    matrix[i, i], matrix[i, i + 1] = a * x + b * y, c * x + d * y
    x, y = matrix[i + 1, i], matrix[i + 1, i + 1]
    matrix[i + 1, i], matrix[i + 1, i + 1] = matrix[i, i + 1], c * x + d * y


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def add_stationary(size, i, vector, product):  # type: ignore[no-untyped-def]
    """`product` += P∞ `vector`, for the block of `size` states at `i`."""
    if size == 3:
        product[i] += vector[i] - vector[i + 2] / 3.0
        product[i + 1] += vector[i + 1] / 3.0
        product[i + 2] += vector[i + 2] - vector[i] / 3.0
    else:
        for j in range(i, i + size):
            product[j] += vector[j]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def step_gradient(size, i, t, means, matrices, adjoint, information):  # type: ignore[no-untyped-def]
    """∂L/∂z of the step of the block at `i`, by dF/dz = A F and what is behind the step.

    `means[t]` m, `matrices[t]` D; `adjoint` μ = ∂L/∂m and `information` Λ = −∂²L/∂m², so that ∂L/∂D = ½ (μμᵀ − Λ):
    Σ_i μ_i (A m)_i + Σ_ij (μ_i μ_j − Λ_ij) (A D)_ij over the rows i of the block.
    """
    states = adjoint.shape[0]
    if size == 3:
        a, b, c = adjoint[i], adjoint[i + 1], adjoint[i + 2]
        x, y, w = means[t, i], means[t, i + 1], means[t, i + 2]
        total = a * y + b * w - c * (x + 3.0 * (y + w))
        for j in range(states):
            x, y, w = matrices[t, i, j], matrices[t, i + 1, j], matrices[t, i + 2, j]
            m = adjoint[j]
            total += (a * m - information[i, j]) * y + (b * m - information[i + 1, j]) * w
            total -= (c * m - information[i + 2, j]) * (x + 3.0 * (y + w))
    elif size == 2:
        a, b = adjoint[i], adjoint[i + 1]
        x, y = means[t, i], means[t, i + 1]
        total = a * y - b * (x + 2.0 * y)
        for j in range(states):
            x, y = matrices[t, i, j], matrices[t, i + 1, j]
            m = adjoint[j]
            total += (a * m - information[i, j]) * y - (b * m - information[i + 1, j]) * (x + 2.0 * y)
    else:
        a = adjoint[i]
        total = -a * means[t, i]
        for j in range(states):
            total -= (a * adjoint[j] - information[i, j]) * matrices[t, i, j]
    return total
