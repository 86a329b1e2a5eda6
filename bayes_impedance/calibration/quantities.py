"""What is ranked: impedance and desired position at two places of each group, and every hyperparameter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.calibration.problem import Problem, rows_of
from bayes_impedance.features import Features
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.parameters import QUANTITIES

Array = NDArray[np.float64]

#: Where along the samples of a group, ordered by phase where there is one.
PLACES = (0.25, 0.75)
#: Draws of latents at the samples of a target, `(draws, axes, groups, m)`, for coordinates `(draws, size)`, by a seed.
DrawLatents = Callable[[JointDensity, Array, Features, int], Mapping[Latent, Array]]


@dataclass(frozen=True)
class Places:
    """Two samples of each group at which functions are compared.

    `rows` `(groups, 2)`: their places among the samples of the group; `labels` of each, for people.
    """

    rows: NDArray[np.int64]
    labels: tuple[tuple[str, ...], ...]

    @classmethod
    def of(cls, problem: Problem) -> Places:
        """Samples at a quarter and three quarters of the phase, or of the samples where θ is not phase."""
        features = problem.prior.features
        by_phase = problem.config.model.trajectory_input == "phase"
        rows, labels = [], []
        for g, own in enumerate(features.rows):
            position = features.inputs[0, g, : len(own), 0].numpy() if by_phase else np.arange(len(own))
            wanted = [position.min() + share * np.ptp(position) for share in PLACES]
            chosen = [int(np.abs(position - place).argmin()) for place in wanted]
            rows.append(chosen)
            labels.append(tuple(f"phase {position[r]:.2f}" if by_phase else f"sample {r}" for r in chosen))
        return cls(np.array(rows, dtype=np.int64), tuple(labels))


class Ranked:
    """Names of all quantities of a problem, their true values, and their values at draws of a posterior."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.axes, self.groups = problem.motion.axes, problem.prior.features.groups
        self.places = Places.of(problem)
        self._varies = [not problem.prior.is_constant(j) for j in range(len(QUANTITIES))]

    def truth(self, standard: Array, log: PreparedLog) -> dict[str, float]:
        """Of the coordinates `(size,)` and the recording drawn at them."""
        features = self.problem.features(log)
        desired = np.empty((1, len(self.axes), *self.places.rows.shape))
        for g, rows in enumerate(self.places.rows):
            for p, (trial, sample) in enumerate(features.rows[g][rows]):
                for a, axis in enumerate(self.axes):
                    desired[0, a, g, p] = log.trials[trial].truth[f"desired_position_{axis}"][sample]
        values = self._values(self.problem.prior, features, standard[None], desired)
        return {name: float(value[0]) for name, value in values.items()}

    def draws(
        self, density: JointDensity, standard: Array, draw_latents: DrawLatents, seed: int
    ) -> dict[str, Array]:
        """Of coordinates `(draws, size)` of a posterior, `(draws,)` each."""
        target = rows_of(density.features, self.places.rows)
        desired = draw_latents(density, standard, target, seed)[Latent.DESIRED_POSITION]
        return self._values(density, density.features, standard, desired)

    def _values(
        self, density: JointDensity, features: Features, standard: Array, desired: Array
    ) -> dict[str, Array]:
        target = rows_of(features, self.places.rows)
        points = torch.from_numpy(standard)
        with torch.no_grad():
            sites = density.values(points)
            impedance = np.stack(
                [density.impedance(density.values(point), target).numpy() for point in points]
            )
        found: dict[str, Array] = {}
        for g, group in enumerate(self.groups):
            of_group = f", group {group}" if len(self.groups) > 1 else ""
            for j, name in enumerate(QUANTITIES):
                # What is a constant is the same everywhere.
                labels = self.places.labels[g] if self._varies[j] else ("",)
                for p, label in enumerate(labels):
                    where = of_group + (f", {label}" if label else "")
                    found |= self._entries(name, where, impedance[:, g, p, j])
            for p, label in enumerate(self.places.labels[g]):
                for a, axis in enumerate(self.axes):
                    found[f"desired position {axis}{of_group}, {label}"] = desired[:, a, g, p]
        return found | _hyperparameters(density, sites, self.axes)

    def _entries(self, name: str, where: str, matrices: Array) -> dict[str, Array]:
        """Logarithms on the diagonal of `(draws, axes, axes)`, and where axes couple what is off it."""
        found = {f"log {name} {axis}{where}": np.log(matrices[:, a, a]) for a, axis in enumerate(self.axes)}
        if self.problem.prior.coupled:
            found |= {
                f"{name} {self.axes[a]}{self.axes[b]}{where}": matrices[:, a, b]
                for a in range(len(self.axes))
                for b in range(a + 1, len(self.axes))
            }
        return found


def _hyperparameters(
    density: JointDensity, sites: Mapping[str, Tensor], axes: tuple[str, ...]
) -> dict[str, Array]:
    """Components of every hyperparameter that is sampled."""
    found: dict[str, Array] = {}
    for parameter in density.parameters:
        for a in range(parameter.shape[0] if parameter.labels else 0):
            # One that axes share belongs to none of them.
            axis = f" {axes[a]}" if parameter.shape[0] == len(axes) else ""
            for c, label in enumerate(parameter.labels):
                name = " ".join(filter(None, (parameter.name.replace("_", " "), label)))
                found[f"{name}{axis}"] = sites[parameter.name][:, a, c].numpy()
    return found
