"""CSV, TSV and text with blanks."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import RowNumbers
from bayes_impedance.readers.cells import MISSING, is_number
from bayes_impedance.readers.table import Opened, Stream, Table

#: Before pandas 3.1 decimals are off by a bit unless this is set; from 3.1 on it is deprecated.
_OLD = tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1)
EXACT: dict[str, Any] = {"float_precision": "round_trip"} if _OLD else {}


def open_text(file: Path, source: str, config: LogConfig) -> Opened:
    """A table of text: a header line, then a line a sample.

    Raises:
        LogError: names file and line.
    """
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
    delimiter = config.delimiter
    if delimiter is None:
        delimiter = next((character for character in "\t;," if character in head), " ")
    header = [name.strip() for name in _cells(head, delimiter, source)]
    if all(is_number(name) for name in header):
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

    def load(names: Sequence[str], labels: Collection[str]) -> list[Stream]:
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
        return [Stream("", {name: frame[index] for name, index in at.items()}, rows)]

    rows = RowNumbers("line", np.array([number for number, _ in body], dtype=np.int64))
    return Opened((Table(source, tuple(header), load),), config)


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
