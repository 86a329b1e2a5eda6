"""Where draws are kept: functions along phase at the average motion of a group, forces at the samples of the log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.config import Config
from bayes_impedance.features import FeatureMap
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial
from bayes_impedance.preprocessing.prepared import ARRAYS

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Samples of the log at which forces are kept: beyond that every other one is left out, or more.
MOST_SAMPLES = 1000
#: Name of a motion that nobody made, so that it has a residual force of its own.
AVERAGE = "average motion"
#: A repetition that covers less of the phase than this share of the longest of its group was broken off.
COMPLETE = 0.9


@dataclass(frozen=True)
class Places:
    """Samples at which latents are drawn.

    `samples` of each trial of `log`; among those the `places` of functions and the `forces` that are kept. `dimension`
    of the places is `phase`, with the same values for each group, `time` of one trial, or `place` of several.
    """

    log: PreparedLog
    samples: tuple[Integers, ...]
    places: tuple[Integers, ...]
    forces: tuple[Integers, ...]
    dimension: str


def choose_places(config: Config, log: PreparedLog, places: int) -> Places:
    """Average motions over phase, where the desired trajectory is one function of it for all repetitions of a group.

    Else, and where groups have no phase in common, `places` samples of each trial.
    """
    step = -(-log.n_samples // MOST_SAMPLES)
    forces = tuple(np.arange(0, trial.n_samples, step) for trial in log.trials)
    none = np.zeros(0, dtype=np.int64)
    if config.model.trajectory_input == "phase" and FeatureMap(config, log.axes).trajectory_shared:
        low, high = common_phase(log)
    else:
        low, high = 0.0, 0.0
    if low < high:
        phase = np.linspace(low, high, places)
        averages = tuple(average_motion(log, group, phase) for group in log.groups)
        every = (np.arange(places),) * len(averages)
        return Places(
            PreparedLog(log.axes, averages + log.trials),
            every + forces,
            every + (none,) * len(forces),
            (none,) * len(averages) + forces,
            "phase",
        )
    kept = tuple(_evenly(trial.n_samples, places) for trial in log.trials)
    samples = tuple(np.union1d(*pair) for pair in zip(kept, forces, strict=True))
    return Places(log, samples, kept, forces, "time" if len(log.trials) == 1 else "place")


def common_phase(log: PreparedLog) -> tuple[float, float]:
    """From where to where all repetitions of all groups go, but for those that were broken off."""
    parts = [part for group in log.groups for part in _repetitions(log, group)]
    return max(float(_phase(part).min()) for part in parts), min(float(_phase(part).max()) for part in parts)


def average_motion(log: PreparedLog, group: str, phase: Array) -> PreparedTrial:
    """Mean over the repetitions of a group at equal phase, but for those that were broken off."""
    own = _repetitions(log, group)
    values = {
        name: np.mean([_at_phase(part, name, phase) for part in own], axis=0)
        for name in ARRAYS
        if name not in ("force", "perturbation", "smoothing", "repetition")
        and all(getattr(part, name) is not None for part in own)
    }
    repetition = np.zeros(len(phase), dtype=np.int64)
    # Of the group's own name, for names of trials differ.
    named = {"name": f"{AVERAGE} of {group}", "group": group, "source": "memory"}
    arrays: dict[str, Any] = {**named, **values, "phase": phase, "repetition": repetition}
    return PreparedTrial(**arrays)


def _repetitions(log: PreparedLog, group: str) -> list[PreparedTrial]:
    """Repetitions of a group, those that were broken off left out."""
    parts = list(_every_repetition(log, group))
    covered = [float(np.ptp(_phase(part))) for part in parts]
    return [part for part, span in zip(parts, covered, strict=True) if span >= COMPLETE * max(covered)]


def _every_repetition(log: PreparedLog, group: str) -> Iterator[PreparedTrial]:
    for trial in log.trials:
        if trial.group == group:
            for number in np.unique(trial.repetition):
                yield trial.part(np.flatnonzero(trial.repetition == number))


def _phase(trial: PreparedTrial) -> Array:
    assert trial.phase is not None
    return trial.phase


def _at_phase(trial: PreparedTrial, name: str, phase: Array) -> Array:
    values = np.asarray(getattr(trial, name))
    # Noise lets phase go back for a sample or two.
    order = np.argsort(_phase(trial), kind="stable")
    known, values = _phase(trial)[order], values[order]
    columns = [np.interp(phase, known, column) for column in values.reshape(len(values), -1).T]
    return np.stack(columns, axis=-1).reshape(len(phase), *values.shape[1:])


def _evenly(count: int, places: int) -> Integers:
    return np.unique(np.linspace(0, count - 1, places).round().astype(np.int64))
