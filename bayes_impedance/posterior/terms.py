"""The law of matrices K, D and M that are sums of log-normal terms, at each sample."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.kernels.coupled_terms import term_directions

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
