"""Phase from the motion itself: the share of the way that has been covered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayes_impedance.errors import LogError
from bayes_impedance.log import Array
from bayes_impedance.preprocessing.grid import check_phase_length, place, repetitions
from bayes_impedance.preprocessing.prepared import PreparedTrial

#: Gauss–Legendre rule on [0, 1], for the way between two samples.
NODES, WEIGHTS = (part / 2 for part in np.polynomial.legendre.leggauss(5))
NODES = NODES + 0.5


def along_path(trial: PreparedTrial, rest_speed: float) -> PreparedTrial:
    """`trial` with phase by path progress, 0 to 1 in each repetition, never slower than `rest_speed` [m/s] =: v₀.

        φ̇ = √(|v|² + v₀²) / L    φ̈ = v·a / (L √(|v|² + v₀²))    φ = ∫ φ̇ dt    L = ∫ √(|v|² + v₀²) dt

    Raises:
        LogError: a repetition has one sample, or phase stands still because `rest_speed` is all but zero.
    """
    phase, rate, change = (np.empty(trial.n_samples) for _ in range(3))
    for part in repetitions(trial):
        time, velocity, acceleration = trial.time[part], trial.velocity[part], trial.acceleration[part]
        check_phase_length(len(time), float(time[0]), trial)
        way = np.concatenate([[0.0], np.cumsum(_ways(time, velocity, acceleration, rest_speed))])
        pace = np.hypot(np.linalg.norm(velocity, axis=1), rest_speed)
        phase[part] = way / way[-1]
        rate[part] = pace / way[-1]
        change[part] = (velocity * acceleration).sum(axis=1) / pace / way[-1]
        stuck = np.flatnonzero(np.diff(phase[part]) <= 0)
        if len(stuck):
            raise LogError(
                f"{place(trial)}: expected phase to increase at every sample, found it standing still at "
                f"{time[stuck[0] + 1]:g} s with preprocessing.phase.rest_speed = {rest_speed:g} m/s; raise it"
            )
    return replace(trial, phase=phase, phase_velocity=rate, phase_acceleration=change)


def _ways(time: Array, velocity: Array, acceleration: Array, rest_speed: float) -> Array:
    """∫ √(|v|² + v₀²) dt from each sample to the next [m].

    Of the cubic through velocity and acceleration at both: of fourth order, and positive however rough they are.
    """
    step = np.diff(time)[:, None]
    before, after = velocity[:-1], velocity[1:]
    leaving, arriving = step * acceleration[:-1], step * acceleration[1:]
    total = np.zeros(len(step))
    for s, weight in zip(NODES, WEIGHTS, strict=True):
        between = before + s**2 * (3 - 2 * s) * (after - before)
        between = between + s * (1 - s) * ((1 - s) * leaving - s * arriving)
        total += weight * np.hypot(np.linalg.norm(between, axis=1), rest_speed)
    return total * step[:, 0]
