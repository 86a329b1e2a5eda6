"""The Kalman filter, compiled: sequences of scalar observations, one after another.

The covariance of the state is kept as D = P − P∞, what observations have taught. Prediction is then D ← F D Fᵀ, which
is P⁻ = P∞ + F (P − P∞) Fᵀ: no process noise is formed, and a step of zero length is nothing special. An observation
y = h·x + ε of variance r updates with g = P h, s = h·g + r, v = y − h·m:

    log p += −½ (log 2πs + v²/s),     m += g v/s,     D −= g gᵀ/s

Every function takes a `plan` (starts, states, at, observed, sizes, offsets): sequence k has the samples `starts[k]` to
`starts[k + 1]` and `states[k]` states; at sample t the blocks of the trajectory begin at state `at[t, 0]`, those of the
residual at `at[t, 1]`; block b has `sizes[b]` states and lies `offsets[b]` behind that beginning. The first blocks are
the trajectories of the axes that one filter holds, then follow the terms of the residual, axis by axis. And it takes
`data` (z, h, c, y, r): z `(n, blocks)` steps; h `(n, axes, 3 axes)` what forces are of the trajectories' states [N]; c
`(axes, terms)` SDs of residual terms [N]; y `(n, axes)` forces [N]; r `(axes,)` their noise variances [N²].
"""

from __future__ import annotations

import numpy as np
from numba import njit

from bayes_impedance.engines.markov.state_space import move


