"""Pyro's NUTS over one vector: what a step was like, and a state that can be put away and taken up again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyro
import torch
from numpy.typing import NDArray
from pyro.infer import NUTS
from pyro.infer.mcmc.adaptation import BlockMassMatrix
from torch import Tensor

from bayes_impedance.config import SamplingConfig
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.sampling.exceptions import count_failures_as_divergences
from bayes_impedance.sampling.start import Start

State = dict[str, NDArray[np.generic]]

#: The one site that Pyro sees, and its block of the mass matrix.
SITE, BLOCK = "y", ("y",)
#: Draws a coordinate that Laplace's curvature counts for, and the least of which a covariance is taken.
WEIGHT = 5
#: Numbers that adaptation goes by, as they are called in Pyro.
AVERAGES = ("prox_center", "_x_avg", "_g_avg", "_t", "_x_t")


class ShrunkMassMatrix(BlockMassMatrix):
    """Inverse mass matrix (n Ŝ + w I)/(n + w): the covariance Ŝ of n draws, shrunk towards the identity.

    In coordinates whitened by Laplace's approximation that is its curvature, w = 5 `size`. The covariance of hardly
    more draws than coordinates is almost singular, and the trees that it grows are several times as deep.
    """

    def end_adaptation(self) -> None:
        """Take the covariance since the last time for the inverse mass matrix."""
        scheme = self._adapt_scheme[BLOCK]
        size = self.mass_matrix_size[BLOCK]
        share = scheme.n_samples / (scheme.n_samples + WEIGHT * size)
        identity = torch.eye(size, dtype=torch.float64)
        covariance = scheme.get_covariance(regularize=False)
        self.inverse_mass_matrix = {BLOCK: share * covariance + (1.0 - share) * identity}


@dataclass
class Trajectory:
    """What became of one iteration: gradients, their summed acceptance probabilities, and the energy it began with."""

    energy: float = np.nan
    n_steps: int = 0
    acceptance: float = 0.0
    diverging: bool = False


class Kernel(NUTS):
    """NUTS of `density` at z = `point` + `root` y, dense in y; `trajectory` tells of the last iteration."""

    def __init__(self, density: SampledDensity, start: Start, settings: SamplingConfig) -> None:
        count_failures_as_divergences()
        self._density = density
        self._point, self._root = torch.from_numpy(start.point), torch.from_numpy(start.root)
        super().__init__(
            potential_fn=self._potential,
            full_mass=True,
            target_accept_prob=settings.target_acceptance,
            max_tree_depth=settings.max_tree_depth,
        )
        self.mass_matrix_adapter = ShrunkMassMatrix()
        self._adapter._adapt_initial_window = max(self._adapter._adapt_initial_window, WEIGHT * density.size)
        self._warmup = settings.warmup
        self.trajectory = Trajectory()

    def begin(self, place: Tensor) -> None:
        """Be at `place` `(size,)` in y, with nothing adapted."""
        self.initial_params = {SITE: place}
        with pyro.validation_enabled(False):
            self.setup(self._warmup)

    def advance(self) -> None:
        """One iteration."""
        self.trajectory = Trajectory()
        # What is not finite is a divergence, and no mistake.
        with pyro.validation_enabled(False):
            self.sample(self._z_last)

    @property
    def standard(self) -> NDArray[np.float64]:
        """Coordinates z `(size,)` of the chain now."""
        z: NDArray[np.float64] = (self._point + self._root @ self._z_last[SITE].detach()).numpy()
        return z

    @property
    def log_density(self) -> float:
        """Log density at `standard` [nats]."""
        return -float(self._potential_energy_last)

    def state(self) -> State:
        """All that the iterations to come depend on, but for random numbers."""
        adapter, matrix = self._adapter, self.mass_matrix_adapter
        averaging, moments = adapter._step_size_adapt_scheme, matrix._adapt_scheme[BLOCK]
        size = self._density.size
        return {
            "y": _array(self._z_last[SITE]),
            "gradient": _array(self._z_grads_last[SITE]),
            "potential": _array(self._potential_energy_last),
            "count": np.array([self._t, adapter._current_window, moments.n_samples]),
            "step_size": np.array(adapter.step_size),
            "averages": np.array([getattr(averaging, name, np.nan) for name in AVERAGES], dtype=np.float64),
            "inverse_mass": _array(matrix.inverse_mass_matrix[BLOCK]),
            "mean": np.broadcast_to(_array(moments._mean), (size,)).copy(),
            "moment": np.broadcast_to(_array(moments._m2), (size, size)).copy(),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Go on from a `state`, to the last bit as if never interrupted."""
        arrays = {name: torch.from_numpy(np.array(state[name])) for name in ("y", "gradient", "potential")}
        self.begin(arrays["y"].clone())
        self._cache({SITE: arrays["y"]}, arrays["potential"], {SITE: arrays["gradient"]})
        adapter, matrix = self._adapter, self.mass_matrix_adapter
        self._t, adapter._current_window, n_samples = map(int, state["count"])
        adapter.step_size = float(state["step_size"])
        for name, value in zip(AVERAGES, state["averages"], strict=True):
            setattr(adapter._step_size_adapt_scheme, name, float(value))
        # Setting the matrix forgets the moments.
        matrix.inverse_mass_matrix = {BLOCK: torch.from_numpy(np.array(state["inverse_mass"]))}
        moments = matrix._adapt_scheme[BLOCK]
        moments.n_samples = n_samples
        moments._mean = torch.from_numpy(np.array(state["mean"]))
        moments._m2 = torch.from_numpy(np.array(state["moment"]))

    def _potential(self, sites: Mapping[str, Tensor]) -> Tensor:
        return -self._density.log_density(self._point + self._root @ sites[SITE])

    # Names and arguments of what follows are Pyro's.

    def _sample_r(self, name):  # type: ignore[no-untyped-def]
        momentum, unscaled = super()._sample_r(name)
        if name.startswith("r_t="):
            self.trajectory.energy = float(self._kinetic_energy(unscaled) + self._potential_energy_last)
        return momentum, unscaled

    def _build_basetree(self, *arguments):  # type: ignore[no-untyped-def]
        tree = super()._build_basetree(*arguments)
        self.trajectory.n_steps += 1
        self.trajectory.acceptance += float(tree.sum_accept_probs)
        self.trajectory.diverging |= bool(tree.diverging)
        return tree


def _array(value: Tensor | float) -> NDArray[np.float64]:
    return np.array(torch.as_tensor(value, dtype=torch.float64).detach().numpy(), copy=True)
