"""Kalman filter, its reverse sweep and the smoother, compiled; sequences of scalar observations, one after another.

The covariance of the state is kept as D = P − P∞, what observations have taught. Then prediction is D ← F D Fᵀ, which
is P⁻ = P∞ + F (P − P∞) Fᵀ: no process noise is formed, and steps of zero length are nothing special. Each observation
y = h·x + ε of variance r updates with g = P h, s = h·g + r, v = y − h·m:

    log p += −½ (log 2πs + v²/s),     m += g v/s,     D −= g gᵀ/s

Backwards run μ = ∂L/∂m and Λ = −∂²L/∂m² of the log likelihood L of what is still to come. With q = Λg, b = g·q,
e = (v − μ·g)/s and κ = b/s² + 1/s

    ∂L/∂y = −e,     ∂L/∂r = ½ (e² − κ),     ∂L/∂h = e m + P (e μ⁻ − κ h + q/s)
    μ⁻ = μ + e h,     Λ⁻ = Λ − (q hᵀ + h qᵀ)/s + κ h hᵀ

and then Fᵀ μ, Fᵀ Λ F. These are the smoother's, too (Bryson and Frazier 1963): m + P μ and P − P Λ P, without an inverse.

Filtered states are stored at every √n-th step only, and what lies between is computed again on the way back.

Every function takes a `plan` (starts, states, at, observed, sizes, offsets): sequence k has the samples `starts[k]` to
`starts[k + 1]` and `states[k]` states; at sample t the blocks of the trajectory begin at state `at[t, 0]`, those of the
residual at `at[t, 1]`; block l has `sizes[l]` states and lies `offsets[l]` behind that beginning. The first blocks are
the trajectories of the axes that one filter holds, then follow the residual's terms, axis by axis. And `data`
(z, h, c, y, r): z `(n, blocks)` steps; h `(n, axes, 3 axes)` observed combination of trajectories [N]; c `(axes, terms)`
SDs of residual terms [N]; y `(n, axes)` [N]; r `(axes,)` [N²].
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bayes_impedance.engines.markov.state_space import add_stationary, move, step_gradient


@njit(cache=True, nogil=True)
def stored_length(starts, states):  # type: ignore[no-untyped-def]
    """Length of what `log_likelihoods` stores of all sequences."""
    total = 0
    for k in range(states.shape[0]):
        n = starts[k + 1] - starts[k]
        total += -(-n // _interval(n)) * (states[k] + 1) * states[k]
    return total


@njit(cache=True, nogil=True)
def _interval(n):  # type: ignore[no-untyped-def]
    """Steps between stored states, √n: as many are stored as lie between two."""
    return max(1, int(np.ceil(np.sqrt(n))))


@njit(cache=True, nogil=True)
def log_likelihoods(plan, data, stored, result):  # type: ignore[no-untyped-def]
    """log p of each sequence to `result`, states to `stored` unless that is empty.

    Returns the sample at which the variance s is not positive, −1 where all are.
    """
    starts, states = plan[0], plan[1]
    axes = data[3].shape[1]
    place = 0
    for k in range(states.shape[0]):
        begin, end, size = starts[k], starts[k + 1], states[k]
        every = _interval(end - begin)
        mean, matrix = np.zeros(size), np.zeros((size, size))
        gain, innovation, variance = np.zeros((axes, size)), np.zeros(axes), np.ones(axes)
        row = _empty_row(data)
        total = 0.0
        for t in range(begin, end):
            if stored.shape[0] > 0 and (t - begin) % every == 0:
                stored[place : place + size] = mean
                stored[place + size : place + size + size * size] = matrix.ravel()
                place += size + size * size
            _predict(plan, data, t, mean, matrix)
            if plan[3][t]:
                _update(plan, data, t, mean, matrix, row, gain, innovation, variance)
                for a in range(axes):
                    if not variance[a] > 0.0:
                        return t
                    ratio = innovation[a] * innovation[a] / variance[a]
                    total -= 0.5 * (np.log(2.0 * np.pi * variance[a]) + ratio)
        result[k] = total
    return -1


@njit(cache=True, nogil=True)
def gradients(plan, data, stored, weights, results):  # type: ignore[no-untyped-def]
    """Adds ∂(Σ_k `weights[k]` log p_k) by each array of `data` to `results`, which are shaped alike."""
    starts, states = plan[0], plan[1]
    place = stored.shape[0]
    for k in range(states.shape[0] - 1, -1, -1):
        begin, end, size = starts[k], starts[k + 1], states[k]
        every = _interval(end - begin)
        record = _record(every, size, data[3].shape[1])
        adjoint, information = np.zeros(size), np.zeros((size, size))
        work, row = np.zeros((3, size)), _empty_row(data)
        for first in range(begin + (end - begin - 1) // every * every, begin - 1, -every):
            place -= size + size * size
            last = min(first + every, end)
            _replay(plan, data, first, last, stored[place : place + size + size * size], record, row)
            for t in range(last - 1, first - 1, -1):
                _reverse(
                    plan, data, t, t - first, record, adjoint, information, row, work, weights[k], results
                )


@njit(cache=True, nogil=True)
def smooth(plan, data, stored, targets, means, covariances):  # type: ignore[no-untyped-def]
    """Posterior of the states of the blocks at sample t to row `targets[t]` of `means` and `covariances`, unless −1."""
    starts, states = plan[0], plan[1]
    place = stored.shape[0]
    for k in range(states.shape[0] - 1, -1, -1):
        begin, end, size = starts[k], starts[k + 1], states[k]
        every = _interval(end - begin)
        record = _record(every, size, data[3].shape[1])
        adjoint, information = np.zeros(size), np.zeros((size, size))
        work, row = np.zeros((3, size)), _empty_row(data)
        for first in range(begin + (end - begin - 1) // every * every, begin - 1, -every):
            place -= size + size * size
            last = min(first + every, end)
            _replay(plan, data, first, last, stored[place : place + size + size * size], record, row)
            for t in range(last - 1, first - 1, -1):
                if targets[t] >= 0:
                    j = targets[t]
                    _at_target(plan, t, t - first, record, adjoint, information, means[j], covariances[j])
                _reverse(plan, data, t, t - first, record, adjoint, information, row, work, 0.0, data)


@njit(cache=True, nogil=True)
def _empty_row(data):  # type: ignore[no-untyped-def]
    """Where an observation is not zero: indices of states, and values."""
    width = data[1].shape[2] + data[2].shape[1]
    return np.zeros(width, dtype=np.int64), np.zeros(width)


@njit(cache=True, nogil=True)
def _record(every, size, axes):  # type: ignore[no-untyped-def]
    """Of each step between two stored states: predicted mean and D, then g, v and s of each axis."""
    return (
        np.zeros((every, size)),
        np.zeros((every, size, size)),
        np.zeros((every, axes, size)),
        np.zeros((every, axes)),
        np.ones((every, axes)),
    )


@njit(cache=True, nogil=True)
def _block(plan, axes, t, l):  # type: ignore[no-untyped-def]
    """First state of block l at sample t."""
    return plan[2][t, 0 if l < axes else 1] + plan[5][l]


@njit(cache=True, nogil=True)
def _predict(plan, data, t, mean, matrix):  # type: ignore[no-untyped-def]
    z, axes = data[0], data[3].shape[1]
    for l in range(z.shape[1]):
        if z[t, l] != 0.0:
            move(plan[4][l], z[t, l], _block(plan, axes, t, l), mean, matrix, True)


@njit(cache=True, nogil=True)
def _row(plan, data, t, a, row):  # type: ignore[no-untyped-def]
    """h of axis a at sample t: all trajectories, and its own residual terms."""
    h, c = data[1], data[2]
    axes, width, terms = h.shape[1], h.shape[2], c.shape[1]
    index, value = row
    for i in range(width):
        index[i], value[i] = plan[2][t, 0] + i, h[t, a, i]
    for j in range(terms):
        index[width + j] = plan[2][t, 1] + plan[5][axes + a * terms + j]
        value[width + j] = c[a, j]


@njit(cache=True, nogil=True)
def _update(plan, data, t, mean, matrix, row, gain, innovation, variance):  # type: ignore[no-untyped-def]
    y, r = data[3], data[4]
    axes, terms, size = y.shape[1], data[2].shape[1], mean.shape[0]
    index, value = row
    for a in range(axes):
        _row(plan, data, t, a, row)
        g = gain[a]
        g[:] = 0.0
        v = y[t, a]
        for i in range(index.shape[0]):
            h, known = value[i], matrix[index[i]]
            v -= h * mean[index[i]]
            for j in range(size):
                g[j] += h * known[j]
        # P∞ h, block by block: add_stationary without a dense h.
        for l in range(axes):
            j, i = index[3 * l], 3 * l
            g[j] += value[i] - value[i + 2] / 3.0
            g[j + 1] += value[i + 1] / 3.0
            g[j + 2] += value[i + 2] - value[i] / 3.0
        for l in range(terms):
            i = 3 * axes + l
            g[index[i]] += value[i]
            if plan[4][axes + a * terms + l] == 3:
                g[index[i] + 2] -= value[i] / 3.0
        s = r[a]
        for i in range(index.shape[0]):
            s += value[i] * g[index[i]]
        innovation[a], variance[a] = v, s
        for i in range(size):
            mean[i] += g[i] * (v / s)
            for j in range(i + 1):
                matrix[i, j] -= g[i] * g[j] / s
                matrix[j, i] = matrix[i, j]


@njit(cache=True, nogil=True)
def _replay(plan, data, first, last, state, record, row):  # type: ignore[no-untyped-def]
    """The filter from a stored state, every step recorded."""
    means, matrices, gains, innovations, variances = record
    size = means.shape[1]
    mean, matrix = state[:size].copy(), state[size:].copy().reshape(size, size)
    for t in range(first, last):
        i = t - first
        _predict(plan, data, t, mean, matrix)
        means[i], matrices[i] = mean, matrix
        if plan[3][t]:
            _update(plan, data, t, mean, matrix, row, gains[i], innovations[i], variances[i])


@njit(cache=True, nogil=True)
def _reverse(plan, data, t, i, record, adjoint, information, row, work, weight, results):  # type: ignore[no-untyped-def]
    """One step back: `adjoint` μ and `information` Λ from behind sample t to before the step to it."""
    axes = data[3].shape[1]
    if plan[3][t]:
        for a in range(axes - 1, -1, -1):
            _row(plan, data, t, a, row)
            _reverse_update(plan, data, t, i, a, record, adjoint, information, row, work, weight, results)
    z = data[0]
    mean, matrix = record[0][i], record[1][i]
    for l in range(z.shape[1]):
        if weight != 0.0:
            block = _block(plan, axes, t, l)
            slope = step_gradient(plan[4][l], block, mean, matrix, adjoint, information)
            results[0][t, l] = weight * slope
    for l in range(z.shape[1]):
        if z[t, l] != 0.0:
            move(plan[4][l], z[t, l], _block(plan, axes, t, l), adjoint, information, False)


@njit(cache=True, nogil=True)
def _reverse_update(  # type: ignore[no-untyped-def]
    plan, data, t, i, a, record, adjoint, information, row, work, weight, results
):  # fmt: skip
    means, matrices, gains, innovations, variances = record
    index, value = row
    size = adjoint.shape[0]
    g, v, s = gains[i, a], innovations[i, a], variances[i, a]
    q, p = work[0], work[1]
    ahead = b = 0.0
    for j in range(size):
        total = 0.0
        for l in range(size):
            total += information[j, l] * g[l]
        q[j] = total
        b += total * g[j]
        ahead += adjoint[j] * g[j]
    e = (v - ahead) / s
    kappa = (b / s + 1.0) / s
    for j in range(index.shape[0]):
        adjoint[index[j]] += e * value[j]
    if weight != 0.0:
        for j in range(size):
            p[j] = e * adjoint[j] + q[j] / s
        for j in range(index.shape[0]):
            p[index[j]] -= kappa * value[j]
        results[3][t, a] = -weight * e
        results[4][a] += 0.5 * weight * (e * e - kappa)
        _row_gradient(plan, t, i, a, record, e, p, row, work[2], weight, results)
    # Λ −= (q hᵀ + h qᵀ)/s − κ h hᵀ, by w = ½ κ h − q/s
    for j in range(size):
        p[j] = -q[j] / s
    for j in range(index.shape[0]):
        p[index[j]] += 0.5 * kappa * value[j]
    for j in range(index.shape[0]):
        k, h = index[j], value[j]
        for l in range(size):
            information[k, l] += h * p[l]
        for l in range(size):
            information[l, k] += h * p[l]


@njit(cache=True, nogil=True)
def _row_gradient(plan, t, i, a, record, e, p, row, product, weight, results):  # type: ignore[no-untyped-def]
    """∂L/∂h = e m + P p, with m and P of just before axis a was observed."""
    means, matrices, gains, innovations, variances = record
    index, _ = row
    axes, width, terms = gains.shape[1], results[1].shape[2], results[2].shape[1]
    size = p.shape[0]
    for j in range(index.shape[0]):
        total = e * means[i, index[j]]
        known = matrices[i, index[j]]
        for l in range(size):
            total += known[l] * p[l]
        product[index[j]] = total
    for earlier in range(a):
        g = gains[i, earlier]
        along = 0.0
        for l in range(size):
            along += g[l] * p[l]
        along = (e * innovations[i, earlier] - along) / variances[i, earlier]
        for j in range(index.shape[0]):
            product[index[j]] += g[index[j]] * along
    for l in range(axes):
        add_stationary(3, index[3 * l], p, product)
    for j in range(width):
        results[1][t, a, j] = weight * product[index[j]]
    for j in range(terms):
        k = index[width + j]
        total = product[k] + p[k]
        if plan[4][axes + a * terms + j] == 3:
            total -= p[k + 2] / 3.0
        results[2][a, j] += weight * total


@njit(cache=True, nogil=True)
def _at_target(plan, t, i, record, adjoint, information, mean, covariance):  # type: ignore[no-untyped-def]
    """m + P μ and P − P Λ P of the states of the blocks at sample t, block after block."""
    sizes, axes, size = plan[4], record[2].shape[1], adjoint.shape[0]
    width = mean.shape[0]
    rows, index = np.zeros((width, size)), np.zeros(width, dtype=np.int64)
    k = 0
    for l in range(sizes.shape[0]):
        block = _block(plan, axes, t, l)
        for j in range(sizes[l]):
            unit = np.zeros(size)
            unit[block + j] = 1.0
            rows[k] = record[1][i, block + j]
            add_stationary(sizes[l], block, unit, rows[k])
            index[k] = block + j
            k += 1
    weighted = np.zeros(size)
    for j in range(width):
        mean[j] = record[0][i, index[j]] + np.sum(rows[j] * adjoint)
        for l in range(size):
            weighted[l] = np.sum(information[l] * rows[j])
        for l in range(width):
            covariance[j, l] = rows[j, index[l]] - np.sum(weighted * rows[l])