@njit(cache=True, nogil=True, error_model="numpy")
def stored_length(starts, states):  # type: ignore[no-untyped-def]
    """Length of what `log_likelihoods` stores of all sequences."""
    total = 0
    for k in range(states.shape[0]):
        n = starts[k + 1] - starts[k]
        total += -(-n // interval(n)) * (states[k] + 1) * states[k]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def interval(n):  # type: ignore[no-untyped-def]
    """Steps from one stored state to the next, √n: then as many are stored as lie between two."""
    return max(1, int(np.ceil(np.sqrt(n))))


@njit(cache=True, nogil=True, error_model="numpy")
def log_likelihoods(plan, data, stored, result):  # type: ignore[no-untyped-def]
    """log p of each sequence to `result` [nats], and states for the way back to `stored` unless that is empty.

    Returns the sample at which the variance s is not positive, −1 where all are.
    """
    starts, states, _, observed, _, _ = plan
    axes = data[3].shape[1]
    place = 0
    for k in range(states.shape[0]):
        begin, end, size = starts[k], starts[k + 1], states[k]
        every = interval(end - begin)
        mean, matrix = np.zeros(size), np.zeros((size, size))
        gains, innovations, variances = np.zeros((1, axes, size)), np.zeros((1, axes)), np.ones((1, axes))
        row = empty_row(data)
        total = 0.0
        for t in range(begin, end):
            if stored.shape[0] > 0 and (t - begin) % every == 0:
                stored[place : place + size] = mean
                stored[place + size : place + size + size * size] = matrix.ravel()
                place += size + size * size
            predict(plan, data, t, mean, matrix)
            if observed[t]:
                _update(plan, data, t, 0, mean, matrix, row, gains, innovations, variances)
                for a in range(axes):
                    v, s = innovations[0, a], variances[0, a]
                    if not s > 0.0:
                        return t
                    total -= 0.5 * (np.log(2.0 * np.pi * s) + v * v / s)
        result[k] = total
    return -1


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def replay(plan, data, first, last, state, record, row):  # type: ignore[no-untyped-def]
    """The filter from a stored state, every step from `first` to `last` recorded."""
    means, matrices, gains, innovations, variances = record
    size = means.shape[1]
    mean, matrix = state[:size].copy(), state[size:].copy().reshape(size, size)
    for t in range(first, last):
        predict(plan, data, t, mean, matrix)
        for i in range(size):
            means[t - first, i] = mean[i]
            for j in range(size):
                matrices[t - first, i, j] = matrix[i, j]
        if plan[3][t]:
            _update(plan, data, t, t - first, mean, matrix, row, gains, innovations, variances)


@njit(cache=True, nogil=True, error_model="numpy")
def empty_record(every, size, axes):  # type: ignore[no-untyped-def]
    """Of each step between two stored states: predicted mean and D, then g, v and s of each axis."""
    return (
        np.zeros((every, size)),
        np.zeros((every, size, size)),
        np.zeros((every, axes, size)),
        np.zeros((every, axes)),
        np.ones((every, axes)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def empty_row(data):  # type: ignore[no-untyped-def]
    """Where an observation is not zero: indices of states, and values."""
    width = data[1].shape[2] + data[2].shape[1]
    return np.zeros(width, dtype=np.int64), np.zeros(width)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def fill_row(plan, data, t, a, row):  # type: ignore[no-untyped-def]
    """h of axis a at sample t: the trajectories of all axes, and its own residual terms."""
    at, offsets = plan[2], plan[5]
    h, c = data[1], data[2]
    axes, width, terms = h.shape[1], h.shape[2], c.shape[1]
    index, value = row
    for i in range(width):
        index[i], value[i] = at[t, 0] + i, h[t, a, i]
    for j in range(terms):
        index[width + j] = at[t, 1] + offsets[axes + a * terms + j]
        value[width + j] = c[a, j]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def first_state(plan, axes, t, block):  # type: ignore[no-untyped-def]
    """Index of the first state of a block at sample t."""
    return plan[2][t, 0 if block < axes else 1] + plan[5][block]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def predict(plan, data, t, mean, matrix):  # type: ignore[no-untyped-def]
    """Over the step to sample t."""
    z, axes = data[0], data[3].shape[1]
    for block in range(z.shape[1]):
        if z[t, block] != 0.0:
            move(plan[4][block], z[t, block], first_state(plan, axes, t, block), mean, matrix, True)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _update(plan, data, t, i, mean, matrix, row, gains, innovations, variances):  # type: ignore[no-untyped-def]
    """By the forces of sample t, with g, v and s to entry `i`."""
    y, r = data[3], data[4]
    size = mean.shape[0]
    index, value = row
    for a in range(y.shape[1]):
        fill_row(plan, data, t, a, row)
        _gain(plan, data, i, a, matrix, row, gains)
        v, s = y[t, a], r[a]
        for j in range(index.shape[0]):
            v -= value[j] * mean[index[j]]
            s += value[j] * gains[i, a, index[j]]
        innovations[i, a], variances[i, a] = v, s
        inverse = 1.0 / s
        for j in range(size):
            scaled = gains[i, a, j] * inverse
            mean[j] += scaled * v
            for k in range(j + 1):
                matrix[j, k] -= scaled * gains[i, a, k]
                matrix[k, j] = matrix[j, k]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _gain(plan, data, i, a, matrix, row, gains):  # type: ignore[no-untyped-def]
    """g = P h = D h + P∞ h, where h is not zero at the first state only of a residual term."""
    sizes = plan[4]
    axes, terms, size = data[2].shape[0], data[2].shape[1], matrix.shape[0]
    index, value = row
    for j in range(size):
        gains[i, a, j] = 0.0
    for j in range(index.shape[0]):
        for k in range(size):
            gains[i, a, k] += value[j] * matrix[index[j], k]
    for c in range(axes):
        j, k = 3 * c, index[3 * c]
        gains[i, a, k] += value[j] - value[j + 2] / 3.0
        gains[i, a, k + 1] += value[j + 1] / 3.0
        gains[i, a, k + 2] += value[j + 2] - value[j] / 3.0
    for term in range(terms):
        j, k = 3 * axes + term, index[3 * axes + term]
        gains[i, a, k] += value[j]
        if sizes[axes + a * terms + term] == 3:
            gains[i, a, k + 2] -= value[j] / 3.0
