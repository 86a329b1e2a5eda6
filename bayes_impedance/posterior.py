"""Gaussian posteriors of every latent, given forces (docs/model.md §4).

The covariance between the force and another process is the primitive: predicting x_d is the same code as
predicting u. Warped impedance is conditioned in the logarithm, so its quantiles are positive.

Levels of stiffness, damping and mass that were learned are uncertain too. Their hyperprior enters as a
Gaussian offset b_j of each process, linearised at the fitted level: u gains Σ_j ē_j sensitivity_j b_j. So
where ē = 0 (the equilibrium prior) the posterior of an impedance keeps the whole width of its hyperprior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.stats import norm
from torch import Tensor

from bayes_impedance.engines.closed_loop import LoopEvidence
from bayes_impedance.engines.dense import Factor
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, TRAJECTORY_ORDER, InteractionKernel, Latent
from bayes_impedance.kernels.warped import ImpedanceProcess
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import Entry, ForceModel
from bayes_impedance.training import observations

Array = NDArray[np.float64]

UNITS: Mapping[Latent, str] = {
    Latent.FORCE: "N",
    Latent.RESIDUAL_FORCE: "N",
    Latent.DESIRED_POSITION: "m",
    Latent.DESIRED_VELOCITY: "m/s",
    Latent.DESIRED_ACCELERATION: "m/s²",
    Latent.STIFFNESS: "N/m",
    Latent.DAMPING: "Ns/m",
    Latent.MASS: "kg",
}

#: Targets are taken this many at a time, which bounds memory whatever the length of the log.
CHUNK = 512


@dataclass(frozen=True)
class Marginal:
    """Posterior of one latent at each sample, beside its prior.

    `location`, `scale`: mean and SD of the Gaussian variable, `(samples, axes)`: the latent, or its
    logarithm where `warped`.

    Example:
        >>> location, scale = np.log([[300.0], [200.0]]), np.full((2, 1), 0.1)
        >>> stiffness = Marginal(Latent.STIFFNESS, True, location, scale, location, 10 * scale)
        >>> stiffness.quantile(0.5).round().tolist()
        [[300.0], [200.0]]
        >>> stiffness.contraction.round(2).tolist()
        [0.99]
    """

    latent: Latent
    warped: bool
    location: Array
    scale: Array
    prior_location: Array
    prior_scale: Array

    @property
    def mean(self) -> Array:
        """Posterior mean, `(samples, axes)` [unit of the latent]."""
        return np.exp(self.location + 0.5 * self.scale**2) if self.warped else self.location

    @property
    def sd(self) -> Array:
        """Posterior SD, `(samples, axes)` [unit of the latent]."""
        return self.mean * np.sqrt(np.expm1(self.scale**2)) if self.warped else self.scale

    def quantile(self, probability: float) -> Array:
        """Posterior quantile, `(samples, axes)` [unit of the latent]; positive where warped."""
        return self._quantile(self.location, self.scale, probability)

    def prior_quantile(self, probability: float) -> Array:
        """Prior quantile, `(samples, axes)` [unit of the latent]."""
        return self._quantile(self.prior_location, self.prior_scale, probability)

    @property
    def contraction(self) -> Array:
        """1 − posterior variance / prior variance of the Gaussian variable, averaged over samples, `(axes,)`."""
        prior = np.square(self.prior_scale).mean(axis=0)
        posterior = np.square(self.scale).mean(axis=0)
        # A latent that the configuration fixes has no variance to lose.
        return np.where(prior > 0, 1.0 - posterior / np.where(prior > 0, prior, 1.0), 0.0)

    def _quantile(self, location: Array, scale: Array, probability: float) -> Array:
        value = location + scale * norm.ppf(probability)
        return np.asarray(np.exp(value) if self.warped else value)


@dataclass(frozen=True)
class Posterior:
    """Posteriors of the latents at every sample of a log; immutable.

    `marginals[latent]` holds arrays `(samples, axes)`, samples in the order of `log`'s trials.
    """

    log: PreparedLog
    marginals: Mapping[Latent, Marginal]

    def __getitem__(self, latent: Latent | str) -> Marginal:
        """Marginal of a latent, by member of `Latent` or by name ("stiffness")."""
        return self.marginals[Latent(latent)]

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the log."""
        return self.log.axes

    def trial_slice(self, index: int) -> slice:
        """Rows of trial `index` in the arrays of the marginals."""
        start = sum(len(trial.time) for trial in self.log.trials[:index])
        return slice(start, start + len(self.log.trials[index].time))

    def table(self) -> pd.DataFrame:
        """One row a sample: `trial`, `time` [s], then `<quantity>_<axis>_{mean,sd,q05,q95}` in SI units.

        `source` and `group` precede where the log has several files or groups.
        """
        trials = self.log.trials
        columns: dict[str, object] = {}
        lengths = [len(trial.time) for trial in trials]
        if len({trial.source for trial in trials}) > 1:
            columns["source"] = np.repeat([trial.source for trial in trials], lengths)
        if len({trial.group for trial in trials}) > 1:
            columns["group"] = np.repeat([trial.group for trial in trials], lengths)
        columns["trial"] = np.repeat([trial.name for trial in trials], lengths)
        columns["time"] = np.concatenate([trial.time for trial in trials])
        for latent, marginal in self.marginals.items():
            low, high = marginal.quantile(0.05), marginal.quantile(0.95)
            for a, axis in enumerate(self.axes):
                name = f"{latent.value}_{axis}{axis if latent in IMPEDANCE_ORDER else ''}"
                columns[f"{name}_mean"] = marginal.mean[:, a]
                columns[f"{name}_sd"] = marginal.sd[:, a]
                columns[f"{name}_q05"] = low[:, a]
                columns[f"{name}_q95"] = high[:, a]
        return pd.DataFrame(columns)


