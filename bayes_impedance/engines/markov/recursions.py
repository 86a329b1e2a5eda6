"""The Kalman filter, compiled: sequences of scalar observations, one after another.

The covariance of the state is kept as D = P − P∞, what observations have taught. Prediction is then D ← F D Fᵀ, which
is P⁻ = P∞ + F (P − P∞) Fᵀ: no process noise is formed, and a step of zero length is nothing special. An observation
y = h·x + ε of variance r updates with g = P h, s = h·g + r, v = y − h·m:

    log p += −½ (log 2πs + v²/s),     m += g v/s,     D −= g gᵀ/s
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bayes_impedance.engines.markov.state_space import move

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


class Plan(NamedTuple):
    """Which states each sample moves and sees.

    Sequence k has the samples `starts[k]` to `starts[k + 1]` and `states[k]` states. At sample t the blocks of the
    trajectory begin at state `at[t, 0]`, those of the residual at `at[t, 1]`; block b has `sizes[b]` states and lies
    `offsets[b]` behind that beginning. The first blocks are the trajectories of the axes that one filter holds, then
    follow the terms of the residual, axis by axis. Where `observed` is False the forces of a sample are not known.
    """

    starts: Integers
    states: Integers
    at: Integers
    observed: NDArray[np.bool_]
    sizes: Integers
    offsets: Integers


class Data(NamedTuple):
    """What a filter is given: steps z = λΔ `(n, blocks)`; h, what forces are of the trajectories' states, `(n, axes,
    3 axes)` [N]; c, SDs of residual terms, `(axes, terms)` [N]; forces y `(n, axes)` [N], of noise variance r `(axes,)`
    [N²].
    """  # fmt: skip

    z: Floats
    h: Floats
    c: Floats
    y: Floats
    r: Floats


class Record(NamedTuple):
    """Of each step between two stored states: predicted mean and D, then g, v and s of each axis."""

    mean: Floats
    matrix: Floats
    g: Floats
    v: Floats
    s: Floats


class Row(NamedTuple):
    """Where an observation is not zero: indices of states, and values."""

    state: Integers
    value: Floats


@njit(cache=True, nogil=True, error_model="numpy")
def stored_length(plan):  # type: ignore[no-untyped-def]
    """Length of what `log_likelihoods` stores of all sequences."""
    total = 0
    for k in range(plan.states.shape[0]):
        n = plan.starts[k + 1] - plan.starts[k]
        total += -(-n // interval(n)) * (plan.states[k] + 1) * plan.states[k]
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
    axes = data.y.shape[1]
    place = 0
    for k in range(plan.states.shape[0]):
        begin, end, size = plan.starts[k], plan.starts[k + 1], plan.states[k]
        every = interval(end - begin)
        mean, matrix = np.zeros(size), np.zeros((size, size))
        record, row = empty_record(1, size, axes), empty_row(data)
        total = 0.0
        for t in range(begin, end):
            if stored.shape[0] > 0 and (t - begin) % every == 0:
                stored[place : place + size] = mean
                stored[place + size : place + size + size * size] = matrix.ravel()
                place += size + size * size
            _predict(plan, data, t, mean, matrix)
            if plan.observed[t]:
                _update(plan, data, t, 0, mean, matrix, row, record)
                for a in range(axes):
                    v, s = record.v[0, a], record.s[0, a]
                    if not s > 0.0:
                        return t
                    total -= 0.5 * (np.log(2.0 * np.pi * s) + v * v / s)
        result[k] = total
    return -1


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def replay(plan, data, first, last, state, record, row):  # type: ignore[no-untyped-def]
    """The filter from a stored state, every step from `first` to `last` recorded."""
    size = record.mean.shape[1]
    mean, matrix = state[:size].copy(), state[size:].copy().reshape(size, size)
    for t in range(first, last):
        _predict(plan, data, t, mean, matrix)
        for i in range(size):
            record.mean[t - first, i] = mean[i]
            for j in range(size):
                record.matrix[t - first, i, j] = matrix[i, j]
        if plan.observed[t]:
            _update(plan, data, t, t - first, mean, matrix, row, record)


@njit(cache=True, nogil=True, error_model="numpy")
def empty_record(every, size, axes):  # type: ignore[no-untyped-def]
    """A `Record` of so many steps."""
    return Record(
        np.zeros((every, size)),
        np.zeros((every, size, size)),
        np.zeros((every, axes, size)),
        np.zeros((every, axes)),
        np.ones((every, axes)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def empty_row(data):  # type: ignore[no-untyped-def]
    """A `Row` to fill."""
    width = data.h.shape[2] + data.c.shape[1]
    return Row(np.zeros(width, dtype=np.int64), np.zeros(width))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def fill_row(plan, data, t, a, row):  # type: ignore[no-untyped-def]
    """h of axis a at sample t: the trajectories of all axes, and its own residual terms."""
    axes, width, terms = data.h.shape[1], data.h.shape[2], data.c.shape[1]
    for i in range(width):
        row.state[i], row.value[i] = plan.at[t, 0] + i, data.h[t, a, i]
    for j in range(terms):
        row.state[width + j] = plan.at[t, 1] + plan.offsets[axes + a * terms + j]
        row.value[width + j] = data.c[a, j]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def first_state(plan, axes, t, block):  # type: ignore[no-untyped-def]
    """Index of the first state of a block at sample t."""
    return plan.at[t, 0 if block < axes else 1] + plan.offsets[block]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _predict(plan, data, t, mean, matrix):  # type: ignore[no-untyped-def]
    """Over the step to sample t."""
    axes = data.y.shape[1]
    for block in range(data.z.shape[1]):
        z = data.z[t, block]
        if z != 0.0:
            move(plan.sizes[block], z, first_state(plan, axes, t, block), mean, matrix, True)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _update(plan, data, t, i, mean, matrix, row, record):  # type: ignore[no-untyped-def]
    """By the forces of sample t, with g, v and s to entry `i` of the record."""
    size = mean.shape[0]
    for a in range(data.y.shape[1]):
        fill_row(plan, data, t, a, row)
        _gain(plan, data, i, a, matrix, row, record.g)
        v, s = data.y[t, a], data.r[a]
        for j in range(row.state.shape[0]):
            v -= row.value[j] * mean[row.state[j]]
            s += row.value[j] * record.g[i, a, row.state[j]]
        record.v[i, a], record.s[i, a] = v, s
        inverse = 1.0 / s
        for j in range(size):
            scaled = record.g[i, a, j] * inverse
            mean[j] += scaled * v
            for k in range(j + 1):
                matrix[j, k] -= scaled * record.g[i, a, k]
                matrix[k, j] = matrix[j, k]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _gain(plan, data, i, a, matrix, row, g):  # type: ignore[no-untyped-def]
    """g = P h = D h + P∞ h, where h is not zero at the first state only of a residual term."""
    axes, terms = data.c.shape
    for j in range(matrix.shape[0]):
        total = 0.0
        for k in range(row.state.shape[0]):
            total += row.value[k] * matrix[j, row.state[k]]
        g[i, a, j] = total
    for c in range(axes):
        j, k = 3 * c, row.state[3 * c]
        g[i, a, k] += row.value[j] - row.value[j + 2] / 3.0
        g[i, a, k + 1] += row.value[j + 1] / 3.0
        g[i, a, k + 2] += row.value[j + 2] - row.value[j] / 3.0
    for term in range(terms):
        j, k = 3 * axes + term, row.state[3 * axes + term]
        g[i, a, k] += row.value[j]
        if plan.sizes[axes + a * terms + term] == 3:
            g[i, a, k + 2] -= row.value[j] / 3.0
