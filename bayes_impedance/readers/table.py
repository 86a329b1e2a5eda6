"""Tables as interaction logs: CSV, TSV, text with blanks, Parquet."""

from __future__ import annotations

import csv
import difflib
import io
import re
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from bayes_impedance.config import Columns, LogConfig
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import (
    AXES,
    TRUTH_COLUMN,
    VECTORS,
    Array,
    InteractionLog,
    RowNumbers,
    Trial,
    named_rows,
)

LABELS = ("trial", "group", "repetition")
#: Cells of a text file that mean: no number here.
MISSING = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None", "none")
#: Before pandas 3.1 decimals are off by a bit unless this is set; from 3.1 on it is deprecated.
_OLD = tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1)
EXACT: dict[str, Any] = {"float_precision": "round_trip"} if _OLD else {}
#: What pandas and Arrow raise at a file that is not what it claims to be.
UNREADABLE = (OSError, ValueError, pa.ArrowException)


def read_log(
    paths: str | Path | Sequence[str | Path], config: LogConfig | None = None, *, require_force: bool = True
) -> InteractionLog:
    """Interaction log of one or several files, mapped by `config` (default: `LogConfig()`) to SI.

    Without `require_force` a file may lack force.

    Example:
        >>> cells = {"time": [0, 10, 20], "position_x": [0.10, 0.11, 0.13], "force_x": [1.5, 1.6, 1.4]}
        >>> pd.DataFrame(cells).to_csv("log.csv", index=False)
        >>> log = read_log("log.csv", LogConfig.model_validate({"units": {"time": "ms"}}))
        >>> log.trials[0].time.tolist()
        [0.0, 0.01, 0.02]

    Raises:
        LogError: names file, column and row.
    """
    config = LogConfig() if config is None else config
    files = [Path(path) for path in ([paths] if isinstance(paths, (str, Path)) else paths)]
    if not files:
        raise LogError("expected at least one file to read, found none; name a recording")
    logs = [
        _read_file(file, source, config, require_force)
        for file, source in zip(files, _sources(files), strict=True)
    ]
    axes = logs[0][0]
    for other, trials in logs:
        if other != axes:
            raise LogError(
                "expected the same axes in every file, found axes that differ between files: "
                f"{', '.join(axes)} in {logs[0][1][0].source} and {', '.join(other)} in {trials[0].source}; "
                "set log.axes to those they have in common"
            )
    return InteractionLog(axes, tuple(trial for _, trials in logs for trial in trials))


def _sources(files: Sequence[Path]) -> list[str]:
    """File names, with as many parent folders as it takes to tell files of one name apart."""
    resolved = [file.resolve() for file in files]
    repeated = [file for index, file in enumerate(files) if resolved[index] in resolved[:index]]
    if repeated:
        raise LogError(f"{repeated[0]}: expected each file once, found it twice; name it once")
    parts = [file.absolute().parts for file in files]
    sources = []
    for path in parts:
        namesakes = [other for other in parts if other[-1:] == path[-1:]]
        depth = 1
        while len({other[-depth:] for other in namesakes}) < len(namesakes):
            depth += 1
        sources.append("/".join(path[-depth:]))
    return sources


# --- files ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Table:
    """A file opened as far as its header; `load(names, labels)` reads columns, those in `labels` as text."""

    source: str
    columns: tuple[str, ...]
    rows: RowNumbers
    load: Callable[[Sequence[str], Collection[str]], dict[str, pd.Series[Any]]]


def _open(file: Path, source: str, config: LogConfig) -> _Table:
    if file.is_dir():
        raise LogError(f"{source}: expected a file, found a folder; name the recordings in it")
    if not file.exists():
        raise LogError(f"{source}: expected a recording, found no such file at '{file}'; check the path")
    suffix = file.suffix.lower()
    try:
        if suffix in (".csv", ".tsv", ".txt"):
            return _open_text(file, source, config.delimiter)
        if suffix in (".parquet", ".pq"):
            return _open_parquet(file, source)
    except OSError as error:
        raise LogError(
            f"{source}: expected a readable file, found: {_brief(error)}; check the file"
        ) from error
    raise LogError(
        f"{source}: expected a file that ends in .csv, .tsv, .txt, .parquet or .pq, found "
        f"{repr(file.suffix) if suffix else 'no ending'}; convert it, or rename it if it is one of these"
    )


