"""Every latent for each posterior draw of impedance and hyperparameters: what these leave open is drawn once each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.engines.given_impedance import LATENTS
from bayes_impedance.features import Features
from bayes_impedance.impedance_functions.density import Designs
from bayes_impedance.impedance_functions.function import ImpedanceFunction
from bayes_impedance.impedance_functions.threads import one_thread
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.sampling.density import JointDensity, weights

Array = NDArray[np.float64]


@one_thread()
def draw_latents(
    density: JointDensity,
    standard: Array,
    target: Features,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> dict[Latent, Array]:
    """One draw of all latents at the samples of `target` for each of the coordinates `standard` `(draws, size)`.

    Desired trajectory [m, m/s, m/s²], residual force and force [N] are `(draws, axes, groups, m)`, drawn together given
    the forces of `density`; FORCE is a new measurement along the same motion, with noise of its own, so without it
    FORCE = Σ_j W_j e^{(j)} + RESIDUAL_FORCE in each draw. STIFFNESS [N/m], DAMPING [Ns/m] and MASS [kg] are matrices
    `(draws, groups, m, axes, axes)`: the functions of each draw, without the variation between inducing inputs that
    these do not carry. Padding of `target` has the prior mean and noise.

    Groups of `target` are those of the density, in their order. Draw i depends on row i, `seed` and i only. `progress`
    is called with the draws done and all of them.

    Raises:
        NotPositiveDefiniteError: a draw at which the density is not finite.
        ConfigurationError: the engine cannot hold the samples of `target` beside its own.
    """
    count, shape = len(standard), tuple(target.inputs.shape[:3])
    square = (*shape[1:], shape[0], shape[0])
    result = {
        latent: np.empty((count, *(square if latent in IMPEDANCE_ORDER else shape)))
        for latent in (*LATENTS, *IMPEDANCE_ORDER)
    }
    there = DesignsAt(target)
    with torch.no_grad():
        values = density.values(torch.from_numpy(np.asarray(standard, dtype=np.float64)))
        for i in range(count):
            own = {name: value[i] for name, value in values.items()}
            generator = _generator(seed, i)
            processes, designs = density.processes(own), density.designs(own)
            here = designs.matrices(weights(own))
            impedance = there.designs(designs.functions).matrices(weights(own))
            drawn = density.engine.draw(processes, here, target, impedance, generator)
            for latent, part in drawn.items():
                result[latent][i] = part.numpy()
            noise = torch.randn(shape, generator=generator, dtype=torch.float64)
            result[Latent.FORCE][i] += (processes.noise_variance.sqrt() * noise).numpy()
            for latent, j in IMPEDANCE_ORDER.items():
                result[latent][i] = impedance[:, :, j].numpy()
            if progress is not None:
                progress(i + 1, count)
    return result


@dataclass
class DesignsAt:
    """Designs at the samples of `target`; of a function that stays the same from draw to draw there is but one."""

    target: Features
    known: dict[int, tuple[ImpedanceFunction, Tensor]] = field(default_factory=dict)

    def designs(self, functions: tuple[ImpedanceFunction, ...]) -> Designs:
        """Those of K, D and M."""
        for j, function in enumerate(functions):
            if j not in self.known or self.known[j][0] is not function:
                self.known[j] = function, function.design(self.target.inputs)
        return Designs(functions, tuple(self.known[j][1] for j in range(len(functions))))


def _generator(seed: int, draw: int) -> torch.Generator:
    (state,) = np.random.SeedSequence([seed, draw]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state))
