"""Posteriors where axes are coupled: the logarithms of the terms of K, D and M, jointly at each sample.

Every latent is conditioned on the forces of all axes together. Levels that were learned enter as Gaussian offsets b of
log level and log coupling, as where axes are independent; a pair's terms take their share of them: g_r gains
Σ_b T_rb b.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bayes_impedance.engines.coupled_loop import CoupledLoopEvidence
from bayes_impedance.engines.dense import Factor
from bayes_impedance.features import Features
from bayes_impedance.kernels.coupled import (
    CoupledInteractionKernel,
    Derivatives,
    by_axis,
    join_axes,
    rows_of,
)
from bayes_impedance.kernels.coupled_terms import CoupledProcess
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, TRAJECTORY_ORDER, Latent
from bayes_impedance.posterior.conditioning import Moments, log_shift, offset_covariance
from bayes_impedance.posterior.terms import TermMoments
from bayes_impedance.priors import Entry, ForceModel
from bayes_impedance.training import observations


class CoupledPrior:
    """What the prior of a model has that does not depend on samples.

    `variance` of the logarithms of levels and couplings of K, D and M `(3 terms,)`; `shown`: levels of the terms of
    each before training, `(terms,)` [unit of W].
    """

    def __init__(self, model: ForceModel) -> None:
        self.model = model
        entries = {entry.name: entry for entry in model.entries}
        variances, self.shown = [], {}
        for latent, order in IMPEDANCE_ORDER.items():
            own = [entries[f"{latent.value}.{name}"] for name in ("level", "coupling")]
            variances += [_variance(entry) for entry in own]
            self.shown[latent] = _median_levels(model.kernel.impedance.processes[order], *own).reshape(-1)
        self.variance = torch.cat(variances)


class CoupledConditioner:
    """Forces of all axes given once, conditioned on for any number of targets; without `given` the prior.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """

    def __init__(self, prior: CoupledPrior, given: Features | None, jitter: float) -> None:
        self.prior, self.model, self.variance = prior, prior.model, prior.variance
        self.kernel: CoupledInteractionKernel = self.model.kernel
        self.factor: Factor | None = None
        if given is not None:
            self.inputs = self._joined(given)
            forces = observations(self.model, given)
            self.factor = Factor(self.kernel, forces, jitter)
            self.white_loading = self.factor.whiten(self._level_loading(self.inputs))
            self.level_covariance = offset_covariance(
                self.white_loading.mT @ self.white_loading, self.variance
            )
            self.loop: CoupledLoopEvidence | None = None
            if given.loop is not None:
                self.loop = CoupledLoopEvidence(self.kernel.impedance, self.factor, forces, given.loop)
                loading = self._by_level(self.loop.apparent.loading) - self.loop.white.mT @ self.white_loading
                self.loop_levels = self.level_covariance @ loading.mT
                self.loop_gain = self.loop.gain(self.loop.covariance + loading @ self.loop_levels)

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of latents that are no impedance, `(axes, groups, m)` each."""
        wanted = [latent for latent in latents if latent not in IMPEDANCE_ORDER]
        if not wanted:
            return {}
        x = self._joined(target)
        # What the force and the desired trajectory have in common.
        before = self.kernel.impedance.derivatives(x, x, diag=True)
        after = None if self.factor is None else self.kernel.impedance.derivatives(self.inputs, x)
        return {latent: self._latent(target, x, latent, before, after) for latent in wanted}

    def terms(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, TermMoments]:
        """Moments of the terms of each impedance."""
        x = self._joined(target)
        result: dict[Latent, TermMoments] = {}
        for latent in latents:
            if latent not in IMPEDANCE_ORDER:
                continue
            order = IMPEDANCE_ORDER[latent]
            if self.kernel.impedance.processes[order].covariance.num_dims:
                result[latent] = self._terms(x, order, latent)
            else:
                # A constant has one law, whatever the target.
                one = self._terms(x[..., :1, :], order, latent)
                result[latent] = TermMoments(*(_repeated(part, x.shape[-2]) for part in one))
        return result

    def _joined(self, features: Features) -> Tensor:
        return join_axes(features.inputs, self.kernel.impedance.layout)

    def _latent(
        self, target: Features, x: Tensor, latent: Latent, before: Derivatives, after: Derivatives | None
    ) -> Moments:
        own = self.kernel.prior_variance(x, latent, before)
        prior_location = self._prior_location(target, x, latent).expand_as(own)
        loading = x.new_zeros(*own.shape, len(self.variance))
        noise = torch.zeros((), dtype=x.dtype)
        if latent is Latent.FORCE:
            loading = self._level_loading(x)
            noise = self.model.noise_variance.reshape(-1).repeat(x.shape[-2])
        prior_variance = own + (loading.square() * self.variance).sum(-1) + noise
        location, variance = prior_location, prior_variance
        if self.factor is not None:
            cross = self.kernel.cross_covariance(self.inputs, x, latent, after)
            white = self.factor.whiten(cross)
            # On padding α is zero.
            location = prior_location + (cross.mT @ self.factor.alpha.unsqueeze(-1)).squeeze(-1)
            known = (own - white.square().sum(-2)).clamp_min(0.0)
            rest = loading - white.mT @ self.white_loading
            variance = known + ((rest @ self.level_covariance) * rest).sum(-1)
            if self.loop is not None:
                with_loop = -white.mT @ self.loop.white
                if latent is Latent.FORCE:
                    with_loop = with_loop + self.loop.apparent.force_covariance(x)
                location = location + (with_loop @ self.loop.jacobian.slope.unsqueeze(-1)).squeeze(-1)
                with_loop = with_loop + rest @ self.loop_levels
                variance = (variance - ((with_loop @ self.loop_gain) * with_loop).sum(-1)).clamp_min(0.0)
            variance = variance + noise
        rows = (location, variance, prior_location, prior_variance)
        a, b, c, d = (by_axis(part, self.kernel.impedance.axes) for part in rows)
        return a, b, c, d

    def _prior_location(self, target: Features, x: Tensor, latent: Latent) -> Tensor:
        if latent is Latent.FORCE:
            return self.kernel.prior_mean(x)
        if latent is Latent.RESIDUAL_FORCE:
            return torch.zeros((), dtype=x.dtype)
        return rows_of(target.trajectory_mean[..., TRAJECTORY_ORDER[latent]])

    def _terms(self, x: Tensor, order: int, latent: Latent) -> TermMoments:
        process = self.kernel.impedance.processes[order]
        count = len(process.shares)
        shape = (*x.shape[:-1], count)
        own = process.gaussian_covariance(x, x, diag=True).movedim(0, -1).expand(shape)
        before, shown = process.levels.reshape(-1), self.prior.shown[latent]
        loading = x.new_zeros(count, len(self.variance))
        loading[:, order * count : (order + 1) * count] = process.offsets
        prior_own = torch.diag_embed(own)
        prior_covariance = prior_own + (loading * self.variance) @ loading.mT
        mean_of_one = torch.exp(0.5 * own)
        prior = (shown * mean_of_one, prior_own, prior_covariance)
        if self.factor is None:
            return TermMoments(before * mean_of_one, prior_own, prior_covariance, *prior)
        cross = self.kernel.impedance.impedance_covariance(self.inputs, x, order)
        white = self.factor.whiten(cross)
        shift = (cross.mT @ self.factor.alpha.unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, count))
        # `(groups, m, terms, n)`
        each = white.unflatten(-1, (-1, count)).movedim(-3, -1)
        known = prior_own - each @ each.mT
        rest = loading - each @ self.white_loading.unsqueeze(-3)
        covariance = known + rest @ self.level_covariance.unsqueeze(-3) @ rest.mT
        if self.loop is not None:
            with_loop = self.loop.apparent.term_covariance(x, order) - each @ self.loop.white.unsqueeze(-3)
            shift = shift + (with_loop @ self.loop.jacobian.slope[:, None, :, None]).squeeze(-1)
            with_loop = with_loop + rest @ self.loop_levels.unsqueeze(-3)
            covariance = covariance - with_loop @ self.loop_gain.unsqueeze(-3) @ with_loop.mT
        return TermMoments(before * mean_of_one * log_shift(shift).exp(), known, covariance, *prior)

    def _level_loading(self, x: Tensor) -> Tensor:
        """Derivative of E[u] by the logarithms of levels and couplings of K, D and M, `(groups, n · axes, 3 terms)`."""
        impedance = self.kernel.impedance
        columns = [impedance.row_loading(x, order) for order in range(len(impedance.processes))]
        return self._by_level(torch.cat(columns, dim=-1))

    def _by_level(self, by_term: Tensor) -> Tensor:
        """Derivatives by log levels and couplings from those by the logarithms of the terms of K, D and M."""
        offsets = [process.offsets for process in self.kernel.impedance.processes]
        return by_term @ torch.block_diag(*offsets)


def _variance(entry: Entry) -> Tensor:
    """Variance of the logarithms of one kind of levels or couplings."""
    spec = entry.specs[0]
    return torch.full((entry.raw.numel(),), 0.0 if spec.fixed else spec.log_sd**2, dtype=torch.float64)


def _median_levels(process: CoupledProcess, level: Entry, coupling: Entry) -> Tensor:
    """Levels of the terms before training [unit of W]."""
    medians = (level.medians.expand_as(process.level), coupling.medians.expand_as(process.coupling))
    return process.levels_of(*medians)


def _repeated(values: Tensor, count: int) -> Tensor:
    """`(groups, 1, …)` for `count` samples alike."""
    return values.expand(-1, count, *values.shape[2:])
