"""Draws of Matérn processes along their input, compiled.

With s the time that is left of a step of length z, the noise enters a state of d entries as φ(s) = e^{−s} T p(s),
p = (1, s, s²/2), so that the covariance of what a step adds is

    P∞ − F P∞ Fᵀ = q T D H D Tᵀ,    D = diag(z^{k + ½} / k!),    H_kl = ∫₀¹ t^{k + l} e^{−2zt} dt,    k, l < d

Its entries shrink with powers z to z⁵, and their difference as it stands loses all digits, while H is as regular as
Hilbert's matrix of so few rows, whatever z.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from bayes_impedance.engines.markov.state_space import transition_2, transition_3

#: Steps 2z from which moments are formed upwards; below, the highest comes from its series.
LONG = 8.0


@njit(cache=True, nogil=True, error_model="numpy")
def simulate(size, first, rates, steps, fresh, order, states):  # type: ignore[no-untyped-def]
    """Processes of `size` states from `first` on in `states` `(n, axes, width)`, where standard normal numbers stand.

    Sample `order[t]` is `steps[t]` beyond the one before it, unless `fresh[t]`: there another realisation begins.
    z is the step times `rates[a]`.
    """
    for a in range(rates.shape[0]):
        state = np.zeros(size)
        for t in range(order.shape[0]):
            own = states[order[t], a, first : first + size]
            z = rates[a] * steps[t]
            if fresh[t]:
                _begin(size, own, state)
            elif z != 0.0:
                _step(size, z, own, state)
            for j in range(size):
                own[j] = state[j]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _begin(size, standard, state):  # type: ignore[no-untyped-def]
    """`state` of covariance P∞."""
    for j in range(size):
        state[j] = standard[j]
    if size == 3:
        state[1] = standard[1] * math.sqrt(1.0 / 3.0)
        state[2] = standard[2] * math.sqrt(8.0 / 9.0) - standard[0] / 3.0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _step(size, z, standard, state):  # type: ignore[no-untyped-def]
    """`state` ← F `state` + noise."""
    if size == 1:
        variance = -np.expm1(-2.0 * z)
        state[0] = np.exp(-z) * state[0] + np.sqrt(variance) * standard[0]
        return
    n0, n1, n2 = _noise(size, z, standard)
    x, y = state[0], state[1]
    if size == 2:
        a, b, c, d = transition_2(z)
        # q = 4, φ = e^{−s} (s, 1 − s)
        state[0], state[1] = a * x + b * y + 2.0 * n1, c * x + d * y + 2.0 * (n0 - n1)
        return
    w = state[2]
    (a, b, c), (d, e, f), (g, h, k) = transition_3(z)
    # q = 16/3, φ = e^{−s} (s²/2, s − s²/2, 1 − 2s + s²/2)
    root = math.sqrt(16.0 / 3.0)
    state[0] = a * x + b * y + c * w + root * n2
    state[1] = d * x + e * y + f * w + root * (n1 - n2)
    state[2] = g * x + h * y + k * w + root * (n0 - 2.0 * n1 + n2)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _noise(size, z, standard):  # type: ignore[no-untyped-def]
    """∫ e^{−s} p(s) dW over a step, by Cholesky's factor of H; its third entry is 0 where `size` is 2."""
    m0, m1, m2, m3, m4 = moments(z)
    l00 = np.sqrt(m0)
    l10, l20 = m1 / l00, m2 / l00
    l11 = np.sqrt(m2 - l10 * l10)
    root = np.sqrt(z)
    first, second = l00 * standard[0], l10 * standard[0] + l11 * standard[1]
    if size == 2:
        return root * first, root * z * second, 0.0
    l21 = (m3 - l20 * l10) / l11
    l22 = np.sqrt(m4 - l20 * l20 - l21 * l21)
    third = l20 * standard[0] + l21 * standard[1] + l22 * standard[2]
    return root * first, root * z * second, 0.5 * root * z * z * third


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def moments(z):  # type: ignore[no-untyped-def]
    """∫₀¹ t^m e^{−2zt} dt for m = 0 … 4, to rounding at any z ≥ 0."""
    a = 2.0 * z
    e = np.exp(-a)
    if a > LONG:
        m0 = (1.0 - e) / a
        m1 = (m0 - e) / a
        m2 = (2.0 * m1 - e) / a
        m3 = (3.0 * m2 - e) / a
        return m0, m1, m2, m3, (4.0 * m3 - e) / a
    # e^{−a} Σ_j a^j / (5 · 6 ⋯ (5 + j)): no term is negative, neither here nor on the way down.
    term, total, j = 0.2, 0.2, 5.0
    while term > 1e-17 * total:
        j += 1.0
        term *= a / j
        total += term
    m4 = e * total
    m3 = (a * m4 + e) / 4.0
    m2 = (a * m3 + e) / 3.0
    m1 = (a * m2 + e) / 2.0
    return a * m1 + e, m1, m2, m3, m4
