"""Posteriors where axes are coupled: the logarithms of the terms of K, D and M, jointly at each sample.

Every latent is conditioned on the forces of all axes together. Levels that were learned enter as Gaussian offsets b of
log level and log coupling, as where axes are independent; a pair's terms take their share of them: g_r gains
Σ_b T_rb b.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.coupled_loop import CoupledLoopEvidence
from bayes_impedance.engines.dense import Factor
from bayes_impedance.features import Features
from bayes_impedance.kernels.coupled import CoupledInteractionKernel, by_axis, join_axes, rows_of
from bayes_impedance.kernels.coupled_terms import CoupledProcess, term_directions
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, TRAJECTORY_ORDER, Latent
from bayes_impedance.posterior.conditioning import Moments, chunks, entry_of, log_shift, offset_covariance
from bayes_impedance.priors import ForceModel
from bayes_impedance.training import observations

Array = NDArray[np.float64]


class TermMoments(NamedTuple):
    """Moments of the terms of a matrix, then those of their prior: `(groups, m, terms)`, `(groups, m, terms, terms)`.

    See `LogTerms`.
    """

    expected: Tensor
    own: Tensor
    covariance: Tensor
    prior_expected: Tensor
    prior_own: Tensor
    prior_covariance: Tensor


@dataclass(frozen=True)
class LogTerms:
    """Posterior of the terms w_r = e^{g_r} of W = Σ_r a_r a_rᵀ w_r at each sample, beside its prior.

    `expected` E[w_r] at known levels `(samples, terms)` [unit of W]; covariances of g `(samples, terms, terms)`: `own`
    at known levels, `covariance` with the uncertainty of the levels. The terms are those of `term_directions`.

    What the data tell is W and not its terms: one that is small stays uncertain by itself, and the others make up for
    it. So W is expanded to first order in the deviations δ of g, in which this cancels as it should, and each entry has
    the law that it would have with one term: with W̄ = Σ_r a_r a_rᵀ E[w_r] and Σ the covariance of g,

        log W_aa ~ N(log W̄_aa − ½ pᵀ Σ_own p, pᵀ Σ p),   p_r = a_ra² E[w_r] / W̄_aa
        W_ab     ~ N(W̄_ab, cᵀ Σ c),                       c_r = a_ra a_rb E[w_r]

    Moments of the log-normal terms themselves would lift the diagonal by the variance of what is not known of each.

    Example:
        >>> prior = np.array([[200.0, 200.0, 60.0, 60.0]]), 0.01 * np.eye(4)[None], 0.01 * np.eye(4)[None]
        >>> stiffness = LogTerms(2, *prior, *prior)
        >>> stiffness.mean().round().tolist(), stiffness.draw(2, np.random.default_rng(0)).shape
        ([[[260.0, 0.0], [0.0, 260.0]]], (2, 1, 2, 2))
    """

    axes: int
    expected: Array
    own: Array
    covariance: Array
    prior_expected: Array
    prior_own: Array
    prior_covariance: Array

    def mean(self, prior: bool = False) -> Array:
        """W̄, `(samples, axes, axes)` [unit of W]."""
        return np.einsum("rab,nr->nab", self._dyads(), self._of(prior)[0])

    def diagonal(self, prior: bool = False) -> tuple[Array, Array]:
        """Location and scale of log W_aa, `(samples, axes)` each."""
        expected, own, covariance = self._of(prior)
        centre = self.mean(prior).diagonal(axis1=1, axis2=2)
        shares = np.einsum("raa,nr->nar", self._dyads(), expected) / centre[..., None]
        location = np.log(centre) - 0.5 * _quadratic(shares, own)
        # Rounding can push the variance of a fully determined entry just below zero.
        return location, np.sqrt(_quadratic(shares, covariance).clip(min=0.0))

    def off_diagonal(self, prior: bool = False) -> tuple[Array, Array]:
        """Mean and SD of W_ab, `(samples, pairs)` each [unit of W]."""
        expected, _, covariance = self._of(prior)
        rows, columns = np.triu_indices(self.axes, 1)
        slopes = np.einsum("rp,nr->npr", self._dyads()[:, rows, columns], expected)
        return self.mean(prior)[:, rows, columns], np.sqrt(_quadratic(slopes, covariance).clip(min=0.0))

    def draw(self, draws: int, generator: np.random.Generator, prior: bool = False) -> Array:
        """Matrices W, `(draws, samples, axes, axes)` [unit of W], positive definite; samples are drawn each on its own.

        Of the prior W = Σ_r a_r a_rᵀ e^{g_r}. Of the posterior W = L exp(X) L with L² = W̄, X = Y − ½ E[Y²], Y = Σ_r δ_r
        P_r and P_r = L⁻¹ a_r a_rᵀ L⁻¹ E[w_r]: to first order in δ the same, for Σ_r P_r = I.
        """
        expected, own, covariance = self._of(prior)
        values, vectors = np.linalg.eigh(covariance)
        roots = vectors * np.sqrt(values.clip(min=0.0))[:, None]
        deviation = np.einsum("nrs,dns->dnr", roots, generator.standard_normal((draws, *expected.shape)))
        if prior:
            terms = expected * np.exp(deviation - 0.5 * own.diagonal(axis1=1, axis2=2))
            return np.einsum("rab,dnr->dnab", self._dyads(), terms)
        root = _function(self.mean(), np.sqrt)
        inverse = np.linalg.inv(root)
        parts = np.einsum("nab,rbc,ncd,nr->nrad", inverse, self._dyads(), inverse, expected, optimize=True)
        square = np.einsum("nrs,nrab,nsbc->nac", own, parts, parts, optimize=True)
        exponent = np.einsum("dnr,nrab->dnab", deviation, parts) - 0.5 * square
        return root @ _function(exponent, np.exp) @ root

    def _of(self, prior: bool) -> tuple[Array, Array, Array]:
        if prior:
            return self.prior_expected, self.prior_own, self.prior_covariance
        return self.expected, self.own, self.covariance

    def _dyads(self) -> Array:
        directions: Array = term_directions(self.axes).numpy()
        return directions[:, :, None] * directions[:, None]


def _quadratic(weights: Array, covariance: Array) -> Array:
    """wᵀ Σ w of `weights` `(samples, …, terms)`, `(samples, …)`."""
    return np.einsum("nar,nrs,nas->na", weights, covariance, weights, optimize=True)


def _function(matrices: Array, function: Callable[[Array], Array]) -> Array:
    """A function of symmetric matrices, by their eigenvalues."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * function(values)[..., None, :]) @ vectors.swapaxes(-1, -2))


