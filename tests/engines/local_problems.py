"""Small problems for local models: kernels of shipped configurations with hyperparameters of each axis its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import Config, LocalConfig, load_config
from bayes_impedance.engines.compiled.covariance import covariances, variances
from bayes_impedance.engines.compiled.numbers import KernelNumbers
from bayes_impedance.engines.local.cell import Cell, Sums, empty_cell, learn, moments
from bayes_impedance.engines.local.grid import Grid
from bayes_impedance.engines.local.model import LocalModel
from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.generative import repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

Floats = NDArray[np.float64]

#: Rows that compiled covariances give.
ROWS = (Latent.FORCE, Latent.DESIRED_POSITION, Latent.DESIRED_VELOCITY)
#: More than any cell here holds, so that views of arrays are views, as in cells.
WIDE = 3


def kernel_of(model: ForceModel, axis: int) -> torch.nn.Module:
    """Kernel of one axis, without batch."""
    return model.kernel[axis, 0]


@dataclass(frozen=True)
class Problem:
    """A force model of two axes, inputs `(axes, n, D)` along a motion, and residual forces `(axes, n)`."""

    config: Config
    feature_map: FeatureMap
    model: ForceModel
    numbers: KernelNumbers
    noise: Floats
    inputs: Floats
    residual: Floats

    @classmethod
    def of(
        cls, name: str, overrides: Sequence[str] = (), n: int = 24, repetitions: int = 2, seed: int = 0
    ) -> Problem:
        """Of a shipped configuration; hyperparameters are off their medians, differently along each axis."""
        config = load_config(name, overrides)
        log = repeated_motion(repetitions, duration=2.0, rate=n / 2.0 / repetitions, seed=seed)
        feature_map = FeatureMap(config, log.axes)
        model = build_force_model(config, feature_map)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for parameter in model.kernel.parameters():
                parameter += 0.2 * torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
        mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
        inputs = feature_map(log, mean).inputs[:, 0].numpy()
        residual = 3.0 * np.random.default_rng(seed).standard_normal(inputs.shape[:2])
        return cls(
            config, feature_map, model, KernelNumbers.of(model.kernel, feature_map.width),
            np.array([0.04, 0.09]), inputs, residual,
        )  # fmt: skip

    def cross(self, axis: int, one: Floats, two: Floats, latent: Latent = Latent.FORCE) -> Floats:
        """Cov[u(one), latent(two)] by tensors, `(n1, n2)`: the oracle."""
        with torch.no_grad():
            found = kernel_of(self.model, axis).cross_covariance(
                torch.from_numpy(one), torch.from_numpy(two), latent
            )
        return found.expand(len(one), len(two)).numpy()

    def own(self, axis: int, inputs: Floats, latent: Latent = Latent.FORCE) -> Floats:
        """Prior variances by tensors, `(n,)`, without noise."""
        with torch.no_grad():
            found = kernel_of(self.model, axis).prior_variance(torch.from_numpy(inputs), latent)
        return found.expand(len(inputs)).numpy()

    def whole(self, settings: LocalConfig) -> LocalModel:
        """A local model with one cell that holds everything, and no cell beside it."""
        columns = np.array(self.feature_map.layout.theta)
        place = self.inputs[0][:, columns]
        width = 1.0 + np.ptp(place, axis=0)
        grid = Grid(columns, place.min(axis=0) - 0.5, width, np.ones(len(columns), dtype=np.int64))
        return LocalModel(self.numbers, self.noise, grid, settings, self.inputs.shape[-1])


def compiled(numbers: KernelNumbers, axis: int, one: Floats, two: Floats) -> Floats:
    """Compiled covariances between rows of `one` and `two`, `(3, n1, n2)`."""
    n = len(one)
    kept = np.full((one.shape[1], n + WIDE), np.nan)
    kept[:, :n] = one.T
    found = np.empty((3, n, len(two)))
    out = np.empty((3, n + WIDE))
    for t, x in enumerate(two):
        covariances(numbers, axis, kept[:, :n], np.ascontiguousarray(x), out[:, :n])
        found[:, :, t] = out[:, :n]
    return found


def own_variances(numbers: KernelNumbers, axis: int, inputs: Floats) -> Floats:
    """Compiled prior variances, `(3, n)`."""
    found = np.empty((len(inputs), 3))
    for t, x in enumerate(inputs):
        variances(numbers, axis, np.ascontiguousarray(x), found[t])
    return found.T


@dataclass
class Taught:
    """A cell, its sums, and what it was taught."""

    problem: Problem
    novelty: float
    cell: Cell
    sums: Sums

    @classmethod
    def empty(cls, problem: Problem, inducing: int, novelty: float = 0.0) -> Taught:
        """Nothing was taught."""
        axes, _, width = problem.inputs.shape
        return cls(problem, novelty, empty_cell(axes, inducing, width), Sums.empty(axes, inducing))

    def learn(self, x: Floats, residual: Floats) -> None:
        """Teach one sample `(axes, D)`, `(axes,)`."""
        numbers = self.problem.numbers
        own = np.array([own_variances(numbers, axis, x[[axis]])[0, 0] for axis in range(len(x))])
        self.cell = self.cell.successor()
        learn(numbers, self.problem.noise, self.novelty, self.cell, self.sums, x, own, residual)

    def learn_all(self, rows: Sequence[int] | None = None) -> Taught:
        """Teach samples of the problem, one by one."""
        for t in range(self.problem.inputs.shape[1]) if rows is None else rows:
            self.learn(np.ascontiguousarray(self.problem.inputs[:, t]), self.problem.residual[:, t].copy())
        return self

    def predict(self, inputs: Floats) -> tuple[Floats, Floats]:
        """Mean and variance of force, x_d, ẋ_d at `(axes, m, D)`, `(axes, m, 3)` each."""
        return predict(self.problem.numbers, self.cell, inputs)


def predict(numbers: KernelNumbers, cell: Cell, inputs: Floats) -> tuple[Floats, Floats]:
    """Moments of a cell at `(axes, m, D)`, `(axes, m, 3)` each."""
    axes, m, _ = inputs.shape
    mean, variance = np.empty((2, axes, m, 3))
    for t in range(m):
        x = np.ascontiguousarray(inputs[:, t])
        prior = np.array([own_variances(numbers, axis, x[[axis]])[:, 0] for axis in range(axes)])
        one, other = np.empty((2, axes, 3))
        moments(numbers, cell, x, prior, one, other)
        mean[:, t], variance[:, t] = one, other
    return mean, variance
