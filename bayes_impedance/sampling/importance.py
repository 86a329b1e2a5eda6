"""Draws from an approximation, weighted by how far it is from the posterior, and whether that can be trusted.

Ratios r = p(z | u) / q(z) of draws z ~ q have a Pareto tail. Its shape k says how many moments they have: at k ≤ .7
weights that are smoothed by the fitted tail correct the approximation, beyond no practical number of draws does
(Vehtari, Simpson, Gelman, Yao and Gabry 2024, doi 10.48550/arXiv.1507.02646).
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
import torch
from arviz_stats.base import array_stats
from numpy.typing import NDArray
from scipy.special import logsumexp

from bayes_impedance.config import SamplingConfig
from bayes_impedance.config.inference import SamplingMethod
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.sampling.draws import Draws, Progress
from bayes_impedance.sampling.start import Start

Array = NDArray[np.float64]

#: The largest k at which weights are trusted.
TRUSTED_K = 0.7
#: Degrees of freedom of proposals: the tails of a Gaussian are lighter than those of a posterior over hyperparameters,
#: and in tens of dimensions those of few degrees of freedom lead far away from it.
DEGREES = 30.0
#: Proposals from which a tail is judged, and the fewest of finite density.
PROPOSALS, FEWEST = 1000, 100
#: Proposals are at most so many times the draws asked for, fewer where their weights are worth this share of those.
ROUNDS, ENOUGH = 4, 0.5
#: Evaluations between lines of progress.
REPORTED = 100


@dataclass(frozen=True)
class Weighted:
    """Coordinates `(n, size)` with the log density of the posterior there, up to a constant, and log weights `(n,)`.

    Weights sum to one; those of coordinates without a finite density are zero.
    """

    standard: Array
    log_density: Array
    log_weights: Array
    pareto_k: float

    @property
    def effective(self) -> float:
        """The number of independent draws that tell a mean as well, 1 / Σ w²."""
        return float(np.exp(-logsumexp(2.0 * self.log_weights)))


def log_densities(
    density: SampledDensity, standard: Array, progress: Progress | None = None, done: int = 0
) -> Array:
    """`density.log_density` at each of coordinates `(n, size)`, −∞ where it is not finite or has no Cholesky factor.

    `progress` hears of the evaluations, of which `done` came before.
    """
    values = np.full(len(standard), -np.inf)
    with torch.no_grad(), one_thread():
        for i, point in enumerate(torch.from_numpy(standard)):
            with contextlib.suppress(NotPositiveDefiniteError):
                value = float(density.log_density(point))
                values[i] = value if np.isfinite(value) else -np.inf
            if progress is not None and (done + i + 1) % REPORTED == 0:
                progress(0, done + i + 1, done + len(standard), "importance weights")
    return values


def weigh(standard: Array, log_density: Array, log_approximation: Array) -> Weighted:
    """Pareto-smoothed importance weights of coordinates drawn from an approximation.

    `log_density` and `log_approximation` `(n,)`: of the posterior and of the approximation, each up to a constant.

    Raises:
        NotPositiveDefiniteError: the posterior is finite at too few of them.
    """
    finite = np.isfinite(log_density)
    if finite.sum() < FEWEST:
        raise NotPositiveDefiniteError(
            f"expected a posterior density that is finite about its mode, found it so at {finite.sum()} of "
            f"{len(finite)} draws of the approximation, fewer than {FEWEST}; set sampling.method=nuts, and check that "
            "the medians under model are of the size that their unit lets expect"
        )
    log_weights = np.full(len(finite), -np.inf)
    log_weights[finite], k = smoothed(log_density[finite] - log_approximation[finite])
    return Weighted(standard, log_density, log_weights, k)


def smoothed(log_ratios: Array) -> tuple[Array, float]:
    """Log weights that sum to one, the largest replaced by quantiles of the fitted Pareto tail, and its shape k.

    `log_ratios` `(n,)` are finite, n at least 25.
    """
    centred = log_ratios - log_ratios.max()
    tail = np.sort(centred)[-int(3.0 * np.sqrt(len(centred))) :]
    if np.ptp(tail) < 1e-10:
        return centred - logsumexp(centred), 0.0
    # The library takes log-likelihoods that are left out, which are the negative of log ratios.
    with np.errstate(all="ignore"):
        log_weights, k = array_stats.psislw(-centred)
    if np.isfinite(k) and np.isfinite(logsumexp(log_weights)):
        return np.asarray(log_weights), float(k)
    # Weights that underflow next to the largest fit no tail: Hill's estimator does with their logarithms.
    return centred - logsumexp(centred), float(np.mean(tail - tail[0]))


def laplace_draws(
    density: SampledDensity, start: Start, settings: SamplingConfig, progress: Progress | None = None
) -> Draws:
    """Draws of Laplace's approximation, see `approximate_draws`.

    Raises:
        NotPositiveDefiniteError: the posterior is finite hardly anywhere about its mode.
    """
    return approximate_draws("laplace", density, start, settings, progress)


def approximate_draws(
    method: SamplingMethod,
    density: SampledDensity,
    approximation: Start,
    settings: SamplingConfig,
    progress: Progress | None = None,
    remarks: tuple[str, ...] = (),
) -> Draws:
    """`settings.chains` times `settings.draws` draws, in one chain, of a Gaussian approximation and its weights.

    Proposals have its curvature and the tails of a multivariate t. At k ≤ .7 they are resampled systematically by their
    weights: the number of copies of each is its expected number rounded down or up, so that a draw comes more than
    once where too few proposals carry the weight. At a larger k the weights are those that make proposals draws of the
    Gaussian as it is, where the posterior is finite, and `pareto_k` says not to trust them. `remarks` are handed on.

    Raises:
        NotPositiveDefiniteError: the posterior is finite hardly anywhere about its mode.
    """
    generator = np.random.default_rng(settings.seed)
    wanted = settings.chains * settings.draws
    steps, weighted = _propose(density, approximation, wanted, generator, progress)
    if weighted.pareto_k <= TRUSTED_K:
        log_weights = weighted.log_weights
    else:
        gaussian = -0.5 * np.square(steps).sum(1) - log_t(steps)
        log_weights = np.where(np.isfinite(weighted.log_weights), gaussian, -np.inf)
    chosen = systematic(log_weights, wanted, generator)
    values = {"lp": weighted.log_density[chosen][None]}
    return Draws(method, weighted.standard[chosen][None], values, weighted.pareto_k, remarks=remarks)


def systematic(log_weights: Array, count: int, generator: np.random.Generator) -> NDArray[np.intp]:
    """Indices `(count,)` in random order, each as often as `count` times its weight, rounded down or up."""
    steps = np.cumsum(np.exp(log_weights - logsumexp(log_weights)))
    places = (np.arange(count) + generator.random()) / count
    return generator.permutation(np.searchsorted(steps / steps[-1], places, side="right"))


def proposals(count: int, size: int, generator: np.random.Generator) -> Array:
    """Draws `(count, size)` of a standard multivariate t with `DEGREES` of freedom."""
    normal = generator.standard_normal((count, size))
    return normal * np.sqrt(DEGREES / generator.chisquare(DEGREES, (count, 1)))


def log_t(steps: Array) -> Array:
    """The log density `(n,)` of `proposals` at `steps` `(n, size)`, up to a constant."""
    return -0.5 * (DEGREES + steps.shape[1]) * np.log1p(np.square(steps).sum(1) / DEGREES)


def _propose(
    density: SampledDensity,
    approximation: Start,
    wanted: int,
    generator: np.random.Generator,
    progress: Progress | None,
) -> tuple[Array, Weighted]:
    """Proposals, and their steps, as many as `wanted` draws need and help to."""
    steps = proposals(PROPOSALS, density.size, generator)
    standard = approximation.at(steps)
    values = log_densities(density, standard, progress)
    first = weigh(standard, values, log_t(steps))
    needed = PROPOSALS * ENOUGH * wanted / first.effective
    more = min(int(needed), ROUNDS * wanted) - PROPOSALS
    if first.pareto_k > TRUSTED_K:
        # The k of so few is known to .15 only; where the tail is heavy more than this cost time for nothing.
        more = 2 * PROPOSALS
    if more <= 0:
        return steps, first
    steps = np.concatenate([steps, proposals(more, density.size, generator)])
    standard = approximation.at(steps)
    beyond = log_densities(density, standard[PROPOSALS:], progress, PROPOSALS)
    return steps, weigh(standard, np.concatenate([values, beyond]), log_t(steps))
