"""The way back of the Kalman filter, compiled: gradients of the log likelihood, and the smoother.

For the log likelihood L of what is still to come, μ = ∂L/∂m and Λ = −∂²L/∂m² are kept. With q = Λg, b = g·q,
e = (v − μ·g)/s and κ = b/s² + 1/s an observation (see `log_likelihoods`) gives

    ∂L/∂y = −e,     ∂L/∂r = ½ (e² − κ),     ∂L/∂h = e m + P (e μ⁻ − κ h + q/s)
    μ⁻ = μ + e h,     Λ⁻ = Λ − (q hᵀ + h qᵀ)/s + κ h hᵀ

and a step takes them to Fᵀ μ and Fᵀ Λ F. The smoother needs no more, and no inverse: m + P μ and P − P Λ P, from the
predicted m and P (Bryson and Frazier 1963).

The filter has stored every √n-th state; what lies between is computed again, so that memory grows with √n.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from bayes_impedance.engines.markov.recursions import (
    Floats,
    empty_record,
    empty_row,
    fill_row,
    first_state,
    interval,
    replay,
)
from bayes_impedance.engines.markov.state_space import add_stationary, move, step_gradient


class Work(NamedTuple):
    """Vectors that are made once: q, a combination p of the states, and P p."""

    q: Floats
    p: Floats
    product: Floats


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(plan, data, stored, weights, results, targets, means, covariances):  # type: ignore[no-untyped-def]
    """Gradients, posteriors, or both.

    ∂(Σ_k `weights[k]` log p_k) by each array of `data` to `results`, zeros of the same shapes, unless weights are zero;
    the posterior of the states of the blocks at sample t to row `targets[t]` of `means` and `covariances`, unless −1;
    means alone where covariances are `(m, 0, 0)`.
    """
    place = stored.shape[0]
    for k in range(plan.states.shape[0] - 1, -1, -1):
        begin, end, size = plan.starts[k], plan.starts[k + 1], plan.states[k]
        every = interval(end - begin)
        record, row = empty_record(every, size, data.y.shape[1]), empty_row(data)
        adjoint, information = np.zeros(size), np.zeros((size, size))
        work = Work(np.zeros(size), np.zeros(size), np.zeros(size))
        for first in range(begin + (end - begin - 1) // every * every, begin - 1, -every):
            last = min(first + every, end)
            place -= size + size * size
            replay(plan, data, first, last, stored[place : place + size + size * size], record, row)
            for t in range(last - 1, first - 1, -1):
                j = targets[t] if targets.shape[0] > 0 else -1
                if j >= 0:
                    _smoothed(plan, t, t - first, record, adjoint, information, means[j], covariances[j])
                _back(plan, data, t, t - first, record, adjoint, information, row, work, weights[k], results)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _back(plan, data, t, i, record, adjoint, information, row, work, weight, results):  # type: ignore[no-untyped-def]
    """From behind sample t to before the step to it; gradients only where `weight` is not zero."""
    axes = data.y.shape[1]
    if plan.observed[t]:
        for a in range(axes - 1, -1, -1):
            fill_row(plan, data, t, a, row)
            e, kappa = _back_update(i, a, record, adjoint, information, row, work)
            if weight != 0.0:
                _force_gradients(plan, t, i, a, record, adjoint, e, kappa, row, work, weight, results)
            _add_information(i, a, record, information, kappa, row, work)
    for block in range(data.z.shape[1]):
        if weight != 0.0:
            first = first_state(plan, axes, t, block)
            slope = step_gradient(
                plan.sizes[block], first, i, record.mean, record.matrix, adjoint, information
            )
            results.z[t, block] = weight * slope
    for block in range(data.z.shape[1]):
        z = data.z[t, block]
        if z != 0.0:
            first = first_state(plan, axes, t, block)
            move(plan.sizes[block], z, first, adjoint, information, False)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _back_update(i, a, record, adjoint, information, row, work):  # type: ignore[no-untyped-def]
    """`adjoint` to before the observation of axis a, and q; returns e and κ."""
    size = adjoint.shape[0]
    ahead = b = 0.0
    for j in range(size):
        total = 0.0
        for k in range(size):
            total += information[j, k] * record.g[i, a, k]
        work.q[j] = total
        b += total * record.g[i, a, j]
        ahead += adjoint[j] * record.g[i, a, j]
    s = record.s[i, a]
    e = (record.v[i, a] - ahead) / s
    for j in range(row.state.shape[0]):
        adjoint[row.state[j]] += e * row.value[j]
    return e, (b / s + 1.0) / s


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _add_information(i, a, record, information, kappa, row, work):  # type: ignore[no-untyped-def]
    """Λ⁻ = Λ + h pᵀ + p hᵀ with p = ½ κ h − q/s."""
    size = information.shape[0]
    inverse = 1.0 / record.s[i, a]
    for j in range(size):
        work.p[j] = -work.q[j] * inverse
    for j in range(row.state.shape[0]):
        work.p[row.state[j]] += 0.5 * kappa * row.value[j]
    for j in range(row.state.shape[0]):
        for k in range(size):
            information[row.state[j], k] += row.value[j] * work.p[k]
        for k in range(size):
            information[k, row.state[j]] += row.value[j] * work.p[k]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _force_gradients(plan, t, i, a, record, adjoint, e, kappa, row, work, weight, results):  # type: ignore[no-untyped-def]
    """By y, r, h and c of axis a at sample t: ∂L/∂h = e m + P p with p = e μ⁻ − κ h + q/s."""
    axes, width, terms = record.g.shape[1], results.h.shape[2], results.c.shape[1]
    inverse = 1.0 / record.s[i, a]
    for j in range(adjoint.shape[0]):
        work.p[j] = e * adjoint[j] + work.q[j] * inverse
    for j in range(row.state.shape[0]):
        work.p[row.state[j]] -= kappa * row.value[j]
    results.y[t, a] = -weight * e
    results.r[a] += 0.5 * weight * (e * e - kappa)
    _moments(i, a, record, e, row, work)
    for c in range(axes):
        add_stationary(3, row.state[3 * c], work.p, work.product)
    for j in range(width):
        results.h[t, a, j] = weight * work.product[row.state[j]]
    for term in range(terms):
        k = row.state[width + term]
        total = work.product[k] + work.p[k]
        if plan.sizes[axes + a * terms + term] == 3:
            total -= work.p[k + 2] / 3.0
        results.c[a, term] += weight * total


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _moments(i, a, record, e, row, work):  # type: ignore[no-untyped-def]
    """e m + D p, with m and D of just before axis a was observed."""
    size = work.p.shape[0]
    for j in range(row.state.shape[0]):
        total = e * record.mean[i, row.state[j]]
        for k in range(size):
            total += record.matrix[i, row.state[j], k] * work.p[k]
        work.product[row.state[j]] = total
    # The record is of before all axes: m lacks g v/s, and D lacks −g gᵀ/s, of those observed earlier.
    for earlier in range(a):
        along = e * record.v[i, earlier]
        for k in range(size):
            along -= record.g[i, earlier, k] * work.p[k]
        along /= record.s[i, earlier]
        for j in range(row.state.shape[0]):
            work.product[row.state[j]] += record.g[i, earlier, row.state[j]] * along


@njit(cache=True, nogil=True, error_model="numpy")
def _smoothed(plan, t, i, record, adjoint, information, mean, covariance):  # type: ignore[no-untyped-def]
    """m + P μ and P − P Λ P (unless that is empty) of the states of the blocks at sample t, block after block."""
    axes, size, width = record.g.shape[1], adjoint.shape[0], mean.shape[0]
    # Rows of P: those of P∞ are its product with unit vectors.
    rows, index = np.zeros((width, size)), np.zeros(width, dtype=np.int64)
    count = 0
    for block in range(plan.sizes.shape[0]):
        first = first_state(plan, axes, t, block)
        for j in range(first, first + plan.sizes[block]):
            unit = np.zeros(size)
            unit[j] = 1.0
            rows[count] = record.matrix[i, j]
            add_stationary(plan.sizes[block], first, unit, rows[count])
            index[count] = j
            count += 1
    weighted = np.zeros(size)
    for j in range(width):
        mean[j] = record.mean[i, index[j]] + np.sum(rows[j] * adjoint)
    if covariance.shape[0] == 0:
        return
    for j in range(width):
        for k in range(size):
            weighted[k] = np.sum(information[k] * rows[j])
        for k in range(width):
            covariance[j, k] = rows[j, index[k]] - np.sum(weighted * rows[k])
