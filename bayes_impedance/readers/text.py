"""CSV, TSV and text with blanks, in pieces: a long recording never stands in memory as text."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pandas.api.types import union_categoricals

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import Integers, RowNumbers
from bayes_impedance.readers.cells import MISSING, is_number, readable
from bayes_impedance.readers.table import Opened, Stream, Table

#: Before pandas 3.1 decimals are off by a bit unless this is set; from 3.1 on it is deprecated.
_OLD = tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1)
EXACT: dict[str, Any] = {"float_precision": "round_trip"} if _OLD else {}
#: Bytes of a file that are in memory as lines at a time.
PIECE = 8 * 2**20
BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class _Lines(NamedTuple):
    """Lines that are not blank, with their numbers in the file."""

    numbers: Integers
    texts: list[str]


def open_text(file: Path, source: str, config: LogConfig) -> Opened:
    """A table of text: a header line, then a line a sample.

    Raises:
        LogError: names file and line.
    """
    # A line may be all that a piece holds.
    beginning = list(islice((line for lines in _pieces(file, source) for line in lines.texts), 2))
    if not beginning:
        raise LogError(
            f"{source}: expected a header line and samples, found an empty file; record or export it anew"
        )
    head = beginning[0]
    delimiter = config.delimiter
    if delimiter is None:
        delimiter = next((character for character in "\t;," if character in head), " ")
    header = [name.strip() for name in _cells(head, delimiter, source)]
    if all(is_number(name) for name in header):
        raise LogError(
            f"{source}: expected names of columns in the first line, found numbers; add a header line"
        )
    if len(beginning) == 1:
        raise LogError(
            f"{source}: expected samples below the header line, found none; record or export it anew"
        )

    def load(names: Sequence[str], labels: Collection[str]) -> list[Stream]:
        numbers: list[Integers] = []
        parts: dict[str, list[pd.Series[Any]]] = {name: [] for name in names}
        with readable(source):
            for lines in _bodies(file, source):
                _check_widths(lines, delimiter, len(header), source)
                numbers.append(lines.numbers)
                frame = _parsed(lines, delimiter, header, names, labels)
                for name in names:
                    cells = frame[str(header.index(name))]
                    # A label stands in thousands of lines.
                    parts[name].append(cells.astype("category") if name in labels else cells)
        # Piece by piece given up as the columns grow.
        columns = {name: _joined(parts.pop(name)) for name in names}
        return [Stream("", columns, RowNumbers("line", np.concatenate(numbers)))]

    return Opened((Table(source, tuple(header), load),), config)


# --- pieces --------------------------------------------------------------------------------------


def _bodies(file: Path, source: str) -> Iterator[_Lines]:
    """Pieces without the header line."""
    pieces = _pieces(file, source)
    first = next(pieces)
    if len(first.texts) > 1:
        yield _Lines(first.numbers[1:], first.texts[1:])
    yield from pieces


def _pieces(file: Path, source: str) -> Iterator[_Lines]:
    """Lines that are not blank, some at a time.

    Raises:
        LogError: they are no text.
    """
    count, position = 0, 0
    for data in _blocks(file):
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError as error:
            raise LogError(
                f"{source}: expected text in UTF-8, found byte 0x{data[error.start]:02x} at position "
                f"{position + error.start}; save it as UTF-8, or rename it if it is not text"
            ) from error
        if "\0" in text:
            raise LogError(
                f"{source}: expected text, found binary data; rename the file by its format, or export it anew"
            )
        lines = text.replace("\r\n", "\n").replace("\r", "\n").removesuffix("\n").split("\n")
        kept = np.flatnonzero([bool(line.strip()) for line in lines])
        if len(kept):
            yield _Lines(
                count + 1 + kept, lines if len(kept) == len(lines) else [lines[index] for index in kept]
            )
        count += len(lines)
        position += len(data)


def _blocks(file: Path) -> Iterator[bytes]:
    """Bytes of whole lines, without byte order mark."""
    with file.open("rb") as stream:
        rest = stream.read(len(BYTE_ORDER_MARK)).removeprefix(BYTE_ORDER_MARK)
        while block := stream.read(PIECE):
            rest += block
            if len(block) < PIECE:
                break
            # A carriage return at the end may be the first half of a line's end.
            cut = max(rest.rfind(b"\n"), rest.rfind(b"\r", 0, len(rest) - 1)) + 1
            if cut:
                yield rest[:cut]
                rest = rest[cut:]
        if rest:
            yield rest


# --- cells ---------------------------------------------------------------------------------------


def _check_widths(lines: _Lines, delimiter: str, expected: int, source: str) -> None:
    """Pandas would shift or drop cells of a line that is too long without a word."""
    widths = [
        line.count(delimiter) + 1
        if delimiter != " " and '"' not in line
        else len(_cells(line, delimiter, source))
        for line in lines.texts
    ]
    wrong = np.flatnonzero(np.array(widths) != expected)
    if len(wrong):
        raise LogError(
            f"{source}, line {lines.numbers[wrong[0]]}: expected {expected} cells as in the header, found "
            f"{widths[wrong[0]]}; mend the line, set log.delimiter, or write decimals with a point"
        )


def _parsed(
    lines: _Lines,
    delimiter: str,
    header: Sequence[str],
    names: Sequence[str],
    labels: Collection[str],
) -> pd.DataFrame:
    at = {name: str(header.index(name)) for name in names}
    return pd.read_csv(
        io.StringIO("\n".join(lines.texts)),
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


def _joined(parts: list[pd.Series[Any]]) -> pd.Series[Any]:
    """One column of its pieces: numbers where all are, else as if all had been read as text."""
    if isinstance(parts[0].dtype, pd.CategoricalDtype):
        return pd.Series(union_categoricals(parts))
    kinds = {part.dtype.kind for part in parts}
    if kinds <= set("iuf"):
        return pd.Series(np.concatenate([part.to_numpy(dtype=np.float64) for part in parts]))
    if kinds == {"b"}:
        return pd.concat(parts, ignore_index=True)
    return pd.concat(
        [part.astype(str) if part.dtype.kind == "b" else part.astype(object) for part in parts],
        ignore_index=True,
    )


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
