"""Latents of one group of trials, drawn from their priors: desired trajectory, impedance, residual force and noise."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.gaussian import draw_gaussian
from bayes_impedance.features import Features
from bayes_impedance.kernels.coupled import CoupledImpedanceKernel, CoupledInteractionKernel
from bayes_impedance.kernels.coupled_terms import CoupledProcess, contract
from bayes_impedance.kernels.derivative import derivative_table
from bayes_impedance.kernels.impedance import ImpedanceKernel, same_label
from bayes_impedance.kernels.warped import ImpedanceProcess
from bayes_impedance.priors import ForceModel

Array = NDArray[np.float64]

#: Length scales beyond which a covariance is below rounding, for every profile that is made periodic.
REACH = 16.0


def draw_group(
    model: ForceModel,
    features: Features,
    group: int,
    generator: torch.Generator,
    periodic: bool,
    known: Tensor | None,
) -> tuple[Array, Array, Array, Array]:
    """Desired trajectory and impedance `(axes, n, 3)`, residual and noise `(axes, n)`.

    Where axes are coupled impedance is `(axes, n, 3, axes)`; it is `known` where that is given.
    """
    n = len(features.rows[group])
    x = features.inputs[:, group : group + 1, :n]
    kernel = model.kernel
    impedance = kernel.impedance
    deviation = draw_gaussian(_trajectory_covariance(impedance, x, periodic), generator)
    desired = features.trajectory_mean[:, group : group + 1, :n] + torch.stack(
        deviation.split(n, dim=-1), dim=-1
    )
    if known is None:
        columns = [_draw_impedance(process, x, generator) for process in impedance.processes]
        own_impedance = torch.stack(columns, dim=3)
    else:
        own_impedance = known[:, None, :n]
    coupled = isinstance(kernel, CoupledInteractionKernel)
    own = kernel.axis_residuals(x[0], x[0]) if coupled else kernel.residual_covariance(x, x)
    residual = draw_gaussian(own, generator)
    standard = torch.randn(residual.shape, generator=generator, dtype=residual.dtype)
    noise = model.noise_variance.sqrt() * standard
    parts = (desired, own_impedance, residual, noise)
    return tuple(part[:, 0].numpy() for part in parts)  # type: ignore[return-value]


def _trajectory_covariance(
    impedance: ImpedanceKernel | CoupledImpedanceKernel, x: Tensor, periodic: bool
) -> Tensor:
    """Of x_d, ẋ_d and ẍ_d at the rows of `x` `(axes, 1, n, D)`, `(axes, 1, 3n, 3n)`."""
    kernel, layout = impedance.trajectory, impedance.layout
    path = layout.path(x)
    # Where the ends of the phase join, Σ_r k(θ − θ' + r) over whole r, as far as k reaches.
    reach = math.ceil(1.0 + REACH * float(kernel.lengthscale.max())) if periodic else 0
    total = torch.zeros((), dtype=x.dtype)
    for shift in range(-reach, reach + 1):
        common, table = derivative_table(kernel, path, path._replace(theta=path.theta + shift))
        rows = [
            torch.cat([(common * table[i][j]).expand_as(common) for j in range(3)], dim=-1) for i in range(3)
        ]
        total = total + torch.cat(rows, dim=-2)
    shared = same_label(x, x, layout.trajectory)
    return total if shared is None else total * shared.repeat(1, 1, 3, 3)


def _draw_impedance(
    process: ImpedanceProcess | CoupledProcess, x: Tensor, generator: torch.Generator
) -> Tensor:
    """One of k, d, m at the rows of `x` `(axes, 1, n, D)`: `(axes, 1, n)`, or `(axes, 1, n, axes)` of a matrix."""
    if isinstance(process, CoupledProcess):
        n = x.shape[-2]
        covariance = process.gaussian_covariance(x[0], x[0])
        draw = draw_gaussian(covariance.expand(*covariance.shape[:-2], n, n), generator)
        return contract(process.dyads, process.levels[..., 0] * draw.exp()).movedim(1, -1)
    draw = draw_gaussian(process.gaussian_covariance(x, x), generator)
    level = process.level[..., 0]
    return level + draw if process.law == "gaussian" else level * draw.exp()
