"""What looks wrong with a channel on its own: dead band, saturation, samples that were held, force at rest.

Each check gives None where nothing does, and else a finding that says in one sentence what it is and how to mend it.
Checks of force belong before any rotation, which would mix the channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from bayes_impedance.log import Array
from bayes_impedance.recording import least_squares

#: Of the largest magnitude: less is a zero that arithmetic has touched, and two values so near are the same.
ROUNDING = 1e-9
#: Shares of samples that are zero or held from which on they are worth a word.
SMALLEST_SHARE = 0.05
#: Parts of a recording, most of which have to show a fault that is there throughout.
BLOCKS = 20
#: Steps of the resolution by which a channel that was held changes next.
CAUGHT_UP = 4
#: Samples in a row at an extreme that make it a limit.
SHORTEST_STOP = 3
#: Rest: speed below this share of its 95 % quantile, for at least so long [s].
REST_SPEED, SHORTEST_REST = 0.02, 0.5
#: Force at rest that is worth a word: this share of its RMS, and so many standard errors.
OFFSET_SHARE, SURE = 0.1, 3.0


class Finding(Protocol):
    """Something that looks wrong."""

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        ...


@dataclass(frozen=True)
class DeadBand:
    """Share of samples that are exactly zero, and half width of the band in the unit of the channel.

    `half_width` is None where the band was subtracted (smaller values follow continuously) or nothing else is there.
    """

    channel: str
    share: float
    half_width: float | None

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        width = (
            "of a width that does not show in the values"
            if self.half_width is None
            else f"up to {self.half_width:.3g}"
        )
        return (
            f"{self.channel}: {100 * self.share:.0f} % of samples are exactly zero, a dead band {width}; smaller force "
            "was not recorded, so leave parts without contact out with log.window or expect too low a force"
        )


def dead_band(values: Array, channel: str) -> DeadBand | None:
    """Exact zeros among `values (n,)` that finer values surround; zeros of a coarse resolution are none."""
    magnitude = np.abs(values)
    largest = float(magnitude.max(initial=0.0))
    zero = magnitude <= ROUNDING * largest
    share = float(zero.mean()) if len(values) else 0.0
    if share < SMALLEST_SHARE:
        return None
    others = magnitude[~zero]
    if not len(others):
        return DeadBand(channel, share, None)
    smallest = float(np.quantile(others, 0.01))
    levels = np.unique(values[~zero])
    spacing = float(np.median(np.diff(levels))) if len(levels) > 1 else largest
    # In steps of a resolution the smallest value beside zero is one step.
    if smallest < 1.5 * spacing and len(levels) < 0.5 * len(others):
        return None
    visible = smallest > 0.05 * float(np.sqrt(np.mean(others**2)))
    return DeadBand(channel, share, smallest if visible else None)


@dataclass(frozen=True)
class Saturation:
    """Samples at the limit `value` (unit of the channel), where they stay for up to `longest` in a row."""

    channel: str
    value: float
    count: int
    longest: int

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        return (
            f"{self.channel}: {self.count} samples stop at exactly {self.value:.4g}, up to {self.longest} in a row, as "
            "a sensor or a limit does that saturates; leave these parts out with log.window, or this column out of "
            "log.columns"
        )


def saturation(values: Array, channel: str) -> Saturation | None:
    """Stops at exactly the largest or the smallest of `values (n,)`, longer than values are held elsewhere.

    For force and velocity; a position comes to rest. Velocity may be limited in norm, so check the speed too.
    """
    if len(values) < SHORTEST_STOP or np.ptp(values) == 0:
        return None
    tolerance = ROUNDING * float(np.abs(values).max())
    found = []
    extremes = (values.max(), values.min())
    # A sensor may stop on both sides: neither tells how long values are held by chance.
    between = np.abs(values - extremes[0]) > tolerance
    between &= np.abs(values - extremes[1]) > tolerance
    elsewhere = _lengths(_repeated(values) & between & (np.abs(values) > tolerance)) + 1
    held = int(np.quantile(elsewhere, 0.99)) if len(elsewhere) else 1
    for extreme in extremes:
        # A channel that rests at zero has not hit a limit.
        if abs(extreme) <= tolerance:
            continue
        at = np.abs(values - extreme) <= tolerance
        stops = _lengths(at)
        # Two stops, or one that is much too long for a value held by chance.
        long = stops[stops >= max(SHORTEST_STOP, 2 * held)]
        if len(long) > 1 or long.max(initial=0) >= 3 * max(SHORTEST_STOP, held):
            found.append(Saturation(channel, float(extreme), int(long.sum()), int(long.max())))
    return max(found, key=lambda stop: stop.count) if found else None


@dataclass(frozen=True)
class Held:
    """Share of samples that repeat the one before exactly."""

    channel: str
    share: float

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        return (
            f"{self.channel}: {100 * self.share:.0f} % of samples repeat the one before exactly, so it was sampled "
            f"about {1 / (1 - self.share):.2g} times more slowly than it was logged and is up to that much late; set "
            "preprocessing.rate below its own rate"
        )


def held_samples(values: Array, channel: str) -> Held | None:
    """Repeated samples of `values (n,)`, apart from zeros, stops at a limit, rests and steps of a coarse resolution."""
    if len(values) < 10 * BLOCKS or np.ptp(values) == 0:
        return None
    tolerance = ROUNDING * float(np.abs(values).max())
    inside = (np.abs(values) > tolerance) & (values != values.max()) & (values != values.min())
    repeated = _repeated(values) & inside
    # What is held is held throughout; a hand rests now and then.
    share = float(np.median([block.mean() for block in np.array_split(repeated, BLOCKS)]))
    if not SMALLEST_SHARE <= share < 1.0:
        return None
    # After a hold a channel catches up; a slow one of coarse resolution goes on by a step.
    steps = np.abs(np.diff(values))
    released = steps[1:][repeated[1:-1] & (steps[1:] > 0)]
    step = float(steps[steps > 0].min())
    return Held(channel, share) if len(released) and np.median(released) > CAUGHT_UP * step else None


@dataclass(frozen=True)
class RestForce:
    """Mean force [N] while the hand rests, its standard error [N], and how fast it drifts from rest to rest [N/s].

    `drift` is None with a single rest.
    """

    channel: str
    offset: float
    error: float
    drift: float | None

    @property
    def sentence(self) -> str:
        """What it is and how to mend it."""
        drift = "" if self.drift is None else f" and drifts by {60 * self.drift:.2g} N a minute"
        return (
            f"{self.channel}: force at rest is {self.offset:.3g} ± {self.error:.2g} N{drift}, where a person who holds "
            "still gives none; give log.force.tool with the bias of the sensor, unless the hand leans on something"
        )


def force_at_rest(time: Array, force: Array, speed: Array, channel: str) -> RestForce | None:
    """Offset of `force (n,)` [N] where `speed (n,)` [m/s] is next to nothing for half a second or longer."""
    rests = _rests(time, speed)
    resting = np.concatenate([np.arange(a, b) for a, b in rests]) if rests else np.empty(0, dtype=np.intp)
    if len(resting) < 10:
        return None
    offset, error = least_squares.mean(force[resting])
    scale = float(np.sqrt(np.mean((force - force.mean()) ** 2)))
    if abs(offset) < max(SURE * error, OFFSET_SHARE * scale):
        return None
    centres = np.array([time[a:b].mean() for a, b in rests])
    levels = np.array([force[a:b].mean() for a, b in rests])
    drift = float(np.polyfit(centres, levels, 1)[0]) if len(rests) > 1 else None
    return RestForce(channel, offset, error, drift)


def _rests(time: Array, speed: Array) -> list[tuple[int, int]]:
    """First sample and the one after the last of each rest."""
    still = speed < REST_SPEED * np.quantile(speed, 0.95)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    return [
        (int(a), int(b))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if time[b - 1] - time[a] >= SHORTEST_REST
    ]


def _repeated(values: Array) -> npt.NDArray[np.bool_]:
    return np.concatenate([[False], np.diff(values) == 0])


def _lengths(where: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Lengths of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return (edges[1::2] - edges[::2]).astype(np.int64)
