"""The problems that are timed: one axis, θ = ξ = [x, ẋ] of two axes, so four dimensions each."""

from __future__ import annotations

import gpytorch
import torch
from torch import Tensor

from bayes_impedance.kernels import (
    ImpedanceKernel,
    ImpedanceProcess,
    InputLayout,
    InteractionKernel,
    StationaryKernel,
)

XI = (0, 1, 2, 3)
LAYOUT = InputLayout(
    theta=XI, theta_velocity=(4, 5, 6, 7), theta_acceleration=(8, 9, 10, 11), error=(12, 13, 14)
)


def inputs(n: int) -> Tensor:
    """Two sinusoids with exact derivatives, and errors of about a centimetre, `(n, 15)`."""
    time = torch.linspace(0.0, 20.0, n, dtype=torch.float64).unsqueeze(-1)
    omega = torch.tensor([1.3, 1.7], dtype=torch.float64)
    shift = torch.tensor([0.0, 1.0], dtype=torch.float64)
    x, v, a, j = (0.1 * omega**k * torch.sin(omega * time + shift + 0.5 * torch.pi * k) for k in range(4))
    generator = torch.Generator().manual_seed(0)
    errors = 0.01 * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    return torch.cat([x, v, v, a, a, j, errors], dim=-1)


def force(n: int) -> Tensor:
    """White forces, `(n,)` [N]."""
    return torch.randn(n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def interaction_kernel() -> InteractionKernel:
    """Impedance with log-GP stiffness and damping over ξ, residual over ξ."""
    trajectory = StationaryKernel(num_dims=4)
    stiffness = ImpedanceProcess(StationaryKernel(num_dims=4, active_dims=XI))
    damping = ImpedanceProcess(StationaryKernel(num_dims=4, active_dims=XI))
    mass = ImpedanceProcess(StationaryKernel(num_dims=0), law="gaussian")
    residual = StationaryKernel(num_dims=4, active_dims=XI)
    kernel = InteractionKernel(
        ImpedanceKernel(LAYOUT, trajectory, stiffness, damping, mass), residual
    ).double()
    trajectory.sd, trajectory.lengthscale = 0.02, 0.4
    stiffness.level, stiffness.covariance.sd = 300.0, 0.3
    damping.level, damping.covariance.sd = 20.0, 0.3
    mass.level, mass.covariance.sd = 1.5, 0.3
    return kernel


class PlainGP(gpytorch.models.ExactGP):
    """The competitor: an ARD squared exponential on ξ."""

    def __init__(self, x: Tensor, y: Tensor) -> None:
        super().__init__(x, y, gpytorch.likelihoods.GaussianLikelihood())
        self.mean_module = gpytorch.means.ConstantMean()
        self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=4))
        self.double()

    def forward(self, x: Tensor) -> gpytorch.distributions.MultivariateNormal:
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))
