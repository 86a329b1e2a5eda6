"""The posterior that samplers race on: one axis, stiffness and damping along phase at eight inducing phases each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bayes_impedance.config import Config, load_config
from bayes_impedance.engines.lowrank.hilbert import FINE, Extent, counts
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.priors import build_force_model
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

Array = NDArray[np.float64]

#: Levels, weights at the inducing phases, mass, σ and ℓ of x_d, and noise are sampled: 22 numbers.
SETTINGS = (
    "model.residual=null",
    "log.axes=[x]",
    "engine.inducing=8",
    "model.stiffness.log_sd.fixed=true",
    "model.stiffness.length_scale.phase.fixed=true",
    "model.damping.log_sd.fixed=true",
    "model.damping.length_scale.phase.fixed=true",
)
#: Waves in JAX, whose arrays do not change shape, over those at the mode; what is not needed is masked.
SPARE = 1.5


@dataclass(frozen=True)
class Posed:
    """A density and the configuration that it is of."""

    config: Config
    density: JointDensity


def posed(
    repetitions: int, samples: int, kernel: str = "squared_exponential", settings: tuple[str, ...] = ()
) -> Posed:
    """Forces drawn from the model along repetitions of four seconds, σ_r = .1 N, displacement SD 20 mm."""
    drawn = (f"model.desired_trajectory.kernel={kernel}", "model.residual=null", "log.axes=[x]")
    config = load_config("phase", [*drawn[:1], *SETTINGS, *settings])
    motion = repeated_motion(repetitions, 4.0, samples / 4.0, axes=("x",), displacement_sd=0.02)
    log = draw_force(load_config("phase", [*drawn, "model.noise_sd=.1"]), motion, 0)
    feature_map = FeatureMap(config, log.axes)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, log)
    features = feature_map(log, mean, observed=True)
    model = build_force_model(config, feature_map)
    density = JointDensity(config, model, features, choose_inducing(config, model, features))
    return Posed(config, density)


def in_jax(density: JointDensity, about: Array) -> Callable[[Any], Any]:
    """The same log density of z `(22,)` with the same features, in JAX, on a domain about `about`."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    with torch.no_grad():
        values = density.values(torch.from_numpy(about))
        processes = density.processes(values)
        designs = density.designs(values)
    features = density.features
    path = processes.layout.path(features.inputs)
    extent = Extent.of([features], processes.layout.theta[0])
    waves = jnp.arange(1, 1 + round(SPARE * counts(processes.trajectory, [extent], 1, FINE)[0]))
    factors = [jnp.asarray(design[0, 0].numpy()) for design in designs.designs]
    locations = [float(function.location[0]) for function in designs.functions]
    errors = processes.layout.errors(features.inputs, order=2)
    known = 0.0 if errors is None else jnp.asarray(torch.cat(errors, dim=-1)[0, 0].numpy())
    assert features.force is not None
    assert path.acceleration is not None
    force = jnp.asarray(features.force[0, 0].numpy())
    theta, rate, change = (
        jnp.asarray(part[0, 0].numpy()) for part in (path.theta, path.velocity, path.acceleration)
    )
    names = [p.name for p in density.parameters]
    ends = np.cumsum(density.sizes)
    medians = {p.name: float(p.median) for p in density.parameters if p.median is not None}
    log_sds = {p.name: float(p.log_sd) for p in density.parameters if p.log_sd is not None}

    def log_density(z: Any) -> Any:
        own = dict(zip(names, jnp.split(z, ends[:-1]), strict=True))
        sampled = {name: medians[name] * jnp.exp(log_sds[name] * own[name][0]) for name in medians}
        sd, scale = sampled["desired_trajectory_sd"], sampled["desired_trajectory_length_scale"]
        noise = sampled["noise_sd"]
        weights = (own["stiffness_weights"], own["damping_weights"], own["mass_weights"])
        k, d, m = (
            jnp.exp(location + factor @ weight)[:, None]
            for location, factor, weight in zip(locations, factors, weights, strict=True)
        )
        length = extent.half + FINE.margin * scale
        frequency = 0.5 * jnp.pi * waves / length
        needed = jnp.ceil(2.0 * length * FINE.cutoff / (jnp.pi * scale))
        weight = (2.0 * jnp.pi) ** 0.25 * jnp.sqrt(scale / length) * sd
        weight = weight * jnp.exp(-0.25 * (frequency * scale) ** 2) * (waves <= jax.lax.stop_gradient(needed))
        angle = (theta - extent.centre + length) * frequency
        value, slope = jnp.sin(angle) * weight, jnp.cos(angle) * weight * frequency
        # K f + D ḟ + M f̈
        phi = value * (k - m * rate**2 * frequency**2) + slope * (d * rate + m * change)
        misfit = force - (jnp.concatenate([k, d, m], axis=1) * known).sum(1)
        phi, misfit = phi / noise, misfit / noise
        factor = jnp.linalg.cholesky(jnp.eye(len(waves)) + phi.T @ phi)
        beta = jax.scipy.linalg.cho_solve((factor, True), phi.T @ misfit)
        quadratic = jnp.sum((misfit - phi @ beta) ** 2) + beta @ beta
        log_det = 2.0 * jnp.log(jnp.diag(factor)).sum() + len(force) * jnp.log(2.0 * jnp.pi * noise**2)
        return -0.5 * (quadratic + log_det + z @ z)

    return log_density
