"""Posteriors where axes are independent: each latent of an axis given the forces along it.

Levels of stiffness, damping and mass that were learned are uncertain too. Their hyperprior enters as a
Gaussian offset b_j of each process, linearised at the fitted level: u gains Σ_j ē_j sensitivity_j b_j. So
where ē = 0 (the equilibrium prior) the posterior of an impedance keeps the whole width of its hyperprior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bayes_impedance.engines.closed_loop import LoopEvidence
from bayes_impedance.engines.dense import Factor
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import (
    IMPEDANCE_ORDER,
    TRAJECTORY_ORDER,
    Derivatives,
    InteractionKernel,
    Latent,
)
from bayes_impedance.kernels.warped import ImpedanceProcess, evaluate
from bayes_impedance.posterior.conditioning import Moments, offset_covariance, unwarped
from bayes_impedance.priors import Entry, ForceModel
from bayes_impedance.training import observations


class IndependentConditioner:
    """Forces given once, conditioned on for any number of targets; the prior's constants are those of `prior`.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """

    def __init__(self, prior: IndependentPrior, given: Features, jitter: float) -> None:
        self.prior, self.model, self.given = prior, prior.model, given
        forces = observations(self.model, given)
        self.factor = Factor(self.model.kernel, forces, jitter)
        self.has_levels = prior.level_variance is not None
        if prior.level_variance is not None:
            self.white_loading = self.factor.whiten(_level_loading(self.model, given.inputs, Latent.FORCE))
            self.level_covariance = offset_covariance(self.white_loading, prior.level_variance)
        self.loop = None
        if given.loop is not None:
            self.loop = LoopEvidence(self.model.kernel.impedance, self.factor, forces, given.loop)
            loading = self.loop.apparent.loading - self.loop.white.mT @ self.white_loading
            self.loop_loading = self.level_covariance @ loading.mT
            variance = self.loop.variance + (loading @ self.loop_loading).sum((-2, -1))
            self.loop_gain = self.loop.gain(variance).unsqueeze(-1)

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of each latent at the samples of `target`."""
        x = target.inputs
        derivatives = self.prior.derivatives(self.given.inputs, x, latents)
        result = {}
        for latent, prior in self.prior.at(target, latents).items():
            # A constant has one covariance with a force, whatever the target.
            at = x[..., :1, :] if self.prior.is_constant(latent) else x
            cross = self._cross_covariance(at, latent, derivatives)
            moments = self._moments(at, latent, prior, cross)
            result[latent] = _broadcast(x.shape[:-1], *moments)
        return result

    def _moments(self, x: Tensor, latent: Latent, prior: LatentPrior, cross: Tensor) -> Sequence[Tensor]:
        white = self.factor.whiten(cross)
        # On padding α is zero.
        location = prior.location + (cross.mT @ self.factor.alpha.unsqueeze(-1)).squeeze(-1)
        # Rounding can push the variance of a fully determined variable just below zero.
        known = (prior.own_variance - white.square().sum(-2)).clamp_min(0.0)
        variance = known
        if self.has_levels:
            loading = prior.loading - white.mT @ self.white_loading
            variance = variance + ((loading @ self.level_covariance) * loading).sum(-1)
        if self.loop is not None:
            with_loop = self.loop.covariance(x, latent, white)
            location = location + with_loop * self.loop.jacobian.slope.unsqueeze(-1)
            with_loop = with_loop + (loading @ self.loop_loading).squeeze(-1)
            variance = (variance - with_loop.square() * self.loop_gain).clamp_min(0.0)
        if is_warped(self.model, latent):
            location = unwarped(location, prior.location, known, prior.own_variance)
        if latent is Latent.FORCE:
            variance = variance + self.model.noise_variance
        return location, variance, prior.shown, prior.variance

    def _cross_covariance(self, x: Tensor, latent: Latent, derivatives: Derivatives | None) -> Tensor:
        kernel = self.model.kernel
        if isinstance(kernel, InteractionKernel):
            return kernel.cross_covariance(self.given.inputs, x, latent, derivatives)
        return evaluate(kernel, self.given.inputs, x)


def is_warped(model: ForceModel, latent: Latent) -> bool:
    """Whether it is the logarithm of the latent that is conditioned."""
    if latent not in IMPEDANCE_ORDER or not isinstance(model.kernel, InteractionKernel):
        return False
    process: ImpedanceProcess = model.kernel.impedance.processes[IMPEDANCE_ORDER[latent]]
    return process.law == "log_gaussian"


class LatentPrior(NamedTuple):
    """Prior of a latent at some samples, `(axes, groups, m)` each or what broadcasts to it.

    `location` at the fitted levels, `shown` before training; `own_variance` at known levels and without noise,
    `variance` with both; `loading` is the derivative of the location by the levels' offsets b_j.
    """

    location: Tensor
    shown: Tensor
    own_variance: Tensor
    variance: Tensor
    loading: Tensor


class IndependentPrior:
    """Prior of every latent; what does not depend on the samples is computed once."""

    def __init__(self, model: ForceModel) -> None:
        self.model = model
        self.level_variance: Tensor | None = None
        self._medians: dict[Latent, Tensor] = {}
        if isinstance(model.kernel, InteractionKernel):
            entries = {entry.name: entry for entry in model.entries}
            levels = {latent: entries[f"{latent.value}.level"] for latent in IMPEDANCE_ORDER}
            self._medians = {latent: entry.medians for latent, entry in levels.items()}
            self.level_variance = _level_variance(model, levels)

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of each latent at the samples of `target`, where no force is given."""
        shape = target.inputs.shape[:-1]
        return {
            latent: _broadcast(shape, prior.location, prior.variance, prior.shown, prior.variance)
            for latent, prior in self.at(target, latents).items()
        }

    def derivatives(
        self, x1: Tensor, x2: Tensor, latents: Sequence[Latent], diag: bool = False
    ) -> Derivatives | None:
        """Those of the desired trajectory, which its latents and the force have in common; None without any."""
        kernel = self.model.kernel
        shared = any(latent in TRAJECTORY_ORDER or latent is Latent.FORCE for latent in latents)
        if not shared or not isinstance(kernel, InteractionKernel):
            return None
        return kernel.impedance.derivatives(x1, x2, diag)

    def is_constant(self, latent: Latent) -> bool:
        """Whether it is an impedance that no input changes."""
        kernel = self.model.kernel
        if latent not in IMPEDANCE_ORDER or not isinstance(kernel, InteractionKernel):
            return False
        return kernel.impedance.processes[IMPEDANCE_ORDER[latent]].covariance.num_dims == 0

    def at(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, LatentPrior]:
        """Prior of each latent at the samples of `target`."""
        x = target.inputs
        derivatives = self.derivatives(x, x, latents, diag=True)
        return {latent: self._at(target, latent, derivatives) for latent in latents}

    def _at(self, target: Features, latent: Latent, derivatives: Derivatives | None) -> LatentPrior:
        model = self.model
        own = self._own_variance(target.inputs, latent, derivatives)
        loading = _level_loading(model, target.inputs, latent)
        variance = own
        if self.level_variance is not None:
            variance = own + (loading.square() * self.level_variance.unsqueeze(-2)).sum(-1)
        if latent is Latent.FORCE:
            location = model.prior_mean(target.inputs)
            return LatentPrior(location, location, own, variance + model.noise_variance, loading)
        if latent is Latent.RESIDUAL_FORCE:
            location = torch.zeros_like(own)
            return LatentPrior(location, location, own, variance, loading)
        if latent in TRAJECTORY_ORDER:
            location = target.trajectory_mean[..., TRAJECTORY_ORDER[latent]]
            return LatentPrior(location, location, own, variance, loading)
        process = model.kernel.impedance.processes[IMPEDANCE_ORDER[latent]]
        level, median = process.level[..., 0], self._medians[latent]
        if process.law == "log_gaussian":
            level, median = level.log(), median.log()
        return LatentPrior(level, median, own, variance, loading)

    def _own_variance(self, x: Tensor, latent: Latent, derivatives: Derivatives | None) -> Tensor:
        """Prior variance at known levels, without noise."""
        kernel = self.model.kernel
        if isinstance(kernel, InteractionKernel):
            return kernel.prior_variance(x, latent, derivatives)
        return evaluate(kernel, x, x, diag=True)


