"""Gaussian regression on features with unit prior: log determinant and quadratic form by least squares.

For rows y = Ψ γ + Φ β + ε, ε ~ N(0, I), with γ ~ N(0, I) of each block and β ~ N(0, I) of its group:

    log det(I + ΨΨᵀ + ΦΦᵀ) = Σ log det(I + ΨᵀΨ) + log det(I + Φ̃ᵀΦ̃)
    yᵀ (I + ΨΨᵀ + ΦΦᵀ)⁻¹ y = min over γ, β of |y − Ψγ − Φβ|² + |γ|² + |β|²

where Φ̃ is what Ψ leaves of Φ. The minimum is formed as this sum of squares, which an error of γ and β enters to second
order; yᵀy − yᵀΦ(…)⁻¹Φᵀy would lose as many digits as yᵀy is larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bayes_impedance.errors import NotPositiveDefiniteError


@dataclass(frozen=True)
class Rows:
    """Whitened rows of some blocks of a group: `own` Ψ `(axes, blocks, n, own features)`, `shared` Φ, `force` y."""

    group: int
    own: Tensor
    shared: Tensor
    force: Tensor


@dataclass(frozen=True)
class Own:
    """γ of each block given β: mean `offset` − `slope` β, covariance from its Cholesky factor of I + ΨᵀΨ."""

    factor: Tensor
    slope: Tensor
    offset: Tensor


@dataclass(frozen=True)
class Solution:
    """`quadratic` and `log_det` `(axes, groups)`; β has the mean `mean` and the precision `factor` `factor`ᵀ; γ."""

    quadratic: Tensor
    log_det: Tensor
    factor: Tensor
    mean: Tensor
    own: tuple[Own, ...]


def regress(batches: Sequence[Rows]) -> Solution:
    """Eliminate each block's own features, then those that a group shares; groups are 0, 1, … without a gap.

    Raises:
        NotPositiveDefiniteError: rounding leaves no Cholesky factor.
    """
    reduced = [_eliminate(rows) for rows in batches]
    groups = [
        [reduced[k] for k, rows in enumerate(batches) if rows.group == group]
        for group in range(1 + max(rows.group for rows in batches))
    ]
    factor = _cholesky(torch.stack([_sum([part.gram for part in group]) for group in groups], dim=-3))
    cross = torch.stack([_sum([part.cross for part in group]) for group in groups], dim=-2)
    mean = torch.cholesky_solve(cross.unsqueeze(-1), factor)[..., 0]
    log_det, quadratic = [], []
    for g, group in enumerate(groups):
        log_det.append(_sum([part.log_det for part in group]))
        quadratic.append(_sum([part.quadratic(mean[..., g, :]) for part in group]))
    return Solution(
        torch.stack(quadratic, dim=-1) + mean.square().sum(-1),
        torch.stack(log_det, dim=-1) + _log_det(factor),
        factor,
        mean,
        tuple(part.own for part in reduced),
    )


@dataclass(frozen=True)
class _Reduced:
    """Rows of β alone, over whose squares the best γ leaves a sum: `shared` Φ̃ `(axes, rows, features)`, `force` ỹ."""

    shared: Tensor
    force: Tensor
    own: Own

    @property
    def gram(self) -> Tensor:
        return self.shared.mT @ self.shared

    @property
    def cross(self) -> Tensor:
        return (self.shared.mT @ self.force.unsqueeze(-1))[..., 0]

    @property
    def log_det(self) -> Tensor:
        return _log_det(self.own.factor).sum(-1)

    def quadratic(self, mean: Tensor) -> Tensor:
        """|ỹ − Φ̃β|² at β `(axes, features)`."""
        return (self.force - (self.shared @ mean.unsqueeze(-1))[..., 0]).square().sum(-1)


def _eliminate(rows: Rows) -> _Reduced:
    right = torch.cat([rows.shared, rows.force.unsqueeze(-1)], dim=-1) if rows.own.shape[-1] else None
    factor = _cholesky(rows.own.mT @ rows.own)
    if right is None:
        none = rows.own.mT @ rows.shared
        return _Reduced(rows.shared.flatten(-3, -2), rows.force.flatten(-2), Own(factor, none, none.sum(-1)))
    fit = torch.cholesky_solve(rows.own.mT @ right, factor)
    left = torch.cat([right - rows.own @ fit, -fit], dim=-2).flatten(-3, -2)
    return _Reduced(left[..., :-1], left[..., -1], Own(factor, fit[..., :-1], fit[..., -1]))


def _cholesky(gram: Tensor) -> Tensor:
    """Factor of I + `gram`."""
    size = gram.shape[-1]
    factor, info = torch.linalg.cholesky_ex(gram + torch.eye(size, dtype=gram.dtype))
    if bool(info.any()) or not bool(factor.detach().isfinite().all()):
        raise NotPositiveDefiniteError(
            f"expected a Cholesky factor of the precision of {size} features, found none, for the noise is negative, "
            "not finite, or eight orders of magnitude below the forces; raise model.noise_sd"
        )
    return factor


def _log_det(factor: Tensor) -> Tensor:
    return 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _sum(parts: Sequence[Tensor]) -> Tensor:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total
