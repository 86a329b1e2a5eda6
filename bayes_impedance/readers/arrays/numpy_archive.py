"""NumPy archives of arrays, .npz; a slash in a name makes a group."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.readers.arrays.tables import broken_file, open_arrays
from bayes_impedance.readers.arrays.tree import Leaf, Selection, Tree, Values, branch, count_array
from bayes_impedance.readers.table import Opened

EXPECTED = "a NumPy archive"


def open_npz(file: Path, source: str, config: LogConfig) -> Opened:
    """The recordings in a NumPy archive; nothing pickled is read.

    Raises:
        LogError: it is none, is truncated, or holds no position.
    """
    tree: Tree = {}
    count = 0
    with file.open("rb") as stream, broken_file(source, EXPECTED), zipfile.ZipFile(stream) as archive:
        for member in archive.infolist():
            if member.filename.endswith(".npy"):
                count = count_array(count, source)
                _put(tree, member.filename.removesuffix(".npy"), _array(file, archive, member), source)
    return open_arrays(tree, source, config, EXPECTED)


def _array(file: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Tree | Leaf:
    """The array of a member as far as its header."""
    with archive.open(member) as stream:
        version = npy.read_magic(stream)
        header: Any = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, _, dtype = header[version](stream)
        size = int(np.prod(shape, dtype=object)) * dtype.itemsize
        # NumPy takes memory for what the header declares before it looks for it.
        if not dtype.hasobject and size > member.file_size - stream.tell():
            raise ValueError(f"{member.filename} is shorter than its header says")

    def read(fields: tuple[str, ...], selection: Selection) -> Values:
        with np.load(file, allow_pickle=False) as arrays:
            values: Values = arrays[member.filename]
        for field in fields:
            values = values[field]
        return values[selection]

    if dtype.hasobject:
        dtype = np.dtype(object)
    return branch(shape, dtype, read, cost=size)


def _put(tree: Tree, name: str, array: Tree | Leaf, source: str) -> None:
    *groups, last = name.split("/")
    for group in groups:
        inner = tree.setdefault(group, {})
        if isinstance(inner, Leaf):
            raise _twofold(source, group)
        tree = inner
    if last in tree:
        raise _twofold(source, last)
    tree[last] = array


def _twofold(source: str, name: str) -> LogError:
    return LogError(
        f"{source}: expected names of arrays that differ from those of groups, found {name!r} twice; rename one"
    )