def compute_posterior(
    model: ForceModel,
    log: PreparedLog,
    target: Features,
    given: Features | None,
    jitter: float,
    latents: Sequence[Latent] | None = None,
) -> Posterior:
    """Posteriors at `target`, the features of `log`, given the forces of `given`; the prior where it is None.

    Groups of `target` without a namesake in `given` keep their prior.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """
    if latents is None:
        latents = list(Latent) if isinstance(model.kernel, InteractionKernel) else [Latent.FORCE]
    known = [] if given is None else [g for g in target.groups if g in given.groups]
    unknown = [g for g in target.groups if g not in known]
    parts: list[tuple[list[str], dict[Latent, Moments]]] = []
    with torch.no_grad():
        if known:
            assert given is not None
            conditioner = _Conditioner(model, _select_groups(given, known), jitter)
            parts.append((known, conditioner.moments(_select_groups(target, known), latents)))
        if unknown:
            parts.append((unknown, _prior_only(model, _select_groups(target, unknown), latents)))
    return Posterior(log, {latent: _marginal(model, log, target, latent, parts) for latent in latents})


#: Location, variance, prior location, prior variance, each `(axes, groups, m)`.
Moments = tuple[Tensor, Tensor, Tensor, Tensor]


class _Conditioner:
    """Forces given once, conditioned on for any number of targets."""

    def __init__(self, model: ForceModel, given: Features, jitter: float) -> None:
        self.model, self.given = model, given
        forces = observations(model, given)
        self.factor = Factor(model.kernel, forces, jitter)
        variance = _level_variance(model)
        self.has_levels = variance is not None
        if variance is not None:
            self.white_loading = self.factor.whiten(_level_loading(model, given.inputs, Latent.FORCE))
            gram = self.white_loading.mT @ self.white_loading
            root = variance.sqrt()
            scaled = root.unsqueeze(-1) * gram * root.unsqueeze(-2)
            # Covariance of b given the forces, V½ (I + V½ AᵀK⁻¹A V½)⁻¹ V½, defined for V = 0 too.
            inner = torch.linalg.inv(torch.eye(gram.shape[-1], dtype=gram.dtype) + scaled)
            self.level_covariance = root.unsqueeze(-1) * inner * root.unsqueeze(-2)
        self.loop = None
        if given.loop is not None:
            self.loop = LoopEvidence(model.kernel.impedance, self.factor, forces, given.loop)
            loading = self.loop.apparent.loading - self.loop.white.mT @ self.white_loading
            self.loop_loading = self.level_covariance @ loading.mT
            variance = self.loop.variance + (loading @ self.loop_loading).sum((-2, -1))
            self.loop_gain = self.loop.gain(variance).unsqueeze(-1)

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        result = {}
        for latent in latents:
            pieces = [self._chunk(piece, latent) for piece in _chunks(target)]
            a, b, c, d = zip(*pieces, strict=True)
            result[latent] = tuple(torch.cat(part, dim=-1) for part in (a, b, c, d))
        return result  # type: ignore[return-value]

    def _chunk(self, target: Features, latent: Latent) -> Moments:
        cross = _cross_covariance(self.model, self.given.inputs, target.inputs, latent)
        white = self.factor.whiten(cross)
        prior = _prior(self.model, target, latent)
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
        if _is_warped(self.model, latent):
            location = _unwarped(location, prior.location, known, prior.own_variance)
        if latent is Latent.FORCE:
            variance = variance + self.model.noise_variance
        return location, variance, prior.shown.expand_as(location), prior.variance.expand_as(location)


