"""What forces tell of every latent when impedance is a function: moments at new samples, and draws of matrices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.given_impedance import LATENTS, MeanAndVariance
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import Density, Designs
from bayes_impedance.impedance_functions.function import ImpedanceFunction
from bayes_impedance.impedance_functions.symmetric import derivatives
from bayes_impedance.kernels.impedance import Latent

Array = NDArray[np.float64]

#: Draws of impedance and hyperparameters over which the moments of the other latents are averaged, in antithetic pairs.
PAIRS = 24
SEED = 0


@dataclass(frozen=True)
class ImpedanceMoments:
    """Posterior and prior of one impedance matrix at some samples, each `(axes, groups, m)` or `(pairs, groups, m)`.

    Of the diagonal the logarithm (location and variance), of what is off it the entry itself.
    """

    diagonal: MeanAndVariance
    diagonal_prior: MeanAndVariance
    coupling: MeanAndVariance
    coupling_prior: MeanAndVariance


class Conditioned:
    """The Laplace approximation of a `Density` about its mode.

    `point` `(size,)` and `covariance` `(free, free)` of those of its coordinates that are uncertain, `free` `(size,)`.
    """

    def __init__(self, density: Density, point: Array, covariance: Array, free: NDArray[np.bool_]) -> None:
        self.density, self.point, self.free = density, point, free
        self.covariance = covariance
        # A covariance from a Laplace approximation may be singular to rounding.
        values, vectors = np.linalg.eigh(covariance)
        self.root = vectors * np.sqrt(values.clip(0.0))

    def impedance(self, target: Features, function: int) -> ImpedanceMoments:
        """Moments of K, D or M (0, 1, 2) at the samples of `target`."""
        one = self.density.functions[function]
        design = one.design(target.inputs)
        weights = self.density.weights(torch.from_numpy(self.point))[function]
        spread = torch.einsum("genw,gewfv,gfnv->gnef", design, self._weight_covariance(function), design)
        left_out = one.left_out(target.inputs, design).transpose(1, 2)
        spread = spread + torch.diag_embed(left_out)
        own = design.square().sum(-1).transpose(1, 2) + left_out
        centre = one.logarithm(design, weights)
        prior_centre = one.location.expand_as(centre)
        diagonal, coupling = _through_exponential(one, centre, spread)
        diagonal_prior, coupling_prior = _through_exponential(one, prior_centre, torch.diag_embed(own))
        return ImpedanceMoments(diagonal, diagonal_prior, coupling, coupling_prior)

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

    def draw_matrices(self, target: Features, draws: int, seed: int) -> Array:
        """K, D, M at the samples of `target`, each draw a function, `(draws, groups, m, 3, axes, axes)`.

        What inducing inputs do not carry is left out.
        """
        there = Designs.at(self.density.functions, target.inputs)
        generator = np.random.default_rng(seed)
        result = []
        for _ in range(draws):
            point = self._moved(generator.standard_normal(self.root.shape[1]))
            result.append(there.matrices(self.density.weights(torch.from_numpy(point))).numpy())
        return np.stack(result)

    def _draws(self, pairs: int) -> list[Array]:
        generator = np.random.default_rng(SEED)
        steps = generator.standard_normal((pairs, self.root.shape[1]))
        return [self._moved(sign * step) for step in steps for sign in (1.0, -1.0)]

    def _moved(self, step: Array) -> Array:
        point = self.point.copy()
        point[self.free] += self.root @ step
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


def _through_exponential(
    function: ImpedanceFunction, centre: Tensor, spread: Tensor
) -> tuple[MeanAndVariance, MeanAndVariance]:
    """Log of the diagonal, and what is off it, to first order in S, `(axes | pairs, groups, m)`.

    `centre` `(groups, m, entries)`, `spread` `(groups, m, entries, entries)`.
    """
    axes = function.axes
    matrix = function.exponential(centre)
    slope = derivatives(centre, function.places, axes)
    variance = torch.einsum("gneab,gnef,gnfab->gnab", slope, spread, slope)
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    log_variance = variance.diagonal(dim1=-2, dim2=-1) / diagonal.square()
    rows, columns = torch.triu_indices(axes, axes, offset=1)
    return (
        (diagonal.log().movedim(-1, 0), log_variance.movedim(-1, 0)),
        (matrix[..., rows, columns].movedim(-1, 0), variance[..., rows, columns].movedim(-1, 0)),
    )