def _open_text(file: Path, source: str, delimiter: str | None) -> _Table:
    try:
        text = file.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError(
            f"{source}: expected text in UTF-8, found byte 0x{error.object[error.start]:02x} at position "
            f"{error.start}; save it as UTF-8, or rename it if it is not text"
        ) from error
    if "\0" in text:
        raise LogError(
            f"{source}: expected text, found binary data; rename the file by its format, or export it anew"
        )
    numbered = [
        (number, line)
        for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1)
        if line.strip()
    ]
    if not numbered:
        raise LogError(
            f"{source}: expected a header line and samples, found an empty file; record or export it anew"
        )
    (_, head), *body = numbered
    if delimiter is None:
        delimiter = next((character for character in "\t;," if character in head), " ")
    header = [name.strip() for name in _cells(head, delimiter, source)]
    if all(_is_number(name) for name in header):
        raise LogError(
            f"{source}: expected names of columns in the first line, found numbers; add a header line"
        )
    if not body:
        raise LogError(
            f"{source}: expected samples below the header line, found none; record or export it anew"
        )
    for number, line in body:
        # pandas would shift or drop cells of a line that is too long without a word.
        width = (
            line.count(delimiter) + 1
            if delimiter != " " and '"' not in line
            else len(_cells(line, delimiter, source))
        )
        if width != len(header):
            raise LogError(
                f"{source}, line {number}: expected {len(header)} cells as in the header, found {width}; "
                "mend the line, set log.delimiter, or write decimals with a point"
            )

    def load(names: Sequence[str], labels: Collection[str]) -> dict[str, pd.Series[Any]]:
        at = {name: str(header.index(name)) for name in names}
        frame = pd.read_csv(
            io.StringIO("\n".join(line for _, line in body)),
            sep=r"\s+" if delimiter == " " else delimiter,
            header=None,
            names=[str(index) for index in range(len(header))],
            usecols=list(at.values()),
            index_col=False,
            dtype={at[name]: str for name in names if name in labels},
            na_values={at[name]: list(MISSING) for name in names if name not in labels},
            keep_default_na=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
            **EXACT,
        )
        return {name: frame[index] for name, index in at.items()}

    numbers = np.array([number for number, _ in body], dtype=np.int64)
    return _Table(source, tuple(header), RowNumbers("line", numbers), load)


def _cells(line: str, delimiter: str, source: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        # Strict: an open quote would swallow the lines that follow.
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True))
    except (csv.Error, TypeError, ValueError) as error:
        raise LogError(
            f"{source}: expected cells separated by {delimiter!r}, found {line[:40]!r} ({error}); mend the "
            "quotes, or set log.delimiter"
        ) from error


def _parquet(file: Path) -> pq.ParquetFile:
    return pq.ParquetFile(file)


def _open_parquet(file: Path, source: str) -> _Table:
    try:
        with _parquet(file) as parquet:
            columns = tuple(parquet.schema_arrow.names)
            n = parquet.metadata.num_rows
    except UNREADABLE as error:
        raise LogError(
            f"{source}: expected a Parquet file, found one that is truncated or something else "
            f"({_brief(error)}); write it anew"
        ) from error
    if n == 0:
        raise LogError(f"{source}: expected samples, found a table without rows; record or export it anew")

    def load(names: Sequence[str], _: Collection[str]) -> dict[str, pd.Series[Any]]:
        with _parquet(file) as parquet:
            table = parquet.read(columns=list(names))
        return {name: table.column(name).to_pandas() for name in names}

    return _Table(source, columns, RowNumbers("row", np.arange(1, n + 1)), load)


