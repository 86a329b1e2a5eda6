"""Columns of a table as numbers in SI units, at common times."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from bayes_impedance.config import LogConfig
from bayes_impedance.config.log import Quantity
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import Array, RowNumbers
from bayes_impedance.readers.cells import labels, numbers
from bayes_impedance.readers.columns import TIMES
from bayes_impedance.readers.table import Stream, Table
from bayes_impedance.recording import synchronise as on_one_clock
from bayes_impedance.recording.clock import ClockReport, StreamClock, choose_clock

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
#: What has the time stamps of `log.columns.force_time`.
OF_THE_SENSOR = ("force", "torque")


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


@dataclass(frozen=True)
class _Part:
    """Quantities that share a stream and its time stamps; `clock`: the key of their column of time."""

    name: str
    stream: Stream
    clock: str
    keys: tuple[str, ...]


def read_samples(table: Table, wanted: Mapping[str, tuple[str, ...]], config: LogConfig) -> Samples:
    """The `wanted` columns of a table within `log.window`, all at the times of position.

    Warns (LogWarning) where samples of position are left out because another stream has none there.

    Raises:
        LogError: names file, column and row.
    """
    names = list(dict.fromkeys(name for columns in wanted.values() for name in columns))
    texts = {name for key in LABELS for name in wanted.get(key, ())}
    base, *others = _parts(table, table.load(names, texts), wanted)
    clock = None if not (table.timed or others) else _clock(table, base, wanted, config)
    time = _time(table, base.stream, base.clock, wanted, config) if clock is None else clock.time
    zero = time[0] if table.timed and len(time) else 0.0
    inside = _window(table, time - zero, config)
    samples = _values(table, base, wanted, config, inside if clock is None else clock.kept[inside])
    if clock is None:
        return Samples(time[inside], *samples)
    return _merged(table, _Timed(base, clock, *samples), time[inside], zero, others, wanted, config)


def _parts(table: Table, streams: Sequence[Stream], wanted: Mapping[str, tuple[str, ...]]) -> list[_Part]:
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
        _Part(f"{streams[i].name or ', '.join(keys)}", streams[i], clock, tuple(keys))
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


# --- time ----------------------------------------------------------------------------------------


def _time(
    table: Table, stream: Stream, clock: str, wanted: Mapping[str, tuple[str, ...]], config: LogConfig
) -> Array:
    """A column of time, or that of samples at `log.sampling_rate` [s]."""
    if clock not in wanted:
        assert config.sampling_rate is not None
        return np.arange(len(stream.rows.numbers)) / config.sampling_rate
    (name,) = wanted[clock]
    if name not in stream.columns:
        raise LogError(
            f"{table.where}: expected as many values in {name!r} as in the columns that it times, found another "
            f"number; name their time stamps in log.columns.{clock}"
        )
    return numbers(stream.rows, stream.columns[name], table.where, clock, name) * config.units.scale("time")


def _clock(
    table: Table, part: _Part, wanted: Mapping[str, tuple[str, ...]], config: LogConfig
) -> StreamClock:
    stream = part.stream
    place = f"{table.where}, {part.name}"
    if stream.sent is not None:
        return choose_clock(stream.sent, stream.received, config.clock, place)
    if stream.received is not None:
        return choose_clock(stream.received, None, config.clock, place)
    return choose_clock(_time(table, stream, part.clock, wanted, config), None, config.clock, place)


def _window(table: Table, time: Array, config: LogConfig) -> npt.NDArray[np.bool_]:
    start, end = config.window.start, config.window.end
    inside: npt.NDArray[np.bool_] = (time >= (-np.inf if start is None else start)) & (
        time < (np.inf if end is None else end)
    )
    if not inside.any():
        raise LogError(
            f"{table.where}: expected samples within log.window (start {start}, end {end} s), found none, for the "
            f"file spans {time.min():g} to {time.max():g} s; change log.window"
        )
    return inside


# --- values --------------------------------------------------------------------------------------


def _values(
    table: Table,
    part: _Part,
    wanted: Mapping[str, tuple[str, ...]],
    config: LogConfig,
    which: npt.NDArray[np.bool_] | npt.NDArray[np.int64],
) -> tuple[RowNumbers, dict[str, Array], dict[str, npt.NDArray[np.object_]]]:
    """The numbers of some rows of a part, its values in SI units and its labels."""
    stream = part.stream
    rows = RowNumbers(stream.rows.word, stream.rows.numbers[which])
    values = {
        key: _scale(key, config)
        * np.stack(
            [numbers(rows, stream.columns[name][which], table.where, key, name) for name in wanted[key]],
            axis=-1,
        )
        for key in part.keys
        if key not in LABELS
    }
    marks = {
        key: labels(rows, stream.columns[wanted[key][0]][which], table.where, key, wanted[key][0])
        for key in part.keys
        if key in LABELS
    }
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

    part: _Part
    clock: StreamClock
    rows: RowNumbers
    values: Mapping[str, Array]
    labels: Mapping[str, npt.NDArray[np.object_]]


def _merged(
    table: Table,
    base: _Timed,
    time: Array,
    zero: float,
    others: Sequence[_Part],
    wanted: Mapping[str, tuple[str, ...]],
    config: LogConfig,
) -> Samples:
    """Everything at the times of `base`, which begin at `zero` [s]."""
    clocks = {base.part.name: base.clock.report}
    streams = []
    for part in others:
        clock = _clock(table, part, wanted, config)
        clocks[part.name] = clock.report
        _, values, _ = _values(table, part, wanted, config, clock.kept)
        for key, columns in values.items():
            rotation = config.force.rotation if key == "orientation" else None
            streams.append(
                on_one_clock.Stream(
                    f"{part.name} ({key})", clock.time, columns, rotation, clock.against_recorder
                )
            )
    # Rows of the base stand for its columns: they are taken, not interpolated.
    index = np.arange(len(time), dtype=np.float64)[:, None]
    result = on_one_clock.synchronise(
        on_one_clock.Stream(base.part.name, time, index, None, base.clock.against_recorder),
        streams,
        align=config.clock.align,
        place=table.where,
    )
    for name, count in result.left_out.items():
        if count:
            warnings.warn(
                f"{table.where}: {count} samples of {base.part.name} lie in gaps of {name} and are left out",
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
