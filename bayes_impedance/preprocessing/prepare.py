"""From raw samples to smoothed motion and force on an even grid, with phase.

The same Savitzky–Golay filter acts on force and on motion: filtering one alone would bias mass, damping
and stiffness, because u = m ẍ + d ẋ + k x + … holds between signals that saw the same filter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from bayes_impedance.config import PreprocessingConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, InteractionLog, Trial
from bayes_impedance.preprocessing.grid import check_phase_length, on_even_grid, place, repetitions
from bayes_impedance.preprocessing.phase import along_path
from bayes_impedance.preprocessing.prepared import PreparedLog, PreparedTrial
from bayes_impedance.preprocessing.savitzky_golay import SavitzkyGolay, choose_filter
from bayes_impedance.preprocessing.segmentation import segment
from bayes_impedance.preprocessing.warping import align

#: A channel and its first two derivatives.
Orders = tuple[Array, Array, Array]

#: Steps that differ from the median by more than this share of it make a trial unevenly sampled.
UNEVEN = 0.01


def prepare(
    log: InteractionLog, config: PreprocessingConfig, reference: PreparedLog | None = None
) -> PreparedLog:
    """Every trial segmented, put on an even grid, smoothed, differentiated, given its phase and thinned to `rate`.

    With `phase.source: warping` phase is aligned to that of `reference`, an earlier log of the same configuration, or,
    for groups that are not in it, to a repetition of `log`. Warns (LogWarning) of gaps that split a trial and of parts
    that are left out, and when the smoother needs a longer window.

    Example:
        >>> time = np.arange(200) / 100.0
        >>> log = InteractionLog.from_arrays(time, time**2, np.sin(time), axes=["x"])
        >>> prepared = prepare(log, PreprocessingConfig(rate=20))
        >>> prepared.n_samples, prepared.trials[0].acceleration.mean().round(6).item()
        (40, 2.0)

    Raises:
        LogError: names source and trial.
    """
    log = segment(log, config)
    prepared = PreparedLog(log.axes, tuple(_prepare(trial, config) for trial in log.trials))
    if config.segmentation.repetitions_as_trials:
        parts = tuple(part for trial in prepared.trials for part in _by_repetition(trial))
        prepared = PreparedLog(log.axes, parts)
    return align(prepared, config.phase, reference) if config.phase.source == "warping" else prepared


def _prepare(trial: Trial, config: PreprocessingConfig) -> PreparedTrial:
    steps = np.diff(trial.time)
    step = float(np.median(steps))
    if config.phase.source != "column":
        trial = replace(trial, phase=None)
    smooth = None
    if config.smoother is None:
        prepared = _as_logged(trial)
    else:
        # Relative slack, here and below: differences of time stamps carry rounding errors.
        if np.abs(steps - step).max() > UNEVEN * step * (1 + 1e-9):
            trial = on_even_grid(trial, step)
        smooth = choose_filter(trial, config.smoother, step)
        prepared = _smoothed(trial, smooth)
    if config.phase.source != "column":
        prepared = along_path(prepared, config.phase.rest_speed)
    every = _stride(prepared, step, config.rate)
    prepared = _thinned(prepared, every)
    return prepared if smooth is None else replace(prepared, smoothing=_smoothing(trial, smooth, every))


def _smoothed(trial: Trial, smooth: SavitzkyGolay) -> PreparedTrial:
    # Differentiate what was measured as few times as possible: each order amplifies noise.
    if trial.velocity is None:
        velocity, acceleration, jerk = (smooth(trial.position, order) for order in (1, 2, 3))
    else:
        velocity, acceleration, jerk = (smooth(trial.velocity, order) for order in (0, 1, 2))
    if trial.acceleration is not None:
        acceleration, jerk = smooth(trial.acceleration), smooth(trial.acceleration, 1)
    return _assembled(
        trial,
        (smooth(trial.position), velocity, acceleration, jerk),
        value=smooth,
        orders=lambda values: (smooth(values), smooth(values, 1), smooth(values, 2)),
        phase_orders=lambda phase, part: _smooth_phase(trial, phase, part, smooth),
    )


def _smoothing(trial: Trial, smooth: SavitzkyGolay, every: int) -> Array:
    """What `PreparedTrial.smoothing` says of the samples that are kept, `(n, 6)`."""
    first, place_in_window = (column[::every] for column in smooth.windows(trial.n_samples))
    from_positions = 1 + (trial.velocity is None) * (1 + (trial.acceleration is None))
    constants = (smooth.length, smooth.order, smooth.step, from_positions)
    columns = [first, place_in_window, *(np.full(len(first), value) for value in constants)]
    return np.stack(columns, axis=1).astype(np.float64)


def _assembled(
    trial: Trial,
    motion: tuple[Array, Array, Array, Array],
    value: Callable[[Array], Array],
    orders: Callable[[Array], Orders],
    phase_orders: Callable[[Array, slice], Orders],
) -> PreparedTrial:
    """Prepared trial of position, velocity, acceleration and jerk, its other channels by the same rule.

    `value` gives a channel as the model sees it, `orders` it and two derivatives, `phase_orders` the same of phase
    within a repetition.
    """
    optional: dict[str, Any] = {}
    for name in ("force", "perturbation"):
        values = getattr(trial, name)
        optional[name] = None if values is None else value(values)
    if trial.reference is not None:
        optional |= _with_derivatives("reference", orders(trial.reference))
    if trial.phase is not None:
        parts = [phase_orders(trial.phase, part) for part in repetitions(trial)]
        optional |= _with_derivatives(
            "phase", tuple(np.concatenate(order) for order in zip(*parts, strict=True))
        )
    position, velocity, acceleration, jerk = motion
    return PreparedTrial(
        name=trial.name,
        group=trial.group,
        source=trial.source,
        time=trial.time,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        repetition=trial.repetition,
        truth=trial.truth,
        **optional,
    )


def _with_derivatives(name: str, orders: Sequence[Array]) -> dict[str, Array]:
    return dict(zip((name, f"{name}_velocity", f"{name}_acceleration"), orders, strict=True))


def _smooth_phase(trial: Trial, phase: Array, part: slice, smooth: SavitzkyGolay) -> Orders:
    """Phase [1] and its two derivatives [1/s, 1/s²] within one repetition, since phase jumps between two."""
    time, values = trial.time[part], phase[part]
    check_phase_length(len(time), float(time[0]), trial)
    if len(time) >= smooth.length:
        value, first, second = (smooth(values, order) for order in range(3))
    else:
        fit = Polynomial.fit(time, values, deg=min(smooth.order, len(time) - 1))
        value, first, second = fit(time), fit.deriv(1)(time), fit.deriv(2)(time)
    stuck = np.flatnonzero(np.diff(value) <= 0)
    if len(stuck):
        raise LogError(
            f"{place(trial)}: expected smoothed phase to increase within repetition "
            f"{trial.repetition[part.start]}, found it resting or going back at {time[stuck[0] + 1]:g} s; "
            "cut pauses, or change preprocessing.smoother.window"
        )
    return value, first, second


# --- without smoother ----------------------------------------------------------------------------


def _as_logged(trial: Trial) -> PreparedTrial:
    """Values as they are; only what no log holds (jerk, derivatives of others) is differenced."""
    if trial.velocity is None or trial.acceleration is None:
        lacking = "velocity" if trial.velocity is None else "acceleration"
        raise LogError(
            f"{place(trial)}: expected velocity and acceleration in a log that is not smoothed, found no "
            f"{lacking}; set preprocessing.smoother"
        )

    def phase_orders(phase: Array, part: slice) -> Orders:
        check_phase_length(part.stop - part.start, float(trial.time[part.start]), trial)
        return _gradients(phase[part], trial.time[part])

    jerk = np.gradient(trial.acceleration, trial.time, axis=0)
    return _assembled(
        trial,
        (trial.position, trial.velocity, trial.acceleration, jerk),
        value=lambda values: values,
        orders=lambda values: _gradients(values, trial.time),
        phase_orders=phase_orders,
    )


def _gradients(values: Array, time: Array) -> Orders:
    first = np.gradient(values, time, axis=0)
    return values, first, np.gradient(first, time, axis=0)


# --- repetitions ---------------------------------------------------------------------------------


def _by_repetition(trial: PreparedTrial) -> list[PreparedTrial]:
    """Each repetition as a trial, cut from what was smoothed in one piece."""
    parts = list(repetitions(trial))
    if len(parts) == 1:
        return [trial]
    return [
        replace(trial.part(part), name=f"{trial.name}.{number}") for number, part in enumerate(parts, start=1)
    ]


# --- rate ----------------------------------------------------------------------------------------


def _stride(trial: PreparedTrial, step: float, rate: float | None) -> int:
    """Native over wanted rate, rounded."""
    if rate is None:
        return 1
    if rate * step > 1 + UNEVEN:
        raise LogError(
            f"{place(trial)}: expected preprocessing.rate of at most the native rate, {1 / step:.4g} Hz, found "
            f"{rate:g} Hz; lower it or leave it out"
        )
    # However low the rate, the first sample stays.
    return max(1, round(1 / max(step * rate, 1 / trial.n_samples)))


def _thinned(trial: PreparedTrial, every: int) -> PreparedTrial:
    """Each sample that is a multiple of `every` away from the first."""
    return trial if every == 1 else trial.part(slice(None, None, every))
