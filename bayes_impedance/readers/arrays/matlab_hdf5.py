"""MATLAB 7.3: HDF5 in which cells and struct arrays are references, and matrices stand transposed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bayes_impedance.readers.arrays.hdf5 import array_of
from bayes_impedance.readers.arrays.tree import TEXT, Elements, Leaf, Selection, Tree, Values, count_array

#: Deeper than any struct; references can go round in circles.
DEEPEST = 16


def tree_of(file: Path, source: str) -> Tree:
    """The variables of a MATLAB file of version 7.3."""
    with h5py.File(file, "r") as opened:
        return _Variables(file, source, opened).struct(opened, 0)


class _Variables:
    """Follows groups and references and counts what it meets."""

    def __init__(self, file: Path, source: str, opened: h5py.File) -> None:
        self.file = file
        self.source = source
        self.opened = opened
        self.count = 0

    def struct(self, group: h5py.Group, depth: int) -> Tree:
        """A struct, or the file: its fields by name."""
        children = {name: group.get(name) for name in group if not name.startswith("#")}
        if children and all(_refers(child) and not _class(child) for child in children.values()):
            return self.struct_array(children, depth)
        found = {name: self.value(child, depth + 1) for name, child in children.items()}
        return {name: value for name, value in found.items() if value is not None}

    def struct_array(self, fields: dict[str, h5py.Dataset], depth: int) -> Tree:
        """Elements of a struct array, each field of which refers to as many values."""
        elements = Elements()
        for name, dataset in fields.items():
            for index, value in enumerate(self.referred(dataset, depth), start=1):
                element = elements.setdefault(str(index), {})
                if value is not None:
                    element[name] = value
        return elements

    def value(self, child: Any, depth: int) -> Tree | Leaf | None:
        """A variable, field or cell; None where it is empty or no array."""
        self.count = count_array(self.count, self.source)
        if depth > DEEPEST or not isinstance(child, (h5py.Group, h5py.Dataset)):
            return None
        if isinstance(child, h5py.Group):
            return self.struct(child, depth)
        if "MATLAB_empty" in child.attrs:
            return None
        if _class(child) == "char":
            return Leaf(child.shape[1:], TEXT, self.characters(child))
        if not _refers(child):
            return _transposed(array_of(self.file, child))
        if self.holds_text(child):
            return Leaf((child.size,), TEXT, self.texts(child))
        cells = enumerate(self.referred(child, depth), start=1)
        return Elements({str(index): value for index, value in cells if value is not None})

    def referred(self, dataset: h5py.Dataset, depth: int) -> list[Tree | Leaf | None]:
        # In the order of MATLAB's linear index, for the matrix stands transposed.
        count_array(self.count + dataset.size - 1, self.source)
        return [self.value(self.opened[reference], depth + 1) for reference in dataset[()].ravel()]

    def holds_text(self, cells: h5py.Dataset) -> bool:
        """Whether the first cell is text."""
        first = self.opened[cells[(0,) * cells.ndim]]
        return isinstance(first, h5py.Dataset) and _class(first) == "char"

    def characters(self, dataset: h5py.Dataset) -> Any:
        reference = dataset.ref

        def read(selection: Selection) -> Values:
            with h5py.File(self.file, "r") as opened:
                return np.array(_texts(opened[reference]), dtype=object)[selection]

        return read

    def texts(self, cells: h5py.Dataset) -> Any:
        reference = cells.ref

        def read(selection: Selection) -> Values:
            with h5py.File(self.file, "r") as opened:
                found = (opened[inner] for inner in opened[reference][()].ravel())
                texts = ["".join(_texts(cell)) if _class(cell) == "char" else "" for cell in found]
            return np.array(texts, dtype=object)[selection]

        return read


def _transposed(array: Tree | Leaf) -> Tree | Leaf:
    if not isinstance(array, Leaf):
        return {name: _transposed(field) for name, field in array.items()}
    return Leaf(array.shape[::-1], array.dtype, lambda selection: array.read(selection[::-1]).T, array.cost)


def _texts(dataset: h5py.Dataset) -> list[str]:
    """Rows of a matrix of characters, which stand as UTF-16."""
    if "MATLAB_empty" in dataset.attrs:
        return [""]
    rows = np.atleast_2d(dataset[()].T).astype("<u2")
    return [row.tobytes().decode("utf-16-le", "replace").rstrip() for row in rows]


def _class(child: Any) -> str:
    """MATLAB's class of a variable, empty where none is given."""
    name = child.attrs.get("MATLAB_class", b"") if isinstance(child, (h5py.Group, h5py.Dataset)) else b""
    return name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name)


def _refers(child: Any) -> bool:
    return isinstance(child, h5py.Dataset) and h5py.check_ref_dtype(child.dtype) is not None
