"""Data drawn from the model itself: true products of drawn impedance and drawn desired trajectory.

Nothing here is Gaussian in u, because u = Σ_j w_j e⁽ʲ⁾ + ũ + ε is formed as it stands, with matrices in place of w_j
where axes are coupled; the truth of every latent is kept beside the force.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config
from bayes_impedance.engines.gaussian import draw_gaussian
from bayes_impedance.features import FeatureMap, Features
from bayes_impedance.kernels.coupled import CoupledInteractionKernel
from bayes_impedance.kernels.coupled_terms import CoupledProcess, contract
from bayes_impedance.kernels.derivative import derivative_table
from bayes_impedance.kernels.impedance import same_label
from bayes_impedance.kernels.warped import ImpedanceProcess
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.trajectory_mean import TrajectoryMean

Array = NDArray[np.float64]


def repeated_motion(
    repetitions: int = 4,
    duration: float = 4.0,
    rate: float = 50.0,
    displacement_sd: float = 0.02,
    axes: tuple[str, ...] = ("x", "y"),
    seed: int = 0,
    group: str = "0",
) -> PreparedLog:
    """Motions along one closed path, each repetition perturbed and paced in its own way, without force.

    Path: a figure of eight, .2 m wide, as `reference` [m]. Displacement: five sinusoids of .3 to 2 Hz with
    SD `displacement_sd` [m]. Every derivative is exact. `duration` [s] and `rate` [Hz] of a repetition.

    Example:
        >>> motion = repeated_motion(repetitions=3, duration=2.0, rate=50.0, axes=("x",))
        >>> len(motion.trials), motion.trials[0].position.shape, motion.trials[0].force is None
        (3, (100, 1), True)
    """
    generator = np.random.default_rng(seed)
    trials = []
    for repetition in range(repetitions):
        time = np.arange(round(duration * rate)) / rate
        phase, phase_velocity, phase_acceleration = _pace(time, duration, generator)
        path, path_velocity, path_acceleration, path_jerk = _path(
            phase, phase_velocity, phase_acceleration, len(axes)
        )
        offset = _displacement(time, displacement_sd, len(axes), generator)
        trials.append(
            PreparedTrial(
                name=str(repetition),
                group=group,
                source="memory",
                time=time,
                position=path + offset[0],
                velocity=path_velocity + offset[1],
                acceleration=path_acceleration + offset[2],
                jerk=path_jerk + offset[3],
                repetition=np.zeros(len(time), dtype=np.int64),
                phase=phase,
                phase_velocity=phase_velocity,
                phase_acceleration=phase_acceleration,
                reference=path,
                reference_velocity=path_velocity,
                reference_acceleration=path_acceleration,
            )
        )
    return PreparedLog(axes, tuple(trials))


def draw_force(
    config: Config, motion: PreparedLog, seed: int, force_model: ForceModel | None = None
) -> PreparedLog:
    """`motion` with force drawn from the model, and the truth of every latent.

    Hyperparameters are those of `force_model`, else the medians of `config`. Impedance and, where trials
    share it, the desired trajectory are drawn once a group.

    Example:
        >>> from bayes_impedance.config import load_config
        >>> motion = repeated_motion(repetitions=2, duration=2.0, rate=10.0, axes=("x",))
        >>> trial = draw_force(load_config("phase"), motion, seed=0).trials[0]
        >>> trial.force.shape, bool((trial.truth["stiffness_xx"] > 0).all())
        ((20, 1), True)
    """
    generator = torch.Generator().manual_seed(seed)
    feature_map = FeatureMap(config, motion.axes)
    mean = TrajectoryMean.from_training(config.model.desired_trajectory, motion)
    features = feature_map(motion, mean)
    model = build_force_model(config, feature_map) if force_model is None else force_model
    with torch.no_grad():
        drawn = {group: _draw_group(model, features, g, generator) for g, group in enumerate(features.groups)}
    trials = []
    counts = dict.fromkeys(features.groups, 0)
    for trial in motion.trials:
        rows = slice(counts[trial.group], counts[trial.group] + len(trial.time))
        counts[trial.group] = rows.stop
        desired, impedance, residual, noise = (part[:, rows] for part in drawn[trial.group])
        hand = np.stack([trial.position.T, trial.velocity.T, trial.acceleration.T], axis=-1)
        # u = Σ_j w_j e⁽ʲ⁾ + ũ + ε, with w = (k, d, m)
        force = _impedance_force(impedance, desired - hand) + residual + noise
        truth: dict[str, Array] = {}
        for a, axis in enumerate(motion.axes):
            truth[f"desired_position_{axis}"] = desired[a, :, 0]
            truth[f"desired_velocity_{axis}"] = desired[a, :, 1]
            truth[f"desired_acceleration_{axis}"] = desired[a, :, 2]
            truth[f"residual_force_{axis}"] = residual[a]
            truth |= _impedance_truth(impedance, a, motion.axes)
        trials.append(replace(trial, force=np.ascontiguousarray(force.T), truth=truth))
    return PreparedLog(motion.axes, tuple(trials))


def _impedance_force(impedance: Array, error: Array) -> Array:
    """Σ_j w_j e⁽ʲ⁾, `(axes, n)`, of `impedance` `(axes, n, 3)`, or `(axes, n, 3, axes)` where axes are coupled."""
    if impedance.ndim == 3:
        return np.asarray((impedance * error).sum(-1))
    return np.einsum("anjc,cnj->an", impedance, error)


def _impedance_truth(impedance: Array, a: int, axes: tuple[str, ...]) -> dict[str, Array]:
    """Impedance of axis number `a`, and where axes are coupled with those after it."""
    truth: dict[str, Array] = {}
    for j, name in enumerate(("stiffness", "damping", "mass")):
        if impedance.ndim == 3:
            truth[f"{name}_{axes[a]}{axes[a]}"] = impedance[a, :, j]
        else:
            truth |= {f"{name}_{axes[a]}{axes[b]}": impedance[a, :, j, b] for b in range(a, len(axes))}
    return truth


def as_recording(prepared: PreparedLog, *, keep_reference: bool = False) -> InteractionLog:
    """What a logger would have written of drawn data: time, position, force, phase, and the truth beside."""
    trials = tuple(
        Trial(
            name=trial.name, group=trial.group, source=trial.source, time=trial.time,
            position=trial.position, force=trial.force, repetition=trial.repetition, phase=trial.phase,
            reference=trial.reference if keep_reference else None, truth=trial.truth,
        )
        for trial in prepared.trials
    )  # fmt: skip
    return InteractionLog(prepared.axes, trials)


def _draw_group(
    model: ForceModel, features: Features, group: int, generator: torch.Generator
) -> tuple[Array, Array, Array, Array]:
    """Desired trajectory and impedance `(axes, n, 3)`, residual and noise `(axes, n)`.

    Where axes are coupled impedance is `(axes, n, 3, axes)`.
    """
    n = len(features.rows[group])
    x = features.inputs[:, group : group + 1, :n]
    kernel = model.kernel
    impedance = kernel.impedance
    path = impedance.layout.path(x)
    common, table = derivative_table(impedance.trajectory, path, path)
    shared = same_label(x, x, impedance.layout.trajectory)
    common = common if shared is None else common * shared
    rows = [torch.cat([(common * table[i][j]).expand_as(common) for j in range(3)], dim=-1) for i in range(3)]
    deviation = draw_gaussian(torch.cat(rows, dim=-2), generator)
    desired = features.trajectory_mean[:, group : group + 1, :n] + torch.stack(
        deviation.split(n, dim=-1), dim=-1
    )
    columns = [_draw_impedance(process, x, generator) for process in impedance.processes]
    coupled = isinstance(kernel, CoupledInteractionKernel)
    own = kernel.axis_residuals(x[0], x[0]) if coupled else kernel.residual_covariance(x, x)
    residual = draw_gaussian(own, generator)
    standard = torch.randn(residual.shape, generator=generator, dtype=residual.dtype)
    noise = model.noise_variance.sqrt() * standard
    parts = (desired, torch.stack(columns, dim=3), residual, noise)
    return tuple(part[:, 0].numpy() for part in parts)  # type: ignore[return-value]


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


def _pace(time: Array, duration: float, generator: np.random.Generator) -> tuple[Array, Array, Array]:
    """Phase from .01 to .99, quicker here and slower there, with its time derivatives."""
    uneven, shift = 0.15 * generator.uniform(-1.0, 1.0), generator.uniform(0.0, 2.0 * math.pi)
    omega = 2.0 * math.pi / duration
    span = 0.98
    linear = time / duration
    wave = np.sin(omega * time + shift) - math.sin(shift)
    phase = 0.01 + span * (linear + uneven * wave / (2.0 * math.pi))
    velocity = span / duration * (1.0 + uneven * np.cos(omega * time + shift))
    acceleration = -span / duration * uneven * omega * np.sin(omega * time + shift)
    return phase, velocity, acceleration


def _path(phase: Array, velocity: Array, acceleration: Array, axes: int) -> tuple[Array, Array, Array, Array]:
    """Figure of eight over phase and its time derivatives; the jerk neglects that of the phase."""
    amplitude = np.array([0.1, 0.05, 0.03])[:axes]
    omega = 2.0 * math.pi * np.array([1.0, 2.0, 1.0])[:axes]
    shift = np.array([0.0, 0.0, 0.5 * math.pi])[:axes]
    angle = phase[:, None] * omega + shift
    rate, change = velocity[:, None], acceleration[:, None]
    d0, d1 = amplitude * np.sin(angle), amplitude * omega * np.cos(angle)
    d2, d3 = -(omega**2) * d0, -(omega**2) * d1
    return d0, d1 * rate, d2 * rate**2 + d1 * change, d3 * rate**3 + 3.0 * d2 * rate * change


def _displacement(time: Array, sd: float, axes: int, generator: np.random.Generator) -> Array:
    """Sum of five sinusoids and its first three derivatives, `(4, n, axes)`."""
    terms = 5
    omega = 2.0 * math.pi * generator.uniform(0.3, 2.0, size=(terms, axes))
    shift = generator.uniform(0.0, 2.0 * math.pi, size=(terms, axes))
    angle = time[:, None, None] * omega + shift
    derivatives = []
    for order in range(4):
        wave = np.sin(angle + 0.5 * math.pi * order)
        derivatives.append((omega**order * wave).sum(axis=1) * sd * math.sqrt(2.0 / terms))
    return np.stack(derivatives)
