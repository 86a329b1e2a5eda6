"""Forces drawn from the model of configuration `arm`: K, D and M from the priors of its functions, x_d beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance import Latent, load_config
from bayes_impedance.config import Config
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions.function import build_functions, choose_inducing
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force
from bayes_impedance.simulation.interaction import impedance_force, impedance_truth
from bayes_impedance.simulation.tasks import Path
from bayes_impedance.trajectory_mean import TrajectoryMean, phase_derivatives

Array = NDArray[np.float64]

QUANTITIES = (Latent.STIFFNESS, Latent.DAMPING, Latent.MASS)
AXES = ("x", "y")
#: Levels near the arm's; no device, because the motion does not answer the drawn force; no residual, as none is drawn.
PRIORS = (
    "device=null",
    "model.residual=null",
    "model.stiffness.level={median: 120, log_sd: 0.3}",
    "model.damping.level={median: 10, log_sd: 0.3}",
    "model.mass.level={median: 1.4, log_sd: 0.3}",
)
NOISE = 0.02  # [N]
#: Inducing inputs that carry all but a millionth of a function's variance, and those of the configuration.
WHOLE, CARRIED = 200, 16


def draw(motion: PreparedLog, seed: int, intention: Path | None, inducing: int = WHOLE) -> PreparedLog:
    """`motion` with u = K e + D ė + M ë + ε, and what made it as its truth.

    K, D and M are drawn from their priors by `inducing` inputs; x_d is `intention`, or drawn from its prior, too, at
    the medians of the hyperpriors, where that is None.
    """
    config = load_config("arm", [*PRIORS, f"engine.inducing={inducing}"])
    generator = torch.Generator().manual_seed(seed)
    matrices = _matrices(config, motion, generator)
    noise = NOISE * torch.randn((len(matrices), len(AXES)), generator=generator, dtype=torch.float64).numpy()
    if intention is None:
        desired = [_drawn_intention(trial) for trial in draw_force(config, motion, seed).trials]
    else:
        desired = [_along(intention, trial) for trial in motion.trials]
    ends = np.cumsum([trial.n_samples for trial in motion.trials])[:-1]
    parts = zip(motion.trials, desired, np.split(matrices, ends), np.split(noise, ends), strict=True)
    return replace(motion, trials=tuple(_with_force(*part) for part in parts))


def _matrices(config: Config, motion: PreparedLog, generator: torch.Generator) -> Array:
    """K, D and M at every sample, `(samples, 3, axes, axes)`."""
    feature_map = FeatureMap(config, motion.axes)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, motion)
    features = feature_map(motion, mean)
    model = build_force_model(config, feature_map)
    drawn = []
    with torch.no_grad():
        for function in build_functions(config, model, choose_inducing(config, model, features)):
            shape = (1, len(function.places), function.width)
            weights = torch.randn(shape, generator=generator, dtype=torch.float64)
            drawn.append(function.matrices(function.design(features.inputs), weights)[0].numpy())
    return np.stack(drawn, axis=1)


def _drawn_intention(trial: PreparedTrial) -> Array:
    """x_d, ẋ_d and ẍ_d `(3, n, axes)` that `draw_force` drew."""
    orders = ("position", "velocity", "acceleration")
    return np.stack(
        [np.stack([trial.truth[f"desired_{order}_{axis}"] for axis in AXES], axis=-1) for order in orders]
    )


def _along(path: Path, trial: PreparedTrial) -> Array:
    """x_d, ẋ_d and ẍ_d `(3, n, axes)` of a path, with the derivatives of the phase that the model sees."""
    phase, rate, change = phase_derivatives(trial)
    x, x1, x2 = path(phase)
    return np.stack([x, x1 * rate[:, None], x2 * rate[:, None] ** 2 + x1 * change[:, None]])


def _with_force(trial: PreparedTrial, desired: Array, matrices: Array, noise: Array) -> PreparedTrial:
    error = desired - np.stack([trial.position, trial.velocity, trial.acceleration])
    impedance = matrices.transpose(2, 0, 1, 3)
    force = impedance_force(impedance, error.transpose(2, 1, 0)).T + noise
    truth: dict[str, Array] = {}
    for a, axis in enumerate(AXES):
        truth |= impedance_truth(impedance, a, AXES)
        truth[f"desired_position_{axis}"] = desired[0, :, a]
    return replace(trial, force=force, truth=truth)
