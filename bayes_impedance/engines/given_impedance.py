"""What engines that are given stiffness, damping and mass have in common (docs/model.md §13).

Given the matrices W_j = (K, D, M) at every sample, x_d = μ_xd + f and the residual force are Gaussian and

    u − Σ_j W_j ē_j = Σ_j W_j f^{(j)} + ũ + ε,    ē_j = μ_xd^{(j)} − x^{(j)}

is linear in them: the likelihood is exact, and so is the posterior of f and ũ. Engines differ in cost and in what they
can hold, not in what they compute.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from gpytorch.kernels import AdditiveKernel, Kernel
from torch import Tensor

from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import TRAJECTORY_ORDER, InputLayout, Latent
from bayes_impedance.kernels.stationary import Stationary
from bayes_impedance.priors import ForceModel

#: Mean and variance of a latent, `(axes, groups, m)` each.
MeanAndVariance = tuple[Tensor, Tensor]
#: Latents that have a posterior once impedance is given; `FORCE` is without its white noise.
LATENTS = (
    Latent.FORCE,
    Latent.DESIRED_POSITION,
    Latent.DESIRED_VELOCITY,
    Latent.DESIRED_ACCELERATION,
    Latent.RESIDUAL_FORCE,
)


@dataclass(frozen=True)
class Processes:
    """The Gaussian processes beside impedance: desired trajectory, residual force and noise.

    Hyperparameters have batch shape `(axes, 1)`. `residual`: a sum of independent terms, none where ũ = 0;
    `noise_variance` σ_r² `(axes, 1, 1)` [N²]; `periodic`: the trajectory's kernel over phase is made periodic.
    """

    layout: InputLayout
    trajectory: Stationary
    residual: tuple[Stationary, ...]
    noise_variance: Tensor
    periodic: bool = False

    @classmethod
    def of(cls, model: ForceModel, periodic: bool = False) -> Processes:
        """Those of a force model, whose parameters they share."""
        impedance = model.kernel.impedance
        terms = residual_terms(model.kernel.residual)
        return cls(impedance.layout, impedance.trajectory, terms, model.noise_variance, periodic)


class ConditionalEngine(Protocol):
    """Exact inference given impedance, for the samples of `features` that it was built with.

    `impedance` is `(groups, n, 3, axes, axes)`: K [N/m], D [Ns/m], M [kg] at each sample, symmetric. An engine of
    `independent` axes reads only diagonals.
    """

    def log_likelihood_given_impedance(self, processes: Processes, impedance: Tensor) -> Tensor:
        """log p(u | W), `(axes, groups)`, or `(1, groups)` where axes couple [nats]; differentiable in both.

        Raises:
            NotPositiveDefiniteError: rounding left no positive variance of the forces.
        """

    def posterior(
        self, processes: Processes, impedance: Tensor, target: Features, target_impedance: Tensor
    ) -> Mapping[Latent, MeanAndVariance]:
        """Mean and variance of every latent of `LATENTS` at the samples of `target`, at any θ.

        The desired trajectory is x_d itself, with its prior mean. Groups of `target` are those of the engine's samples,
        in their order.
        """

    def draw(
        self,
        processes: Processes,
        impedance: Tensor,
        target: Features,
        target_impedance: Tensor,
        generator: torch.Generator,
    ) -> Mapping[Latent, Tensor]:
        """One draw of all of `LATENTS` together given the forces, at the samples of `target`, `(axes, groups, m)` each.

        x_d is one function, whose derivatives are those drawn, and FORCE = Σ_j W_j e^{(j)} + ũ of the same draw.
        Conventions are those of `posterior`; padding of `target` has the prior mean.
        """


def residual_terms(kernel: Kernel | None) -> tuple[Stationary, ...]:
    """The independent terms of a residual's covariance."""
    if kernel is None:
        return ()
    return tuple(kernel.kernels) if isinstance(kernel, AdditiveKernel) else (kernel,)


def mean_force(layout: InputLayout, features: Features, impedance: Tensor) -> Tensor:
    """Σ_j W_j ē_j, `(axes, groups, n)` [N]: the force where the desired trajectory is its prior mean."""
    errors = layout.errors(features.inputs, order=2)
    if errors is None:
        return features.inputs.new_zeros(features.inputs.shape[:-1])
    stacked = torch.cat(errors, dim=-1)
    return torch.einsum("gnjab,bgnj->agn", impedance, stacked)


def prior_mean(layout: InputLayout, target: Features, impedance: Tensor, latent: Latent) -> Tensor:
    """Mean of a latent of `LATENTS` before any force, `(axes, groups, m)`; `impedance` at the samples of `target`."""
    if latent is Latent.FORCE:
        return mean_force(layout, target, impedance)
    if latent is Latent.RESIDUAL_FORCE:
        return target.inputs.new_zeros(target.inputs.shape[:-1])
    return target.trajectory_mean[..., TRAJECTORY_ORDER[latent]]


def drawn_latents(
    layout: InputLayout, target: Features, impedance: Tensor, deviation: Tensor, residual: Tensor
) -> dict[Latent, Tensor]:
    """All of `LATENTS`, `(axes, groups, m)` each, of drawn f, ḟ, f̈ `(axes, groups, m, 3)` and ũ `(axes, groups, m)`.

    `impedance` as the engine reads it; at padding the prior mean stands in for the draw.
    """
    if target.valid is not None:
        deviation = torch.where(target.valid.unsqueeze(-1), deviation, 0.0)
        residual = torch.where(target.valid, residual, 0.0)
    force = mean_force(layout, target, impedance) + residual
    force = force + torch.einsum("gnjab,bgnj->agn", impedance, deviation)
    desired = (target.trajectory_mean + deviation).unbind(-1)
    return {
        Latent.FORCE: force,
        **{latent: desired[order] for latent, order in TRAJECTORY_ORDER.items()},
        Latent.RESIDUAL_FORCE: residual,
    }


def diagonal_only(impedance: Tensor) -> Tensor:
    """The same matrices without what couples axes."""
    return torch.diag_embed(impedance.diagonal(dim1=-2, dim2=-1))


def as_read(impedance: Tensor, coupled: bool) -> Tensor:
    """The matrices as an engine reads them: only diagonals where axes do not couple."""
    return impedance if coupled or impedance.shape[-1] == 1 else diagonal_only(impedance)
