"""Posteriors where axes are independent: each latent of an axis given the forces along it.

Levels of stiffness, damping and mass that were learned are uncertain too. Their hyperprior enters as a
Gaussian offset b_j of each process, linearised at the fitted level: u gains Σ_j ē_j sensitivity_j b_j. So
where ē = 0 (the equilibrium prior) the posterior of an impedance keeps the whole width of its hyperprior.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bayes_impedance.engines.closed_loop import LoopEvidence
from bayes_impedance.engines.dense import Factor
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, TRAJECTORY_ORDER, InteractionKernel, Latent
from bayes_impedance.kernels.warped import ImpedanceProcess
from bayes_impedance.posterior.conditioning import Moments, chunks, entry_of, offset_covariance, unwarped
from bayes_impedance.priors import ForceModel
from bayes_impedance.training import observations


class IndependentConditioner:
    """Forces given once, conditioned on for any number of targets.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """

    def __init__(self, model: ForceModel, given: Features, jitter: float) -> None:
        self.model, self.given = model, given
        forces = observations(model, given)
        self.factor = Factor(model.kernel, forces, jitter)
        variance = level_variance(model)
        self.has_levels = variance is not None
        if variance is not None:
            self.white_loading = self.factor.whiten(level_loading(model, given.inputs, Latent.FORCE))
            self.level_covariance = offset_covariance(self.white_loading.mT @ self.white_loading, variance)
        self.loop = None
        if given.loop is not None:
            self.loop = LoopEvidence(model.kernel.impedance, self.factor, forces, given.loop)
            loading = self.loop.apparent.loading - self.loop.white.mT @ self.white_loading
            self.loop_loading = self.level_covariance @ loading.mT
            variance = self.loop.variance + (loading @ self.loop_loading).sum((-2, -1))
            self.loop_gain = self.loop.gain(variance).unsqueeze(-1)

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of each latent at the samples of `target`."""
        result = {}
        for latent in latents:
            pieces = [self._chunk(piece, latent) for piece in chunks(target)]
            a, b, c, d = zip(*pieces, strict=True)
            result[latent] = tuple(torch.cat(part, dim=-1) for part in (a, b, c, d))
        return result  # type: ignore[return-value]

    def _chunk(self, target: Features, latent: Latent) -> Moments:
        cross = _cross_covariance(self.model, self.given.inputs, target.inputs, latent)
        white = self.factor.whiten(cross)
        prior = prior_of(self.model, target, latent)
        # On padding α is zero.
        location = prior.location + (cross.mT @ self.factor.alpha.unsqueeze(-1)).squeeze(-1)
        # Rounding can push the variance of a fully determined variable just below zero.
        known = (prior.own_variance - white.square().sum(-2)).clamp_min(0.0)
        variance = known
        if self.has_levels:
            loading = prior.loading - white.mT @ self.white_loading
            variance = variance + ((loading @ self.level_covariance) * loading).sum(-1)
        if self.loop is not None:
            with_loop = self.loop.covariance(target.inputs, latent, white)
            location = location + with_loop * self.loop.jacobian.slope.unsqueeze(-1)
            with_loop = with_loop + (loading @ self.loop_loading).squeeze(-1)
            variance = (variance - with_loop.square() * self.loop_gain).clamp_min(0.0)
        if is_warped(self.model, latent):
            location = unwarped(location, prior.location, known, prior.own_variance)
        if latent is Latent.FORCE:
            variance = variance + self.model.noise_variance
        return location, variance, prior.shown.expand_as(location), prior.variance.expand_as(location)


def is_warped(model: ForceModel, latent: Latent) -> bool:
    """Whether it is the logarithm of the latent that is conditioned."""
    if latent not in IMPEDANCE_ORDER or not isinstance(model.kernel, InteractionKernel):
        return False
    process: ImpedanceProcess = model.kernel.impedance.processes[IMPEDANCE_ORDER[latent]]
    return process.law == "log_gaussian"


def prior_only(model: ForceModel, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
    """Moments of each latent where no force is given."""
    result = {}
    shape = target.inputs.shape[:-1]
    for latent in latents:
        prior = prior_of(model, target, latent)
        location, variance = prior.location.expand(shape), prior.variance.expand(shape)
        result[latent] = (location, variance, prior.shown.expand(shape), variance)
    return result


def _cross_covariance(model: ForceModel, x1: Tensor, x2: Tensor, latent: Latent) -> Tensor:
    if isinstance(model.kernel, InteractionKernel):
        return model.kernel.cross_covariance(x1, x2, latent)
    return model.kernel(x1, x2).to_dense()


def _own_variance(model: ForceModel, target: Features, latent: Latent) -> Tensor:
    """Prior variance at known levels, without noise."""
    if isinstance(model.kernel, InteractionKernel):
        return model.kernel.prior_variance(target.inputs, latent)
    return model.kernel(target.inputs, diag=True)


class Prior(NamedTuple):
    """Prior of a latent at some samples, `(axes, groups, m)` each or what broadcasts to it.

    `location` at the fitted levels, `shown` before training; `own_variance` at known levels and without noise,
    `variance` with both; `loading` is the derivative of the location by the levels' offsets b_j.
    """

    location: Tensor
    shown: Tensor
    own_variance: Tensor
    variance: Tensor
    loading: Tensor


def prior_of(model: ForceModel, target: Features, latent: Latent) -> Prior:
    """Prior of a latent at the samples of `target`."""
    own = _own_variance(model, target, latent)
    loading = level_loading(model, target.inputs, latent)
    levels = level_variance(model)
    variance = own if levels is None else own + (loading.square() * levels.unsqueeze(-2)).sum(-1)
    if latent is Latent.FORCE:
        location = model.prior_mean(target.inputs)
        return Prior(location, location, own, variance + model.noise_variance, loading)
    if latent is Latent.RESIDUAL_FORCE:
        location = torch.zeros_like(own)
        return Prior(location, location, own, variance, loading)
    if latent in TRAJECTORY_ORDER:
        location = target.trajectory_mean[..., TRAJECTORY_ORDER[latent]]
        return Prior(location, location, own, variance, loading)
    process = model.kernel.impedance.processes[IMPEDANCE_ORDER[latent]]
    level, median = process.level[..., 0], entry_of(model, f"{latent.value}.level").medians
    if process.law == "log_gaussian":
        level, median = level.log(), median.log()
    return Prior(level, median, own, variance, loading)


def level_variance(model: ForceModel) -> Tensor | None:
    """Var[b_j], `(axes, 1, 3)`; None for a naive GP."""
    if not isinstance(model.kernel, InteractionKernel):
        return None
    variances = []
    for latent, order in IMPEDANCE_ORDER.items():
        process = model.kernel.impedance.processes[order]
        spec = entry_of(model, f"{latent.value}.level").specs[0]
        log_sd = 0.0 if spec.fixed else spec.log_sd
        level = process.level[..., 0]
        scale = level if process.law == "gaussian" else torch.ones_like(level)
        variances.append((scale * log_sd).square())
    return torch.cat(variances, dim=-1)


def level_loading(model: ForceModel, inputs: Tensor, latent: Latent) -> Tensor:
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
