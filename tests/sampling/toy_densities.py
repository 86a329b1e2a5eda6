"""Densities with the interface of `JointDensity` whose moments are known."""

from collections.abc import Callable

import numpy as np
import torch

from bayes_impedance.config import SamplingConfig
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.start import Start


class Toy:
    """A log density of a tensor `(size,)`; `fails` says where it has no Cholesky factor."""

    def __init__(
        self,
        size: int,
        log_density: Callable[[torch.Tensor], torch.Tensor],
        fails: Callable[[torch.Tensor], bool] = lambda _: False,
    ):
        self.size, self._log_density, self._fails = size, log_density, fails
        self.evaluations = 0

    def log_density(self, standard):
        self.evaluations += 1
        if self._fails(standard):
            raise NotPositiveDefiniteError("no factor here")
        return self._log_density(standard)

    def joint(self, point):
        z = torch.from_numpy(point).clone().requires_grad_()
        value = self.log_density(z)
        (gradient,) = torch.autograd.grad(value, z)
        if not (value.isfinite() and gradient.isfinite().all()):
            raise NotPositiveDefiniteError("not finite here")
        return float(value.detach()), gradient.numpy()


def gaussian(mean: np.ndarray, covariance: np.ndarray, **settings: object) -> Toy:
    """N(mean, covariance)."""
    centre, precision = torch.from_numpy(mean), torch.from_numpy(np.linalg.inv(covariance))

    def log_density(z):
        return -0.5 * (z - centre) @ precision @ (z - centre)

    return Toy(len(mean), log_density, **settings)


def skewed(size: int, log_sd: float) -> Toy:
    """Logarithms of independent gamma variables: z = log g / log_sd has a left tail that a Gaussian lacks."""
    shape = 1.0 / log_sd**2

    def log_density(z):
        return (shape * (log_sd * z - torch.exp(log_sd * z))).sum()

    return Toy(size, log_density)


def covariance(size: int, seed: int = 0) -> np.ndarray:
    """Some covariance of correlated coordinates, of SDs from .2 to 1."""
    generator = np.random.default_rng(seed)
    vectors, _ = np.linalg.qr(generator.standard_normal((size, size)))
    return vectors * np.linspace(0.2, 1.0, size) ** 2 @ vectors.T


def approximation(mean: np.ndarray, covariance: np.ndarray, scale: float = 1.0) -> Start:
    """A Gaussian of `scale` times the SD."""
    return Start(mean, scale * np.linalg.cholesky(covariance), "given")


def settings(**values: object) -> SamplingConfig:
    return SamplingConfig(**{"method": "laplace", "chains": 2, "draws": 500, "seed": 3, **values})
