"""Several streams on one clock: their columns at the times of one of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Slerp

from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import Array, Integers
from bayes_impedance.recording.offset import ClockOffset
from bayes_impedance.recording.wrench import rotations

#: Two clocks that arrivals put this close [s] are taken for one: messages differ by more in their shortest way.
SAME_CLOCK = 2e-3
#: A stream with so many samples an interval of the base is averaged, for interpolation would alias it.
FASTER = 1.5
#: A gap is longer than so many medians of the stream's own steps, and than `max_gap`.
LONG = 5.0
#: Longest gap that is bridged [s]: within it nobody's force turns round.
MAX_GAP = 0.03

Booleans = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stream:
    """Columns of one topic or file: `time (n,)` [s] that increases, `columns (n, c)`.

    `rotation`: how the columns tell an orientation, as in log.force.rotation, or None where they do not.
    `against_recorder`: its clock against the one that all streams share, where known.
    """

    name: str
    time: Array
    columns: Array
    rotation: str | None = None
    against_recorder: ClockOffset | None = None


@dataclass(frozen=True, eq=False)
class Synchronised:
    """The columns of all streams at `time (m,)` [s], samples `rows (m,)` of the base.

    `columns`: by name of the stream, `(m, c)`. `left_out`: how many samples of the base lie in a gap of each other
    stream; `outside`: how many before or after one of them.
    """

    time: Array
    rows: Integers
    columns: Mapping[str, Array]
    left_out: Mapping[str, int]
    outside: int


def synchronise(
    base: Stream,
    others: Sequence[Stream],
    *,
    align: bool = True,
    max_gap: float = MAX_GAP,
    place: str = "recording",
) -> Synchronised:
    """The columns of `others` at the times of `base`, where all of them have some.

    `align` maps their clocks onto that of the base. A faster stream is averaged over one interval of the base around
    each sample, so that it is neither aliased nor late; a slower one is interpolated by monotone cubics; orientation
    turns at a steady rate from one sample to the next. Nothing is made up in a gap of more than five median steps and
    `max_gap` [s]; samples of `others` with NaN count as missing. `place` names the source in errors.

    Warns (LogWarning) where a clock cannot be mapped.

    Raises:
        LogError: the base has less than two samples, or there is no time at which all streams have samples.
    """
    if len(base.time) < 2:
        raise LogError(
            f"{place}: expected at least two samples of {base.name}, found {len(base.time)}; widen log.window, or "
            "leave the recording out"
        )
    others = [_known(other, place) for other in others]
    times = [on_clock_of(base, other) if align else other.time for other in others]
    half = 0.5 * float(np.median(np.diff(base.time)))
    reaches = [half if _is_averaged(base, other) else 0.0 for other in others]
    inside = np.ones(len(base.time), dtype=bool)
    whole = inside.copy()
    left_out = {}
    for other, time, reach in zip(others, times, reaches, strict=True):
        within = (base.time - reach >= time[0]) & (base.time + reach <= time[-1])
        if not within.any():
            raise LogError(
                f"{place}: expected {base.name} and {other.name} to overlap in time, found {_span(base.time)} and "
                f"{_span(time)}; set log.clock.align=true or log.clock.source=record if their clocks differ, or "
                "leave the recording out"
            )
        inside &= within
        gap = in_gap(base.time, time, reach, max_gap)
        left_out[other.name] = int((gap & within).sum())
        whole &= ~gap
    kept = np.flatnonzero(inside & whole)
    if not len(kept):
        raise LogError(
            f"{place}: expected times at which {', '.join(s.name for s in (base, *others))} all have samples, found "
            "none outside their gaps; leave the recording out, or a stream with long gaps"
        )
    at = base.time[kept]
    columns = {base.name: base.columns[kept]}
    for other, time, reach in zip(others, times, reaches, strict=True):
        if other.rotation is not None:
            columns[other.name] = turned_to(at, time, other.columns, other.rotation)
        elif reach > 0:
            columns[other.name] = averaged(at, time, other.columns, reach)
        else:
            columns[other.name] = PchipInterpolator(time, other.columns, axis=0)(at)
    return Synchronised(at, kept, columns, left_out, int((~inside).sum()))


def on_clock_of(base: Stream, other: Stream) -> Array:
    """Times of `other` on the clock of `base` [s], by what each has against the recorder's.

    Warns (LogWarning) where one of them is not known.
    """
    if base.against_recorder is None or other.against_recorder is None:
        if base.against_recorder is not other.against_recorder:
            unknown = base if base.against_recorder is None else other
            warnings.warn(
                f"{base.name} and {other.name}: expected arrivals that tell both clocks, found none of use for "
                f"{unknown.name}; their stamps are taken for those of one clock. Set log.clock.align=false if they are",
                LogWarning,
                stacklevel=3,
            )
        return other.time
    mapped = base.against_recorder.to_sender(other.against_recorder.to_recorder(other.time))
    # Of two senders on one computer, the stamps are right as they are and the arrivals are not.
    if np.abs(mapped[[0, -1]] - other.time[[0, -1]]).max() < SAME_CLOCK:
        return other.time
    return mapped


def in_gap(at: Array, time: Array, reach: float, max_gap: float) -> Booleans:
    """Which of the times `at (m,)` [s], or what is within `reach` [s] of them, lie in a gap of `time (n,)`, `(m,)`."""
    steps = np.diff(time)
    long = np.flatnonzero(steps > max(LONG * float(np.median(steps)), max_gap))
    # Gaps that end after the sample begins; the first of them is the only one that it can lie in.
    first = np.searchsorted(time[long + 1], at - reach, side="right")
    starts = np.append(time[long], np.inf)
    return np.asarray(starts[first] < at + reach)


def averaged(at: Array, time: Array, values: Array, reach: float) -> Array:
    """Mean of `values (n, c)` from `reach` [s] before to `reach` after each of the times `at (m,)`, `(m, c)`.

    Of the monotone cubic through them, not of the samples that fall in: their own mean time would jitter.
    """
    integral = PchipInterpolator(time, values, axis=0).antiderivative()
    mean: Array = (integral(at + reach) - integral(at - reach)) / (2 * reach)
    return mean


def turned_to(at: Array, time: Array, columns: Array, rotation: str) -> Array:
    """Orientation `columns (n, 3 or 4)` (angles in rad or a quaternion) at the times `at (m,)` [s], in the same terms.

    From sample to sample about one axis at a steady rate, the shorter way: angles wrap, and components of a
    quaternion have two signs. Angles come out within ±π.
    """
    between = Slerp(time, rotations(columns, rotation))(at)
    if rotation.startswith("quaternion"):
        scalar_first = rotation.endswith("wxyz")
        quaternion: Array = between.as_quat(scalar_first=scalar_first)
        return quaternion
    with warnings.catch_warnings():
        # Where two axes coincide the angles are not unique; any that give the orientation will do.
        warnings.filterwarnings("ignore", message="Gimbal lock detected", category=UserWarning)
        angles: Array = between.as_euler(rotation)  # type: ignore[call-overload]  # axes that the configuration checked
    return angles


def _known(stream: Stream, place: str) -> Stream:
    """The samples whose columns are all finite."""
    known = np.isfinite(stream.columns).all(axis=1)
    if known.sum() < 2:
        raise LogError(
            f"{place}: expected {stream.name} to hold at least two samples of numbers, found {known.sum()}; leave its "
            "columns out of log.columns"
        )
    return replace(stream, time=stream.time[known], columns=stream.columns[known])


def _is_averaged(base: Stream, other: Stream) -> bool:
    faster = FASTER * np.median(np.diff(other.time)) <= np.median(np.diff(base.time))
    return bool(faster) and other.rotation is None


def _span(time: Array) -> str:
    return f"{time[0]:.6g} to {time[-1]:.6g} s"
