"""The way back of the Kalman filter, compiled: gradients of the log likelihood, and the smoother.

For the log likelihood L of what is still to come, μ = ∂L/∂m and Λ = −∂²L/∂m² are kept. With q = Λg, b = g·q,
e = (v − μ·g)/s and κ = b/s² + 1/s an observation (see `recursions`) gives

    ∂L/∂y = −e,     ∂L/∂r = ½ (e² − κ),     ∂L/∂h = e m + P (e μ⁻ − κ h + q/s)
    μ⁻ = μ + e h,     Λ⁻ = Λ − (q hᵀ + h qᵀ)/s + κ h hᵀ

and a step takes them to Fᵀ μ and Fᵀ Λ F. The smoother needs no more, and no inverse: m + P μ and P − P Λ P, from the
predicted m and P (Bryson and Frazier 1963).

The filter has stored every √n-th state; what lies between is computed again, so that memory grows with √n.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bayes_impedance.engines.markov.recursions import (
    empty_record,
    empty_row,
    fill_row,
    first_state,
    interval,
    replay,
)
from bayes_impedance.engines.markov.state_space import add_stationary, move, step_gradient


@njit(cache=True, nogil=True, error_model="numpy")
def gradients(plan, data, stored, weights, results):  # type: ignore[no-untyped-def]
    """∂(Σ_k `weights[k]` log p_k) by each array of `data` to `results`, which are zeros of the same shapes."""
    starts, states = plan[0], plan[1]
    place = stored.shape[0]
    for k in range(states.shape[0] - 1, -1, -1):
        begin, end, size = starts[k], starts[k + 1], states[k]
        every = interval(end - begin)
        record = empty_record(every, size, data[3].shape[1])
        adjoint, information = np.zeros(size), np.zeros((size, size))
        work, row = (np.zeros(size), np.zeros(size), np.zeros(size)), empty_row(data)
        for first in range(begin + (end - begin - 1) // every * every, begin - 1, -every):
            last = min(first + every, end)
            place -= size + size * size
            replay(plan, data, first, last, stored[place : place + size + size * size], record, row)
            for t in range(last - 1, first - 1, -1):
                _back(plan, data, t, t - first, record, adjoint, information, row, work, weights[k], results)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth(plan, data, stored, targets, means, covariances):  # type: ignore[no-untyped-def]
    """Posterior of the states of the blocks at sample t to row `targets[t]` of the results, unless that is −1."""
    starts, states = plan[0], plan[1]
    place = stored.shape[0]
    for k in range(states.shape[0] - 1, -1, -1):
        begin, end, size = starts[k], starts[k + 1], states[k]
        every = interval(end - begin)
        record = empty_record(every, size, data[3].shape[1])
        adjoint, information = np.zeros(size), np.zeros((size, size))
        work, row = (np.zeros(size), np.zeros(size), np.zeros(size)), empty_row(data)
        for first in range(begin + (end - begin - 1) // every * every, begin - 1, -every):
            last = min(first + every, end)
            place -= size + size * size
            replay(plan, data, first, last, stored[place : place + size + size * size], record, row)
            for t in range(last - 1, first - 1, -1):
                if targets[t] >= 0:
                    to = (means[targets[t]], covariances[targets[t]])
                    _smoothed(plan, t, t - first, record, adjoint, information, to)
                _back(plan, data, t, t - first, record, adjoint, information, row, work, 0.0, data)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _back(plan, data, t, i, record, adjoint, information, row, work, weight, results):  # type: ignore[no-untyped-def]
    """From behind sample t to before the step to it; gradients only where `weight` is not zero."""
    axes = data[3].shape[1]
    if plan[3][t]:
        for a in range(axes - 1, -1, -1):
            fill_row(plan, data, t, a, row)
            e, kappa = _back_update(i, a, record, adjoint, information, row, work[0])
            if weight != 0.0:
                _force_gradients(plan, t, i, a, record, adjoint, e, kappa, row, work, weight, results)
            _add_information(i, a, record, information, kappa, row, work)
    if weight != 0.0:
        _step_gradients(plan, data, t, i, record, adjoint, information, weight, results)
    for block in range(data[0].shape[1]):
        if data[0][t, block] != 0.0:
            first = first_state(plan, axes, t, block)
            move(plan[4][block], data[0][t, block], first, adjoint, information, False)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _step_gradients(plan, data, t, i, record, adjoint, information, weight, results):  # type: ignore[no-untyped-def]
    for block in range(data[0].shape[1]):
        first = first_state(plan, data[3].shape[1], t, block)
        slope = step_gradient(plan[4][block], first, i, record[0], record[1], adjoint, information)
        results[0][t, block] = weight * slope


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _back_update(i, a, record, adjoint, information, row, q):  # type: ignore[no-untyped-def]
    """`adjoint` to before the observation of axis a, and q; returns e and κ."""
    gains, v, s = record[2], record[3][i, a], record[4][i, a]
    index, value = row
    size = adjoint.shape[0]
    ahead = b = 0.0
    for j in range(size):
        total = 0.0
        for k in range(size):
            total += information[j, k] * gains[i, a, k]
        q[j] = total
        b += total * gains[i, a, j]
        ahead += adjoint[j] * gains[i, a, j]
    e = (v - ahead) / s
    for j in range(index.shape[0]):
        adjoint[index[j]] += e * value[j]
    return e, (b / s + 1.0) / s


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _add_information(i, a, record, information, kappa, row, work):  # type: ignore[no-untyped-def]
    """Λ⁻ = Λ + h pᵀ + p hᵀ with p = ½ κ h − q/s."""
    s = record[4][i, a]
    q, p, _ = work
    index, value = row
    size = information.shape[0]
    for j in range(size):
        p[j] = -q[j] / s
    for j in range(index.shape[0]):
        p[index[j]] += 0.5 * kappa * value[j]
    for j in range(index.shape[0]):
        for k in range(size):
            information[index[j], k] += value[j] * p[k]
        for k in range(size):
            information[k, index[j]] += value[j] * p[k]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _force_gradients(plan, t, i, a, record, adjoint, e, kappa, row, work, weight, results):  # type: ignore[no-untyped-def]
    """By y, r, h and c of axis a at sample t."""
    s = record[4][i, a]
    q, p, product = work
    index, value = row
    for j in range(adjoint.shape[0]):
        p[j] = e * adjoint[j] + q[j] / s
    for j in range(index.shape[0]):
        p[index[j]] -= kappa * value[j]
    results[3][t, a] = -weight * e
    results[4][a] += 0.5 * weight * (e * e - kappa)
    _row_gradient(plan, t, i, a, record, e, p, row, product, weight, results)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _row_gradient(plan, t, i, a, record, e, p, row, product, weight, results):  # type: ignore[no-untyped-def]
    """∂L/∂h = e m + P p, with m and P of just before axis a was observed."""
    means, matrices, gains, innovations, variances = record
    index = row[0]
    axes, width, terms = gains.shape[1], results[1].shape[2], results[2].shape[1]
    size = p.shape[0]
    for j in range(index.shape[0]):
        total = e * means[i, index[j]]
        for k in range(size):
            total += matrices[i, index[j], k] * p[k]
        product[index[j]] = total
    # The record is of before all axes: m lacks g v/s and P lacks −g gᵀ/s of those observed earlier.
    for earlier in range(a):
        along = e * innovations[i, earlier]
        for k in range(size):
            along -= gains[i, earlier, k] * p[k]
        along /= variances[i, earlier]
        for j in range(index.shape[0]):
            product[index[j]] += gains[i, earlier, index[j]] * along
    for c in range(axes):
        add_stationary(3, index[3 * c], p, product)
    for j in range(width):
        results[1][t, a, j] = weight * product[index[j]]
    for term in range(terms):
        k = index[width + term]
        total = product[k] + p[k]
        if plan[4][axes + a * terms + term] == 3:
            total -= p[k + 2] / 3.0
        results[2][a, term] += weight * total


@njit(cache=True, nogil=True, error_model="numpy")
def _smoothed(plan, t, i, record, adjoint, information, to):  # type: ignore[no-untyped-def]
    """m + P μ and P − P Λ P of the states of the blocks at sample t, block after block."""
    sizes, axes, size = plan[4], record[2].shape[1], adjoint.shape[0]
    mean, covariance = to
    width = mean.shape[0]
    # Rows of P: those of P∞ are its product with unit vectors.
    rows, index = np.zeros((width, size)), np.zeros(width, dtype=np.int64)
    count = 0
    for block in range(sizes.shape[0]):
        first = first_state(plan, axes, t, block)
        for j in range(first, first + sizes[block]):
            unit = np.zeros(size)
            unit[j] = 1.0
            rows[count] = record[1][i, j]
            add_stationary(sizes[block], first, unit, rows[count])
            index[count] = j
            count += 1
    weighted = np.zeros(size)
    for j in range(width):
        mean[j] = record[0][i, index[j]] + np.sum(rows[j] * adjoint)
        for k in range(size):
            weighted[k] = np.sum(information[k] * rows[j])
        for k in range(width):
            covariance[j, k] = rows[j, index[k]] - np.sum(weighted * rows[k])
