"""When the samples of a file were taken: by a column of time, the stamps of messages, or a rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pandas as pd

from bayes_impedance.config import LogConfig
from bayes_impedance.config.log import Window
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, named_rows
from bayes_impedance.readers.cells import numbers
from bayes_impedance.readers.table import Stream, Table
from bayes_impedance.recording.clock import StreamClock, choose_clock
from bayes_impedance.recording.offset import RECORDER

#: What has the time stamps of `log.columns.force_time`.
OF_THE_SENSOR = ("force", "torque")


@dataclass(frozen=True)
class Part:
    """Quantities that share a stream and its time stamps; `clock`: the key of their column of time."""

    name: str
    stream: Stream
    clock: str
    keys: tuple[str, ...]


def time_of(table: Table, part: Part, wanted: Mapping[str, tuple[str, ...]], config: LogConfig) -> Array:
    """Times `(n,)` [s]: a column, or those of samples at `log.sampling_rate`, anew in each trial.

    Raises:
        LogError: no column of as many values tells them, or one is not a number.
    """
    rows, columns = part.stream.rows, part.stream.columns
    leading = "position" in part.keys
    if part.clock not in wanted and leading:
        assert config.sampling_rate is not None
        counted = np.arange(float(len(rows.numbers)))
        if "trial" in wanted:
            trial = pd.factorize(columns[wanted["trial"][0]])[0]
            counted = pd.Series(trial).groupby(trial).cumcount().to_numpy(dtype=np.float64)
        return counted / config.sampling_rate
    (name,) = wanted.get(part.clock, ("position",))
    if name not in columns or part.clock not in wanted:
        if leading:
            mend = "name their time stamps in log.columns.time"
        elif set(part.keys) <= set(OF_THE_SENSOR):
            mend = "name their time stamps in log.columns.force_time"
        else:
            mend = f"set log.columns.{part.keys[0]} to null"
        raise LogError(
            f"{table.where}: expected as many samples of {', '.join(part.keys)} as of {name}, which tells their "
            f"time, found {len(rows.numbers)} and another number; {mend}"
        )
    return numbers(rows, columns[name], table.where, part.clock, name) * config.units.scale("time")


def clock_of(
    table: Table, part: Part, wanted: Mapping[str, tuple[str, ...]], config: LogConfig
) -> StreamClock:
    """The clock of a part of a file where there are several, or messages.

    Raises:
        LogError: times go back, repeat where that is refused, are less than two, or stamps asked for are not there.
    """
    stream = part.stream
    place = f"{table.where}, {part.name}"
    if stream.sent is not None:
        return _from_zero(choose_clock(stream.sent, stream.received, config.clock, place))
    if stream.received is not None:
        if config.clock.source == "header":
            raise LogError(
                f"{place}: expected messages with the stamps of their sender, as log.clock.source: header asks, found "
                "none that are set; set it to auto or record"
            )
        clock = choose_clock(stream.received, None, config.clock, place)
        report = replace(clock.report, source="record", why="messages carry no stamp of their sender")
        return _from_zero(replace(clock, report=report, against_recorder=RECORDER))
    time = time_of(table, part, wanted, config)
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        raise LogError(
            f"{place}: expected times that do not go back, for samples at two sets of time stamps meet in one "
            f"recording only, found {time[back[0] + 1]:g} s after {time[back[0]]:g} s at "
            f"{named_rows(back[:1] + 1, stream.rows)}; write a file for each trial, or set log.columns.force_time to "
            "null"
        )
    return choose_clock(time, None, config.clock, place)


def _from_zero(clock: StreamClock) -> StreamClock:
    """Gaps as they lie in the log, whose time begins with the first message; the clock itself as it was."""
    gaps = tuple((start - clock.time[0], length) for start, length in clock.report.gaps)
    return replace(clock, report=replace(clock.report, gaps=gaps))


def within(time: Array, window: Window) -> npt.NDArray[np.bool_]:
    """Which of the times `(n,)` [s] lie in a window."""
    start = -np.inf if window.start is None else window.start
    end = np.inf if window.end is None else window.end
    return np.asarray((time >= start) & (time < end))
