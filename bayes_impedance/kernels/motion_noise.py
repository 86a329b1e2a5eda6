"""The covariance that noise of the recorded motion adds to the force (docs/model.md §12).

Positions are recorded with white noise of SD σ_x. The smoother, with weights c⁽ʳ⁾ of derivative r, leaves of it η̂⁽ʳ⁾ in
position, velocity and acceleration, so that the force as modelled from the recorded motion lacks Σ_j w_j η̂⁽ʲ⁾. With
S_ij(s,t) = Cov[η̂⁽ⁱ⁾(s), η̂⁽ʲ⁾(t)] = σ_x² Σ_n c⁽ⁱ⁾_s(n) c⁽ʲ⁾_t(n) over the native samples n that both windows hold,

    N(s,t) = Σ_ij (E[w_i] E[w_j'] + C_ij) S_ij(s,t)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from gpytorch.priors import Prior
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.kernels.stationary import BatchedKernel, register_positive, set_positive
from bayes_impedance.kernels.warped import ImpedanceProcess

#: Weights of a window's samples in position, velocity and acceleration at each of its places, `(3, length, length)`,
#: of a filter of so many samples, of that polynomial order, at that step [s].
Weights = Callable[[int, int, float], NDArray[np.float64]]

#: Pairs are taken this many at a time, which bounds memory where windows are long.
CHUNK = 4096


class _Smoothing(NamedTuple):
    """The columns that the kernel reads, `(..., n)` each."""

    trial: Tensor
    first: Tensor
    place: Tensor
    length: Tensor
    order: Tensor
    step: Tensor
    from_positions: Tensor


class MotionNoiseKernel(BatchedKernel):
    """Covariance of Σ_j w_j η̂⁽ʲ⁾, what smoothed noise of the positions adds to the force [N²].

    `sd` σ_x has shape `(*batch, 1, 1)` [m]. Samples of different trials, or whose windows share no sample, are
    independent.

    Args:
        columns: seven columns of the input: label of the trial, first native sample of the window that serves the
            sample, its place in it, length of the window (0: no noise), order of the polynomial, native step [s], and
            how many of position, velocity and acceleration come from the recorded positions.
        processes: priors of k, d and m, those of the `ImpedanceKernel`, whose parts they stay: their hyperparameters
            are not listed here. None where axes couple, of which only `smoothed` is asked.
        weights: the filter.
        sd_prior: prior of σ_x.

    Example:
        >>> from bayes_impedance.kernels import StationaryKernel
        >>> average = lambda length, order, step: np.stack([np.full((length, length), 1.0 / length)] * 3)
        >>> k, d, m = (ImpedanceProcess(StationaryKernel(num_dims=0), "gaussian").double() for _ in range(3))
        >>> kernel = MotionNoiseKernel(tuple(range(7)), (k, d, m), average).double()
        >>> k.level, k.covariance.sd, kernel.sd = 300.0, 1e-9, 1e-3
        >>> rows = [[0, first, 1, 3, 0, 0.01, 1] for first in range(4)]  # windows of three samples, positions alone
        >>> kernel(torch.tensor(rows, dtype=torch.float64)).to_dense()[0].mul(100).round().tolist()
        [3.0, 2.0, 1.0, 0.0]
    """

    def __init__(
        self,
        columns: tuple[int, ...],
        processes: Sequence[ImpedanceProcess],
        weights: Weights,
        sd_prior: Prior | None = None,
        batch_shape: torch.Size | None = None,
        active_dims: tuple[int, ...] | None = None,
    ) -> None:
        if len(columns) != len(_Smoothing._fields):
            raise ValueError(f"columns: expected {len(_Smoothing._fields)}, got {len(columns)}")
        super().__init__(batch_shape=batch_shape, active_dims=active_dims)
        self.columns = columns
        # In a tuple they are no modules of this one: gpytorch counts the priors of a module as often as it has parents.
        self.processes = tuple(processes)
        self.weights = weights
        register_positive(self, "sd", self._batch_shape, sd_prior, None)

    @property
    def sd(self) -> Tensor:
        """σ_x, `(*batch, 1, 1)` [m]."""
        return self.raw_sd_constraint.transform(self.raw_sd)

    @sd.setter
    def sd(self, value: Tensor | float) -> None:
        set_positive(self, "sd", value)

    def forward(self, x1: Tensor, x2: Tensor, diag: bool = False, **params: object) -> Tensor:
        """N, `(..., n1, n2)`, or `(..., n)` with `diag` [N²]."""
        if diag:
            moments = [
                (
                    process.expectation(x1)[..., 0],
                    process.expectation(x2)[..., 0],
                    process.forward(x1, x2, diag=True),
                )
                for process in self.processes
            ]
            total = self._sum(moments, self._smoothed(self._smoothing(x1), self._smoothing(x2)))
            return total * self.sd[..., 0].square()
        # N is zero but near the diagonal of each trial: all else is left out.
        near = _near(*self._pairs(x1, x2))
        anywhere = near.reshape(-1, *near.shape[-2:]).any(0)
        rows, columns = anywhere.any(1).nonzero()[:, 0], anywhere.any(0).nonzero()[:, 0]
        one, two = x1.index_select(-2, rows), x2.index_select(-2, columns)
        moments = [process.moments(one, two) for process in self.processes]
        block = self._sum(moments, self._smoothed(*self._pairs(one, two))) * self.sd.square()
        total = block.new_zeros(*block.shape[:-2], *anywhere.shape)
        total[..., rows.unsqueeze(-1), columns] = block
        return total

    def smoothed(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """S_ij/σ_x² of every pair of samples, `(..., n1, n2, 3, 3)`, or `(..., n, 3, 3)` with `diag` [s^−(i + j)]."""
        if diag:
            return self._smoothed(self._smoothing(x1), self._smoothing(x2))
        return self._smoothed(*self._pairs(x1, x2))

    def _smoothing(self, x: Tensor) -> _Smoothing:
        return _Smoothing(*(x[..., column] for column in self.columns))

    def _pairs(self, x1: Tensor, x2: Tensor) -> tuple[_Smoothing, _Smoothing]:
        one, two = self._smoothing(x1), self._smoothing(x2)
        return _Smoothing(*(c.unsqueeze(-1) for c in one)), _Smoothing(*(c.unsqueeze(-2) for c in two))

    def _smoothed(self, one: _Smoothing, two: _Smoothing) -> Tensor:
        """S_ij/σ_x² of pairs of samples, `(..., 3, 3)` [s^−(i + j)]."""
        near = _near(one, two)
        lag = two.first - one.first
        which = torch.zeros(near.shape, dtype=torch.long)
        # Pairs that are not near take the first row.
        tables = [lag.new_zeros(1, 3, 3)]
        filters = torch.stack(
            [c.flatten() for c in (one.length, one.order, one.step, one.from_positions)], -1
        )
        for length, order, step, from_positions in filters.unique(dim=0).tolist():
            same = (one.length == length) & (one.order == order) & (one.step == step)
            chosen = near & same & (one.from_positions == from_positions)
            if not chosen.any():
                continue
            # Few differ: within a trial the place is the middle, and the lags are those of one window.
            code = ((one.place * length + two.place) * 2 + 1) * length + lag
            codes, index = code[chosen].long().unique(return_inverse=True)
            places, later = np.divmod(codes.numpy(), 2 * int(length))
            place1, place2 = np.divmod(places, int(length))
            which[chosen] = index + sum(len(table) for table in tables)
            weights = self.weights(int(length), int(order), step)[: int(from_positions)]
            table = lag.new_zeros(len(codes), 3, 3)
            for start in range(0, len(codes), CHUNK):
                part = slice(start, start + CHUNK)
                noise = shared_noise(weights, place1[part], place2[part], later[part] - int(length))
                table[part, : len(weights), : len(weights)] = torch.from_numpy(noise)
            tables.append(table)
        return torch.cat(tables)[which]

    @staticmethod
    def _sum(moments: Sequence[tuple[Tensor, Tensor, Tensor]], smoothed: Tensor) -> Tensor:
        """Σ_ij (E_i E_j' + C_ij) S_ij."""
        total = torch.zeros((), dtype=smoothed.dtype)
        for i, (e1, _, covariance) in enumerate(moments):
            for j, (_, e2, _) in enumerate(moments):
                weight = e1 * e2 + covariance if i == j else e1 * e2
                total = total + weight * smoothed[..., i, j]
        return total


def _near(one: _Smoothing, two: _Smoothing) -> Tensor:
    """Whether the windows of two samples share some."""
    return (one.trial == two.trial) & ((two.first - one.first).abs() < torch.minimum(one.length, two.length))


def shared_noise(
    weights: NDArray[np.float64], place1: Any, place2: NDArray[np.int64], lag: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Σ_n c⁽ⁱ⁾(n) c⁽ʲ⁾(n) over the samples that two windows share, `(pairs, orders, orders)` [s^−(i + j)].

    `weights` `(orders, length, length)` of a window at each of its places. `place1` (or one for all) and `place2`
    `(pairs,)` of the two samples; `lag` `(pairs,)`: samples by which the second window begins later.
    """
    length = weights.shape[-1]
    in_second = np.arange(length) - lag[:, None]
    shared = (in_second >= 0) & (in_second < length)
    one = weights[:, np.broadcast_to(place1, lag.shape)]
    two = weights[:, place2[:, None], np.where(shared, in_second, 0)] * shared
    product: NDArray[np.float64] = one.transpose(1, 0, 2) @ two.transpose(1, 2, 0)
    return product
