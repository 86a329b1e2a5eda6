"""Recordings drawn from the exact model: impedance and hyperparameters at coordinates z, all else from their priors.

    u = Σ_j W_j(z) e⁽ʲ⁾ + ũ + ε,    z ~ N(0, I),    x_d, ũ | h(z) Gaussian processes

Covariances are those of the kernels that moments are made of, not those of the engines given impedance, so that a
likelihood can be checked against what is drawn here.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions.density import beside_impedance
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.simulation.generative import draw_force

Array = NDArray[np.float64]


def draw_recording(density: JointDensity, motion: PreparedLog, standard: Array, seed: int) -> PreparedLog:
    """`motion` with force, and where a device answers it with velocity and acceleration, at z `standard` `(size,)`.

    `density` of the samples of `motion`, with whatever force; `seed` of desired trajectory, residual force and noise.

    Raises:
        ConfigurationError: on a device that answers force, what the model depends on moves with it.
    """
    check_loop(density.config, motion.axes)
    with torch.no_grad():
        values = density.values(torch.from_numpy(standard))
        model = force_model_at(density.config, motion.axes, values)
        return draw_force(density.config, motion, seed, model, density.impedance(values), in_loop=True)


def force_model_at(config: Config, axes: tuple[str, ...], values: Mapping[str, Tensor]) -> ForceModel:
    """The force model with what `values` of sites say of desired trajectory, residual force and noise."""
    model = build_force_model(config, FeatureMap(config, axes))
    with torch.no_grad():
        for entry in beside_impedance(model):
            # As users see it, (axes, 1, 1, components), of which a site has the learned ones.
            whole = entry.value.clone()
            whole[..., entry.free] = values[entry.name.replace(".", "_")][:, None, None]
            entry.raw.copy_(
                entry.constraint.inverse_transform(whole ** (1.0 / entry.power)).reshape(entry.raw.shape)
            )
    return model


def check_loop(config: Config, axes: tuple[str, ...]) -> None:
    """Refuse a device whose answer moves what desired trajectory, impedance or residual force depend on.

    The Jacobian of the closed loop holds all of them (docs/model.md §6), so the model draws no such recording.

    Raises:
        ConfigurationError: they depend on position as θ, or on velocity.
    """
    feature_map = FeatureMap(config, axes)
    if feature_map.device is None:
        return
    moving = [f"trajectory_input: {config.model.trajectory_input}"] if "position" in feature_map.theta else []
    moving += ["velocity as an input"] if "velocity" in feature_map.xi else []
    if moving:
        raise ConfigurationError(
            "device: expected a model of time, phase or place alone on a device that answers force, found "
            f"{' and '.join(moving)}, which the force of the same instant moves; set device=null, or another input"
        )
