"""A cell: a sparse GP of the force with few inducing inputs, which learns one sample at a time (docs/model.md §17).

Inducing inputs Z are samples that were recorded, and L Lᵀ = K_ZZ. In whitened coordinates a(x) = L⁻¹ k_Z(x) the force
is f(x) = a·w + what Z does not carry, w ~ N(0, I), and the latter, of variance δ = k(x, x) − a·a, counts as noise of
each sample on its own (FITC; Snelson, Ghahramani 2006):

    A = I + Σ a aᵀ/(σ² + δ),     E[w] = A⁻¹ Σ a r/(σ² + δ),     Cov[w] = A⁻¹

A new inducing input is a new row of L and a new coordinate, which no earlier sample has seen. So A and L only grow, and
every cost is O(B²).
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bayes_impedance.engines.compiled.covariance import covariances, variances
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.local.factors import (
    factorise,
    inner,
    rotate,
    solve,
    solve_three,
    solve_transposed,
    solve_transposed_three,
    squared_norm,
)

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Least share of its prior variance that a new inducing input must add: below it rounding decides.
LEAST_NOVELTY = 1e-10


class Cell(NamedTuple):
    """What predictions are made of; nobody changes what a cell holds in its first `used` rows.

    `used` `(axes,)`: inducing inputs in use. `inputs` `(axes, D, B)`; `prior` L `(axes, B, B)`; `posterior` U with
    UᵀU = A `(axes, B, B)`; `d` U⁻ᵀ Σ a r/(σ² + δ) `(axes, B)`, so that E[w] = U⁻¹ d.
    """

    used: Integers
    inputs: Floats
    prior: Floats
    posterior: Floats
    d: Floats

    def successor(self) -> Cell:
        """One that may learn while others read this: what learning changes is its own."""
        return Cell(self.used.copy(), self.inputs, self.prior, self.posterior.copy(), self.d.copy())


class Sums(NamedTuple):
    """What a cell has been taught, kept beside it: Σ a aᵀ/(σ² + δ) `(axes, B, B)`, Σ a r/(σ² + δ) `(axes, B)`.

    The factor of a cell can be computed anew from these. `samples` `(1,)`: how many were learned; `stale` `(1,)`: since
    the factor was last computed so.
    """

    gram: Floats
    moment: Floats
    samples: Integers
    stale: Integers

    @classmethod
    def empty(cls, axes: int, inducing: int) -> Self:
        """Of no sample."""
        return cls(
            np.zeros((axes, inducing, inducing)),
            np.zeros((axes, inducing)),
            np.zeros(1, dtype=np.int64),
            np.zeros(1, dtype=np.int64),
        )


def empty_cell(axes: int, inducing: int, width: int) -> Cell:
    """A cell that has learned nothing: its predictions are the prior."""
    square = (axes, inducing, inducing)
    return Cell(
        np.zeros(axes, dtype=np.int64),
        np.zeros((axes, width, inducing)),
        np.zeros(square),
        np.zeros(square),
        np.zeros((axes, inducing)),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _whiten(numbers: KernelNumbers, axis: int, cell: Cell, n: int, x: Floats, own: float, a: Floats) -> float:
    """a(x) into `a` `(1, B)`, by the first `n` inducing inputs, and what they leave of the prior variance `own`: δ."""
    covariances(numbers, axis, cell.inputs[axis, :, :n], x, a[:, :n])
    solve(cell.prior[axis], n, a[0])
    return max(own - squared_norm(a[0], n), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def learn(
    numbers: KernelNumbers,
    noise: Floats,
    novelty: float,
    cell: Cell,
    sums: Sums,
    x: Floats,
    own: Floats,
    residual: Floats,
) -> None:
    """Teach a cell one sample in place, for which readers must not have it: see `Cell.successor`.

    Inputs `x` `(axes, D)`, prior variance of their force `own` `(axes,)` [N²], u − E[u] `residual` `(axes,)` [N].
    `noise` σ_r² `(axes,)` [N²]. An input becomes an inducing one where the others leave more than `novelty` times the
    noise of its variance, and there is room. `inputs` and `prior`, which a cell shares with those before it, gain rows
    that only the new `used` reaches.
    """
    axes, most = cell.d.shape
    a = np.empty((1, most))
    for axis in range(axes):
        n = cell.used[axis]
        left = _whiten(numbers, axis, cell, n, x[axis], own[axis], a)
        if n < most and left > max(novelty * noise[axis], LEAST_NOVELTY * own[axis]):
            cell.inputs[axis, :, n] = x[axis]
            cell.prior[axis, n, :n] = a[0, :n]
            cell.prior[axis, n, n] = np.sqrt(left)
            cell.posterior[axis, n, n] = 1.0
            a[0, n] = cell.prior[axis, n, n]
            left = 0.0
            n += 1
            cell.used[axis] = n
        scale = np.sqrt(noise[axis] + left)
        for k in range(n):
            a[0, k] /= scale
        y = residual[axis] / scale
        for k in range(n):
            sums.moment[axis, k] += a[0, k] * y
            for i in range(k, n):
                sums.gram[axis, k, i] += a[0, k] * a[0, i]
        rotate(cell.posterior[axis], n, cell.d[axis], a[0], y)
    sums.samples[0] += 1
    sums.stale[0] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def refresh(cell: Cell, sums: Sums, keep: float) -> None:
    """`posterior` and `d` anew from the sums, in place, after what these hold has been given the weight `keep`.

    As with `learn`, readers must not have the cell.
    """
    if keep != 1.0:
        sums.gram[:] *= keep
        sums.moment[:] *= keep
    for axis in range(cell.used.size):
        factorise(sums.gram[axis], cell.used[axis], cell.posterior[axis])
        cell.d[axis] = sums.moment[axis]
        solve_transposed(cell.posterior[axis], cell.used[axis], cell.d[axis])
    sums.stale[0] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def moments(
    numbers: KernelNumbers, cell: Cell, x: Floats, prior: Floats, mean: Floats, variance: Floats
) -> None:
    """Deviations from the prior means and variances of force, x_d and ẋ_d at `x` `(axes, D)`, without noise of force.

    Into `mean` and `variance` `(axes, 3)`; `prior` `(axes, 3)` are the prior variances.
    """
    axes, most = cell.d.shape
    a, explained = np.empty((3, most)), np.empty(3)
    for axis in range(axes):
        n = cell.used[axis]
        covariances(numbers, axis, cell.inputs[axis, :, :n], x[axis], a[:, :n])
        solve_three(cell.prior[axis], n, a)
        for quantity in range(3):
            explained[quantity] = squared_norm(a[quantity], n)
        solve_transposed_three(cell.posterior[axis], n, a)
        for quantity in range(3):
            mean[axis, quantity] = inner(a[quantity], cell.d[axis], n)
            left = prior[axis, quantity] - explained[quantity] + squared_norm(a[quantity], n)
            variance[axis, quantity] = max(left, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def choose(numbers: KernelNumbers, axis: int, inputs: Floats, most: int, enough: float) -> Integers:
    """Rows of `inputs` `(n, D)` to be inducing inputs: each is the one that those before explain least.

    That is a Cholesky factorisation with pivoting; it ends where they leave no row a variance above `enough`
    [N²].
    """
    n = inputs.shape[0]
    most = min(most, n)
    # Views, as the inputs of a cell are: what is compiled for these serves here, too.
    columns, own = np.ascontiguousarray(inputs.T)[:, :n], np.empty(3)
    whole = np.empty(n)
    for i in range(n):
        variances(numbers, axis, inputs[i], own)
        whole[i] = own[0]
    left = whole.copy()
    white = np.empty((most, n))
    chosen = np.empty(most, dtype=np.int64)
    row = np.empty((1, n))[:, :n]
    for m in range(most):
        best = int(np.argmax(left))
        if left[best] <= max(enough, LEAST_NOVELTY * whole[best]):
            return chosen[:m]
        chosen[m] = best
        covariances(numbers, axis, columns, inputs[best], row)
        for j in range(m):
            value = white[j, best]
            for i in range(n):
                row[0, i] -= value * white[j, i]
        scale = np.sqrt(left[best])
        for i in range(n):
            white[m, i] = row[0, i] / scale
            left[i] -= white[m, i] ** 2
        left[best] = 0.0
    return chosen


@njit(cache=True, nogil=True, error_model="numpy")
def place(numbers: KernelNumbers, axis: int, cell: Cell, inputs: Floats) -> None:
    """Make `inputs` `(m, D)` the inducing inputs of an axis of an empty cell."""
    own, row = np.empty(3), np.empty((1, cell.d.shape[1]))
    for n in range(inputs.shape[0]):
        variances(numbers, axis, inputs[n], own)
        left = _whiten(numbers, axis, cell, n, inputs[n], own[0], row)
        cell.inputs[axis, :, n] = inputs[n]
        cell.prior[axis, n, :n] = row[0, :n]
        cell.prior[axis, n, n] = np.sqrt(max(left, LEAST_NOVELTY * own[0]))
        cell.posterior[axis, n, n] = 1.0
    cell.used[axis] = inputs.shape[0]


@njit(cache=True, nogil=True, error_model="numpy")
def whitened(
    numbers: KernelNumbers, noise: float, axis: int, cell: Cell, inputs: Floats, residual: Floats
) -> tuple[Floats, Floats]:
    """a/√(σ² + δ) `(n, B)` and r/√(σ² + δ) `(n,)` of many samples: what `learn` adds to the sums, one by one."""
    n = cell.used[axis]
    own, row = np.empty(3), np.empty((1, cell.d.shape[1]))
    white = np.zeros((inputs.shape[0], cell.d.shape[1]))
    scaled = np.empty(inputs.shape[0])
    for t in range(inputs.shape[0]):
        variances(numbers, axis, inputs[t], own)
        scale = np.sqrt(noise + _whiten(numbers, axis, cell, n, inputs[t], own[0], row))
        white[t, :n] = row[0, :n] / scale
        scaled[t] = residual[t] / scale
    return white, scaled
