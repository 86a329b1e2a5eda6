"""Dense inference given impedance: any θ, any kernel, n³; the oracle of the engines that scale."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from bayes_impedance.engines.gaussian import draw_gaussian
from bayes_impedance.engines.given_impedance import (
    LATENTS,
    MeanAndVariance,
    Processes,
    as_read,
    drawn_latents,
    mean_force,
    prior_mean,
)
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.kernels.derivative import Table, derivative_table
from bayes_impedance.kernels.impedance import TRAJECTORY_ORDER, Latent, same_label
from bayes_impedance.kernels.warped import evaluate

#: What is drawn; forces follow.
DRAWN = (*TRAJECTORY_ORDER, Latent.RESIDUAL_FORCE)


class DenseGivenImpedance:
    """Exact inference given impedance with the covariance of all forces, `(axes · n)²` where axes couple.

    `jitter` is added to the diagonal relative to the mean prior variance.
    """

    def __init__(self, features: Features, coupled: bool, jitter: float = 0.0) -> None:
        self.features, self.coupled, self.jitter = features, coupled, jitter

    def log_likelihood_given_impedance(self, processes: Processes, impedance: Tensor) -> Tensor:
        """See `ConditionalEngine`.

        Raises:
            NotPositiveDefiniteError: no Cholesky factor at this jitter.
        """
        cholesky, residual = self._factor(processes, as_read(impedance, self.coupled))
        white = torch.linalg.solve_triangular(cholesky, residual.unsqueeze(-1), upper=False)[..., 0]
        log_det = 2.0 * cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return -0.5 * (white.square().sum(-1) + log_det + self._count() * math.log(2.0 * math.pi))

    def posterior(
        self, processes: Processes, impedance: Tensor, target: Features, target_impedance: Tensor
    ) -> Mapping[Latent, MeanAndVariance]:
        """See `ConditionalEngine`.

        Raises:
            NotPositiveDefiniteError: no Cholesky factor at this jitter.
        """
        impedance, target_impedance = (
            as_read(impedance, self.coupled),
            as_read(target_impedance, self.coupled),
        )
        with torch.no_grad():
            cholesky, residual = self._factor(processes, impedance)
            alpha = torch.cholesky_solve(residual.unsqueeze(-1), cholesky)
            result = {}
            for latent in LATENTS:
                cross = self._cross(processes, impedance, target, target_impedance, latent)
                white = torch.linalg.solve_triangular(cholesky, cross, upper=False)
                own = self._variance(processes, target, target_impedance, latent)
                shift = self._per_axis((cross.mT @ alpha)[..., 0], own.shape)
                known = self._per_axis(white.square().sum(-2), own.shape)
                location = shift + prior_mean(processes.layout, target, target_impedance, latent)
                result[latent] = (location, (own - known).clamp_min(0.0))
        return result

    def draw(
        self,
        processes: Processes,
        impedance: Tensor,
        target: Features,
        target_impedance: Tensor,
        generator: torch.Generator,
    ) -> Mapping[Latent, Tensor]:
        """See `ConditionalEngine`; costs the cube of all that is drawn.

        Raises:
            NotPositiveDefiniteError: no Cholesky factor at this jitter.
        """
        impedance, target_impedance = (
            as_read(impedance, self.coupled),
            as_read(target_impedance, self.coupled),
        )
        with torch.no_grad():
            cholesky, misfit = self._factor(processes, impedance)
            # f, ḟ, f̈ and ũ; each has the samples of all axes next to each other where these couple.
            cross = torch.cat(
                [self._cross(processes, impedance, target, target_impedance, latent) for latent in DRAWN],
                dim=-1,
            )
            white = torch.linalg.solve_triangular(
                cholesky, torch.cat([cross, misfit.unsqueeze(-1)], dim=-1), upper=False
            )
            known, shift = white[..., :-1], white[..., :-1].mT @ white[..., -1:]
            covariance = self._prior_covariance(processes, target) - known.mT @ known
            drawn = shift[..., 0] + draw_gaussian(covariance, generator)
            parts = [self._per_axis(part, target.inputs.shape[:3]) for part in drawn.chunk(len(DRAWN), -1)]
        deviation = torch.stack(parts[:3], dim=-1)
        return drawn_latents(processes.layout, target, target_impedance, deviation, parts[3])

    def _prior_covariance(self, processes: Processes, target: Features) -> Tensor:
        """Covariance of the quantities of `DRAWN` at the samples of `target`, in the order of `_cross`."""
        x = target.inputs
        table, residual = _trajectory(processes, x, x), _residual(processes, x, x)
        rows = [torch.cat([*row, torch.zeros_like(residual)], dim=-1) for row in table]
        rows.append(torch.cat([*(torch.zeros_like(residual) for _ in table), residual], dim=-1))
        own = torch.cat(rows, dim=-2)
        if not self.coupled:
            return own
        axes, groups, m = x.shape[:3]
        parts = own.reshape(axes, groups, len(DRAWN), m, len(DRAWN), m)
        eye = torch.eye(axes, dtype=own.dtype)
        size = len(DRAWN) * axes * m
        return torch.einsum("agimjk,ac->giamjck", parts, eye).reshape(1, groups, size, size)

    def _count(self) -> Tensor:
        counts = self.features.counts
        return counts * self.features.inputs.shape[0] if self.coupled else counts

    def _factor(self, processes: Processes, impedance: Tensor) -> tuple[Tensor, Tensor]:
        features = self.features
        assert features.force is not None
        x = features.inputs
        covariance = self._covariance(processes, x, impedance, x, impedance)
        noise = processes.noise_variance.expand(x.shape[:-1])
        residual = features.force - mean_force(processes.layout, features, impedance)
        noise, residual = self._rows(noise), self._rows(residual)
        if features.valid is not None:
            valid = self._rows(features.valid.expand(x.shape[:-1]))
            covariance = covariance * valid.unsqueeze(-1) * valid.unsqueeze(-2)
            residual = residual * valid
            noise = torch.where(valid, noise, 1.0)
        scale = covariance.diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)
        cholesky, info = torch.linalg.cholesky_ex(covariance + torch.diag_embed(noise + self.jitter * scale))
        if bool(info.any()):
            raise NotPositiveDefiniteError(
                f"the covariance of {residual.shape[-1]} forces given impedance is not positive definite with jitter "
                f"{self.jitter:g} of the mean prior variance; raise engine.jitter tenfold, or model.noise_sd"
            )
        return cholesky, residual

    def _rows(self, values: Tensor) -> Tensor:
        """`(axes, groups, n)` to one row of all axes a group, `(1, groups, axes · n)`, where axes couple."""
        return values.transpose(0, 1).flatten(1).unsqueeze(0) if self.coupled else values

    def _per_axis(self, values: Tensor, shape: torch.Size) -> Tensor:
        axes, groups, m = shape
        return values.reshape(groups, axes, m).transpose(0, 1) if self.coupled else values

    def _covariance(
        self, processes: Processes, x1: Tensor, impedance1: Tensor, x2: Tensor, impedance2: Tensor
    ) -> Tensor:
        table = _trajectory(processes, x1, x2)
        blocks = torch.einsum("gniac,ijcgnm,gmjbc->gabnm", impedance1, table, impedance2)
        residual = _residual(processes, x1, x2)
        return self._assemble(blocks, residual)

    def _assemble(self, blocks: Tensor, residual: Tensor) -> Tensor:
        """Blocks `(groups, axes, axes, n, m)` and what axes have of their own `(axes, groups, n, m)`."""
        if not self.coupled:
            return blocks.diagonal(dim1=1, dim2=2).movedim(-1, 0) + residual
        groups, axes, _, n, m = blocks.shape
        own = torch.diag_embed(residual.movedim(0, -1)).movedim((-2, -1), (1, 2))
        return (blocks + own).transpose(2, 3).reshape(1, groups, axes * n, axes * m)

    def _cross(
        self, processes: Processes, impedance: Tensor, target: Features, target_impedance: Tensor, latent: Latent
    ) -> Tensor:  # fmt: skip
        x1, x2 = self.features.inputs, target.inputs
        if latent is Latent.FORCE:
            cross = self._covariance(processes, x1, impedance, x2, target_impedance)
        elif latent is Latent.RESIDUAL_FORCE:
            groups, axes = impedance.shape[0], impedance.shape[-1]
            zero = x1.new_zeros(groups, axes, axes, x1.shape[-2], x2.shape[-2])
            cross = self._assemble(zero, _residual(processes, x1, x2))
        else:
            table = _trajectory(processes, x1, x2)[:, TRAJECTORY_ORDER[latent]]
            blocks = torch.einsum("gniac,icgnm->gacnm", impedance, table)
            cross = self._assemble(blocks, x1.new_zeros(()).expand(table.shape[1:]))
        if self.features.valid is None:
            return cross
        return cross * self._rows(self.features.valid.expand(x1.shape[:-1])).unsqueeze(-1)

    def _variance(self, processes: Processes, target: Features, impedance: Tensor, latent: Latent) -> Tensor:
        x = target.inputs
        path = processes.layout.path(x)
        common, table = derivative_table(processes.trajectory, path, path, diag=True)
        if latent in TRAJECTORY_ORDER:
            order = TRAJECTORY_ORDER[latent]
            return (common * table[order][order]).expand(x.shape[:-1])
        residual = x.new_zeros(x.shape[:-1])
        for term in processes.residual:
            residual = residual + evaluate(term, x, x, diag=True)
        if latent is Latent.RESIDUAL_FORCE:
            return residual
        stacked = _stack(common, table, x.shape[:-1])
        return torch.einsum("gniac,ijcgn,gnjac->agn", impedance, stacked, impedance) + residual


def _trajectory(processes: Processes, x1: Tensor, x2: Tensor) -> Tensor:
    """∂_tⁱ ∂_t'ʲ k_xd of each component, `(3, 3, axes, groups, n, m)`."""
    layout = processes.layout
    common, table = derivative_table(processes.trajectory, layout.path(x1), layout.path(x2))
    shared = same_label(x1, x2, layout.trajectory)
    common = common if shared is None else common * shared
    return _stack(common, table, torch.Size([*x1.shape[:-1], x2.shape[-2]]))


def _stack(common: Tensor, table: Table, shape: torch.Size) -> Tensor:
    return torch.stack([torch.stack([(common * entry).expand(shape) for entry in row]) for row in table])


def _residual(processes: Processes, x1: Tensor, x2: Tensor) -> Tensor:
    total = x1.new_zeros(*x1.shape[:-1], x2.shape[-2])
    for term in processes.residual:
        total = total + evaluate(term, x1, x2)
    shared = same_label(x1, x2, processes.layout.residual)
    return total if shared is None else total * shared
