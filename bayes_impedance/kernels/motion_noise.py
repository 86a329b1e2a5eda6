"""The covariance that noise of the recorded motion adds to the force (docs/model.md §12).

Positions are recorded with white noise of SD σ_x. The smoother, with weights c⁽ʳ⁾ of derivative r, leaves of it η̂⁽ʳ⁾ in
position, velocity and acceleration, so that the force as modelled from the recorded motion lacks Σ_j w_j η̂⁽ʲ⁾. With
S_ij(s,t) = Cov[η̂⁽ⁱ⁾(s), η̂⁽ʲ⁾(t)] = σ_x² Σ_n c⁽ⁱ⁾_s(n) c⁽ʲ⁾_t(n) over the native samples n that both windows hold,

    N(s,t) = Σ_ij (E[w_i] E[w_j'] + C_ij) S_ij(s,t)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

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
        processes: priors of k, d and m, those of the `ImpedanceKernel`.
        weights: the filter.
        sd_prior: prior of σ_x.

    Example:
        >>> average = lambda length, order, step: np.stack([np.full((length, length), 1.0 / length)] * 3)
        >>> k, d, m = (ImpedanceProcess(StationaryKernel(num_dims=0), "gaussian") for _ in range(3))
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
        self.processes = cast("Sequence[ImpedanceProcess]", torch.nn.ModuleList(processes))
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
        one, two = self._smoothing(x1), self._smoothing(x2)
        if diag:
            which, table = self._overlaps(one, two)
            total = self._sum(
                [process.expectation(x1)[..., 0] for process in self.processes],
                [process.expectation(x2)[..., 0] for process in self.processes],
                [process.forward(x1, x2, diag=True) for process in self.processes],
                table[which],
            )
            return total * self.sd[..., 0].square()
        one = _Smoothing(*(column.unsqueeze(-1) for column in one))
        two = _Smoothing(*(column.unsqueeze(-2) for column in two))
        which, table = self._overlaps(one, two)
        # N is zero but near the diagonal of each trial: moments are formed there alone.
        near = which.reshape(-1, *which.shape[-2:]).any(0)
        rows, columns = near.any(1).nonzero()[:, 0], near.any(0).nonzero()[:, 0]
        moments = [
            process.moments(x1.index_select(-2, rows), x2.index_select(-2, columns))
            for process in self.processes
        ]
        inside = which.index_select(-2, rows).index_select(-1, columns)
        expectation1, expectation2, covariance = zip(*moments, strict=True)
        block = self._sum(expectation1, expectation2, covariance, table[inside]) * self.sd.square()
        total = block.new_zeros(*block.shape[:-2], *near.shape)
        total[..., rows.unsqueeze(-1), columns] = block
        return total

    def _smoothing(self, x: Tensor) -> _Smoothing:
        return _Smoothing(*(x[..., column] for column in self.columns))

    def _overlaps(self, one: _Smoothing, two: _Smoothing) -> tuple[Tensor, Tensor]:
        """Where pairs of samples stand in a table of S_ij/σ_x² `(pairs, 3, 3)` [s^−(i + j)]; its row 0 is zero."""
        lag = two.first - one.first
        near = (one.trial == two.trial) & (one.length == two.length) & (lag.abs() < one.length)
        which = torch.zeros(near.shape, dtype=torch.long)
        tables = [one.trial.new_zeros(1, 3, 3)]
        filters = torch.stack(
            [c.reshape(-1) for c in (one.length, one.order, one.step, one.from_positions)], -1
        )
        for length, order, step, from_positions in filters.unique(dim=0).tolist():
            if length == 0:
                continue
            same = (one.length == length) & (one.order == order) & (one.step == step)
            chosen = near & same & (one.from_positions == from_positions)
            pairs = torch.stack([part.expand(near.shape)[chosen] for part in (one.place, two.place, lag)], -1)
            # Few differ: within a trial the place is the middle, and the lags are those of one window.
            pairs, index = pairs.long().unique(dim=0, return_inverse=True)
            which[chosen] = index + sum(len(table) for table in tables)
            weights = self.weights(int(length), int(order), step)[: int(from_positions)]
            table = torch.zeros(len(pairs), 3, 3, dtype=torch.float64)
            size = len(weights)
            table[:, :size, :size] = torch.from_numpy(_shared(weights, *pairs.numpy().T))
            tables.append(table.to(one.trial))
        return which, torch.cat(tables)

    @staticmethod
    def _sum(
        expectation1: Sequence[Tensor],
        expectation2: Sequence[Tensor],
        covariance: Sequence[Tensor],
        table: Tensor,
    ) -> Tensor:
        """Σ_ij (E_i E_j' + C_ij) S_ij."""
        total = torch.zeros((), dtype=table.dtype)
        for i, e1 in enumerate(expectation1):
            for j, e2 in enumerate(expectation2):
                weight = e1 * e2 + covariance[i] if i == j else e1 * e2
                total = total + weight * table[..., i, j]
        return total


def _shared(
    weights: NDArray[np.float64], place1: NDArray[np.int64], place2: NDArray[np.int64], lag: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Σ_n c⁽ⁱ⁾(n) c⁽ʲ⁾(n) over the samples of two windows, the second begun `lag` later, `(pairs, orders, orders)`."""
    length = weights.shape[-1]
    in_second = np.arange(length) - lag[:, None]
    held = (in_second >= 0) & (in_second < length)
    one = weights[:, place1]
    two = weights[:, place2[:, None], np.where(held, in_second, 0)] * held
    return np.einsum("ipn,jpn->pij", one, two, optimize=True)
