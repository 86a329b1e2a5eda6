"""Trials and repetitions from the motion itself, where the log has no columns that say where they begin and end."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline
from scipy.ndimage import find_objects, label

from bayes_impedance.config import PreprocessingConfig, Segmentation
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import Array, InteractionLog, RowNumbers, Trial
from bayes_impedance.preprocessing.grid import place

Flags = npt.NDArray[np.bool_]

#: A stretch above a threshold counts where it exceeds so many times the threshold somewhere: noise at it does not.
HYSTERESIS = 2.0


def segment(log: InteractionLog, config: PreprocessingConfig) -> InteractionLog:
    """`log` split at gaps, its trials freed of rest and split at rest, or into rounds, as configured.

    Rounds: the hand has to leave the start by twice `return_radius` and come within it once a round, no oftener; they
    are cut where it is nearest. Warns (LogWarning) of gaps, of trials without motion and of rounds that it leaves out.

    Example:
        >>> time = np.arange(600) / 100.0
        >>> position = 0.1 * (1 - np.cos(2 * np.pi * np.clip(time - 1.0, 0.0, 4.0) / 2.0))
        >>> log = InteractionLog.from_arrays(time, position, np.sin(time), axes=["x"])
        >>> trial = segment(log, PreprocessingConfig(segmentation={"trim_rest": True, "split": "return"})).trials[0]
        >>> trial.time[[0, -1]].round(1), np.unique(trial.repetition)
        (array([1., 5.]), array([0, 1]))

    Raises:
        LogError: a gap is to be refused, the hand does not return to the start, or no trial is left.
    """
    wanted = config.segmentation
    left_out: list[str] = []
    trials = [part for trial in log.trials for part in _without_gaps(trial, config, left_out)]
    if wanted.trim_rest or wanted.split == "rest":
        trials = [part for trial in trials for part in _without_rest(trial, wanted, left_out)]
    if not trials:
        raise LogError(f"expected motion in at least one trial after segmentation, found none: {left_out[0]}")
    for reason in left_out:
        warnings.warn(f"a trial is left out: {reason}", LogWarning, stacklevel=2)
    if wanted.split == "return":
        trials = [_in_rounds(trial, wanted) for trial in trials]
    return log.with_trials(trials)


def _without_gaps(trial: Trial, config: PreprocessingConfig, left_out: list[str]) -> list[Trial]:
    """The stretches of `trial` between gaps longer than `max_gap`."""
    steps = np.diff(trial.time)
    longest = int(np.argmax(steps))
    # Relative slack: differences of time stamps carry rounding errors.
    gaps = np.flatnonzero(steps > config.max_gap * (1 + 1e-9)) + 1
    shortest = config.segmentation.minimum_duration
    splits = config.segmentation.gaps == "split"
    if not len(gaps) and (not splits or np.ptp(trial.time) >= shortest):
        return [trial]
    found = f"{steps[longest]:g} s from {trial.time[longest]:g} to {trial.time[longest + 1]:g} s"
    if not splits:
        raise LogError(
            f"{place(trial)}: expected steps of at most {config.max_gap:g} s, found a gap of {found}; cut there with "
            "log.window, or raise preprocessing.max_gap, or let preprocessing.segmentation.gaps=split make trials of it"
        )
    edges = [0, *gaps.tolist(), trial.n_samples]
    parts = [slice(start, end) for start, end in pairwise(edges)]
    durations = [float(np.ptp(trial.time[part])) for part in parts]
    kept = [part for part, duration in zip(parts, durations, strict=True) if duration >= shortest]
    if not kept:
        left_out.append(
            f"{place(trial)}: expected {shortest:g} s without gap, found at most {max(durations):g} s; raise "
            "preprocessing.max_gap, or lower preprocessing.segmentation.minimum_duration"
        )
        return []
    warnings.warn(
        f"{place(trial)}: split into {len(kept)} at {len(gaps)} gap(s) of more than {config.max_gap:g} s, the longest "
        f"of {found}; {len(parts) - len(kept)} part(s) shorter than {shortest:g} s are left out",
        LogWarning,
        stacklevel=3,
    )
    return list(_numbered(trial, kept))


def _without_rest(trial: Trial, wanted: Segmentation, left_out: list[str]) -> list[Trial]:
    """What lies between two rests of `trial`; with `split: none` or `return` all from the first motion to the last."""
    half = wanted.rest_duration / 4
    speed = _speed(trial, half)
    # The mean spreads motion, however sudden, over `half` at least; what is shorter is noise.
    moving = _lasting(_above(speed, wanted.rest_speed), trial.time, half)
    resting = _lasting(~moving, trial.time, wanted.rest_duration)
    parts = _stretches(_lasting(~resting, trial.time, wanted.minimum_duration))
    if not parts:
        slow, fast = np.quantile(speed, [0.5, 1.0])
        left_out.append(
            f"{place(trial)}: expected motion for at least {wanted.minimum_duration:g} s that exceeds "
            f"{HYSTERESIS:g} × {wanted.rest_speed:g} m/s, found speeds of {slow:.2g} (median) and {fast:.2g} m/s "
            "(largest); lower preprocessing.segmentation.rest_speed or minimum_duration"
        )
        return []
    if wanted.split == "rest":
        return list(_numbered(trial, parts))
    return [_part(trial, slice(parts[0].start, parts[-1].stop), trial.name)]


def _in_rounds(trial: Trial, wanted: Segmentation) -> Trial:
    """`trial` with a repetition for each round from the start back to it."""
    distance = np.linalg.norm(trial.position - trial.position[0], axis=1)
    away = _stretches(_lasting(_above(distance, wanted.return_radius), trial.time, wanted.minimum_duration))
    if not away:
        raise LogError(
            f"{place(trial)}: expected a hand that leaves its start by {HYSTERESIS:g} × {wanted.return_radius:g} m for "
            f"at least {wanted.minimum_duration:g} s, found it {distance.max():.3g} m away at most; lower "
            "preprocessing.segmentation.return_radius or minimum_duration"
        )
    cuts = [
        before.stop + int(np.argmin(distance[before.stop : after.start])) for before, after in pairwise(away)
    ]
    end = trial.n_samples
    if away[-1].stop == end:
        if not cuts:
            nearest = away[0].start + int(np.argmax(distance[away[0]]))
            raise LogError(
                f"{place(trial)}: expected a hand that returns to within {wanted.return_radius:g} m of its start, "
                f"found it {distance[nearest:].min():.3g} m away at least; raise preprocessing.segmentation."
                "return_radius, or set preprocessing.segmentation.split to rest or none"
            )
        end = cuts.pop()
        warnings.warn(
            f"{place(trial)}: left out the last round, from {trial.time[end]:g} s on, which is incomplete: it ends "
            f"{distance[-1]:.3g} m from the start, and preprocessing.segmentation.return_radius is "
            f"{wanted.return_radius:g} m",
            LogWarning,
            stacklevel=3,
        )
    whole = _part(trial, slice(0, end), trial.name)
    return replace(whole, repetition=np.searchsorted(cuts, np.arange(end), side="right"))


# --- parts of a trial ----------------------------------------------------------------------------


def _numbered(trial: Trial, parts: list[slice]) -> Iterator[Trial]:
    for number, part in enumerate(parts, start=1):
        yield _part(trial, part, f"{trial.name}.{number}")


def _part(trial: Trial, part: slice, name: str) -> Trial:
    """Some samples of `trial`, with all that belongs to them."""
    arrays = {key: getattr(trial, key) for key in trial.__slots__}
    changes: dict[str, Any] = {
        key: value[part] for key, value in arrays.items() if isinstance(value, np.ndarray)
    }
    changes["repetition"] = changes["repetition"] - changes["repetition"][0]
    if trial.rows is not None:
        changes["rows"] = RowNumbers(trial.rows.word, trial.rows.numbers[part])
    return replace(
        trial, name=name, **changes, truth={key: column[part] for key, column in trial.truth.items()}
    )


# --- stretches of time ---------------------------------------------------------------------------


def _speed(trial: Trial, half: float) -> Array:
    """Mean position of the `half` [s] ahead less that of the `half` behind, over their distance: [m/s], `(n,)`.

    The means take out noise of the sensor, and are exact for uneven steps.
    """
    time = trial.time - trial.time[0]
    half = min(max(half, float(np.median(np.diff(time)))), float(time[-1]) / 2)
    integral = make_interp_spline(time, trial.position, k=1).antiderivative()
    centre = np.clip(time, half, time[-1] - half)
    velocity = (integral(centre + half) - 2 * integral(centre) + integral(centre - half)) / half**2
    return np.asarray(np.linalg.norm(velocity, axis=1))


def _above(values: Array, threshold: float) -> Flags:
    """Where `values` exceed `threshold`, in stretches that somewhere exceed `HYSTERESIS` times it."""
    stretch, count = label(values > threshold)
    strong = np.zeros(count + 1, dtype=bool)
    strong[stretch[values > HYSTERESIS * threshold]] = True
    return np.asarray(strong[stretch])


def _lasting(flags: Flags, time: Array, duration: float) -> Flags:
    """`flags` in stretches of at least `duration` [s] only."""
    result = np.zeros_like(flags)
    for part in _stretches(flags):
        result[part] = np.ptp(time[part]) >= duration
    return result


def _stretches(flags: Flags) -> list[slice]:
    return [part for (part,) in find_objects(label(flags)[0])]
