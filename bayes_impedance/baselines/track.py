"""Impedance and desired position as they become known along a trial, and what is presumed of them at the start."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.config import Config, Hyperparameter, ImpedancePrior

Array = NDArray[np.float64]

#: Time [s] after which a recursive estimator has forgotten 63 % of what it knew: some repetitions of a few seconds.
MEMORY = 20.0


@dataclass(frozen=True)
class Track:
    """Estimates at each sample of a trial, given the forces up to it.

    `time` `(n,)` [s]; `(n, axes)`: `stiffness` [N/m], `damping` [Ns/m], `desired_position` [m], each with its SD.
    """

    time: Array
    stiffness: Array
    stiffness_sd: Array
    damping: Array
    damping_sd: Array
    desired_position: Array
    desired_position_sd: Array


@dataclass(frozen=True)
class Start:
    """Medians of stiffness [N/m], damping [Ns/m] and mass [kg], `level` `(3,)`, and their log-SDs, `spread` `(3,)`.

    A spread holds that of the level, where it is learned, and that of the process along the path, `process_spread`.
    """

    level: Array
    spread: Array
    process_spread: Array

    @classmethod
    def of(cls, config: Config) -> Start:
        """What `config.model` says."""
        model = config.model
        levels = (model.stiffness.level, model.damping.level, model.mass.level)
        processes = [_log_sd(prior) for prior in (model.stiffness, model.damping)]
        processes.append(model.mass.sd.median / model.mass.level.median)
        spread = [
            math.hypot(0.0 if level.fixed else level.log_sd, process)
            for level, process in zip(levels, processes, strict=True)
        ]
        return cls(np.array([level.median for level in levels]), np.array(spread), np.array(processes))


def _log_sd(prior: ImpedancePrior) -> float:
    scale: Hyperparameter = prior.scale
    return scale.median if prior.prior == "log_gp" else scale.median / prior.level.median
