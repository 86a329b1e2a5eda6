"""MATLAB: variables, structs and cells, of version 4 to 7.3."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.io.matlab import MatlabFunction, MatlabOpaque, matfile_version

from bayes_impedance.config import LogConfig
from bayes_impedance.readers.arrays import matlab_hdf5
from bayes_impedance.readers.arrays.matlab_elements import check_elements
from bayes_impedance.readers.arrays.tables import broken_file, open_arrays
from bayes_impedance.readers.arrays.tree import TEXT, Elements, Leaf, Tree, Values, count_array
from bayes_impedance.readers.table import Opened

EXPECTED = "a MATLAB file"


def open_mat(file: Path, source: str, config: LogConfig) -> Opened:
    """The recordings in the variables of a MATLAB file: structs, struct arrays, cells.

    Raises:
        LogError: it is none, is truncated, or holds no position.
    """
    # What the disk refuses is no fault of the format.
    file.open("rb").close()
    with broken_file(source, EXPECTED):
        version, _ = matfile_version(file)
        if version == 2:
            tree = matlab_hdf5.tree_of(file, source)
        else:
            data = file.read_bytes()
            if version == 1:
                check_elements(data)
            # From memory, where a length beyond the end takes none.
            buffer: Any = io.BytesIO(data)
            variables = scipy.io.loadmat(buffer)
            tree = _Variables(source).struct(
                {name: value for name, value in variables.items() if not name.startswith("__")}
            )
    return open_arrays(tree, source, config, EXPECTED)


class _Variables:
    """Goes through structs and cells and counts what it meets."""

    def __init__(self, source: str) -> None:
        self.source = source
        self.count = 0

    def struct(self, fields: dict[str, Any]) -> Tree:
        found = {name: self.value(field) for name, field in fields.items()}
        return {name: value for name, value in found.items() if value is not None}

    def value(self, value: Any) -> Tree | Leaf | None:
        """A variable, field or cell; None where it is empty or no array."""
        self.count = count_array(self.count, self.source)
        plain = isinstance(value, np.ndarray) and not isinstance(value, (MatlabFunction, MatlabOpaque))
        if not plain or value.size == 0:
            return None
        # MATLAB's linear index runs down the columns.
        elements = value.ravel(order="F")
        names = value.dtype.names
        if names is not None:
            structs = [self.struct({name: element[name] for name in names}) for element in elements]
            return structs[0] if len(structs) == 1 else _numbered(structs)
        if value.dtype.kind == "O":
            return _text(elements) if _is_text(elements[0]) else _numbered(map(self.value, elements))
        return _text(elements) if _is_text(value) else _leaf(value)


def _numbered(values: Any) -> Elements:
    return Elements({str(index): value for index, value in enumerate(values, start=1) if value is not None})


def _is_text(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind == "U"


def _text(elements: Values) -> Leaf:
    texts = ["".join(np.ravel(text)) if _is_text(text) else str(text) for text in elements]
    return _leaf(np.array([text.rstrip() for text in texts], dtype=object), TEXT)


def _leaf(values: Values, dtype: np.dtype[Any] | None = None) -> Leaf:
    return Leaf(values.shape, dtype or values.dtype, lambda selection: values[selection])
