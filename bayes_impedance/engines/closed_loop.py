"""The closed loop: what changes when the device answers force by motion (docs/model.md §6).

On an admittance-controlled device, M_r ẍ + D_r ẋ = u + p, the acceleration that the model multiplies by the mass
contains the force of the same instant, and the velocity half of what that force does within the time Δ between samples.
The density of u then carries the Jacobian 1 + z/M_r for each sample, with the apparent mass
z = m (1 − ½ Δ D_r/M_r) + ½ Δ d. With z ~ N(μ, s²) given the forces, the expectation of (1 + z/M_r)ⁿ is taken by
Laplace's method, in which it acts like a measurement of z.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from gpytorch.kernels import Kernel
from torch import Tensor

from bayes_impedance.device import Loop
from bayes_impedance.engines.dense import (
    Factor,
    Observations,
    log_density,
    log_marginal_likelihood,
    quadratic_forms,
)
from bayes_impedance.kernels.impedance import ImpedanceKernel, Latent

#: The damping of z is averaged over so many samples, spread over those given.
ANCHORS = 64


@dataclass(frozen=True)
class Jacobian:
    """(1 + z/M_r)ⁿ under z ~ N(μ, s²), by Laplace's method; `(*batch,)` each.

    `mode` ẑ [kg] of z with it; `slope` n/(M_r + ẑ) [1/kg] and `curvature` n/(M_r + ẑ)² [1/kg²] of its logarithm there,
    so that it acts on z like a measurement of precision `curvature`; `log_expectation` [nats].
    """

    mode: Tensor
    slope: Tensor
    curvature: Tensor
    log_expectation: Tensor


def jacobian(mean: Tensor, variance: Tensor, count: Tensor, device_mass: Tensor) -> Jacobian:
    """Laplace approximation for z ~ N(`mean`, `variance`) [kg, kg²], `count` samples, M_r = `device_mass` [kg].

    The mode solves (z − μ)(M_r + z) = n s², a quadratic with one root above −M_r.
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


def log_likelihood(kernel: Kernel, observations: Observations, loop: Loop | None, jitter: float) -> Tensor:
    """log p(u) under `kernel`, `(*batch,)` [nats], with the Jacobian of the closed `loop`.

    None where acceleration does not answer force, or does not enter the model.

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """
    if loop is None:
        return log_marginal_likelihood(kernel, observations, jitter)
    apparent = ApparentMass(kernel.impedance, observations, loop)
    column = apparent.covariance(observations.inputs, Latent.FORCE)
    columns = torch.stack([observations.residual, column.expand_as(observations.residual)], dim=-1)
    forms, log_det = quadratic_forms(kernel, observations, columns, jitter)
    variance = (apparent.variance - forms[..., 1, 1]).clamp_min(0.0)
    known = jacobian(apparent.mean + forms[..., 0, 1], variance, observations.count, loop.device_mass)
    return log_density(forms[..., 0, 0], log_det, observations) + known.log_expectation


class ApparentMass:
    """z = m (1 − ½ Δ D_r/M_r) + ½ Δ d̄ before any force is known, d̄ the damping averaged over the samples given.

    `mean` [kg] and `variance` [kg²], `(*batch,)` each; `loading` `(*batch, 1, 3)`: its derivative by offsets of the
    levels of k, d and m.
    """

    def __init__(self, impedance: ImpedanceKernel, observations: Observations, loop: Loop) -> None:
        self._layout, self._order = impedance.layout, impedance.order
        _, self._damping, mass = impedance.processes
        self._half_step = 0.5 * loop.step
        self._mass_share = 1.0 - self._half_step * loop.device_damping / loop.device_mass
        self._anchors = spread(observations.inputs, observations.count)
        half, damping = self._half_step, self._damping
        self.mean = self._mass_share * mass.level[..., 0, 0] + half * damping.expectation(self._anchors).mean(
            (-2, -1)
        )
        own = mass.gaussian_covariance(self._anchors[..., :1, :], self._anchors, diag=True)[..., 0]
        self._with_mass = self._mass_share * own
        average = damping.moments(self._anchors, self._anchors)[2].mean((-2, -1))
        self.variance = self._mass_share * self._with_mass + half.square() * average
        by_level = half * damping.sensitivity(self._anchors).mean((-2, -1))
        self.loading = torch.stack(
            [torch.zeros_like(by_level), by_level, self._mass_share], dim=-1
        ).unsqueeze(-2)

    def covariance(self, x: Tensor, latent: Latent) -> Tensor:
        """Prior covariance of z with a latent at `x` `(*batch, n, D)`, its logarithm where warped; `(*batch, n)`."""
        half, damping = self._half_step.unsqueeze(-1), self._damping
        with_mass = self._with_mass.unsqueeze(-1)
        if latent is Latent.FORCE:
            errors = self._layout.errors(x, self._order)
            if errors is None:
                return x.new_zeros(x.shape[:-1])
            with_damping = half * damping.moments(x, self._anchors)[2].mean(-1)
            _, velocity_error, acceleration_error = errors
            return velocity_error[..., 0] * with_damping + acceleration_error[..., 0] * with_mass
        if latent is Latent.DAMPING:
            expected = damping.sensitivity(self._anchors).mT
            return half * (expected * damping.gaussian_covariance(x, self._anchors)).mean(-1)
        if latent is Latent.MASS:
            return with_mass.expand(x.shape[:-1])
        return x.new_zeros(x.shape[:-1])


class LoopEvidence:
    """What the Jacobian tells of the apparent mass beside the forces of `factor`, and through it of every latent.

    `white` L⁻¹ Cov[u, z] `(*batch, n, 1)`; `variance` s² of z given the forces alone `(*batch,)` [kg²].
    """

    def __init__(
        self, impedance: ImpedanceKernel, factor: Factor, observations: Observations, loop: Loop
    ) -> None:
        self.apparent = ApparentMass(impedance, observations, loop)
        column = self.apparent.covariance(observations.inputs, Latent.FORCE).expand(factor.alpha.shape)
        self.white = factor.whiten(column.unsqueeze(-1))
        self.variance = (self.apparent.variance - self.white.square().sum((-2, -1))).clamp_min(0.0)
        # On padding α is zero.
        mean = self.apparent.mean + (column * factor.alpha).sum(-1)
        self.jacobian = jacobian(mean, self.variance, observations.count, loop.device_mass)

    def covariance(self, x: Tensor, latent: Latent, white: Tensor) -> Tensor:
        """Covariance of z with a latent at `x` given the forces, `(*batch, m)`; `white` L⁻¹ Cov[u, latent]."""
        return self.apparent.covariance(x, latent) - (white.mT @ self.white).squeeze(-1)

    def gain(self, variance: Tensor) -> Tensor:
        """λ / (1 + λ Var[z]): times Cov[·, z]², what a measurement of z of precision λ takes from a variance."""
        return self.jacobian.curvature / (1.0 + self.jacobian.curvature * variance)


def spread(inputs: Tensor, count: Tensor) -> Tensor:
    """Some inputs, spread evenly over the `count` samples that are no padding, `(*batch, anchors, D)`."""
    n = inputs.shape[-2]
    share = torch.linspace(0.0, 1.0, min(n, ANCHORS), dtype=inputs.dtype)
    rows = ((count.unsqueeze(-1) - 1.0) * share).round().long()
    rows = rows.expand(*inputs.shape[:-2], share.numel()).unsqueeze(-1)
    return inputs.gather(-2, rows.expand(*rows.shape[:-1], inputs.shape[-1]))