def _unwarped(location: Tensor, prior_location: Tensor, variance: Tensor, prior_variance: Tensor) -> Tensor:
    """Location of log w to second order: that of the log-normal whose moments are those of w given the forces.

    To first order E[w|u] = E[w] (1 + a) with the shift a of log w, and E[w] = exp(location + ½ prior variance). The
    logarithm of 1 + a is replaced by its expansion below zero, where a linear estimate of w may become negative.
    """
    a = location - prior_location
    log = torch.where(a > 0.0, torch.log1p(a.clamp_min(0.0)), a - 0.5 * a.square())
    return prior_location + 0.5 * (prior_variance - variance) + log


def _is_warped(model: ForceModel, latent: Latent) -> bool:
    if latent not in IMPEDANCE_ORDER or not isinstance(model.kernel, InteractionKernel):
        return False
    process: ImpedanceProcess = model.kernel.impedance.processes[IMPEDANCE_ORDER[latent]]
    return process.law == "log_gaussian"


def _prior_only(model: ForceModel, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
    result = {}
    shape = target.inputs.shape[:-1]
    for latent in latents:
        prior = _prior(model, target, latent)
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


class _Prior(NamedTuple):
    """Prior of a latent at some samples, `(axes, groups, m)` each or what broadcasts to it.

    `location` at the fitted levels, `shown` before training; `own_variance` at known levels and without noise,
    `variance` with both; `loading` is the derivative of the location by the levels' offsets b_j.
    """

    location: Tensor
    shown: Tensor
    own_variance: Tensor
    variance: Tensor
    loading: Tensor


def _prior(model: ForceModel, target: Features, latent: Latent) -> _Prior:
    own = _own_variance(model, target, latent)
    loading = _level_loading(model, target.inputs, latent)
    levels = _level_variance(model)
    variance = own if levels is None else own + (loading.square() * levels.unsqueeze(-2)).sum(-1)
    if latent is Latent.FORCE:
        location = model.prior_mean(target.inputs)
        return _Prior(location, location, own, variance + model.noise_variance, loading)
    if latent is Latent.RESIDUAL_FORCE:
        location = torch.zeros_like(own)
        return _Prior(location, location, own, variance, loading)
    if latent in TRAJECTORY_ORDER:
        location = target.trajectory_mean[..., TRAJECTORY_ORDER[latent]]
        return _Prior(location, location, own, variance, loading)
    process = model.kernel.impedance.processes[IMPEDANCE_ORDER[latent]]
    level, median = process.level[..., 0], _level_entry(model, latent).medians
    if process.law == "log_gaussian":
        level, median = level.log(), median.log()
    return _Prior(level, median, own, variance, loading)


def _level_entry(model: ForceModel, latent: Latent) -> Entry:
    return next(entry for entry in model.entries if entry.name == f"{latent.value}.level")


def _level_variance(model: ForceModel) -> Tensor | None:
    """Var[b_j], `(axes, 1, 3)`; None for a naive GP."""
    if not isinstance(model.kernel, InteractionKernel):
        return None
    variances = []
    for latent, order in IMPEDANCE_ORDER.items():
        process = model.kernel.impedance.processes[order]
        spec = _level_entry(model, latent).specs[0]
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


def _marginal(
    model: ForceModel, log: PreparedLog, target: Features, latent: Latent,
    parts: Sequence[tuple[list[str], dict[Latent, Moments]]],
) -> Marginal:  # fmt: skip
    """Undo the batching: rows of groups back to samples of trials."""
    starts = np.cumsum([0, *(len(trial.time) for trial in log.trials)])
    arrays = np.empty((4, starts[-1], len(log.axes)))
    for groups, moments in parts:
        stacked = torch.stack(moments[latent]).numpy()
        for g, group in enumerate(groups):
            rows = target.rows[target.groups.index(group)]
            arrays[:, starts[rows[:, 0]] + rows[:, 1]] = np.moveaxis(stacked[:, :, g, : len(rows)], 1, 2)
    location, variance, prior_location, prior_variance = arrays
    warped = _is_warped(model, latent)
    return Marginal(latent, warped, location, np.sqrt(variance), prior_location, np.sqrt(prior_variance))


def _select_groups(features: Features, groups: Sequence[str]) -> Features:
    index = [features.groups.index(group) for group in groups]
    return replace(
        features,
        groups=tuple(groups),
        inputs=features.inputs[:, index],
        force=None if features.force is None else features.force[:, index],
        trajectory_mean=features.trajectory_mean[:, index],
        valid=None if features.valid is None else features.valid[index],
        rows=tuple(features.rows[i] for i in index),
        loop=None if features.loop is None else features.loop.select(index),
    )


def _chunks(features: Features) -> list[Features]:
    starts = range(0, features.inputs.shape[2], CHUNK)
    pieces = [slice(start, start + CHUNK) for start in starts]
    return [
        replace(
            features,
            inputs=features.inputs[:, :, piece],
            force=None,
            trajectory_mean=features.trajectory_mean[:, :, piece],
            valid=None,
        )
        for piece in pieces
    ]