def _brief(error: Exception) -> str:
    """First line of another library's message."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return text.splitlines()[0].rstrip(".")


# --- columns -------------------------------------------------------------------------------------


def _read_file(
    file: Path, source: str, config: LogConfig, require_force: bool
) -> tuple[tuple[str, ...], list[Trial]]:
    table = _open(file, source, config)
    axes = _axes(table, config, require_force)
    wanted = _wanted(table, config.columns, axes, require_force)
    names = list(dict.fromkeys(name for columns in wanted.values() for name in columns))
    labels = {name for key in LABELS for name in wanted.get(key, ())}
    try:
        series = table.load(names, labels)
    except UNREADABLE as error:
        raise LogError(
            f"{source}: expected a readable table, found: {_brief(error)}; write it anew"
        ) from error

    time = _numbers(table.rows, series[config.columns.time], source, "time", config.columns.time)
    time = time * config.units.scale("time")
    start, end = config.window.start, config.window.end
    inside = (time >= (-np.inf if start is None else start)) & (time < (np.inf if end is None else end))
    if not inside.any():
        raise LogError(
            f"{source}: expected samples within log.window (start {start}, end {end} s), found none, for the "
            f"file spans {time.min():g} to {time.max():g} s; change log.window"
        )
    rows = RowNumbers(table.rows.word, table.rows.numbers[inside])
    values = {
        key: np.stack([_numbers(rows, series[name][inside], source, key, name) for name in columns], axis=-1)
        for key, columns in wanted.items()
        if key not in (*LABELS, "time")
    }
    texts = {
        key: _labels(rows, series[columns[0]][inside], source, key, columns[0])
        for key, columns in wanted.items()
        if key in LABELS
    }
    for key in VECTORS:
        if key in values:
            values[key] = values[key] * _scale(key, config)
    return axes, list(_trials(source, time[inside], values, texts, rows))


def _trials(
    source: str,
    time: Array,
    values: dict[str, Array],
    texts: dict[str, npt.NDArray[np.object_]],
    rows: RowNumbers,
) -> Sequence[Trial]:
    """One trial for each label, its samples in the order of the file even where they lie apart."""
    everything = np.full(len(time), "0", dtype=object)
    codes, names = pd.factorize(texts.get("trial", everything))
    trials = []
    for code, name in enumerate(names):
        own = np.flatnonzero(codes == code)
        groups = list(dict.fromkeys(texts.get("group", everything)[own]))
        if len(groups) > 1:
            raise LogError(
                f"{source}, trial {name!r}: expected one group a trial, found {groups[0]!r} and "
                f"{groups[1]!r}; label trials so that no two groups share one"
            )
        # Labels as integers: an array of objects sorts and compares slowly.
        repetition = pd.factorize(texts["repetition"][own])[0] if "repetition" in texts else None
        optional: dict[str, Any] = {key: values[key][own] for key in VECTORS if key in values}
        if "phase" in values:
            optional["phase"] = values["phase"][own, 0]
        trials.append(
            Trial(
                name=str(name),
                group=str(groups[0]),
                source=source,
                time=time[own],
                repetition=repetition,  # type: ignore[arg-type]
                truth={key: value[own, 0] for key, value in values.items() if TRUTH_COLUMN.fullmatch(key)},
                rows=RowNumbers(rows.word, rows.numbers[own]),
                **optional,
            )
        )
    return trials


def _axes(table: _Table, config: LogConfig, require_force: bool) -> tuple[str, ...]:
    if config.axes is not None:
        return config.axes
    moving = [axis for axis in AXES if _of_axis(config.columns.position, axis) in table.columns]
    if not moving:
        raise _missing(table, "position", _of_axis(config.columns.position, AXES[0]))
    measured = [axis for axis in moving if _of_axis(config.columns.force, axis) in table.columns]
    if not measured and require_force:
        raise _missing(table, "force", _of_axis(config.columns.force, moving[0]))
    _question_half_axes(table, config.columns, forceless=not measured)
    return tuple(measured or moving)


def _question_half_axes(table: _Table, columns: Columns, forceless: bool) -> None:
    """An axis with position or force alone is a misspelling where a name is near (LogError), else a warning."""
    known = {
        _of_axis(getattr(columns, key), axis) for key in VECTORS for axis in AXES if getattr(columns, key)
    }
    others = [name for name in table.columns if name not in known]
    for axis in AXES:
        names = {key: _of_axis(getattr(columns, key), axis) for key in ("position", "force")}
        absent = [key for key, name in names.items() if name not in table.columns]
        if len(absent) != 1:
            continue
        (key,) = absent
        if difflib.get_close_matches(names[key], others, n=1, cutoff=0.85):
            raise _missing(table, key, names[key])
        if not forceless:
            (present,) = set(names) - {key}
            warnings.warn(
                f"{table.source}: axis {axis} has a column {names[present]!r} but none named {names[key]!r}, so it "
                "is left out; name the axes that are meant in log.axes",
                LogWarning,
                stacklevel=2,
            )


def _wanted(
    table: _Table, columns: Columns, axes: tuple[str, ...], require_force: bool
) -> dict[str, tuple[str, ...]]:
    """Columns to load for each quantity; LogError when a required, renamed or half present one lacks."""
    required = {"time", "position"} | ({"force"} if require_force else set())
    wanted: dict[str, tuple[str, ...]] = {}
    for key in Columns.model_fields:
        template = getattr(columns, key)
        if template is None:
            continue
        names = tuple(_of_axis(template, axis) for axis in axes) if key in VECTORS else (template,)
        absent = [name for name in names if name not in table.columns]
        # A name that the user wrote down is a name that the user expects to be there.
        expected = key in required or (key != "force" and template != Columns.model_fields[key].default)
        if absent and (expected or len(absent) < len(names)):
            raise _missing(table, key, absent[0], optional=_is_optional(key))
        if not absent:
            wanted[key] = names
    taken = {name for names in wanted.values() for name in names}
    wanted |= {name: (name,) for name in table.columns if TRUTH_COLUMN.fullmatch(name) and name not in taken}
    for names in wanted.values():
        for name in names:
            if table.columns.count(name) > 1:
                raise LogError(
                    f"{table.source}: expected one column {name!r}, found {table.columns.count(name)}; "
                    "rename the others"
                )
    return wanted


def _of_axis(template: str, axis: str) -> str:
    return template.replace("{axis}", axis)


def _missing(table: _Table, key: str, name: str, optional: bool = False) -> LogError:
    by_lower_case = {column.lower(): column for column in table.columns}
    near = difflib.get_close_matches(name.lower(), by_lower_case, n=1, cutoff=0.3)
    found = f"the nearest is {by_lower_case[near[0]]!r}" if near else f"there is {_listed(table.columns)}"
    return LogError(
        f"{table.source}: expected column {name!r}, found none of that name ({found}); set log.columns.{key}"
        f"{' to null or' if optional else ''} to the name in the file"
    )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name[:40]) for name in names[:5]) + (", …" if len(names) > 5 else "")


def _scale(key: str, config: LogConfig) -> float:
    """Factor into SI, with the sign that makes force the one by the human on the robot."""
    if key in ("force", "perturbation"):
        # The perturbation acts on the robot either way.
        flip = key == "force" and config.force_direction == "robot_on_human"
        return (-1.0 if flip else 1.0) * config.units.scale("force")
    if key == "velocity":
        return config.units.scale("velocity")
    if key == "acceleration":
        return config.units.scale("acceleration")
    return config.units.scale("position")


# --- cells ---------------------------------------------------------------------------------------


def _numbers(rows: RowNumbers, series: pd.Series[Any], source: str, key: str, name: str) -> Array:
    """`(n,)` finite float64."""
    if pd.api.types.is_string_dtype(series.dtype) or series.dtype == object:
        text = series.astype(object)
        numbers = text.map(_number).to_numpy(dtype=np.float64)
        wrong = np.flatnonzero(
            np.isnan(numbers) & ~np.isin(text.astype(str).str.strip(), MISSING) & text.notna()
        )
        if len(wrong):
            value = str(text.iloc[wrong[0]])[:40]
            hint = (
                "write decimals with a point"
                if re.fullmatch(r"\s*[-+]?\d+,\d+\s*", value)
                else "mend the cell"
            )
            raise LogError(
                f"{source}, column {name!r}: expected numbers, found {value!r} at "
                f"{named_rows(wrong[:1], rows)}; {hint}"
            )
    elif pd.api.types.is_numeric_dtype(series.dtype) and not pd.api.types.is_bool_dtype(series.dtype):
        numbers = series.to_numpy(dtype=np.float64, na_value=np.nan)
    else:
        raise LogError(
            f"{source}, column {name!r}: expected numbers, found {str(series.iloc[0])[:40]!r} at "
            f"{named_rows([0], rows)}, of type {series.dtype}; convert the column"
        )
    bad = np.flatnonzero(~np.isfinite(numbers))
    if len(bad):
        fallback = f", or leave the column out with log.columns.{key}: null" if _is_optional(key) else ""
        raise LogError(
            f"{source}, column {name!r}: expected finite numbers, found {numbers[bad[0]]:g} or an empty cell "
            f"at {named_rows(bad, rows)}; fill or remove these samples, or cut them with log.window{fallback}"
        )
    return numbers


def _is_optional(key: str) -> bool:
    return key in Columns.model_fields and key not in ("time", "position", "force")


def _number(value: Any) -> float:
    try:
        # Python reads 1_0 as 10; a file does not mean that.
        return np.nan if "_" in str(value) else float(value)
    except (TypeError, ValueError):
        return np.nan


def _is_number(text: str) -> bool:
    return not np.isnan(_number(text))


def _labels(
    rows: RowNumbers, series: pd.Series[Any], source: str, key: str, name: str
) -> npt.NDArray[np.object_]:
    """`(n,)` text; whole numbers without a decimal point, so that 1.0 and 1 are one label."""
    codes, values = pd.factorize(series)
    texts = np.array(
        [re.sub(r"^(-?\d+)\.0+$", r"\1", str(value).strip()) for value in values] + [""], dtype=object
    )
    labels: npt.NDArray[np.object_] = texts[codes]
    missing = np.flatnonzero(labels == "")
    if len(missing):
        raise LogError(
            f"{source}, column {name!r}: expected a label in every cell, found none at "
            f"{named_rows(missing, rows)}; fill it, or leave the column out with log.columns.{key}: null"
        )
    return labels
