"""Problems for the engines that are given impedance: motion, force, processes and matrices that vary along the way."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bayes_impedance.config import Config, load_config
from bayes_impedance.engines.given_impedance import Processes
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

#: A Markov desired trajectory, a few settings of the residual.
BASE = (
    "model.desired_trajectory.kernel=matern52",
    "model.stiffness.level=300",
    "model.damping.level=20",
)
NO_RESIDUAL = ("model.residual=null",)
OVER_PHASE = ("model.residual.kernel=matern32", "model.residual.input=[phase]", "shared.residual=true")
OVER_TIME = ("model.residual.kernel=matern32", "model.residual.input=[time]")


@dataclass(frozen=True)
class GivenProblem:
    """What an engine is built with and asked; `impedance` `(groups, n, 3, axes, axes)`."""

    config: Config
    log: PreparedLog
    features: Features
    model: ForceModel
    impedance: Tensor

    @property
    def processes(self) -> Processes:
        return Processes.of(self.model, self.config.model.desired_trajectory.periodic)


def given_problem(
    name: str = "phase",
    overrides: tuple[str, ...] = NO_RESIDUAL,
    axes: tuple[str, ...] = ("x", "y"),
    repetitions: int = 3,
    rate: float = 12.0,
    duration: float = 2.0,
    groups: int = 1,
    coupling: float = 0.4,
    seed: int = 0,
) -> GivenProblem:
    """Repeated motion of some groups with force drawn from the model, and impedance that is not constant."""
    config = load_config(name, [*BASE, *overrides])
    trials = []
    for group in range(groups):
        # Fewer repetitions in later groups, so that batches are padded.
        count = max(1, repetitions - group)
        trials += repeated_motion(
            count, duration, rate, axes=axes, seed=seed + group, group=str(group)
        ).trials
    log = draw_force(config, PreparedLog(axes, tuple(trials)), seed)
    feature_map = FeatureMap(config, axes)
    features = feature_map(
        log, TrajectoryMean.from_training(config.model.desired_trajectory, log), observed=True
    )
    model = build_force_model(config, feature_map)
    return GivenProblem(config, log, features, model, matrices(features, coupling, seed))


def matrices(features: Features, coupling: float, seed: int = 0) -> Tensor:
    """K, D, M at every sample: exp of a symmetric matrix whose entries wander, `(groups, n, 3, axes, axes)`."""
    generator = np.random.default_rng(seed)
    axes, groups, n = features.inputs.shape[:3]
    phase = np.linspace(0.0, 1.0, n)
    result = np.empty((groups, n, 3, axes, axes))
    for group in range(groups):
        for j, level in enumerate((300.0, 20.0, 1.5)):
            logarithm = np.zeros((n, axes, axes))
            for a in range(axes):
                for b in range(a, axes):
                    scale = 0.3 if a == b else coupling
                    wave = scale * np.sin(2.0 * np.pi * (phase + generator.uniform()))
                    logarithm[:, a, b] = logarithm[:, b, a] = wave if j < 2 else scale
            values, vectors = np.linalg.eigh(logarithm)
            result[group, :, j] = level * (vectors * np.exp(values)[:, None]) @ vectors.transpose(0, 2, 1)
    return torch.from_numpy(result)
