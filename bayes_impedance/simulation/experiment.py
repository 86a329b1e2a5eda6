"""Recordings of simulated people tracing a path with a device in their hand, and the truth beside them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from bayes_impedance.errors import SimulationError
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.simulation.arm import Arm, motion_of_joints
from bayes_impedance.simulation.device import (
    NO_SERVO,
    Admittance,
    Perturbation,
    Sensors,
    Unperturbed,
)
from bayes_impedance.simulation.dynamics import Drive, Motion, integrate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import Path, Run, desired_motion

Array = NDArray[np.float64]

AXES = ("x", "y")
#: Of integration and of the device's controller [s].
STEP = 1e-3
#: Steps of one trial (a kilobyte each while it is simulated) and samples of a log, three hundred bytes each.
LARGEST_TRIAL, LARGEST_LOG = 1_000_000, 10_000_000


@dataclass(frozen=True)
class Experiment:
    """Who traces what with which device: `trials` of `repetitions` rounds for each subject.

    `rate` of the log [Hz]; `step` of integration and controller [s]. A subject is a group of the log.

    Raises:
        SimulationError: a number is out of range, two subjects have one name, `rate` does not divide 1 / `step`, or
            that would be less than two samples a trial or more than memory is for.
    """

    subjects: Sequence[Subject]
    task: Path
    trials: int = 10
    repetitions: int = 3
    perturbation: Perturbation = Unperturbed()
    device: Admittance = Admittance()
    sensors: Sensors = Sensors()
    rate: float = 200.0
    step: float = STEP

    def __post_init__(self) -> None:
        """Check what does not depend on the arm."""
        if not self.subjects:
            raise SimulationError("subjects: expected at least one, got none; name one or more")
        names = [subject.name for subject in self.subjects]
        for name in names:
            if names.count(name) > 1:
                raise SimulationError(
                    f"subjects: expected names that differ, got {name!r} {names.count(name)} times; rename them"
                )
        for name in ("trials", "repetitions"):
            if getattr(self, name) < 1:
                raise SimulationError(f"{name}: expected at least 1, got {getattr(self, name)}; ask for more")
        for name in ("rate", "step"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise SimulationError(
                    f"{name}: expected a finite value > 0, got {getattr(self, name):g}; choose one"
                )
        steps = 1.0 / self.rate / self.step
        if steps < 0.999 or not math.isfinite(steps) or abs(steps - round(steps)) > 1e-6:
            raise SimulationError(
                f"rate: expected a whole number of steps of {self.step:g} s between samples, got {self.rate:g} Hz; "
                f"choose a divisor of {1.0 / self.step:g} Hz"
            )
        self._check_length()

    def _check_length(self) -> None:
        times = [self.repetitions * subject.pace.repetition for subject in self.subjects]
        if min(times) * self.rate < 2.0:
            raise SimulationError(
                f"expected trials of at least two samples, got one of {min(times):g} s at {self.rate:g} Hz; make "
                "duration or rate larger"
            )
        if max(times) / self.step > LARGEST_TRIAL:
            raise SimulationError(
                f"expected trials of at most {LARGEST_TRIAL} steps, got one of {max(times):g} s in steps of "
                f"{self.step:g} s; make duration or repetitions smaller"
            )
        samples = self.trials * sum(times) * self.rate
        if samples > LARGEST_LOG:
            raise SimulationError(
                f"expected at most {LARGEST_LOG} samples in a log, got {samples:.3g}; make trials or rate smaller, or "
                "simulate several logs"
            )

    @property
    def every(self) -> int:
        """Steps between samples of the log."""
        return round(1.0 / self.rate / self.step)


def simulate(
    experiment: Experiment, seed: int = 0, progress: Callable[[int], None] | None = None
) -> InteractionLog:
    """The log of an experiment, with perturbation, displayed path as `reference`, phase, and the truth.

    Truth at every sample: desired position, velocity and acceleration, the endpoint matrices of stiffness (at constant
    muscle commands, with the geometric term; `muscle_stiffness` without), damping and mass, and the residual force
    u − K e − D ė − M ë. Trials are independent draws, named `subject-number`: the first of ten are the same as if there
    were but these, and a subject's are the same whoever else takes part. `progress` is told how many are done.

    Example:
        >>> from bayes_impedance.simulation.tasks import FigureEight, Pace
        >>> person = Subject("P", pace=Pace(repetition=2.0))
        >>> log = simulate(Experiment([person], FigureEight(), trials=2, repetitions=1, rate=100.0), seed=1)
        >>> log.trials[0].position.shape[1], sorted(log.trials[0].truth)[0]
        (2, 'damping_xx')

    Raises:
        SimulationError: the path is out of reach, the step too large, or a perturbation throws the hand out of reach.
    """
    tasks = [
        (subject, f"{subject.name}-{k}", seeds)
        for subject in experiment.subjects
        for k, seeds in enumerate(
            np.random.SeedSequence(seed, spawn_key=tuple(subject.name.encode())).spawn(experiment.trials)
        )
    ]

    def run(task: tuple[Subject, str, np.random.SeedSequence]) -> Trial:
        subject, name, seeds = task
        # What overflows is refused where it is found.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return _trial(experiment, subject, name, np.random.default_rng(seeds))

    # Compiled code and numpy let go of the interpreter, so trials run side by side, each with its own generator.
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        trials = []
        for trial in pool.map(run, tasks):
            trials.append(trial)
            if progress is not None:
                progress(len(trials))
    return InteractionLog(AXES, tuple(trials))


@dataclass(frozen=True)
class _Plan:
    """What is known of a trial before it is integrated; arrays at each step `(n, …)`, `drive` at half steps."""

    subject: Subject
    name: str
    time: Array
    run: Run
    drive: Drive
    position_added: Array


def _trial(experiment: Experiment, subject: Subject, name: str, generator: np.random.Generator) -> Trial:
    plan = _plan(experiment, subject, name, generator)
    mass, damping = np.full(2, experiment.device.mass), np.full(2, experiment.device.damping)
    if len(plan.drive.servo):
        undisturbed = _undisturbed(plan.drive)
        _command(plan, integrate(subject.arm, mass, damping, undisturbed, experiment.step))
    return _record(experiment, plan, integrate(subject.arm, mass, damping, plan.drive, experiment.step))


def _plan(experiment: Experiment, subject: Subject, name: str, generator: np.random.Generator) -> _Plan:
    arm, step = subject.arm, experiment.step
    run = subject.pace.draw(experiment.repetitions, generator)
    # To the last sample before the end, whose phase would be 1 and already the next repetition's 0.
    n = math.ceil(experiment.repetitions * run.duration / step - 1e-9)
    time = step * np.arange(n, dtype=np.float64)
    desired, start = _desired(experiment, arm, run, 0.5 * step * np.arange(2 * n - 1, dtype=np.float64))
    force, servo = experiment.perturbation.draw(n, step, generator)
    noise = arm.noise * _coloured((n, 6), arm.noise_time, step, generator)
    sensors = experiment.sensors
    drive = Drive(
        desired,
        noise,
        force,
        sensors.force.added((n, 2), generator),
        servo,
        experiment.perturbation.gains,
        start,
    )
    return _Plan(subject, name, time, run, drive, sensors.position.added((n, 2), generator))


def _desired(experiment: Experiment, arm: Arm, run: Run, time: Array) -> tuple[Array, Array]:
    """q_d, q̇_d and feedforward torque at `time`, and the state to begin in: on the desired trajectory."""
    x, v, a = desired_motion(experiment.task, run, time)
    q, w, acceleration = motion_of_joints(arm, x, v, a)
    # Inverse dynamics of the arm, and of what the person expects of the device.
    load = arm.anticipation * (experiment.device.mass * a + experiment.device.damping * v)
    torque = (arm.inertia(q) @ acceleration[..., None])[..., 0] + arm.coriolis(q, w)
    torque += np.einsum("nij,ni->nj", arm.jacobian(q), load)
    return np.concatenate([q, w, torque], axis=1), np.concatenate([q[0], w[0]])


def _coloured(shape: tuple[int, int], time: float, step: float, generator: np.random.Generator) -> Array:
    """Ornstein–Uhlenbeck processes of unit variance along the first dimension."""
    keep = math.exp(-step / time)
    white = generator.standard_normal(shape)
    white[1:] *= math.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], white, axis=0))


def _undisturbed(drive: Drive) -> Drive:
    """The same intention without noise and perturbation: what a controller would predict from earlier trials."""
    quiet = np.zeros_like(drive.perturbation)
    return Drive(
        drive.desired, np.zeros_like(drive.tension_noise), quiet, quiet, NO_SERVO, (0.0, 0.0), drive.start
    )


def _command(plan: _Plan, predicted: Motion) -> None:
    """Add the predicted motion of the hand to the displacement that the servo is to command."""
    x, v, _ = _hand(plan.subject.arm, predicted)
    plan.drive.servo[:, 1:3] += x
    plan.drive.servo[:, 3:5] += v


def _hand(arm: Arm, motion: Motion) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration of the hand, `(n, 2)` [m, s]."""
    jacobian, rate = arm.jacobian(motion.q), arm.jacobian_rate(motion.q, motion.w)
    velocity = np.einsum("nij,nj->ni", jacobian, motion.w)
    acceleration = np.einsum("nij,nj->ni", jacobian, motion.acceleration)
    return arm.hand(motion.q), velocity, acceleration + np.einsum("nij,nj->ni", rate, motion.w)


