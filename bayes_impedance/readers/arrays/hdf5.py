"""HDF5: groups of arrays."""

from __future__ import annotations

import math
import mmap
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bayes_impedance.config import LogConfig
from bayes_impedance.readers.arrays.tables import LARGEST, broken_file, open_arrays
from bayes_impedance.readers.arrays.tree import TEXT, Leaf, Selection, Tree, Values, branch, count_array
from bayes_impedance.readers.table import Opened

EXPECTED = "an HDF5 file"
OPAQUE = np.dtype("V8")
#: Signature and version of a heap that holds text of variable length.
HEAP = b"GCOL\x01\0\0\0"


def open_hdf5(file: Path, source: str, config: LogConfig) -> Opened:
    """The recordings in the groups of an HDF5 file.

    Raises:
        LogError: it is none, is truncated, or holds no position.
    """
    # What the disk refuses is no fault of the format.
    file.open("rb").close()
    with broken_file(source, EXPECTED), h5py.File(file, "r") as opened:
        tree = _Groups(file, source).tree(opened)
    return open_arrays(tree, source, config, EXPECTED)


class _Groups:
    """Walks down the groups of a file and counts what it meets."""

    def __init__(self, file: Path, source: str) -> None:
        self.file = file
        self.source = source
        self.count = 0

    def tree(self, group: h5py.Group, above: tuple[h5py.Group, ...] = ()) -> Tree:
        tree: Tree = {}
        for name in group:
            self.count = count_array(self.count, self.source)
            link = group.get(name, getlink=True)
            child = None if isinstance(link, h5py.ExternalLink) else group.get(name)
            if isinstance(child, h5py.Dataset):
                tree[name] = array_of(self.file, child)
            # A second name of a group would be a second recording, and may lie above.
            elif (
                isinstance(child, h5py.Group)
                and isinstance(link, h5py.HardLink)
                and child not in (*above, group)
            ):
                tree[name] = self.tree(child, (*above, group))
        return tree


def array_of(file: Path, dataset: h5py.Dataset) -> Tree | Leaf:
    """A dataset as an array that opens the file anew when it is read."""
    reference, dataset_type = dataset.ref, dataset.dtype

    def read(fields: tuple[str, ...], selection: Selection) -> Values:
        with h5py.File(file, "r") as opened:
            values: Any = opened[reference]
            if dataset_type.hasobject:
                _check_texts(file, values)
            if not fields:
                return np.asarray(values[selection])
            values = values.fields(fields[0])[()]
        for field in fields[1:]:
            values = values[field]
        return np.asarray(values[selection])

    # A chunk is read and unpacked as a whole.
    cost = math.prod(dataset.chunks or (0,)) * dataset_type.itemsize
    return branch(dataset.shape or (), _type(dataset_type), read, cost)


def _type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Text of any kind as one; what is neither number nor text, such as references, as opaque."""
    if dtype.names is not None:
        return np.dtype([(name, _type(dtype[name])) for name in dtype.names])
    if h5py.check_string_dtype(dtype):
        return TEXT
    return OPAQUE if dtype.hasobject else dtype


def _check_texts(file: Path, dataset: h5py.Dataset) -> None:
    """HDF5 takes memory for a text as long as declared, and never returns from a heap that is out of order."""
    with file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        start = data.find(HEAP)
        while start >= 0:
            _check_heap(data, start)
            start = data.find(HEAP, start + 1)
        offset = dataset.id.get_offset()
        if offset is not None and dataset.dtype.names is None:
            # Length (4 bytes), and where in which heap the text lies (12 bytes).
            lengths = np.frombuffer(data, "<u4", 4 * dataset.size, offset)[::4].astype(np.int64)
            total, largest = int(lengths.sum()), int(lengths.max(initial=0))
            del lengths
            if largest > len(data) or total > LARGEST:
                raise ValueError("the lengths of its texts are damaged")


def _check_heap(data: mmap.mmap, start: int) -> None:
    at, end = start + 16, start + int.from_bytes(data[start + 8 : start + 16], "little")
    damaged = end > len(data)
    while at + 16 <= end and not damaged:
        index, size = data[at : at + 2], int.from_bytes(data[at + 8 : at + 16], "little")
        # Object 0 is the free space, whose size includes its head.
        at += size if index == b"\0\0" else 16 + -(-size // 8) * 8
        damaged = at > end or (index == b"\0\0" and size < 16)
    if damaged:
        raise ValueError("the sizes of its texts are damaged")