def _broadcast(shape: torch.Size, a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Moments:
    return a.expand(shape), b.expand(shape), c.expand(shape), d.expand(shape)


def _level_variance(model: ForceModel, levels: Mapping[Latent, Entry]) -> Tensor:
    """Var[b_j], `(axes, 1, 3)`."""
    variances = []
    for latent, order in IMPEDANCE_ORDER.items():
        process = model.kernel.impedance.processes[order]
        spec = levels[latent].specs[0]
        log_sd = 0.0 if spec.fixed else spec.log_sd
        level = process.level[..., 0]
        scale = level if process.law == "gaussian" else torch.ones_like(level)
        variances.append((scale * log_sd).square())
    return torch.cat(variances, dim=-1)


def _level_loading(model: ForceModel, inputs: Tensor, latent: Latent) -> Tensor:
    """Derivative of the latent's prior location by each b_j, `(axes, groups, n, 3)`; zero for a naive GP."""
    loading = inputs.new_zeros(*inputs.shape[:-1], len(IMPEDANCE_ORDER))
    if latent in IMPEDANCE_ORDER:
        loading[..., IMPEDANCE_ORDER[latent]] = 1.0
    if latent is not Latent.FORCE or not isinstance(model.kernel, InteractionKernel):
        return loading
    impedance = model.kernel.impedance
    errors = impedance.layout.errors(inputs, impedance.order)
    if errors is not None:
        for j, process in enumerate(impedance.processes):
            loading[..., j] = (errors[j] * process.sensitivity(inputs)).squeeze(-1)
    return loading
