"""Covariances of force and desired trajectory between one sample and many, compiled (docs/model.md §2, §3).

The oracle is `kernels.impedance`, which computes the same with tensors. Here a call costs microseconds, so that a
control loop can make it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bayes_impedance.engines.compiled.numbers import (
    NONE,
    RATIONAL_QUADRATIC,
    SQUARED_EXPONENTIAL,
    KernelNumbers,
)

Floats = NDArray[np.float64]

#: Where the series of eᵏ − 1 to k⁴ errs by less than rounding does.
SMALL = 1e-3


@njit(cache=True, nogil=True, inline="always")
def _bessel(order: int, z: float) -> float:
    """z^ν K_ν(z) e^z √(2/π), ν = `order` + ½; see `kernels.stationary`."""
    if order == -2:
        return (1.0 + z) / z**3
    if order == -1:
        return 1.0 / z
    if order == 0:
        return 1.0
    if order == 1:
        return 1.0 + z
    if order == 2:
        return 3.0 + z * (3.0 + z)
    if order == 3:
        return 15.0 + z * (15.0 + z * (6.0 + z))
    return 105.0 + z * (105.0 + z * (45.0 + z * (10.0 + z)))


@njit(cache=True, nogil=True, inline="always")
def _norm(degree: int) -> float:
    """Value of the Bessel polynomial of that degree at zero: 1, 1, 3, 15, 105."""
    return _bessel(degree, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _value(profile: int, shape: float, s: float) -> float:
    """κ(s) of unit variance, of a profile that is no squared exponential."""
    if profile == RATIONAL_QUADRATIC:
        return math.exp(-shape * math.log1p(s / shape))
    z = math.sqrt(max((4.0 * profile + 2.0) * s, (4.0 * profile + 2.0) * 1e-24))
    return math.exp(-z) * _bessel(profile, z) / _norm(profile)


@njit(cache=True, nogil=True, error_model="numpy")
def _derivatives(profile: int, shape: float, s: Floats, k: Floats) -> None:
    """κ and its first four derivatives with respect to s `(n,)`, into `k` `(5, n)`."""
    if profile == SQUARED_EXPONENTIAL:
        for i in range(s.size):
            k[0, i] = math.exp(-s[i])
        for i in range(s.size):
            k[2, i] = k[4, i] = k[0, i]
            k[1, i] = k[3, i] = -k[0, i]
        return
    if profile == RATIONAL_QUADRATIC:
        for i in range(s.size):
            step = -1.0 / (1.0 + s[i] / shape)
            k[0, i] = math.exp(-shape * math.log1p(s[i] / shape))
            for n in range(4):
                k[n + 1, i] = k[n, i] * step * (1.0 + n / shape)
        return
    twice_nu = 2.0 * profile + 1.0
    for i in range(s.size):
        z = math.sqrt(2.0 * twice_nu * max(s[i], 1e-24))
        factor = math.exp(-z) / _norm(profile)
        for n in range(5):
            k[n, i] = factor * _bessel(profile - n, z)
            factor *= -twice_nu


@njit(cache=True, nogil=True, error_model="numpy")
def _forms(numbers: KernelNumbers, axis: int, inputs: Floats, x: Floats, forms: Floats) -> None:
    """s and s10, s01, s11, s20, s02, s21, s12, s22 between `inputs` `(D, n)` and `x` `(D,)`, into `forms` `(9, n)`."""
    forms[:] = 0.0
    n = inputs.shape[1]
    s, s10, s01, s11, s20, s02, s21, s12, s22 = (
        forms[0], forms[1], forms[2], forms[3], forms[4], forms[5], forms[6], forms[7], forms[8]
    )  # fmt: skip
    for c in range(numbers.theta.size):
        p = numbers.precision[axis, c]
        theta1, theta2 = inputs[numbers.theta[c]], x[numbers.theta[c]]
        a1, a2 = inputs[numbers.velocity[c]], x[numbers.velocity[c]]
        for i in range(n):
            r = theta1[i] - theta2
            s[i] += 0.5 * p * r * r
            s10[i] += p * a1[i] * r
            s01[i] -= p * a2 * r
            s11[i] -= p * a1[i] * a2
            s20[i] += p * a1[i] * a1[i]
            s02[i] += p * a2 * a2
        if numbers.acceleration.size:
            b1, b2 = inputs[numbers.acceleration[c]], x[numbers.acceleration[c]]
            for i in range(n):
                r = theta1[i] - theta2
                s20[i] += p * b1[i] * r
                s02[i] -= p * b2 * r
                s21[i] -= p * b1[i] * a2
                s12[i] -= p * a1[i] * b2
                s22[i] -= p * b1[i] * b2


@njit(cache=True, nogil=True, error_model="numpy")
def _tables(numbers: KernelNumbers, axis: int, inputs: Floats, x: Floats, table: Floats) -> None:
    """∂_tⁱ ∂_t'ʲ k_xd between `inputs` `(D, n)` and `x`, into `table` `(9, n)`, whose row 3 i + j it is."""
    n = inputs.shape[1]
    forms, k = np.empty((9, n)), np.empty((5, n))
    _forms(numbers, axis, inputs, x, forms)
    _derivatives(numbers.profile, numbers.shape[axis], forms[0], k)
    v = numbers.variance[axis]
    for i in range(n):
        s10, s01, s11, s20, s02 = forms[1, i], forms[2, i], forms[3, i], forms[4, i], forms[5, i]
        s21, s12, s22 = forms[6, i], forms[7, i], forms[8, i]
        k0, k1, k2, k3, k4 = v * k[0, i], v * k[1, i], v * k[2, i], v * k[3, i], v * k[4, i]
        table[0, i] = k0
        table[1, i] = k1 * s01
        table[2, i] = k2 * s01 * s01 + k1 * s02
        table[3, i] = k1 * s10
        table[4, i] = k2 * s10 * s01 + k1 * s11
        table[5, i] = k3 * s01 * s01 * s10 + k2 * (2.0 * s01 * s11 + s02 * s10) + k1 * s12
        table[6, i] = k2 * s10 * s10 + k1 * s20
        table[7, i] = k3 * s10 * s10 * s01 + k2 * (2.0 * s10 * s11 + s20 * s01) + k1 * s21
        third = s10 * s10 * s02 + 4.0 * s10 * s01 * s11 + s20 * s01 * s01
        second = 2.0 * (s10 * s12 + s01 * s21 + s11 * s11) + s20 * s02
        table[8, i] = k4 * s10 * s10 * s01 * s01 + k3 * third + k2 * second + k1 * s22
    column = numbers.labels[0]
    if column != NONE:
        for i in range(n):
            if inputs[column, i] != x[column]:
                table[:, i] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _part(numbers: KernelNumbers, axis: int, part: int, inputs: Floats, x: Floats, out: Floats) -> None:
    """Covariance over ξ number `part` between `inputs` and `x`, into `out` `(n,)`."""
    out[:] = 0.0
    for c in range(numbers.part_columns.shape[1]):
        column = numbers.part_columns[part, c]
        if column != NONE:
            p, values, centre = numbers.part_precision[axis, part, c], inputs[column], x[column]
            for i in range(out.size):
                r = values[i] - centre
                out[i] += p * r * r
    profile, variance = numbers.part_profile[part], numbers.part_variance[axis, part]
    if profile == SQUARED_EXPONENTIAL:
        for i in range(out.size):
            out[i] = variance * math.exp(-out[i])
    else:
        for i in range(out.size):
            out[i] = variance * _value(profile, numbers.part_shape[axis, part], out[i])


