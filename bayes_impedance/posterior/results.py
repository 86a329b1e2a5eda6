"""What users see of a posterior: marginals of every latent at every sample, and matrices drawn from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import norm

from bayes_impedance.kernels.coupled_terms import pair_names
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.posterior.terms import LogTerms
from bayes_impedance.preprocessing import PreparedLog

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

    def draw(self, draws: int, generator: np.random.Generator, prior: bool = False) -> Array:
        """Draws of each sample on its own, `(draws, samples, axes)` [unit of the latent]."""
        location, scale = (self.prior_location, self.prior_scale) if prior else (self.location, self.scale)
        value = location + scale * generator.standard_normal((draws, *location.shape))
        return np.exp(value) if self.warped else value

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


class MatrixLaw(Protocol):
    """Joint law of the entries of K, D or M at each sample."""

    def draw(self, draws: int, generator: np.random.Generator, prior: bool = False) -> Array:
        """Matrices, `(draws, samples, axes, axes)` [unit of the matrix]; samples are drawn each on its own."""


@dataclass(frozen=True)
class Posterior:
    """Posteriors of the latents at every sample of a log; immutable.

    `marginals[latent]` holds arrays `(samples, axes)`, samples in the order of `log`'s trials; of a matrix its
    diagonal, log-normal. Where axes are coupled `couplings[latent]` holds the
    entries beside the diagonal, `(samples, pairs)`, as Gaussians, and `terms[latent]` what the matrix is made of.
    """

    log: PreparedLog
    marginals: Mapping[Latent, Marginal]
    couplings: Mapping[Latent, Marginal] = field(default_factory=dict)
    terms: Mapping[Latent, MatrixLaw] = field(default_factory=dict)

    def __getitem__(self, latent: Latent | str) -> Marginal:
        """Marginal of a latent, by member of `Latent` or by name ("stiffness")."""
        return self.marginals[Latent(latent)]

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the log."""
        return self.log.axes

    @property
    def pairs(self) -> tuple[str, ...]:
        """Pairs of axes that couple, in the order of `couplings`: xy, xz, yz; none where axes are independent."""
        return pair_names(self.axes) if self.couplings else ()

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
            doubled = [f"{axis}{axis}" if latent in IMPEDANCE_ORDER else axis for axis in self.axes]
            columns |= _columns(marginal, doubled)
            if latent in self.couplings:
                columns |= _columns(self.couplings[latent], self.pairs)
        return pd.DataFrame(columns)


def _columns(marginal: Marginal, names: Sequence[str]) -> dict[str, object]:
    columns: dict[str, object] = {}
    low, high = marginal.quantile(0.05), marginal.quantile(0.95)
    for a, name in enumerate(names):
        columns[f"{marginal.latent.value}_{name}_mean"] = marginal.mean[:, a]
        columns[f"{marginal.latent.value}_{name}_sd"] = marginal.sd[:, a]
        columns[f"{marginal.latent.value}_{name}_q05"] = low[:, a]
        columns[f"{marginal.latent.value}_{name}_q95"] = high[:, a]
    return columns


def draw_matrices(posterior: Posterior, draws: int, seed: int, prior: bool = False) -> Array:
    """Draws of K [N/m], D [Ns/m] and M [kg] at each sample, `(draws, samples, 3, axes, axes)`, or of their prior.

    Samples, and K, D and M, are drawn each on its own: what a draw shows is one instant, not a course along the path.
    Diagonal where axes are independent.

    Example:
        >>> from bayes_impedance.simulation.generative import repeated_motion
        >>> motion = repeated_motion(repetitions=1, duration=1.0, rate=2.0)
        >>> level = np.full((2, 2), np.log(300.0))
        >>> k = Marginal(Latent.STIFFNESS, True, level, 0.1 + 0 * level, level, 0.1 + 0 * level)
        >>> posterior = Posterior(motion, {Latent.STIFFNESS: k, Latent.DAMPING: k, Latent.MASS: k})
        >>> draw_matrices(posterior, 5, seed=0).shape
        (5, 2, 3, 2, 2)
    """
    generator = np.random.default_rng(seed)
    drawn = []
    for latent in IMPEDANCE_ORDER:
        if latent in posterior.terms:
            drawn.append(posterior.terms[latent].draw(draws, generator, prior))
        else:
            diagonal = posterior[latent].draw(draws, generator, prior)
            drawn.append(diagonal[..., None] * np.eye(diagonal.shape[-1]))
    return np.stack(drawn, axis=2)


def matrix_marginals(latent: Latent, terms: LogTerms) -> tuple[Marginal, Marginal]:
    """Marginals of the diagonal of a matrix, `(samples, axes)`, and of the entries beside it, `(samples, pairs)`."""
    diagonal = Marginal(latent, True, *terms.diagonal(), *terms.diagonal(prior=True))
    return diagonal, Marginal(latent, False, *terms.off_diagonal(), *terms.off_diagonal(prior=True))
