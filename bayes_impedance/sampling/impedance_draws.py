"""K, D and M for each draw, with the variation between inducing inputs that these do not carry.

Whatever the forces tell, a function is known between its inducing inputs only as well as its prior says given its
values there. So draws of it have that added, as one function each: variances are those at the draw's own log-SD and
length scales, correlations between samples those in the middle of all draws.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.function import ImpedanceFunction
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.kernels.warped import evaluate
from bayes_impedance.sampling.density import JointDensity, weights
from bayes_impedance.sampling.latents import DesignsAt

Array = NDArray[np.float64]


@one_thread()
def draw_impedance(
    density: JointDensity, standard: Array, target: Features, seed: int
) -> dict[Latent, Array]:
    """Stiffness [N/m], damping [Ns/m] and mass [kg] at `target` for each of the coordinates `(draws, size)`.

    `(draws, groups, m, axes, axes)` each; the forces of a draw (`draw_latents`) come from the functions as their
    inducing inputs carry them.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        there = DesignsAt(target)
        middle = density.functions(density.values(torch.from_numpy(standard.mean(axis=0))))
        roots = [_correlation_root(function, target) for function in middle]
        found = [
            _draw(density, torch.from_numpy(row), there, roots, generator)
            for row in np.asarray(standard, dtype=np.float64)
        ]
    return {latent: np.stack([one[j] for one in found]) for latent, j in IMPEDANCE_ORDER.items()}


def _draw(
    density: JointDensity,
    standard: Tensor,
    there: DesignsAt,
    roots: list[Tensor | None],
    generator: torch.Generator,
) -> list[Array]:
    values = density.values(standard)
    known = there.designs(density.functions(values))
    matrices = []
    for function, design, own, root in zip(
        known.functions, known.designs, weights(values), roots, strict=True
    ):
        logarithm = function.logarithm(design, own)
        if root is not None:
            deviation = function.left_out(there.target.inputs, design).sqrt()
            noise = torch.randn((*root.shape[:-1], 1), generator=generator, dtype=torch.float64)
            logarithm = logarithm + (deviation * (root @ noise)[..., 0]).transpose(1, 2)
        matrices.append(function.exponential(logarithm).numpy())
    return matrices


def _correlation_root(function: ImpedanceFunction, target: Features) -> Tensor | None:
    """Of what inducing inputs leave out, between samples of `target`, `(groups, entries, m, m)`; None without any."""
    if function.inducing is None:
        return None
    design = function.design(target.inputs)
    own = evaluate(function.covariance, target.inputs, target.inputs)
    own = own[[a for a, _ in function.places]].transpose(0, 1) * function.scale.square()[:, None, None]
    carried = design[..., 1:] @ design[..., 1:].mT
    values, vectors = torch.linalg.eigh(own - carried)
    root = vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)
    scale = root.square().sum(-1, keepdim=True).sqrt()
    return root / torch.where(scale > 0.0, scale, 1.0)
