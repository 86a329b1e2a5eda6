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
from bayes_impedance.features import FeatureMap
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.priors import ForceModel, build_force_model
from bayes_impedance.simulation.drawn_latents import draw_group
from bayes_impedance.simulation.interaction import (
    device_answer,
    force_in_loop,
    impedance_force,
    impedance_truth,
)
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
    config: Config,
    motion: PreparedLog,
    seed: int,
    force_model: ForceModel | None = None,
    impedance: Tensor | None = None,
    *,
    in_loop: bool = False,
) -> PreparedLog:
    """`motion` with force drawn from the model, and the truth of every latent.

    Hyperparameters are those of `force_model`, else the medians of `config`. Impedance and, where trials
    share it, the desired trajectory are drawn once a group. `impedance` `(groups, n, 3, axes, axes)` at the samples of
    each group is taken as it is instead. `in_loop`: velocity and acceleration are those without the person's force of
    their instant, and the device of `config` answers it (docs/model.md §6).

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
    periodic = config.model.desired_trajectory.periodic
    known = None if impedance is None else _by_axis(impedance, config.model.axes == "coupled")
    with torch.no_grad():
        drawn = {
            group: draw_group(model, features, g, generator, periodic, None if known is None else known[g])
            for g, group in enumerate(features.groups)
        }
    answers = {
        group: device_answer(features.loop, g) if in_loop and features.loop is not None else None
        for g, group in enumerate(features.groups)
    }
    trials = []
    counts = dict.fromkeys(features.groups, 0)
    for trial in motion.trials:
        rows = slice(counts[trial.group], counts[trial.group] + len(trial.time))
        counts[trial.group] = rows.stop
        parts = [part[:, rows] for part in drawn[trial.group]]
        trials.append(_with_force(trial, motion.axes, answers[trial.group], *parts))
    return PreparedLog(motion.axes, tuple(trials))


def _with_force(
    trial: PreparedTrial,
    axes: tuple[str, ...],
    answer: Array | None,
    desired: Array,
    impedance: Array,
    residual: Array,
    noise: Array,
) -> PreparedTrial:
    """`trial` with what was drawn for it, as `draw_group` gives it."""
    hand = np.stack([trial.position.T, trial.velocity.T, trial.acceleration.T], axis=-1)
    # u = Σ_j w_j e⁽ʲ⁾ + ũ + ε, with w = (k, d, m)
    force = impedance_force(impedance, desired - hand) + residual + noise
    if answer is not None:
        force = force_in_loop(force, impedance, answer)
        hand = hand + force[..., None] * answer[:, None]
    truth: dict[str, Array] = {}
    for a, axis in enumerate(axes):
        truth[f"desired_position_{axis}"] = desired[a, :, 0]
        truth[f"desired_velocity_{axis}"] = desired[a, :, 1]
        truth[f"desired_acceleration_{axis}"] = desired[a, :, 2]
        truth[f"residual_force_{axis}"] = residual[a]
        truth |= impedance_truth(impedance, a, axes)
    velocity, acceleration = (np.ascontiguousarray(hand[..., order].T) for order in (1, 2))
    return replace(
        trial, force=np.ascontiguousarray(force.T), velocity=velocity, acceleration=acceleration, truth=truth
    )


def _by_axis(impedance: Tensor, coupled: bool) -> Tensor:
    """`(groups, axes, n, 3, axes)` of `(groups, n, 3, axes, axes)`; only diagonals where axes do not couple."""
    if coupled:
        return impedance.permute(0, 3, 1, 2, 4)
    return impedance.diagonal(dim1=-2, dim2=-1).permute(0, 3, 1, 2)


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
