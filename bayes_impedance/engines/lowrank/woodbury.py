"""Gaussian regression on features with unit prior: log determinant and quadratic form by least squares.

For rows y = Ψ γ + Φ β + ε, ε ~ N(0, I), with γ ~ N(0, I) of each block and β ~ N(0, I) of its group:

    log det(I + ΨΨᵀ + ΦΦᵀ) = Σ log det(I + ΨᵀΨ) + log det(I + Φ̃ᵀΦ̃)
    yᵀ (I + ΨΨᵀ + ΦΦᵀ)⁻¹ y = min over γ, β of |y − Ψγ − Φβ|² + |γ|² + |β|²

where Φ̃ is what Ψ leaves of Φ. The minimum is formed as this sum of squares, which an error of γ and β enters to second
order; yᵀy − yᵀΦ(…)⁻¹Φᵀy would lose as many digits as yᵀy is larger.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from bayes_impedance.errors import NotPositiveDefiniteError


class Rows(NamedTuple):
    """Whitened rows of some blocks: `own` Ψ `(axes, blocks, n, own features)`, `shared` Φ, `force` y."""

    own: Tensor
    shared: Tensor
    force: Tensor


@dataclass(frozen=True)
class Source:
    """Where the rows of some blocks of a group come from."""

    group: int
    rows: Callable[[], Rows]


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


def regress(sources: Sequence[Source], recompute: bool = False) -> Solution:
    """Eliminate each block's own features, then those that a group shares; groups are 0, 1, … without a gap.

    With `recompute` rows are made anew for each of two passes, and for each of these in the backward pass, so that none
    but those of one source are held at a time.

    Raises:
        NotPositiveDefiniteError: rounding leaves no Cholesky factor.
    """
    call = _recomputed if recompute else _called
    reduced = [
        partial(_eliminate, source.rows) if recompute else partial(_kept, _eliminate(source.rows))
        for source in sources
    ]
    moments = [call(partial(_moments, part)) for part in reduced]
    members = [
        [k for k, source in enumerate(sources) if source.group == group]
        for group in range(1 + max(source.group for source in sources))
    ]

    def add(entry: int) -> list[Tensor]:
        return [_sum([moments[k][entry] for k in group]) for group in members]

    factor = _cholesky(torch.stack(add(0), dim=-3))
    mean = torch.cholesky_solve(torch.stack(add(1), dim=-2).unsqueeze(-1), factor)[..., 0]
    squares = [
        _sum([call(partial(_squares, reduced[k]), mean[..., g, :]) for k in group])
        for g, group in enumerate(members)
    ]
    return Solution(
        torch.stack(squares, dim=-1) + mean.square().sum(-1),
        torch.stack(add(2), dim=-1) + _log_det(factor),
        factor,
        mean,
        tuple(Own(*part[3:]) for part in moments),
    )


class _Reduced(NamedTuple):
    """Rows of β alone, whose squares sum to what the best γ leaves: `shared` Φ̃ `(axes, rows, features)`, `force` ỹ."""

    shared: Tensor
    force: Tensor
    own: Own


def _eliminate(make: Callable[[], Rows]) -> _Reduced:
    own, shared, force = make()
    if own.shape[-1] == 0:
        none = own.mT @ shared
        return _Reduced(shared.flatten(-3, -2), force.flatten(-2), Own(own.mT @ own, none, none.sum(-1)))
    factor = _cholesky(own.mT @ own)
    right = torch.cat([shared, force.unsqueeze(-1)], dim=-1)
    fit = torch.cholesky_solve(own.mT @ right, factor)
    left = torch.cat([right - own @ fit, -fit], dim=-2).flatten(-3, -2)
    return _Reduced(left[..., :-1], left[..., -1], Own(factor, fit[..., :-1], fit[..., -1]))


def _moments(part: Callable[[], _Reduced]) -> tuple[Tensor, ...]:
    """Φ̃ᵀΦ̃, Φ̃ᵀỹ, log det(I + ΨᵀΨ) of all blocks, and what gives γ."""
    shared, force, own = part()
    cross = (shared.mT @ force.unsqueeze(-1))[..., 0]
    return shared.mT @ shared, cross, _log_det(own.factor).sum(-1), own.factor, own.slope, own.offset


def _squares(part: Callable[[], _Reduced], mean: Tensor) -> Tensor:
    """|ỹ − Φ̃β|² at β `(axes, features)`."""
    shared, force, _ = part()
    return (force - (shared @ mean.unsqueeze(-1))[..., 0]).square().sum(-1)


def _kept(part: _Reduced) -> _Reduced:
    return part


def _called(function: Callable[..., Any], *arguments: Tensor) -> Any:
    return function(*arguments)


def _recomputed(function: Callable[..., Any], *arguments: Tensor) -> Any:
    return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)


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
