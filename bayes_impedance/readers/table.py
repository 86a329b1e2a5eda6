"""What every format opens as: named columns, loaded when they are known to be wanted."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import Array, RowNumbers


@dataclass(frozen=True)
class Stream:
    """Samples that share their time stamps: a table, or the messages of a topic.

    `columns` `(n,)` each; `sent` and `received` `(n,)` [s]: stamp of the sender and time of arrival of messages,
    counted from one origin for all streams of a file; None where time is a column.
    """

    name: str
    columns: Mapping[str, pd.Series[Any]]
    rows: RowNumbers
    sent: Array | None = None
    received: Array | None = None


@dataclass(frozen=True)
class Table:
    """A recording opened as far as the names of its columns.

    `load(names, labels)` reads columns, those in `labels` as text, a stream for each set of time stamps. `trial`: its
    name where a file holds several recordings (a group of HDF5, an element of a MATLAB array). `timed`: streams carry
    the stamps of their messages, so that no column tells the time. `absent`: what to say of quantities that were sought
    in vain, where the reader knows better than that a column lacks.
    """

    source: str
    columns: tuple[str, ...]
    load: Callable[[Sequence[str], Collection[str]], list[Stream]]
    trial: str | None = None
    timed: bool = False
    absent: Mapping[str, LogError] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """How errors name the recording."""
        return self.source if self.trial is None else f"{self.source}, trial {self.trial!r}"


@dataclass(frozen=True)
class Opened:
    """A file as its recordings, and the configuration with the columns that were found where it named none."""

    tables: tuple[Table, ...]
    config: LogConfig
