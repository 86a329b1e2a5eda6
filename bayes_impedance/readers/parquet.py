"""Parquet."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import RowNumbers
from bayes_impedance.readers.cells import brief
from bayes_impedance.readers.table import Opened, Stream, Table

#: What Arrow raises at a file that is not what it claims to be.
UNREADABLE = (OSError, ValueError, pa.ArrowException)


def open_parquet(file: Path, source: str, config: LogConfig) -> Opened:
    """A Parquet file, read column by column.

    Raises:
        LogError: it is none, is truncated, or holds no rows.
    """
    try:
        with pq.ParquetFile(file) as parquet:
            columns = tuple(parquet.schema_arrow.names)
            n = parquet.metadata.num_rows
    except UNREADABLE as error:
        raise LogError(
            f"{source}: expected a Parquet file, found one that is truncated or something else "
            f"({brief(error)}); write it anew"
        ) from error
    if n == 0:
        raise LogError(f"{source}: expected samples, found a table without rows; record or export it anew")

    def load(names: Sequence[str], _: Collection[str]) -> list[Stream]:
        try:
            with pq.ParquetFile(file) as parquet:
                # One after the other, so that Arrow's copy of a column goes before the next comes.
                series = {name: parquet.read(columns=[name]).column(name).to_pandas() for name in names}
            if any(len(column) != n for column in series.values()):
                raise ValueError(f"columns without the {n} rows that the file declares")
        except UNREADABLE as error:
            raise LogError(
                f"{source}: expected a readable table, found: {brief(error)}; write it anew"
            ) from error
        return [Stream("", series, RowNumbers("row", np.arange(1, n + 1)))]

    return Opened((Table(source, columns, load),), config)
