"""ROS 1 `.bag`, ROS 2 `.db3` and `.mcap`, and the folder that ROS 2 records into."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import AXES, Array, RowNumbers
from bayes_impedance.readers.bags.bag import Bag, Topic, read_bag
from bayes_impedance.readers.bags.layout import Decoder, MalformedError
from bayes_impedance.readers.bags.topics import name_columns
from bayes_impedance.readers.columns import of_axis
from bayes_impedance.readers.table import Opened, Stream, Table

#: Messages that are decoded at once, and the bytes of them that are held until then.
BATCH, BATCH_BYTES = 1024, 1 << 22
STAMP = ("header.stamp.sec", "header.stamp.nanosec")


def open_messages(file: Path, source: str, config: LogConfig) -> Opened:
    """A bag: every number in a message is a column, such as /ft.wrench.force.x.

    Raises:
        LogError: it is damaged, or holds no topic that is named or sought.
    """
    bag = read_bag(file, source)
    config, absent = name_columns(bag, config)
    columns = [
        f"{topic.name}.{path}"
        for topic in bag.topics.values()
        if topic.layout
        for path in topic.layout.columns()
    ]
    columns += [name for name in _stated(config) if _is_in_empty_array(bag, name)]

    def load(names: Sequence[str], _: Collection[str]) -> list[Stream]:
        wanted: dict[str, dict[str, str]] = {}
        for name in names:
            topic, _dot, path = name.partition(".")
            wanted.setdefault(topic, {})[name] = path
        gathered = {topic: _Gathered(bag, bag.topics[topic], paths) for topic, paths in wanted.items()}
        for topic, time, raw in bag.messages(gathered):
            gathered[topic].add(time, raw)
        return [topic.stream() for topic in gathered.values()]

    return Opened((Table(source, tuple(columns), load, timed=True, absent=absent),), config)


def _stated(config: LogConfig) -> list[str]:
    """Every column that the configuration may mean."""
    values = [value for _, value in config.columns if value is not None]
    names = [name for value in values for name in (value if isinstance(value, tuple) else (value,))]
    return list(dict.fromkeys(of_axis(name, axis) for name in names for axis in AXES))


def _is_in_empty_array(bag: Bag, name: str) -> bool:
    """Whether a column is of an array that is empty in the first message: whether others fill it is seen later."""
    topic, _, path = name.partition(".")
    layout = bag.topics[topic].layout if topic in bag.topics else None
    array = layout.fields.get(path.rpartition("[")[0]) if layout else None
    return array is not None and array.count == 0


@dataclass
class _Gathered:
    """The wanted numbers of a topic; of the messages themselves no more than a batch."""

    bag: Bag
    topic: Topic
    paths: dict[str, str]
    times: list[int] = field(default_factory=list)
    raws: list[bytes] = field(default_factory=list)
    size: int = 0
    received: list[npt.NDArray[np.int64]] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)
    present: list[npt.NDArray[np.bool_]] = field(default_factory=list)

    def __post_init__(self) -> None:
        assert self.topic.definitions is not None
        wanted = [*self.paths.values(), *STAMP]
        self.decoder = Decoder(self.topic.kind, self.topic.definitions, self.bag.cdr, wanted)

    @property
    def where(self) -> str:
        return f"{self.bag.source}, topic {self.topic.name!r}"

    def add(self, time: int, raw: bytes) -> None:
        self.times.append(time - self.bag.origin)
        self.raws.append(raw)
        self.size += len(raw)
        if len(self.raws) == BATCH or self.size > BATCH_BYTES:
            self._decode()

    def stream(self) -> Stream:
        """All messages, once they are added."""
        self._decode()
        values, present = np.concatenate(self.values, axis=1), np.concatenate(self.present, axis=1)
        n = values.shape[1]
        for path, there in zip(self.paths.values(), present, strict=False):
            if not there.all():
                absent = np.flatnonzero(~there)
                raise LogError(
                    f"{self.where}: expected {path} in every message, found an array without it in "
                    f"{len(absent)} of {n} messages, first in message {absent[0] + 1}; name another field in "
                    "log.columns, or record the topic anew"
                )
        received = np.concatenate(self.received)
        columns = {name: pd.Series(row) for name, row in zip(self.paths, values, strict=False)}
        rows = RowNumbers("message", np.arange(1, n + 1))
        return Stream(self.topic.name, columns, rows, self._sent(values, present), received / 1e9)

    def _sent(self, values: Array, present: npt.NDArray[np.bool_]) -> Array | None:
        """Stamps of the headers [s]; None without, or where nobody set them."""
        seconds, nanoseconds = values[-2:]
        if not present[-2:].all() or not (seconds.any() or nanoseconds.any()):
            return None
        # Whole nanoseconds, for in float64 those of today are 200 ns apart.
        stamps = seconds.astype(np.int64) * 10**9 + nanoseconds.astype(np.int64)
        return (stamps - self.bag.origin) / 1e9

    def _decode(self) -> None:
        if not self.raws:
            return
        try:
            values, present = self.decoder.decode(self.raws)
        except MalformedError as error:
            number = sum(map(len, self.received)) + error.args[1] + 1
            raise LogError(
                f"{self.where}, message {number}: expected a {self.topic.kind}, found {error.args[0]}; repair the "
                "bag, or record it anew"
            ) from error
        self.values.append(values)
        self.present.append(present)
        self.received.append(np.array(self.times, dtype=np.int64))
        self.times, self.raws, self.size = [], [], 0
