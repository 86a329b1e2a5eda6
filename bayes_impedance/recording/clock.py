"""The time stamps of one stream of messages: what they are like, and which of two clocks tells the time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import median_abs_deviation

from bayes_impedance.config.log import ClockConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, Integers
from bayes_impedance.recording.offset import RECORDER, ClockOffset, compare_clocks

#: Why a clock is taken that has no rival.
ONLY_CLOCK = "the only clock there is"
#: A step longer than this many medians is a gap: at least two messages in a row are missing.
GAP = 2.5
#: No two clocks of computers differ by more in their rate [ppm]: quartz keeps 100, the network corrects by up to 500.
LARGEST_DRIFT = 2000.0


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
    gaps = np.flatnonzero(intervals > GAP * np.median(intervals))
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
        return "header", ONLY_CLOCK
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


def _compared(sent: Array, received: Array) -> tuple[ClockOffset | None, str]:
    """The sender's clock against the recorder's, or why the arrivals say nothing of it."""
    offset = compare_clocks(sent, received)
    if abs(offset.rate) > 1e-6 * LARGEST_DRIFT + 3 * offset.rate_error:
        return None, (
            f"record stamps span {np.ptp(received):.3g} s where header stamps span {np.ptp(sent):.3g} s: they tell "
            "when messages were written, not when they arrived"
        )
    return offset, "header stamps agree with arrivals"
