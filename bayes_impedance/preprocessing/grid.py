"""Trials at even steps, and the samples of a repetition."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from bayes_impedance.errors import LogError
from bayes_impedance.log import VECTORS, Array, Trial
from bayes_impedance.preprocessing.prepared import PreparedTrial

#: Samples that interpolation may put in place of one; more are a gap that `max_gap` was raised above.
MOST_FILLED = 1000


def place(trial: Trial | PreparedTrial) -> str:
    """Where a sentence says that something is wrong: source and trial."""
    return f"{trial.source}, trial {trial.name!r}"


def repetitions(trial: Trial | PreparedTrial) -> Iterator[slice]:
    """The samples of each repetition; they lie next to each other."""
    edges = np.flatnonzero(np.diff(trial.repetition)) + 1
    for start, end in zip([0, *edges], [*edges, trial.n_samples], strict=True):
        yield slice(int(start), int(end))


def on_even_grid(trial: Trial, step: float) -> Trial:
    """`trial` interpolated to steps of `step` [s]: monotone cubics, which do not overshoot.

    Raises:
        LogError: gaps would be filled with very many samples, or a repetition with phase has one sample.
    """
    time = trial.time
    count = math.floor((time[-1] - time[0]) / step + 1e-9) + 1
    if count > MOST_FILLED * trial.n_samples:
        raise LogError(
            f"{place(trial)}: expected a log without long gaps, found {trial.n_samples} samples that would have to be "
            f"filled up to {count:.3g} at steps of {step:g} s; cut the gaps with log.window, or lower "
            "preprocessing.max_gap to find them"
        )
    grid = time[0] + step * np.arange(count)
    grid = np.minimum(grid, time[-1])
    before = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, trial.n_samples - 2)
    # Between two repetitions the nearer sample decides; elsewhere both have one label.
    nearer = before + (grid - time[before] > time[before + 1] - grid)
    within = trial.repetition[before] == trial.repetition[before + 1]
    repetition = trial.repetition[np.where(within, before, nearer)]

    changes: dict[str, Any] = {"time": grid, "repetition": repetition, "rows": None}
    for name in VECTORS:
        values = getattr(trial, name)
        if values is not None:
            changes[name] = PchipInterpolator(time, values, axis=0)(grid)
    if trial.phase is not None:
        phase = np.empty_like(grid)
        for part in repetitions(trial):
            chosen = repetition == trial.repetition[part.start]
            phase[chosen] = _phase_at(grid[chosen], time[part], trial.phase[part], trial)
        changes["phase"] = phase
    changes["truth"] = {name: np.interp(grid, time, values) for name, values in trial.truth.items()}
    return replace(trial, **changes)


def _phase_at(grid: Array, time: Array, phase: Array, trial: Trial) -> Array:
    """Phase of one repetition at `grid` [s]; continued straight beyond its first and last sample."""
    check_phase_length(len(time), float(time[0]), trial)
    slope = np.diff(phase) / np.diff(time)
    straight = slope[0] * np.minimum(grid - time[0], 0) + slope[-1] * np.maximum(grid - time[-1], 0)
    value: Array = PchipInterpolator(time, phase)(np.clip(grid, time[0], time[-1])) + straight
    return value


def check_phase_length(n: int, start: float, trial: Trial | PreparedTrial) -> None:
    """Refuse a repetition of `n` samples that begins at `start` [s] if it is too short for a rate of phase.

    Raises:
        LogError: it has one sample.
    """
    if n < 2:
        raise LogError(
            f"{place(trial)}: expected at least two samples in a repetition, for phase needs a rate, found one "
            f"at {start:g} s; cut it off with log.window"
        )
