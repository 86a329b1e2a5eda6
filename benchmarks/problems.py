"""The problems that are timed: one axis, θ = ξ = [x, ẋ] of two axes, so four dimensions each."""

from __future__ import annotations

from typing import NamedTuple

import gpytorch
import numpy as np
import torch
from torch import Tensor

from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.features import Features
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


class ScalarProblem(NamedTuple):
    """Samples over one θ, the processes beside impedance, and impedance, for engines that are given it."""

    features: Features
    processes: Processes
    impedance: Tensor


def scalar_problem(
    n: int,
    step: float,
    axes: int = 1,
    residual: bool = False,
    repetitions: int = 10,
    seed: int = 0,
) -> ScalarProblem:
    """Repetitions whose pooled samples lie λΔ = `step` apart on average, ℓ = .5; residual over θ, or none.

    A tenth of the samples repeat the θ of another exactly.
    """
    generator = np.random.default_rng(seed)
    lengthscale = 0.5
    theta = np.sort(generator.uniform(0.0, step * n * lengthscale / 5.0**0.5, size=n))
    theta[1::10] = theta[0::10][: len(theta[1::10])]
    # Sample i is of repetition i mod `repetitions`, one repetition after another, as logs have it.
    order = np.argsort(np.arange(n) % repetitions, kind="stable")
    inputs = np.zeros((axes, 1, n, 3))
    inputs[..., 0] = theta
    inputs[..., 1] = 1.0 + 0.2 * np.sin(3.0 * theta)
    inputs[..., 2] = 0.6 * np.cos(3.0 * theta)
    forces = [np.sin((2.0 + a) * theta) + 0.2 * generator.standard_normal(n) for a in range(axes)]
    features = Features(
        groups=("0",),
        inputs=torch.from_numpy(inputs[:, :, order]),
        force=torch.from_numpy(np.stack(forces)[:, None, order]),
        trajectory_mean=torch.zeros(axes, 1, n, 3, dtype=torch.float64),
        valid=None,
        rows=(np.stack([np.arange(n) % repetitions, np.arange(n) // repetitions], axis=-1)[order],),
    )
    batch = torch.Size([axes, 1])
    trajectory = StationaryKernel("matern52", batch_shape=batch).double()
    trajectory.sd, trajectory.lengthscale = 0.02, lengthscale
    own = StationaryKernel("matern32", batch_shape=batch, active_dims=(0,)).double()
    own.sd, own.lengthscale = 0.5, 0.3
    layout = InputLayout(theta=(0,), theta_velocity=(1,), theta_acceleration=(2,))
    noise = torch.full((axes, 1, 1), 0.04, dtype=torch.float64, requires_grad=True)
    levels = torch.tensor([300.0, 20.0, 1.5], dtype=torch.float64)[:, None, None]
    matrices = levels * (0.8 * torch.eye(axes, dtype=torch.float64) + 0.2)
    return ScalarProblem(
        features,
        Processes(layout, trajectory, (own,) if residual else (), noise),
        matrices.expand(1, n, 3, axes, axes).contiguous().requires_grad_(),
    )
