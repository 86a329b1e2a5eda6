"""The closed loop: what changes when the device answers force by motion (docs/model.md §6).

On an admittance-controlled device, M_r ẍ + D_r ẋ = u + p, the acceleration that the model multiplies by the mass
contains the force of the same instant. The density of u then carries |∂(u + m ẍ)/∂u| = 1 + m/M_r for each sample.
With m ~ N(μ, s²) given the forces, the expectation of (1 + m/M_r)ⁿ is taken by Laplace's method.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gpytorch.kernels import Kernel
from torch import Tensor

from bayes_impedance.engines.dense import (
    Factor,
    Observations,
    log_density,
    log_marginal_likelihood,
    quadratic_forms,
)
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, ImpedanceKernel, Latent


@dataclass(frozen=True)
class Jacobian:
    """(1 + m/M_r)ⁿ under m ~ N(μ, s²), by Laplace's method; `(*batch,)` each.

    `mode` m̂ [kg] of m with it; `slope` n/(M_r + m̂) [1/kg] and `curvature` n/(M_r + m̂)² [1/kg²] of its logarithm there,
    so that it acts on m like a measurement of precision `curvature`; `log_expectation` [nats].
    """

    mode: Tensor
    slope: Tensor
    curvature: Tensor
    log_expectation: Tensor


def jacobian(mean: Tensor, variance: Tensor, count: Tensor, device_mass: Tensor) -> Jacobian:
    """Laplace approximation for m ~ N(`mean`, `variance`) [kg, kg²], `count` samples, M_r = `device_mass` [kg].

    The mode solves (m − μ)(M_r + m) = n s², a quadratic with one root above −M_r.
    """
    total = (mean + device_mass).square() + 4.0 * count * variance
    mode = 0.5 * (mean - device_mass + total.sqrt())
    slope = count / (device_mass + mode)
    curvature = slope / (device_mass + mode)
    log_expectation = (
        count * torch.log1p(mode / device_mass)
        - 0.5 * variance * slope.square()
        - 0.5 * torch.log1p(variance * curvature)
    )
    return Jacobian(mode, slope, curvature, log_expectation)


def log_likelihood(
    kernel: Kernel, observations: Observations, device_mass: Tensor | None, jitter: float
) -> Tensor:
    """log p(u) under `kernel`, `(*batch,)` [nats].

    With `device_mass` M_r [kg], which broadcasts to the batch, it includes the Jacobian of the closed loop; None
    where acceleration does not answer force, or does not enter the model.

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """
    if device_mass is None:
        return log_marginal_likelihood(kernel, observations, jitter)
    inputs = observations.inputs
    column = mass_covariance(kernel.impedance, inputs, Latent.FORCE)
    columns = torch.stack([observations.residual, column.expand_as(observations.residual)], dim=-1)
    forms, log_det = quadratic_forms(kernel, observations, columns, jitter)
    mean, variance = mass_prior(kernel.impedance, inputs)
    given = jacobian(
        mean + forms[..., 0, 1], (variance - forms[..., 1, 1]).clamp_min(0.0), observations.count, device_mass
    )
    return log_density(forms[..., 0, 0], log_det, observations) + given.log_expectation


class MassEvidence:
    """What the Jacobian tells of the mass beside the forces of `factor`, and through it of every other latent.

    `white` L⁻¹ Cov[u, m] `(*batch, n, 1)`; `variance` s² of m given the forces alone `(*batch,)` [kg²]; `jacobian`.
    """

    def __init__(
        self, impedance: ImpedanceKernel, factor: Factor, observations: Observations, device_mass: Tensor
    ) -> None:
        column = mass_covariance(impedance, observations.inputs, Latent.FORCE)
        self.white = factor.whiten(column.expand(factor.alpha.shape).unsqueeze(-1))
        mean, variance = mass_prior(impedance, observations.inputs)
        self.variance = (variance - self.white.square().sum((-2, -1))).clamp_min(0.0)
        mean = mean + (column * factor.alpha).sum(-1)
        self.jacobian = jacobian(mean, self.variance, observations.count, device_mass)

    def gain(self, variance: Tensor) -> Tensor:
        """λ / (1 + λ Var[m]): times Cov[·, m]², what a measurement of m of precision λ takes from a variance."""
        return self.jacobian.curvature / (1.0 + self.jacobian.curvature * variance)


def mass_prior(impedance: ImpedanceKernel, inputs: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [kg] and variance [kg²] of m at its level, `(*batch,)` each."""
    process = impedance.processes[IMPEDANCE_ORDER[Latent.MASS]]
    return process.level[..., 0, 0], process.gaussian_covariance(inputs[..., :1, :], inputs, diag=True)[
        ..., 0
    ]


def mass_covariance(impedance: ImpedanceKernel, inputs: Tensor, latent: Latent) -> Tensor:
    """Prior covariance of a latent at `inputs` `(…, n, D)` with m, `(…, n)`."""
    if latent is Latent.FORCE:
        return impedance.impedance_covariance(inputs, inputs[..., :1, :], IMPEDANCE_ORDER[Latent.MASS])[
            ..., 0
        ]
    variance = mass_prior(impedance, inputs)[1].unsqueeze(-1)
    return (variance if latent is Latent.MASS else torch.zeros_like(variance)).expand(inputs.shape[:-1])
