"""The clock of one stream of messages: which of its two clocks tells the time, and how far the two are apart.

A message carries `sent`, the stamp of its sender's clock, and `received`, its arrival on the recorder's clock:

    received = sent + what the clocks differ by + delay,    delay ≥ 0
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import median_abs_deviation

from bayes_impedance.config.log import ClockConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, Integers

#: A step longer than this many medians is a gap: at least two messages in a row are missing.
GAP = 2.5
#: No two clocks of computers differ by more in their rate [ppm]: quartz keeps 100, the network corrects by up to 500.
LARGEST_DRIFT = 2000.0
#: Draws of the bootstrap behind standard errors.
DRAWS = 50


@dataclass(frozen=True)
class ClockOffset:
    """A sender's clock against the recorder's: the line received = origin + delay + (1 + rate)(sent − origin).

    No message arrived before it, so `delay` [s] holds what the clocks differ by at `origin` [s] and the shortest way.
    `rate` [1]; `delay_error` [s] and `rate_error` [1] are standard errors; `transport` is the robust SD [s] of delays.
    """

    origin: float = 0.0
    delay: float = 0.0
    rate: float = 0.0
    delay_error: float = 0.0
    rate_error: float = 0.0
    transport: float = 0.0

    @property
    def offset(self) -> float:
        """The sender's clock minus the recorder's at the first message [s]."""
        return -self.delay

    @property
    def drift(self) -> float:
        """By how much the sender's clock runs faster than the recorder's [ppm]."""
        return 1e6 * (1.0 / (1.0 + self.rate) - 1.0)

    @property
    def drift_error(self) -> float:
        """Standard error of the drift [ppm]."""
        return 1e6 * self.rate_error

    def to_recorder(self, sent: Array) -> Array:
        """Times of the sender's clock on the recorder's [s]."""
        return sent + self.delay + self.rate * (sent - self.origin)

    def to_sender(self, received: Array) -> Array:
        """Times of the recorder's clock on the sender's [s]."""
        return self.origin + (received - self.origin - self.delay) / (1.0 + self.rate)


#: The recorder's clock against itself.
RECORDER = ClockOffset()


@dataclass(frozen=True)
class ClockReport:
    """What the time stamps of a stream are like; intervals are those of the clock that was chosen.

    `duplicates` and `backwards`: messages whose header stamp, or only stamp, equals or precedes the one before.
    `span`, `interval` (median), `jitter` (robust SD of intervals) [s]; `gaps`: start and length [s] of each interval
    longer than 2.5 medians. `why` that clock. `against_recorder` compares the sender's clock with arrivals, and
    `remark` says why where it cannot.
    """

    n: int
    span: float
    interval: float
    jitter: float
    gaps: tuple[tuple[float, float], ...]
    duplicates: int
    backwards: int
    source: Literal["header", "record"]
    why: str
    against_recorder: ClockOffset | None
    remark: str

    @property
    def rate(self) -> float:
        """Messages in a second by their median interval [Hz]."""
        return 1.0 / self.interval


@dataclass(frozen=True, eq=False)
class StreamClock:
    """The times of a stream: `time (m,)` [s] increases, `kept (m,)` are the messages they belong to.

    `against_recorder` maps them onto the recorder's clock, where that is known.
    """

    time: Array
    kept: Integers
    report: ClockReport
    against_recorder: ClockOffset | None


def choose_clock(
    sent: Array, received: Array | None, config: ClockConfig, place: str = "recording"
) -> StreamClock:
    """The clock that tells the time of messages `sent (n,)` and `received (n,)` [s], and what the two are like.

    `received` is None for a table, whose column of time is `sent`. `place` names the source in errors.

    Example:
        >>> sent = 100.0 + 0.01 * np.arange(500)
        >>> delay = np.random.default_rng(0).exponential(0.002, 500)
        >>> clock = choose_clock(sent, sent - 90.0 + delay, ClockConfig())
        >>> clock.report.source, round(clock.report.against_recorder.offset, 3)
        ('header', 90.0)

    Raises:
        LogError: there are fewer than two times, one is not a number, the clock goes back, or stamps are equal and
            duplicates are refused.
    """
    for name, stamps in (("header", sent), ("record", received)):
        if stamps is None:
            continue
        bad = np.flatnonzero(~np.isfinite(stamps))
        if len(bad):
            raise LogError(
                f"{place}: expected finite {name} stamps, found {stamps[bad[0]]} at message {bad[0]}; repair the "
                "recording, or choose the other clock with log.clock.source"
            )
    doubt = _doubt(sent)
    source, why = _choose(doubt, received is not None, config)
    stamps = sent if source == "header" or received is None else received
    kept = _kept(stamps, source, config, place)
    time = stamps[kept]
    intervals = np.diff(time)
    against, remark = None, "only one clock was recorded"
    if received is not None:
        against, remark = (None, f"header stamps {doubt}") if doubt else _compared(sent, received)
    gaps = np.flatnonzero(long_steps(time))
    report = ClockReport(
        n=len(stamps),
        span=float(time[-1] - time[0]),
        interval=float(np.median(intervals)),
        jitter=float(median_abs_deviation(intervals, scale="normal")),
        gaps=tuple((float(time[k]), float(intervals[k])) for k in gaps),
        duplicates=int((np.diff(sent) == 0).sum()),
        backwards=int((np.diff(sent) < 0).sum()),
        source=source,
        why=why,
        against_recorder=against,
        remark=remark,
    )
    return StreamClock(time, kept, report, RECORDER if source == "record" else against)


def _doubt(sent: Array) -> str:
    """What speaks against the sender's clock; nothing where it increases save for duplicates."""
    back = np.flatnonzero(np.diff(sent) < 0)
    if len(sent) and np.ptp(sent) == 0:
        return f"are all {sent[0]:g} s"
    return f"go back at message {back[0] + 1}" if len(back) else ""


