"""Columns of a table as numbers in SI units, at common times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bayes_impedance.config import LogConfig
from bayes_impedance.config.log import Quantity
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, RowNumbers
from bayes_impedance.readers.cells import labels, numbers
from bayes_impedance.readers.columns import TIMES
from bayes_impedance.readers.table import Stream, Table

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


@dataclass(frozen=True)
class Samples:
    """`time (n,)` [s], `values` `(n, c)` [SI] of each quantity, `labels (n,)` of each kind of label."""

    time: Array
    rows: RowNumbers
    values: Mapping[str, Array]
    labels: Mapping[str, npt.NDArray[np.object_]]


def read_samples(table: Table, wanted: Mapping[str, tuple[str, ...]], config: LogConfig) -> Samples:
    """The `wanted` columns of a table within `log.window`.

    Raises:
        LogError: names file, column and row.
    """
    names = list(dict.fromkeys(name for columns in wanted.values() for name in columns))
    texts = {name for key in LABELS for name in wanted.get(key, ())}
    (stream,) = table.load(names, texts)
    time = _time(stream, table, wanted, config)
    start, end = config.window.start, config.window.end
    inside = (time >= (-np.inf if start is None else start)) & (time < (np.inf if end is None else end))
    if not inside.any():
        raise LogError(
            f"{table.where}: expected samples within log.window (start {start}, end {end} s), found none, for the "
            f"file spans {time.min():g} to {time.max():g} s; change log.window"
        )
    rows = RowNumbers(stream.rows.word, stream.rows.numbers[inside])
    values = {
        key: _scale(key, config)
        * np.stack(
            [numbers(rows, stream.columns[name][inside], table.where, key, name) for name in columns],
            axis=-1,
        )
        for key, columns in wanted.items()
        if key not in (*LABELS, *TIMES)
    }
    marks = {
        key: labels(rows, stream.columns[wanted[key][0]][inside], table.where, key, wanted[key][0])
        for key in LABELS
        if key in wanted
    }
    return Samples(time[inside], rows, values, marks)


def _time(stream: Stream, table: Table, wanted: Mapping[str, tuple[str, ...]], config: LogConfig) -> Array:
    if stream.sent is not None:
        return stream.sent - stream.sent[0]
    if "time" not in wanted:
        assert config.sampling_rate is not None
        return np.arange(len(stream.rows.numbers)) / config.sampling_rate
    (name,) = wanted["time"]
    return numbers(stream.rows, stream.columns[name], table.where, "time", name) * config.units.scale("time")


def _scale(key: str, config: LogConfig) -> float:
    """Factor into SI, with the sign that makes force the one by the human on the robot."""
    # The perturbation acts on the robot either way.
    flip = key in ("force", "torque") and config.force_direction == "robot_on_human"
    quantity = QUANTITIES.get(key)
    return (-1.0 if flip else 1.0) * (1.0 if quantity is None else config.units.scale(quantity))