def _record(experiment: Experiment, plan: _Plan, motion: Motion) -> Trial:
    arm, device, sensors = plan.subject.arm, experiment.device, experiment.sensors
    x, v, a = _hand(arm, motion)
    _check_reach(plan, x)
    added = plan.drive.sensor
    force = device.mass * a + device.damping * v - motion.perturbation - added
    logged = slice(None, None, experiment.every)
    time = plan.time[logged]
    phase = plan.run.phase(time)[0]
    desired = desired_motion(experiment.task, plan.run, time)
    torque = plan.drive.desired[::2][logged, 4:]
    truth = _truth(arm, motion.q[logged], torque, force[logged], (x[logged], v[logged], a[logged]), desired)
    return Trial(
        name=plan.name,
        group=plan.subject.name,
        source="simulation",
        time=time,
        position=sensors.position.recorded(x + plan.position_added, experiment.step)[logged],
        force=sensors.force.recorded(force + added, experiment.step)[logged],
        perturbation=motion.perturbation[logged],
        reference=desired[0],
        repetition=plan.run.repetition(time),
        phase=phase,
        truth=truth,
    )


def _check_reach(plan: _Plan, x: Array) -> None:
    low, high = plan.subject.arm.reach
    distance = np.hypot(x[:, 0], x[:, 1])
    # Written so that a motion that is not finite is refused too.
    outside = ~((distance >= low) & (distance <= high))
    if outside.any():
        raise SimulationError(
            f"trial {plan.name}: expected the hand between {low:.3f} and {high:.3f} m from the shoulder, found it "
            f"elsewhere at {plan.time[outside.argmax()]:.3f} s; make perturbation, noise or reflex smaller, or the arm "
            "stiffer"
        )


def _truth(
    arm: Arm,
    q: Array,
    torque: Array,
    force: Array,
    hand: tuple[Array, Array, Array],
    desired: tuple[Array, Array, Array],
) -> dict[str, Array]:
    command = arm.command(torque)
    matrices = {
        "stiffness": arm.endpoint_stiffness(q, command, force),
        "muscle_stiffness": arm.endpoint_stiffness(q, command),
        "damping": arm.endpoint_damping(q, command),
        "mass": arm.endpoint_mass(q),
    }
    truth = {
        f"{name}_{AXES[i]}{AXES[j]}": matrix[:, i, j]
        for name, matrix in matrices.items()
        for i, j in ((0, 0), (0, 1), (1, 1))
    }
    residual = force.copy()
    for name, there, here in zip(("stiffness", "damping", "mass"), desired, hand, strict=True):
        residual -= np.einsum("nij,nj->ni", matrices[name], there - here)
    vectors = {
        "desired_position": desired[0],
        "desired_velocity": desired[1],
        "desired_acceleration": desired[2],
        "residual_force": residual,
    }
    return truth | {
        f"{name}_{axis}": values[:, a] for name, values in vectors.items() for a, axis in enumerate(AXES)
    }