class CoupledConditioner:
    """Forces of all axes given once, conditioned on for any number of targets; without `given` the prior.

    Raises:
        NotPositiveDefiniteError: the covariance of the given forces does not factorise.
    """

    def __init__(self, model: ForceModel, given: Features | None, jitter: float) -> None:
        self.model = model
        self.kernel: CoupledInteractionKernel = model.kernel
        self.variance = torch.cat([_level_variance(model, latent) for latent in IMPEDANCE_ORDER])
        self.factor: Factor | None = None
        if given is not None:
            self.inputs = self._joined(given)
            forces = observations(model, given)
            self.factor = Factor(self.kernel, forces, jitter)
            self.white_loading = self.factor.whiten(self._level_loading(self.inputs))
            self.level_covariance = offset_covariance(self.white_loading.mT @ self.white_loading, self.variance)
            self.loop: CoupledLoopEvidence | None = None
            if given.loop is not None:
                self.loop = CoupledLoopEvidence(self.kernel.impedance, self.factor, forces, given.loop)
                loading = self._by_level(self.loop.apparent.loading) - self.loop.white.mT @ self.white_loading
                self.loop_levels = self.level_covariance @ loading.mT
                self.loop_gain = self.loop.gain(self.loop.covariance + loading @ self.loop_levels)

    def moments(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, Moments]:
        """Moments of latents that are no impedance, `(axes, groups, m)` each."""
        result: dict[Latent, Moments] = {}
        for latent in latents:
            if latent not in IMPEDANCE_ORDER:
                a, b, c, d = _joined_pieces([self._latent(piece, latent) for piece in chunks(target)], dim=-1)
                result[latent] = (a, b, c, d)
        return result

    def terms(self, target: Features, latents: Sequence[Latent]) -> dict[Latent, TermMoments]:
        """Moments of the terms of each impedance."""
        result: dict[Latent, TermMoments] = {}
        for latent in latents:
            if latent in IMPEDANCE_ORDER:
                pieces = [self._terms(piece, IMPEDANCE_ORDER[latent], latent) for piece in chunks(target)]
                result[latent] = TermMoments(*_joined_pieces(pieces, dim=1))
        return result

    def _joined(self, features: Features) -> Tensor:
        return join_axes(features.inputs, self.kernel.impedance.layout)

    def _latent(self, target: Features, latent: Latent) -> Moments:
        x = self._joined(target)
        own = self.kernel.prior_variance(x, latent)
        prior_location = self._prior_location(target, x, latent).expand_as(own)
        loading = x.new_zeros(*own.shape, len(self.variance))
        noise = torch.zeros((), dtype=x.dtype)
        if latent is Latent.FORCE:
            loading = self._level_loading(x)
            noise = self.model.noise_variance.reshape(-1).repeat(x.shape[-2])
        prior_variance = own + (loading.square() * self.variance).sum(-1) + noise
        location, variance = prior_location, prior_variance
        if self.factor is not None:
            cross = self.kernel.cross_covariance(self.inputs, x, latent)
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

    def _terms(self, target: Features, order: int, latent: Latent) -> TermMoments:
        x = self._joined(target)
        process = self.kernel.impedance.processes[order]
        count = len(process.shares)
        shape = (*x.shape[:-1], count)
        own = process.gaussian_covariance(x, x, diag=True).movedim(0, -1).expand(shape)
        before, shown = process.levels.reshape(-1), _median_levels(self.model, process, latent).reshape(-1)
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


def _level_variance(model: ForceModel, latent: Latent) -> Tensor:
    """Variance of the logarithms of levels and couplings of one impedance, `(terms,)`."""
    parts = []
    for name in ("level", "coupling"):
        entry = entry_of(model, f"{latent.value}.{name}")
        spec = entry.specs[0]
        parts.append(
            torch.full((entry.raw.numel(),), 0.0 if spec.fixed else spec.log_sd**2, dtype=torch.float64)
        )
    return torch.cat(parts)


def _median_levels(model: ForceModel, process: CoupledProcess, latent: Latent) -> Tensor:
    """Levels of the terms before training [unit of W]."""
    level, coupling = (entry_of(model, f"{latent.value}.{name}").medians for name in ("level", "coupling"))
    return process.levels_of(level.expand_as(process.level), coupling.expand_as(process.coupling))


def _joined_pieces(pieces: Sequence[tuple[Tensor, ...]], dim: int) -> list[Tensor]:
    return [torch.cat(part, dim) for part in zip(*pieces, strict=True)]
