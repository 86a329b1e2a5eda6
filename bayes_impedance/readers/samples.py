"""Columns of a table as numbers in SI units, at common times."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from bayes_impedance.config import LogConfig
from bayes_impedance.config.log import Quantity
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import Array, RowNumbers
from bayes_impedance.readers.cells import labels, numbers
from bayes_impedance.readers.columns import TIMES
from bayes_impedance.readers.table import Stream, Table
from bayes_impedance.readers.times import OF_THE_SENSOR, Part, clock_of, time_of, within
from bayes_impedance.recording import synchronise as on_one_clock
from bayes_impedance.recording.clock import ClockReport, StreamClock
from bayes_impedance.recording.wrench import rotations

LABELS = ("trial", "group", "repetition")
#: What is measured by each column that has a unit.
QUANTITIES: Mapping[str, Quantity] = {
    "position": "position",
    "reference": "position",
    "velocity": "velocity",
    "acceleration": "acceleration",
    "force": "force",
    "perturbation": "force",
    "torque": "torque",
}

#: Of the samples of position: more that lie outside another stream are worth a word.
LARGEST_SHARE_OUTSIDE = 0.05

#: Which samples: a slice copies nothing.
Which = slice | npt.NDArray[np.bool_] | npt.NDArray[np.int64]


@dataclass(frozen=True)
class Samples:
    """`time (n,)` [s], `values` `(n, c)` [SI] of each quantity, `labels (n,)` of each kind of label.

    `clocks`: what the time stamps of each topic or sensor are like, where there are several or messages carry them.
    """

    time: Array
    rows: RowNumbers
    values: Mapping[str, Array]
    labels: Mapping[str, npt.NDArray[np.object_]] = field(default_factory=dict)
    clocks: Mapping[str, ClockReport] = field(default_factory=dict)

    def at(self, which: Which) -> Samples:
        """Some of the samples."""
        return replace(
            self,
            time=self.time[which],
            rows=RowNumbers(self.rows.word, self.rows.numbers[which]),
            values={key: value[which] for key, value in self.values.items()},
            labels={key: marks[which] for key, marks in self.labels.items()},
        )


def read_samples(table: Table, wanted: Mapping[str, tuple[str, ...]], config: LogConfig) -> Samples:
    """The `wanted` columns of a table, all at the times of position, within `log.window` or where a tool is identified.

    Warns (LogWarning) where samples of position are left out because another stream has none there.

    Raises:
        LogError: names file, column and row.
    """
    names = list(dict.fromkeys(name for columns in wanted.values() for name in columns))
    texts = {name for key in LABELS for name in wanted.get(key, ())}
    base, *others = _parts(table, table.load(names, texts), wanted)
    clock = None if not (table.timed or others) else clock_of(table, base, wanted, config)
    time = time_of(table, base, wanted, config) if clock is None else clock.time
    zero = time[0] if table.timed else 0.0
    inside = _needed(table, time - zero, config, "force" in wanted)
    samples = _values(table, base, wanted, config, inside if clock is None else clock.kept[inside])
    if clock is None:
        return Samples(time[inside], *samples)
    return _merged(table, _Timed(base, clock, *samples), time[inside], zero, others, wanted, config)


def _parts(table: Table, streams: Sequence[Stream], wanted: Mapping[str, tuple[str, ...]]) -> list[Part]:
    """Quantities by stream and clock, those with position first."""
    parts: dict[tuple[int, str], list[str]] = {}
    for key, columns in wanted.items():
        if key in TIMES:
            continue
        own = {i for name in columns for i, stream in enumerate(streams) if name in stream.columns}
        if len(own) > 1:
            raise LogError(
                f"{table.where}: expected the columns of {key} at the same times, found {', '.join(columns)} in "
                f"{', '.join(streams[i].name for i in sorted(own))}; name columns of one of them in log.columns.{key}"
            )
        clock = "force_time" if key in OF_THE_SENSOR and "force_time" in wanted else "time"
        parts.setdefault((own.pop(), clock), []).append(key)
    found = [
        Part(f"{streams[i].name or ', '.join(keys)}", streams[i], clock, tuple(keys))
        for (i, clock), keys in parts.items()
    ]
    found.sort(key=lambda part: "position" not in part.keys)
    apart = [key for part in found[1:] for key in part.keys if key in (*LABELS, "phase")]
    if apart:
        raise LogError(
            f"{table.where}: expected {apart[0]} at the times of position, found it elsewhere; write it beside "
            f"position, or set log.columns.{apart[0]} to null"
        )
    return found


def _needed(table: Table, time: Array, config: LogConfig, forces: bool) -> Which:
    """The samples within `log.window`, and those that tell the tool."""
    inside = within(time, config.window)
    if not inside.any():
        raise LogError(
            f"{table.where}: expected samples within log.window (start {config.window.start}, end "
            f"{config.window.end} s), found none, for the file spans {time.min():g} to {time.max():g} s; change "
            "log.window"
        )
    tool = config.force.tool
    if forces and tool is not None and tool.identify is not None:
        inside |= within(time, tool.identify)
    return slice(None) if inside.all() else inside


# --- values --------------------------------------------------------------------------------------


def _values(
    table: Table, part: Part, wanted: Mapping[str, tuple[str, ...]], config: LogConfig, which: Which
) -> tuple[RowNumbers, dict[str, Array], dict[str, npt.NDArray[np.object_]]]:
    """The numbers of some rows of a part, its values in SI units and its labels."""
    stream = part.stream
    rows = RowNumbers(stream.rows.word, stream.rows.numbers[which])
    values, marks = {}, {}
    for key in part.keys:
        cells = [(stream.columns[name].iloc[which], name) for name in wanted[key]]
        if key in LABELS:
            ((series, name),) = cells
            marks[key] = labels(rows, series, table.where, key, name)
        else:
            columns = [numbers(rows, series, table.where, key, name) for series, name in cells]
            values[key] = np.stack(columns, axis=-1)
            values[key] *= _scale(key, config)
    return rows, values, marks


def _scale(key: str, config: LogConfig) -> float:
    """Factor into SI, with the sign that makes force the one by the human on the robot."""
    if key == "orientation":
        angles = config.columns.orientation is not None and len(config.columns.orientation) == 3
        return float(np.pi / 180.0) if angles and config.units.angle == "deg" else 1.0
    # The perturbation acts on the robot either way.
    flip = key in OF_THE_SENSOR and config.force_direction == "robot_on_human"
    quantity = QUANTITIES.get(key)
    return (-1.0 if flip else 1.0) * (1.0 if quantity is None else config.units.scale(quantity))


# --- several streams -----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Timed:
    """A part with its clock and what `_values` made of it."""

    part: Part
    clock: StreamClock
    rows: RowNumbers
    values: Mapping[str, Array]
    labels: Mapping[str, npt.NDArray[np.object_]]


def _merged(
    table: Table,
    base: _Timed,
    time: Array,
    zero: float,
    others: Sequence[Part],
    wanted: Mapping[str, tuple[str, ...]],
    config: LogConfig,
) -> Samples:
    """Everything at the times of `base`, which begin at `zero` [s]."""
    clocks = {base.part.name: base.clock.report}
    # Rows of the base stand for its columns: they are taken, not interpolated.
    index = np.arange(len(time), dtype=np.float64)[:, None]
    leading = on_one_clock.Stream(base.part.name, time, index, None, base.clock.against_recorder)
    streams: list[on_one_clock.Stream] = []
    first_of_part = []
    for part in others:
        clock = clock_of(table, part, wanted, config)
        clocks[part.name] = clock.report
        near, times = _near(leading, part.name, clock, config)
        _, values, _ = _values(table, part, wanted, config, clock.kept[near])
        if "orientation" in values:
            _check_orientation(table, values["orientation"], config)
        first_of_part.append(len(streams))
        for key, columns in values.items():
            rotation = config.force.rotation if key == "orientation" else None
            streams.append(on_one_clock.Stream(f"{part.name} ({key})", times, columns, rotation))
    result = on_one_clock.synchronise(leading, streams, align=False, place=table.where)
    for part, number in zip(others, first_of_part, strict=True):
        if count := result.left_out[streams[number].name]:
            warnings.warn(
                f"{table.where}: {count} samples of {base.part.name} lie in gaps of {part.name} and are left out",
                LogWarning,
                stacklevel=2,
            )
    if result.outside > LARGEST_SHARE_OUTSIDE * len(time):
        warnings.warn(
            f"{table.where}: {result.outside} of {len(time)} samples of {base.part.name} lie before or after those of "
            f"{', '.join(part.name for part in others)} and are left out",
            LogWarning,
            stacklevel=2,
        )
    kept = result.rows
    values = {key: columns[kept] for key, columns in base.values.items()}
    keys = [key for part in others for key in part.keys]
    values |= {key: result.columns[stream.name] for key, stream in zip(keys, streams, strict=True)}
    return Samples(
        result.time - zero,
        RowNumbers(base.rows.word, base.rows.numbers[kept]),
        values,
        {key: marks[kept] for key, marks in base.labels.items()},
        clocks,
    )


def _near(base: on_one_clock.Stream, name: str, clock: StreamClock, config: LogConfig) -> tuple[slice, Array]:
    """The samples of another stream that tell something at the times of `base`, and their times on its clock [s]."""
    other = on_one_clock.Stream(name, clock.time, np.zeros((0, 0)), None, clock.against_recorder)
    times = on_one_clock.on_clock_of(base, other) if config.clock.align else clock.time
    # What is averaged reaches half a step of the base beyond it.
    reach = float(np.median(np.diff(base.time))) if len(base.time) > 1 else 0.0
    start = max(int(np.searchsorted(times, base.time[0] - reach)) - 1, 0)
    end = int(np.searchsorted(times, base.time[-1] + reach)) + 1
    # Streams that do not overlap are refused where they meet.
    near = slice(start, end) if len(times[start:end]) > 1 else slice(None)
    return near, times[near]


def _check_orientation(table: Table, orientation: Array, config: LogConfig) -> None:
    try:
        rotations(orientation, config.force.rotation)
    except LogError as error:
        raise LogError(f"{table.where}: {error}") from error
