"""A device that answers force, M_r ẍ + D_r ẋ = u + p: its law checked against a log, or as source of acceleration."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bayes_impedance.config import DeviceConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial

Array = NDArray[np.float64]

#: Share of the variance of u + p that the law of the device has to explain before nobody is warned.
PLAUSIBLE = 0.5


@dataclass(frozen=True)
class Loop:
    """A device that answers force, as the likelihood sees it.

    Virtual mass M_r and damping D_r `(axes, 1)` [kg, Ns/m], zero where unknown; time between samples `(groups,)` [s].
    """

    device_mass: Tensor
    device_damping: Tensor
    step: Tensor

    @classmethod
    def of(cls, log: PreparedLog, device: DeviceConfig) -> Loop:
        """The device and the mean time between samples of each group of `log`.

        Raises:
            ConfigurationError: an axis of the log has no virtual mass.
        """
        steps = []
        for members in log.by_group.values():
            times = [log.trials[i].time for i in members]
            steps.append(sum(np.ptp(time) for time in times) / max(1, sum(len(time) - 1 for time in times)))
        mass = torch.from_numpy(device.masses(log.axes)).unsqueeze(-1)
        damping = device.dampings(log.axes)
        known = torch.zeros_like(mass) if damping is None else torch.from_numpy(damping).unsqueeze(-1)
        return cls(mass, known, torch.tensor(steps, dtype=mass.dtype))

    def select(self, groups: list[int]) -> Loop:
        """The same for some groups, by index."""
        return Loop(self.device_mass, self.device_damping, self.step[groups])

    def one(self, axis: int, group: int) -> Loop:
        """The same for one axis and group, without batch dimensions."""
        return Loop(self.device_mass[axis, 0], self.device_damping[axis, 0], self.step[group])


def follow_law(log: PreparedLog, device: DeviceConfig) -> PreparedLog:
    """`log` checked against the law of its device, with its acceleration from that law where configured.

    Warns (LogWarning) where the law contradicts the recorded motion and force.

    Raises:
        LogError: the law is to give the acceleration, and a trial has no force.
        ConfigurationError: an axis of the log has no virtual mass or damping.
    """
    mass = device.masses(log.axes)
    damping = device.dampings(log.axes)
    if damping is None:
        return log
    _check_law(log, mass, damping)
    if device.acceleration == "measured":
        return log
    return replace(log, trials=tuple(_by_law(trial, mass, damping) for trial in log.trials))


def _by_law(trial: PreparedTrial, mass: Array, damping: Array) -> PreparedTrial:
    if trial.force is None:
        raise LogError(
            f"{trial.source}, trial {trial.name}: expected force, from which device.acceleration: law takes the "
            "acceleration, found none; set device.acceleration=measured"
        )
    acceleration = (_drive(trial) - damping * trial.velocity) / mass
    jerk = np.gradient(acceleration, trial.time, axis=0)
    smoothing = trial.smoothing
    if smoothing is not None:
        # Position and velocity at most are left to come from the recorded positions.
        smoothing = np.column_stack([smoothing[:, :-1], np.minimum(smoothing[:, -1], 2.0)])
    return replace(trial, acceleration=acceleration, jerk=jerk, smoothing=smoothing)


def _drive(trial: PreparedTrial) -> Array:
    """u + p, `(n, axes)` [N]."""
    assert trial.force is not None
    return trial.force if trial.perturbation is None else trial.force + trial.perturbation


def _check_law(log: PreparedLog, mass: Array, damping: Array) -> None:
    trials = [trial for trial in log.trials if trial.force is not None]
    if not trials:
        return
    drive = np.concatenate([_drive(trial) for trial in trials])
    answer = np.concatenate([mass * trial.acceleration + damping * trial.velocity for trial in trials])
    variance = drive.var(axis=0)
    share = 1.0 - (drive - answer).var(axis=0) / np.where(variance > 0, variance, 1.0)
    for axis, explained in zip(log.axes, share, strict=True):
        if explained < PLAUSIBLE:
            warnings.warn(
                f"axis {axis}: expected motion that follows the device, M_r a + D_r v = u + p, found that this law "
                f"explains {max(explained, 0.0):.0%} of the variance of u + p; check device.mass and damping, sign "
                "and unit of force and perturbation, and a lag between force and motion",
                LogWarning,
                stacklevel=2,
            )