@njit(cache=True, nogil=True, error_model="numpy")
def impedance_covariances(
    numbers: KernelNumbers, axis: int, order: int, inputs: Floats, x: Floats, out: Floats
) -> None:
    """Cov[w, w'] of stiffness, damping or mass, number `order`, of `inputs` `(D, n)` with `x`, into `out` `(n,)`."""
    squared = numbers.expectation[axis, order] ** 2
    if numbers.part_columns[order, 0] == NONE:
        variance = numbers.part_variance[axis, order]
        out[:] = variance if numbers.gaussian[order] else squared * math.expm1(variance)
        return
    _part(numbers, axis, order, inputs, x, out)
    if numbers.gaussian[order]:
        return
    for i in range(out.size):
        k = out[i]
        # eᵏ − 1; below the bound its series is exact to rounding
        small = k * (1.0 + k * (0.5 + k * (1.0 / 6.0 + k / 24.0)))
        out[i] = squared * (small if k < SMALL else math.exp(k) - 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _combined(
    numbers: KernelNumbers, axis: int, inputs: Floats, x: Floats, table: Floats, out: Floats
) -> None:
    """What `covariances` gives, from the derivatives of k_xd in `table` `(9, n)`."""
    orders = numbers.expectation.shape[1]
    expectation = numbers.expectation[axis]
    own = np.empty(out.shape[1])
    out[:] = 0.0
    for i in range(orders):
        for row in range(1, out.shape[0]):
            for t in range(own.size):
                out[row, t] += expectation[i] * table[3 * i + row - 1, t]
        for j in range(orders):
            weight = expectation[i] * expectation[j]
            for t in range(own.size):
                out[0, t] += weight * table[3 * i + j, t]
    for j in range(orders):
        impedance_covariances(numbers, axis, j, inputs, x, own)
        for t in range(own.size):
            out[0, t] += own[t] * table[4 * j, t]
        if numbers.error.size:
            errors, error = inputs[numbers.error[j]], x[numbers.error[j]]
            for t in range(own.size):
                out[0, t] += own[t] * errors[t] * error
    column = numbers.labels[1]
    for part in range(orders, numbers.part_profile.size):
        _part(numbers, axis, part, inputs, x, own)
        for t in range(own.size):
            if column == NONE or inputs[column, t] == x[column]:
                out[0, t] += own[t]


@njit(cache=True, nogil=True, error_model="numpy")
def covariances(numbers: KernelNumbers, axis: int, inputs: Floats, x: Floats, out: Floats) -> None:
    """Cov[u(inputs[:, i]), ·] with force, x_d, ẋ_d at `x` `(D,)`, for `inputs` `(D, n)`, into `out` `(1 to 3, n)`.

    Force is without noise.
    """
    table = np.empty((9, inputs.shape[1]))
    _tables(numbers, axis, inputs, x, table)
    _combined(numbers, axis, inputs, x, table, out)


@njit(cache=True, nogil=True, error_model="numpy")
def variances(numbers: KernelNumbers, axis: int, x: Floats, out: Floats) -> None:
    """Prior variances of force (without noise) [N²], x_d [m²] and ẋ_d [m²/s²] at `x` `(D,)`, into `out` `(3,)`."""
    # Views, as the inputs of a cell are: what is compiled for these serves here, too.
    own = x.copy().reshape(x.size, 1)[:, :1]
    force, table = np.empty((1, 1))[:, :1], np.empty((9, 1))
    _tables(numbers, axis, own, x, table)
    _combined(numbers, axis, own, x, table, force)
    out[0], out[1], out[2] = force[0, 0], table[0, 0], table[4, 0]
