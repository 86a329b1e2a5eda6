"""Posterior of a matrix by the Gaussian of its logarithm, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.impedance_functions.symmetric import derivatives, exponential

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LogMatrix:
    """Gaussian posterior of the entries S_e of log W at each sample, beside its prior.

    `places` of the entries; `location` `(samples, entries)` and `covariance` `(samples, entries, entries)`, W in its
    unit.

    Example:
        >>> prior = np.full((1, 2), np.log(200.0)), 0.01 * np.eye(2)[None]
        >>> stiffness = LogMatrix(((0, 0), (1, 1)), *prior, *prior)
        >>> location, scale = stiffness.diagonal()
        >>> np.exp(location).round().tolist(), scale.round(2).tolist()
        ([[200.0, 200.0]], [[0.1, 0.1]])
        >>> stiffness.draw(3, np.random.default_rng(0)).shape
        (3, 1, 2, 2)
    """

    places: tuple[tuple[int, int], ...]
    location: Array
    covariance: Array
    prior_location: Array
    prior_covariance: Array

    @property
    def axes(self) -> int:
        """Rows of the matrix."""
        return 1 + max(a for a, _ in self.places)

    @property
    def is_coupled(self) -> bool:
        """Whether entries beside the diagonal are free."""
        return len(self.places) > self.axes

    def matrix(self, prior: bool = False) -> Array:
        """exp of the location of log W, `(samples, axes, axes)` [unit of W]."""
        location, _ = self._gaussian(prior)
        return exponential(torch.from_numpy(location), self.places, self.axes).numpy()

    def variance(self, prior: bool = False) -> Array:
        """Variance of the entries of W to first order in log W, `(samples, axes, axes)` [unit of W, squared]."""
        location, covariance = self._gaussian(prior)
        slope = derivatives(torch.from_numpy(location), self.places, self.axes).numpy()
        return np.einsum("neab,nef,nfab->nab", slope, covariance, slope, optimize=True)

    def diagonal(self, prior: bool = False) -> tuple[Array, Array]:
        """Location and SD of the logarithm of the diagonal of W, `(samples, axes)` each."""
        centre, variance = (
            part.diagonal(axis1=1, axis2=2) for part in (self.matrix(prior), self.variance(prior))
        )
        return np.log(centre), np.sqrt(variance) / centre

    def beside(self, prior: bool = False) -> tuple[Array, Array]:
        """Mean and SD of the entries beside the diagonal, `(samples, pairs)` each [unit of W]."""
        rows, columns = np.triu_indices(self.axes, 1)
        centre, variance = self.matrix(prior), self.variance(prior)
        return centre[:, rows, columns], np.sqrt(variance[:, rows, columns])

    def draw(self, draws: int, generator: np.random.Generator, prior: bool = False) -> Array:
        """Matrices W, `(draws, samples, axes, axes)` [unit of W]; samples are drawn each on its own."""
        location, covariance = self._gaussian(prior)
        values, vectors = np.linalg.eigh(covariance)
        # Rounding can push the variance of a fully determined direction just below zero.
        roots = vectors * np.sqrt(values.clip(min=0.0))[:, None]
        standard = generator.standard_normal((draws, *location.shape))
        drawn = location + np.einsum("nef,dnf->dne", roots, standard)
        return exponential(torch.from_numpy(drawn), self.places, self.axes).numpy()

    def _gaussian(self, prior: bool) -> tuple[Array, Array]:
        if prior:
            return self.prior_location, self.prior_covariance
        return self.location, self.covariance