def _choose(doubt: str, both: bool, config: ClockConfig) -> tuple[Literal["header", "record"], str]:
    """Which clock, and why."""
    if not both:
        return "header", "the only clock there is"
    if config.source != "auto":
        return config.source, "log.clock.source says so"
    if doubt:
        return "record", f"header stamps {doubt}"
    return "header", "header stamps increase, and know nothing of delays on the way"


def _kept(stamps: Array, source: str, config: ClockConfig, place: str) -> Integers:
    """Messages that remain when later ones with an equal stamp are dropped."""
    steps = np.diff(stamps)
    back = np.flatnonzero(steps < 0)
    if len(back):
        k = int(back[0])
        raise LogError(
            f"{place}: expected {source} stamps that do not go back, found {stamps[k + 1]:.6f} s after "
            f"{stamps[k]:.6f} s at message {k + 1}; choose the other clock with log.clock.source, or cut there"
        )
    same = np.flatnonzero(steps == 0)
    if len(same) and config.duplicates == "refuse":
        k = int(same[0])
        raise LogError(
            f"{place}: expected {source} stamps that differ, found {len(same)} equal to the one before, first "
            f"{stamps[k]:.6f} s at message {k + 1}; set log.clock.duplicates=drop to keep the first of them"
        )
    kept = np.flatnonzero(np.diff(stamps, prepend=-np.inf) > 0)
    if len(kept) < 2:
        raise LogError(
            f"{place}: expected at least two messages at different times, found {len(kept)}; leave the recording out"
        )
    return kept


# --- one clock against the other -----------------------------------------------------------------


def _compared(sent: Array, received: Array) -> tuple[ClockOffset | None, str]:
    """The sender's clock against the recorder's, or why the arrivals say nothing of it."""
    offset = compare_clocks(sent, received)
    if abs(offset.drift) > LARGEST_DRIFT + 3 * offset.drift_error:
        return None, (
            f"record stamps span {np.ptp(received):.3g} s where header stamps span {np.ptp(sent):.3g} s: they tell "
            "when messages were written, not when they arrived"
        )
    return offset, "header stamps agree with arrivals"


def compare_clocks(sent: Array, received: Array) -> ClockOffset:
    """Offset and drift of a sender's clock, from stamps `sent (n,)` that increase and arrivals `received (n,)` [s].

    The line of the greatest mean that no delay lies under. Delays are one-sided and come in bursts: least squares
    would take a burst for drift, and the line under all of them needs but a few messages that were not held up.
    Standard errors by drawing blocks of the delays again.

    Source: Moon, Skelly, Towsley, Estimation and removal of clock skew from network delay measurements, 1999.
    """
    origin = float(sent[0])
    elapsed = sent - origin
    # Centred, for a difference of minutes leaves few digits for microseconds.
    typical = float(np.median(received - sent))
    delays = received - sent - typical
    start, rate = lower_line(elapsed, delays)
    above = delays - (start + rate * elapsed)

    generator = np.random.default_rng(0)
    n = len(sent)
    block = int(np.ceil(np.sqrt(n)))
    draws = np.empty((DRAWS, 2))
    for draw in draws:
        firsts = generator.integers(0, n - block + 1, -(-n // block))
        again = (firsts[:, None] + np.arange(block)).ravel()[:n]
        draw[:] = lower_line(elapsed, above[again])
    return ClockOffset(
        origin=origin,
        delay=typical + start,
        rate=rate,
        delay_error=float(draws[:, 0].std()),
        rate_error=float(draws[:, 1].std()),
        transport=float(median_abs_deviation(above, scale="normal")),
    )


def lower_line(x: Array, y: Array) -> tuple[float, float]:
    """Intercept and slope of the line under all points `(n,)` that is highest at the mean of x; x does not decrease.

    This is the linear program max Σ(a + b x) under a + b x ≤ y, whose answer is the edge of the lower convex hull
    above the mean of x. From the chord of the two ends, the point farthest below it replaces the end on its side.
    """
    left, right, mean = 0, len(x) - 1, x.mean()
    while True:
        slope = (y[right] - y[left]) / (x[right] - x[left])
        below = y - y[left] - slope * (x - x[left])
        lowest = int(np.argmin(below))
        # What is left is rounding.
        if lowest in (left, right) or below[lowest] >= -1e-12:
            return float(y[left] - slope * x[left]), float(slope)
        if x[lowest] <= mean:
            left = lowest
        else:
            right = lowest


def long_steps(time: Array) -> npt.NDArray[np.bool_]:
    """Steps of `time (n,)` [s] that are gaps, `(n − 1,)`: longer than 2.5 medians."""
    steps = np.diff(time)
    long: npt.NDArray[np.bool_] = steps > GAP * np.median(steps)
    return long
