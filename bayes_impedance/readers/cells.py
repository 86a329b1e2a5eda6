"""Cells of a table as numbers and labels."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from bayes_impedance.config import Columns
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, RowNumbers, named_rows

#: Cells of a text file that mean: no number here.
MISSING = ("", "nan", "NaN", "NAN", "NA", "N/A", "n/a", "null", "NULL", "None", "none")


def numbers(rows: RowNumbers, series: pd.Series[Any], source: str, key: str, name: str) -> Array:
    """Cells as `(n,)` finite float64.

    Raises:
        LogError: a cell is no number, or not a finite one.
    """
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
        fallback = f", or leave the column out with log.columns.{key}: null" if is_optional(key) else ""
        raise LogError(
            f"{source}, column {name!r}: expected finite numbers, found {numbers[bad[0]]:g} or an empty cell "
            f"at {named_rows(bad, rows)}; fill or remove these samples, or cut them with log.window{fallback}"
        )
    return numbers


def labels(
    rows: RowNumbers, series: pd.Series[Any], source: str, key: str, name: str
) -> npt.NDArray[np.object_]:
    """Cells as `(n,)` text; whole numbers without a decimal point, so that 1.0 and 1 are one label.

    Raises:
        LogError: a cell is empty.
    """
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


def is_optional(key: str) -> bool:
    """Whether a log can do without the column of `log.columns.<key>`."""
    return key in Columns.model_fields and key not in ("time", "position", "force")


def _number(value: Any) -> float:
    try:
        # Python reads 1_0 as 10; a file does not mean that.
        return np.nan if "_" in str(value) else float(value)
    except (TypeError, ValueError):
        return np.nan


def is_number(text: str) -> bool:
    """Whether a cell of text is a number."""
    return not np.isnan(_number(text))


@contextmanager
def readable(source: str) -> Iterator[None]:
    """What the disk or the system refuses as an error of ours.

    Raises:
        LogError: an OSError came up.
    """
    try:
        yield
    except OSError as error:
        raise LogError(
            f"{source}: expected a readable file, found: {brief(error)}; check the file"
        ) from error


def brief(error: Exception) -> str:
    """First line of another library's message."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return text.splitlines()[0].rstrip(".")
