"""From prepared samples to the inputs of the kernels: θ, θ̇, θ̈, ξ, ē and labels, batched over axes and groups."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import Config, ModelConfig
from bayes_impedance.config.sections import Component
from bayes_impedance.device import Loop
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.kernels.impedance import InputLayout
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.trajectory_mean import TrajectoryMean, phase_derivatives

Array = NDArray[np.float64]

UNITS: Mapping[str, str] = {"time": "s", "phase": "1", "position": "m", "velocity": "m/s"}


@dataclass(frozen=True)
class Features:
    """Kernel inputs of a log, one batch entry an axis and group.

    `inputs` `(axes, groups, n, D)`; `force` `(axes, groups, n)` [N], None where the log has none;
    `trajectory_mean` `(axes, groups, n, 3)`: μ_xd and its derivatives [m, m/s, m/s²]; `valid`
    `(groups, n)` is False on padding, None where nothing is padded; `rows[g]` lists (trial, sample) of
    each valid row; `loop`: a device that answers force by acceleration, None where none does or acceleration does not
    enter the force.
    """

    groups: tuple[str, ...]
    inputs: Tensor
    force: Tensor | None
    trajectory_mean: Tensor
    valid: Tensor | None
    rows: tuple[NDArray[np.int64], ...]
    loop: Loop | None = None

    @property
    def counts(self) -> Tensor:
        """Samples of each group, padding left out, `(groups,)`."""
        groups, n = self.inputs.shape[1:3]
        return (
            self.inputs.new_full((groups,), n) if self.valid is None else self.valid.sum(-1).to(self.inputs)
        )


class FeatureMap:
    """Layout of the inputs that a configuration asks for, and the map from samples to them."""

    def __init__(self, config: Config, axes: tuple[str, ...]) -> None:
        model = config.model
        self.model = model
        self.axes = axes
        self.theta = theta_components(model)
        self.xi = _xi_components(model)
        shared = config.shared.desired_trajectory
        self.trajectory_shared = model.trajectory_input != "time" if shared is None else shared
        self.residual_shared = config.shared.residual
        self._columns: dict[str, tuple[int, ...]] = {}
        width = 0

        def take(name: str, count: int) -> tuple[int, ...]:
            nonlocal width
            self._columns[name] = tuple(range(width, width + count))
            width += count
            return self._columns[name]

        p = sum(self._size(component) for component in self.theta)
        has_acceleration = model.trajectory_input != "time" and not model.drop_acceleration
        self.layout = InputLayout(
            theta=take("theta", p),
            theta_velocity=take("theta_velocity", p),
            theta_acceleration=take("theta_acceleration", p if has_acceleration else 0),
            error=take("error", 0 if model.desired_trajectory.mean == "equilibrium" else 3),
            trajectory=None if self.trajectory_shared else take("trajectory", 1)[0],
            residual=None if self.residual_shared else take("residual", 1)[0],
            smoothing=take("smoothing", 7 if _carries_motion_noise(model) else 0),
        )
        for component in self.xi:
            take(f"xi.{component}", self._size(component))
        self.width = width
        # Around the hand itself ē_2 = 0: no acceleration enters the force (docs/model.md §6).
        answers = config.device is not None and bool(self.layout.error)
        self.device = config.device if answers else None

    def active_dims(self, components: Sequence[Component]) -> tuple[int, ...]:
        """Input columns of some components of ξ."""
        return tuple(column for component in components for column in self._columns[f"xi.{component}"])

    def columns_of(self, component: str) -> tuple[int, ...]:
        """Input columns of one component, of θ or else of ξ; none where the model does not depend on it."""
        if component not in self.theta:
            return self._columns.get(f"xi.{component}", ())
        before = self.theta[: self.theta.index(component)]
        start = sum(self._size(one) for one in before)
        return self.layout.theta[start : start + self._size(component)]

    def labels(self, components: Sequence[str]) -> list[str]:
        """Name of each dimension of a kernel over `components`: time, position_x, …"""
        names: list[str] = []
        for component in components:
            names += [component] if self._size(component) == 1 and component in ("time", "phase") else [
                f"{component}_{axis}" for axis in self.axes
            ]  # fmt: skip
        return names

    def __call__(
        self,
        log: PreparedLog,
        mean: TrajectoryMean,
        trial_labels: Mapping[str, int] | Sequence[int] | None = None,
        *,
        observed: bool = False,
        samples: Sequence[NDArray[np.int64]] | None = None,
    ) -> Features:
        """Inputs of the samples of `log`; trials with equal label share what trials do not share otherwise.

        `trial_labels` maps `trial_key` to a label, so that two logs can be put into one covariance, or lists that of
        each trial; `observed` leaves out samples without known force, which cannot be conditioned on. `samples`: those
        of each trial that are asked for, all if None.

        Raises:
            ConfigurationError: noise of the positions is to be carried, and the motion did not pass the smoother.
        """
        labels = label_trials(log) if trial_labels is None else trial_labels
        if isinstance(labels, Mapping):
            labels = labels_of(log, labels)
        chosen = samples or [
            np.flatnonzero(trial.observed) if observed else np.arange(trial.n_samples) for trial in log.trials
        ]
        blocks = [self._trial(*one, mean) for one in zip(log.trials, chosen, labels, strict=True)]
        by_group = log.by_group
        groups, members = tuple(by_group), list(by_group.values())
        lengths = [sum(len(chosen[i]) for i in member) for member in members]
        n, a = max(lengths), len(self.axes)
        has_force = all(trial.force is not None for trial in log.trials)
        inputs = np.zeros((a, len(groups), n, self.width))
        means = np.zeros((a, len(groups), n, 3))
        force = np.zeros((a, len(groups), n))
        valid = np.zeros((len(groups), n), dtype=bool)
        rows = []
        for g, (member, length) in enumerate(zip(members, lengths, strict=True)):
            inputs[:, g, :length] = np.concatenate([blocks[i][0] for i in member], axis=1)
            means[:, g, :length] = np.concatenate([blocks[i][1] for i in member], axis=1)
            if has_force:
                known = [values[chosen[i]] for i in member if (values := log.trials[i].force) is not None]
                force[:, g, :length] = np.concatenate(known).T
            valid[g, :length] = True
            rows.append(np.concatenate([_row_index(i, chosen[i]) for i in member]))
        return Features(
            groups=groups,
            inputs=torch.from_numpy(inputs),
            force=torch.from_numpy(force) if has_force else None,
            trajectory_mean=torch.from_numpy(means),
            valid=None if valid.all() else torch.from_numpy(valid),
            rows=tuple(rows),
            loop=None if self.device is None else Loop.of(log, self.device),
        )

    def _trial(
        self, trial: PreparedTrial, rows: NDArray[np.int64], label: int, mean: TrajectoryMean
    ) -> tuple[Array, Array]:
        start = float(trial.time[0]) if trial.n_samples else 0.0
        if len(rows) < trial.n_samples:
            trial = trial.part(rows)
        n, a = len(trial.time), len(self.axes)
        values = np.zeros((a, n, self.width))
        theta = [self._values(trial, component, start) for component in self.theta]
        values[..., list(self._columns["theta"])] = np.concatenate([part[0] for part in theta], axis=1)
        velocity = [part[1] for part in theta]
        if self.model.drop_acceleration:
            velocity[-1] = np.zeros_like(velocity[-1])
        values[..., list(self._columns["theta_velocity"])] = np.concatenate(velocity, axis=1)
        if self.layout.theta_acceleration:
            second = np.concatenate([part[2] for part in theta], axis=1)
            values[..., list(self._columns["theta_acceleration"])] = second
        for component in self.xi:
            values[..., list(self._columns[f"xi.{component}"])] = self._values(trial, component, start)[0]
        desired = mean.derivatives(trial)
        hand = np.stack([trial.position, trial.velocity, trial.acceleration])
        if self.layout.error:
            values[..., list(self.layout.error)] = np.moveaxis(desired - hand, (0, 1, 2), (2, 1, 0))
        for column in (self.layout.trajectory, self.layout.residual):
            if column is not None:
                values[..., column] = label
        if self.layout.smoothing:
            values[..., list(self.layout.smoothing)] = np.column_stack([np.full(n, label), _smoothing(trial)])
        return values, np.moveaxis(desired, (0, 1, 2), (2, 1, 0))

    def _values(self, trial: PreparedTrial, component: str, start: float) -> tuple[Array, Array, Array]:
        """A component and its first two time derivatives, `(n, size)` each; time counts from `start` [s]."""
        if component == "time":
            one = np.ones((len(trial.time), 1))
            return (trial.time - start)[:, None], one, np.zeros_like(one)
        if component == "phase":
            phase, rate, change = phase_derivatives(trial)
            return phase[:, None], rate[:, None], change[:, None]
        if component == "position":
            return trial.position, trial.velocity, trial.acceleration
        return trial.velocity, trial.acceleration, trial.jerk

    def _size(self, component: str) -> int:
        return 1 if component in ("time", "phase") else len(self.axes)


@dataclass(frozen=True)
class LogFeatures:
    """Features of any part of a log, formed when they are asked for; `labels` of its trials (see `FeatureMap`)."""

    feature_map: FeatureMap
    log: PreparedLog
    mean: TrajectoryMean
    labels: Sequence[int]

    def __call__(
        self,
        trials: Sequence[int] | None = None,
        *,
        observed: bool = False,
        samples: Sequence[NDArray[np.int64]] | None = None,
    ) -> Features:
        """Of the trials with these indices, all if None; `rows` of the features count these trials."""
        log, labels = self.log, self.labels
        if trials is not None:
            # Of two logs, whose trials may share their names.
            log = replace(log, trials=tuple(log.trials[i] for i in trials))
            labels = [labels[i] for i in trials]
        return self.feature_map(log, self.mean, labels, observed=observed, samples=samples)


def _carries_motion_noise(model: ModelConfig) -> bool:
    # Around the hand itself its noise cancels (a naive GP has this mean, too).
    return model.position_noise_sd is not None and model.desired_trajectory.mean != "equilibrium"


def _smoothing(trial: PreparedTrial) -> Array:
    if trial.smoothing is None:
        raise ConfigurationError(
            f"{trial.source}, trial {trial.name}: expected motion from the smoother with model.position_noise_sd, "
            "which says what the smoother leaves of the noise, found motion that did not pass it; set "
            "preprocessing.smoother, or model.position_noise_sd=null"
        )
    return trial.smoothing


def theta_components(model: ModelConfig) -> tuple[Component, ...]:
    """Components of θ."""
    if model.trajectory_input == "position_velocity":
        return ("position", "velocity")
    return (model.trajectory_input,)


def baseline_components(config: Config) -> tuple[Component, ...]:
    """Inputs of the naive GP: as configured, else all that the impedance model sees."""
    return model_components(config.model) if config.baseline.input is None else config.baseline.input


def model_components(model: ModelConfig) -> tuple[Component, ...]:
    """Every input of the impedance model: θ and what stiffness, damping and residual depend on, each once."""
    return tuple(dict.fromkeys((*theta_components(model), *_xi_components(model))))


def _xi_components(model: ModelConfig) -> tuple[Component, ...]:
    """Components of ξ, each once."""
    residual = () if model.residual is None else model.residual.input
    impedance = (*model.stiffness.input, *model.damping.input, *model.mass.input)
    return tuple(dict.fromkeys((*impedance, *residual)))


def check_combination(config: Config, log: PreparedLog) -> None:
    """Refuse what the model cannot mean on this log.

    Raises:
        ConfigurationError: `equilibrium` with `phase` over several repetitions, or coupled axes with one alone.
    """
    model = config.model
    if model.axes == "coupled" and len(log.axes) == 1:
        raise ConfigurationError(
            f"model.axes: expected a log of two or three axes with coupled, found {log.axes[0]} alone; set "
            "model.axes=independent, or name more in log.axes"
        )
    if model.trajectory_input == "phase" and model.desired_trajectory.mean == "equilibrium":
        for group, members in log.by_group.items():
            count = count_repetitions(log.select(members))
            if count > 1:
                raise ConfigurationError(
                    "desired_trajectory.mean: expected trial_average, reference or constant with "
                    f"trajectory_input: phase over repetitions, got equilibrium with {count} repetitions in group "
                    f"'{group}'; the hand is not a function of phase there, so equilibrium would make "
                    "x_d − x the shared function; set model.desired_trajectory.mean=trial_average"
                )


def count_repetitions(log: PreparedLog, others: Sequence[PreparedTrial] = ()) -> int:
    """Repetitions of the group of `log` that has fewest, `others` counted in, each motion once."""
    counts = dict.fromkeys(log.groups, 0)
    for trial in {trial_key(trial): trial for trial in (*log.trials, *others)}.values():
        if trial.group in counts:
            counts[trial.group] += np.unique(trial.repetition).size
    return min(counts.values())


def trial_key(trial: PreparedTrial) -> str:
    """Identity of a trial's motion and force, whatever its file is called."""
    return _key(trial, trial.force)


def label_trials(*logs: PreparedLog) -> dict[str, int]:
    """One label for each distinct trial of the logs; one without force is the trial that has its motion."""
    labels: dict[str, int] = {}
    # Those with force come first, so that those without find them.
    trials = sorted((trial for log in logs for trial in log.trials), key=lambda trial: trial.force is None)
    for count, trial in enumerate(trials):
        label = labels.setdefault(trial_key(trial), count)
        labels.setdefault(_key(trial, None), label)
    return labels


def labels_of(log: PreparedLog, labels: Mapping[str, int]) -> list[int]:
    """The label of each trial of `log`."""
    return [labels[trial_key(trial)] for trial in log.trials]


def _key(trial: PreparedTrial, force: Array | None) -> str:
    digest = hashlib.sha256(trial.group.encode())
    for array in (trial.time, trial.position, force):
        digest.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _row_index(trial: int, samples: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([np.full(len(samples), trial), samples], axis=1)
