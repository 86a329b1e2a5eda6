"""What forces tell of every latent when impedance is a function: moments at new samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.given_impedance import LATENTS, MeanAndVariance
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import Density, Designs
from bayes_impedance.kernels.impedance import Latent

Array = NDArray[np.float64]

#: Draws of impedance and hyperparameters over which the moments of the other latents are averaged, in antithetic pairs.
PAIRS = 24
SEED = 0


class Conditioned:
    """The Laplace approximation of a `Density` about its mode.

    `point` `(size,)`, and the `covariance` `(uncertain, uncertain)` of the coordinates that `uncertain` `(size,)`
    marks: the weights, and maybe hyperparameters.
    """

    def __init__(
        self, density: Density, point: Array, covariance: Array, uncertain: NDArray[np.bool_]
    ) -> None:
        self.density, self.point, self.uncertain = density, point, uncertain
        self.covariance = covariance
        # A covariance from a Laplace approximation may be singular to rounding.
        values, vectors = np.linalg.eigh(covariance)
        self.root = vectors * np.sqrt(values.clip(0.0))

    def logarithm(self, target: Features, function: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Entries of log K, log D or log M (0, 1, 2) at the samples of `target`, and of their prior.

        Location `(groups, m, entries)` and covariance `(groups, m, entries, entries)`, twice.
        """
        one = self.density.functions[function]
        weights = self.density.weights(torch.from_numpy(self.point))[function]
        with torch.no_grad():
            design = one.design(target.inputs)
            left_out = torch.diag_embed(one.left_out(target.inputs, design).transpose(1, 2))
            _, _, prior_location, prior_covariance = one.prior(target.inputs, design)
        spread = torch.einsum("genw,gewfv,gfnv->gnef", design, self._weight_covariance(function), design)
        return one.logarithm(design, weights), spread + left_out, prior_location, prior_covariance

    def others(self, target: Features) -> Mapping[Latent, MeanAndVariance]:
        """Mean and variance of force (without its noise), desired trajectory and residual force, `(axes, groups, m)`.

        Means are those at the mode; variances have what impedance and hyperparameters leave open in them.
        """
        density = self.density
        here, there = density.designs, Designs.at(density.functions, target.inputs)

        def posterior(point: Array) -> Mapping[Latent, MeanAndVariance]:
            density.set_hyperparameters(point)
            weights = density.weights(torch.from_numpy(point))
            return density.engine.posterior(
                density.processes, here.matrices(weights), target, there.matrices(weights)
            )

        with torch.no_grad():
            centre = posterior(self.point)
            total = {latent: torch.zeros_like(centre[latent][1]) for latent in LATENTS}
            for point in self._draws(PAIRS):
                drawn = posterior(point)
                for latent in LATENTS:
                    mean, variance = drawn[latent]
                    total[latent] += (variance + (mean - centre[latent][0]).square()) / (2 * PAIRS)
        density.set_hyperparameters(self.point)
        return {latent: (centre[latent][0], total[latent]) for latent in LATENTS}

    def _draws(self, pairs: int) -> list[Array]:
        generator = np.random.default_rng(SEED)
        steps = generator.standard_normal((pairs, self.root.shape[1]))
        return [self._moved(sign * step) for step in steps for sign in (1.0, -1.0)]

    def _moved(self, step: Array) -> Array:
        point = self.point.copy()
        point[self.uncertain] += self.root @ step
        return point

    def _weight_covariance(self, function: int) -> Tensor:
        """Covariance of the weights of one function, a group at a time, `(groups, entries, width, entries, width)`."""
        shapes = self.density.shapes
        start = sum(int(np.prod(shape)) for shape in shapes[:function])
        groups, entries, width = shapes[function]
        size = entries * width
        blocks = [
            self.covariance[at : at + size, at : at + size]
            for at in range(start, start + groups * size, size)
        ]
        return torch.from_numpy(np.stack(blocks)).reshape(groups, entries, width, entries, width)
