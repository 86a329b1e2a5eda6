"""Phase aligned between repetitions: path progress, bent by dynamic time warping to that of a reference.

The bend acts on path progress s and its rates sample by sample, φ = h(s), φ̇ = h'(s) ṡ, φ̈ = h''(s) ṡ² + h'(s) s̈, so
thinned trials can be aligned as well as whole ones, and those that a model keeps serve as reference later.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from dtaidistance import dtw_ndim
from numpy.typing import NDArray
from scipy.interpolate import BSpline, PchipInterpolator
from scipy.optimize import lsq_linear

from bayes_impedance.config import PhaseConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array
from bayes_impedance.preprocessing.grid import place, repetitions
from bayes_impedance.preprocessing.prepared import PreparedLog, PreparedTrial

#: Values of progress at which the positions of two repetitions are compared.
PLACES = np.linspace(0.0, 1.0, 301)
#: Least slope of a bend: phase keeps this share of the pace of path progress.
LEAST_SLOPE = 0.2
#: Of the spline h'; h is once smoother, so that φ̈ has no jumps.
DEGREE = 2


def align(log: PreparedLog, config: PhaseConfig, reference: PreparedLog | None = None) -> PreparedLog:
    """`log`, whose phase is path progress, with the phase of every repetition aligned to one of its group.

    That one is taken from `reference`, a log aligned before, for the groups that it holds.

    Raises:
        LogError: no trial of a group has the name of the reference, or a repetition has one sample.
    """
    paths = {}
    for group in log.groups:
        source = log if reference is None or group not in reference.groups else reference
        members = [trial for trial in source.trials if trial.group == group]
        paths[group] = _path(*_reference(members, config.reference))
    return replace(
        log, trials=tuple(_aligned(trial, paths[trial.group], config.knots) for trial in log.trials)
    )


def _reference(members: list[PreparedTrial], name: str | None) -> tuple[PreparedTrial, slice]:
    """The repetition of median duration, of the trial `name` if that is given."""
    named = [trial for trial in members if name in (None, trial.name)]
    if not named:
        raise LogError(
            f"group '{members[0].group}': expected a trial {name!r} to align with, found "
            f"{', '.join(repr(trial.name) for trial in members)}; change preprocessing.phase.reference"
        )
    candidates = [(trial, part) for trial in named for part in repetitions(trial)]
    durations = [np.ptp(trial.time[part]) for trial, part in candidates]
    return candidates[int(np.argsort(durations, kind="stable")[(len(durations) - 1) // 2])]


def _path(trial: PreparedTrial, part: slice) -> Array:
    """Positions of a repetition at `PLACES`, `(places, axes)` [m]."""
    assert trial.phase is not None
    progress = trial.phase[part]
    if len(progress) < 2:
        raise LogError(
            f"{place(trial)}: expected at least two samples in a repetition that is to be aligned, found one at "
            f"{trial.time[part.start]:g} s; raise preprocessing.rate"
        )
    path: Array = PchipInterpolator(progress, trial.position[part])(
        np.clip(PLACES, progress[0], progress[-1])
    )
    return path


def _aligned(trial: PreparedTrial, reference: Array, knots: int) -> PreparedTrial:
    assert trial.phase is not None
    assert trial.phase_velocity is not None
    assert trial.phase_acceleration is not None
    phase, rate, change = trial.phase.copy(), trial.phase_velocity.copy(), trial.phase_acceleration.copy()
    for part in repetitions(trial):
        path = _path(trial, part)
        # The reference itself keeps its progress to the last bit.
        if np.array_equal(path, reference):
            continue
        bend = _bend(path, reference, knots)
        slope = bend.derivative()
        curvature = slope.derivative()
        s, pace = phase[part], rate[part]
        change[part] = curvature(s) * pace**2 + slope(s) * change[part]
        rate[part] = slope(s) * pace
        # h(1) = 1 to rounding.
        phase[part] = np.minimum(bend(s), 1.0)
    return replace(trial, phase=phase, phase_velocity=rate, phase_acceleration=change)


def _bend(path: Array, reference: Array, knots: int) -> BSpline[np.float64]:
    """Strictly increasing h with h(0) = 0, h(1) = 1 and `path` at s near `reference` at h(s)."""
    # Positions as they are: all axes are metres, and an axis that hardly moves must not count as much as the others.
    # The library refuses vectors of one component: a second one that is zero leaves distances as they are.
    both = (np.pad(positions, ((0, 0), (0, 1))) for positions in (path, reference))
    pairs = np.array(dtw_ndim.warping_path(*both, use_c=True))
    own, other = PLACES[pairs[:, 0]], PLACES[pairs[:, 1]]
    return _monotone(own, other, knots)


def _monotone(x: Array, y: Array, knots: int) -> BSpline[np.float64]:
    """Least-squares fit h(x) ≈ y by a spline with h' = ε + Σ c N/∫N, c ≥ 0 and Σ c = 1 − ε, ε = `LEAST_SLOPE`."""
    inner = np.linspace(0.0, 1.0, knots + 2)
    ends = np.ones(DEGREE)
    vector: NDArray[np.float64] = np.concatenate([0 * ends, inner, ends])
    count = len(vector) - DEGREE - 1
    area = (vector[DEGREE + 1 :] - vector[:count]) / (DEGREE + 1)
    integrals = BSpline(vector, np.diag(1 / area), DEGREE).antiderivative()
    # A heavy row asks for the sum, which is then made exact.
    weight = 1e3 * len(x)
    design = np.vstack([integrals(x), np.full(count, weight)])
    wanted = np.append(y - LEAST_SLOPE * x, weight * (1 - LEAST_SLOPE))
    share = np.maximum(lsq_linear(design, wanted, bounds=(0.0, np.inf)).x, 0.0)
    share = share * (1 - LEAST_SLOPE) / share.sum()
    return BSpline(vector, LEAST_SLOPE + share / area, DEGREE).antiderivative()
