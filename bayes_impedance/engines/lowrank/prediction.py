"""Posteriors of latents at new samples, from the coefficients of their features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import LATENTS, MeanAndVariance, drawn_latents, prior_mean
from bayes_impedance.engines.lowrank.blocks import Batch, batches
from bayes_impedance.engines.lowrank.columns import Design
from bayes_impedance.engines.lowrank.woodbury import Own, Solution
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import TRAJECTORY_ORDER, Latent


def predict(
    design: Design,
    solution: Solution,
    sources: Sequence[Batch],
    target: Features,
    impedance: Tensor,
    column: int | None,
) -> Mapping[Latent, MeanAndVariance]:
    """Mean and variance of every latent at `target`, `(axes, groups, m)`; padded samples keep the mean μ, variance 0.

    `sources` are the blocks that `solution` came from, `column` that of the labels by which a block of `target` finds
    its own; without one its own features have their prior.
    """
    x = target.inputs
    own = _by_label(solution, sources)
    result = {
        latent: (prior_mean(design.layout, target, impedance, latent).clone(), x.new_zeros(x.shape[:-1]))
        for latent in LATENTS
    }
    for batch in batches(target, column):
        for block in batch.blocks():
            known = own.get((block.group, block.labels[0])) or _prior(solution.own[0])
            for latent in LATENTS:
                mean, variance = _moments(design, solution, known, block, x, impedance, latent)
                result[latent][0][:, block.group, block.index[0]] += mean
                result[latent][1][:, block.group, block.index[0]] = variance
    return result


def draw(
    design: Design,
    solution: Solution,
    sources: Sequence[Batch],
    target: Features,
    impedance: Tensor,
    blocks: Sequence[Batch],
    generator: torch.Generator,
) -> Mapping[Latent, Tensor]:
    """One draw of every latent at `target`, from one of all coefficients; `blocks` of its samples have one label each.

    See `predict`.
    """
    own, x = _by_label(solution, sources), target.inputs
    shared = solution.mean + _of_precision(solution.factor, generator)
    deviation, residual = x.new_zeros(*x.shape[:-1], 3), x.new_zeros(x.shape[:-1])
    for block in blocks:
        known = own.get((block.group, block.labels[0])) or _prior(solution.own[0])
        beta = shared[:, block.group]
        gamma = known.offset[:, 0] - (known.slope[:, 0] @ beta.unsqueeze(-1))[..., 0]
        gamma = gamma + _of_precision(known.factor[:, 0], generator)
        coefficients, of_residual = design.by_axis(gamma, beta)
        inputs, place = block.take(x), (slice(None), block.group, block.index[0])
        jet = design.basis.jet(design.layout.path(inputs))
        deviation[place] = torch.stack([_times(part, coefficients) for part in jet], dim=-1)
        start = 0
        for basis in design.residual_bases:
            stop = start + basis.size
            residual[place] += _times(basis.values(inputs), of_residual[:, start:stop])
            start = stop
    return drawn_latents(design.layout, target, impedance, deviation, residual)


def _times(features: Tensor, coefficients: Tensor) -> Tensor:
    """Process `(axes, n)` of `features` `(axes, 1, n, features)`, where axes may have the same ones."""
    return (features @ coefficients[:, None, :, None])[:, 0, :, 0]


def _of_precision(factor: Tensor, generator: torch.Generator) -> Tensor:
    """A draw of mean zero whose precision has the Cholesky factor `factor`."""
    standard = torch.randn(factor.shape[:-1], generator=generator, dtype=factor.dtype)
    return torch.linalg.solve_triangular(factor.mT, standard.unsqueeze(-1), upper=True)[..., 0]


def _by_label(solution: Solution, sources: Sequence[Batch]) -> dict[tuple[int, float], Own]:
    return {
        (batch.group, label): _block(part, b)
        for batch, part in zip(sources, solution.own, strict=True)
        for b, label in enumerate(batch.labels)
    }


def _block(own: Own, b: int) -> Own:
    return Own(own.factor[:, [b]], own.slope[:, [b]], own.offset[:, [b]])


def _prior(like: Own) -> Own:
    zero = like.factor.new_zeros(*like.factor[:, :1].shape)
    eye = zero + torch.eye(zero.shape[-1], dtype=zero.dtype)
    return Own(eye, torch.zeros_like(like.slope[:, :1]), torch.zeros_like(like.offset[:, :1]))


def _moments(
    design: Design, solution: Solution, known: Own, block: Batch, inputs: Tensor, impedance: Tensor, latent: Latent
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Mean and variance `(axes, m)` of Ψ*γ + Φ*β, where γ = offset − slope β + a part independent of β."""
    group = slice(block.group, block.group + 1)
    own, shared = _columns(design, block.take(inputs), impedance[block.group, block.index], latent)
    shared = shared - own @ known.slope
    mean = shared @ solution.mean[:, group].unsqueeze(-1) + own @ known.offset.unsqueeze(-1)
    variance = sum(
        torch.linalg.solve_triangular(factor, rows.mT, upper=False).square().sum(-2)
        for factor, rows in ((solution.factor[:, group], shared), (known.factor, own))
    )
    axes = inputs.shape[0]
    return design.per_axis(mean[..., 0], axes)[:, 0], design.per_axis(torch.as_tensor(variance), axes)[:, 0]


def _columns(design: Design, x: Tensor, impedance: Tensor, latent: Latent) -> tuple[Tensor, Tensor]:
    if latent in TRAJECTORY_ORDER:
        return design.split(
            design.trajectory(x, TRAJECTORY_ORDER[latent]), torch.zeros_like(design.residual(x))
        )
    trajectory = design.force(x, impedance)
    if latent is Latent.RESIDUAL_FORCE:
        trajectory = torch.zeros_like(trajectory)
    return design.split(trajectory, design.residual(x))
