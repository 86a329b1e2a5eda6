"""Impedance matrices that couple axes, as sums of positive terms (docs/model.md, coupled axes).

    W(ξ) = Σ_r a_r a_rᵀ exp(g_r(ξ)),    g_r ~ GP(log level_r, k_r) independent of each other,

is symmetric and positive definite by construction. Directions a_r: one along each axis, and for each pair of axes
(1, 1)/√2 and (1, −1)/√2 on that pair. With a single diagonal direction a pair, the least that spans symmetric matrices,
positive terms could couple axes in one sense only; with both, W_xy = ½ (e^{g₊} − e^{g₋}) has either sign, and its prior
expectation is zero where both have one level.

A term takes its scale from the axes in its direction, weighted by the squares a_rc²: log level_r = log coupling_r +
Σ_c a_rc² log level_c (the geometric mean of a pair's levels; coupling is 1 for the axes themselves) and
k_r = Σ_c a_rc² k_c.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from gpytorch import Module
from gpytorch.priors import Prior
from torch import Tensor

from bayes_impedance.kernels.stationary import StationaryKernel, register_positive, set_positive
from bayes_impedance.kernels.warped import evaluate


def axis_pairs(axes: int) -> tuple[tuple[int, int], ...]:
    """Pairs of axes in the order xy, xz, yz.

    Example:
        >>> axis_pairs(3)
        ((0, 1), (0, 2), (1, 2))
    """
    return tuple(combinations(range(axes), 2))


def pair_names(axes: Sequence[str]) -> tuple[str, ...]:
    """Names of the pairs of axes.

    Example:
        >>> pair_names(("x", "y", "z"))
        ('xy', 'xz', 'yz')
    """
    return tuple(f"{axes[p]}{axes[q]}" for p, q in axis_pairs(len(axes)))


def term_shares(axes: int) -> Tensor:
    """a_rc², `(terms, axes)`: how much of each axis is in the direction of each term."""
    rows = [*torch.eye(axes, dtype=torch.float64)]
    for p, q in axis_pairs(axes):
        pair = torch.zeros(axes, dtype=torch.float64)
        pair[[p, q]] = 0.5
        rows += [pair, pair]
    return torch.stack(rows)


def term_directions(axes: int) -> Tensor:
    """a_r, `(terms, axes)`: the axes, then (1, 1)/√2 and (1, −1)/√2 of each pair.

    Example:
        >>> (term_directions(2) * 2**0.5).round(decimals=2).tolist()
        [[1.41, 0.0], [0.0, 1.41], [1.0, 1.0], [1.0, -1.0]]
    """
    directions = term_shares(axes).sqrt()
    for k, (_, q) in enumerate(axis_pairs(axes)):
        directions[axes + 2 * k + 1, q] *= -1.0
    return directions


def contract(weights: Tensor, terms: Tensor) -> Tensor:
    """Σ_r `weights[..., r]` `terms[r, …]`, `(*weights.shape[:-1], *terms.shape[1:])`."""
    return torch.tensordot(weights.to(terms.dtype), terms, dims=([-1], [0]))


class CoupledProcess(Module):
    """The terms of one of K, D, M, from hyperparameters of its axes and of the coupling of their pairs.

    `level` `(axes, *batch, 1, 1)` [unit of W]: median of the axes' own terms; `coupling` `(2 pairs, *batch, 1, 1)` [1]:
    median of a pair's terms over the geometric mean of its levels, (1, 1)/√2 before (1, −1)/√2. Inputs have shape
    `(*batch, n, D)`; the first dimension of every result is that of the terms.

    Args:
        covariance: k_c of log w along each axis, of batch shape `(axes, *batch)`.
        axes: number of axes.
        level_prior, coupling_prior: priors of the hyperparameters.
        relative: the SD of `covariance`, which then has no input, is that of w itself [unit of W]: log w gets the
            variance log(1 + (sd/level)²), with which SD and mean of w have the ratio sd/level.

    Example:
        >>> stiffness = CoupledProcess(StationaryKernel(batch_shape=torch.Size([2])), axes=2).double()
        >>> stiffness.level, stiffness.coupling, stiffness.covariance.sd = 300.0, 0.3, 1e-6
        >>> stiffness.mean_matrices(torch.zeros(1, 1, dtype=torch.float64))[..., 0, 0].round().tolist()
        [[390.0, 0.0], [0.0, 390.0]]

    Raises:
        ValueError: fewer than two axes.
    """

    def __init__(
        self,
        covariance: StationaryKernel,
        axes: int,
        level_prior: Prior | None = None,
        coupling_prior: Prior | None = None,
        relative: bool = False,
    ) -> None:
        if axes < 2:
            raise ValueError(f"axes: expected two or three that couple, got {axes}")
        super().__init__()
        self.covariance = covariance
        self.relative = relative
        batch = covariance.batch_shape[1:]
        register_positive(self, "level", torch.Size([axes, *batch]), level_prior, None)
        pairs = len(axis_pairs(axes))
        register_positive(self, "coupling", torch.Size([2 * pairs, *batch]), coupling_prior, None)
        self.shares, self.directions = term_shares(axes), term_directions(axes)
        #: a_ra a_rb, `(axes, axes, terms)`: the matrix of each term.
        self.dyads = torch.einsum("ra,rb->abr", self.directions, self.directions)

    @property
    def level(self) -> Tensor:
        """Median of the axes' own terms, `(axes, *batch, 1, 1)` [unit of W]."""
        return self.raw_level_constraint.transform(self.raw_level)

    @level.setter
    def level(self, value: Tensor | float) -> None:
        set_positive(self, "level", value)

    @property
    def coupling(self) -> Tensor:
        """Median of the pairs' terms over the geometric mean of their levels, `(2 pairs, *batch, 1, 1)` [1]."""
        return self.raw_coupling_constraint.transform(self.raw_coupling)

    @coupling.setter
    def coupling(self, value: Tensor | float) -> None:
        set_positive(self, "coupling", value)

    @property
    def offsets(self) -> Tensor:
        """∂ log level_r by the logarithms of `level` and `coupling`, in this order, `(terms, terms)`."""
        terms, axes = self.shares.shape
        own = torch.eye(terms, dtype=self.shares.dtype)
        own[axes:, :axes] = self.shares[axes:]
        return own

    @property
    def levels(self) -> Tensor:
        """level_r, `(terms, *batch, 1, 1)` [unit of W]."""
        return self.levels_of(self.level, self.coupling)

    def levels_of(self, level: Tensor, coupling: Tensor) -> Tensor:
        """level_r for other values of the hyperparameters."""
        axes = self.shares.shape[-1]
        pairs = contract(self.shares[axes:], level.log()).exp() * coupling
        return torch.cat([level, pairs])

    def gaussian_covariance(self, x1: Tensor, x2: Tensor, diag: bool = False) -> Tensor:
        """k_r, `(terms, *batch, n1, n2)` or `(terms, *batch, n)`, or what broadcasts to it."""
        if self.covariance.num_dims == 0:
            # A constant stays one entry.
            x1, x2 = x1[..., :1, :], x2[..., :1, :]
        k = evaluate(self.covariance, x1, x2, diag)
        if self.relative:
            level = self.level[..., 0] if diag else self.level
            k = torch.log1p(k / level.square())
        return contract(self.shares, k)

    def expectations(self, x: Tensor) -> Tensor:
        """E[e^{g_r}] = level_r exp(k_r/2), `(terms, *batch, n, 1)` or what broadcasts to it [unit of W]."""
        return self.levels * torch.exp(0.5 * self.gaussian_covariance(x, x, diag=True).unsqueeze(-1))

    def mean_matrices(self, x: Tensor) -> Tensor:
        """E[W], `(axes, axes, *batch, n, 1)` or what broadcasts to it [unit of W]."""
        return contract(self.dyads, self.expectations(x))
