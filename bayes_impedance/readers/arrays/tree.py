"""A tree of named arrays: which columns its arrays make, and in which of its branches the recordings lie."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import AXES
from bayes_impedance.readers.columns import of_axis

Selection: TypeAlias = tuple[slice, ...]
Values: TypeAlias = npt.NDArray[Any]

#: More columns than this in one array are no vector but an image.
MOST_COLUMNS = 32
#: More arrays than this in one file are no recording; links and references can make them without end.
MOST_ARRAYS = 100_000
#: Text of any length.
TEXT = np.dtype(np.str_)


@dataclass(frozen=True)
class Leaf:
    """An array that is not read yet; `read(selection)` reads a part, and takes `cost` bytes besides it."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[Selection], Values]
    cost: int = 0


Tree: TypeAlias = "dict[str, Tree | Leaf]"


class Elements(dict[str, Any]):
    """The elements of a struct or cell array, named 1, 2, …"""


class Column(NamedTuple):
    """`component` of an array whose dimension `axis` counts samples; None: not to be told, or but one component."""

    leaf: Leaf
    component: int | None = None
    axis: int | None = 0

    @property
    def length(self) -> int:
        """Number of samples."""
        return self.leaf.shape[self.axis or 0] if self.leaf.shape else 1


def branch(
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    read: Callable[[tuple[str, ...], Selection], Values],
    cost: int = 0,
    fields: tuple[str, ...] = (),
) -> Tree | Leaf:
    """A leaf, or a tree of the fields of a structured array, which `read(fields, selection)` reads."""
    # MATLAB's complex numbers.
    if dtype.names is None or dtype.names == ("real", "imag"):
        kind = dtype if dtype.names is None else np.dtype(np.complex128)
        return Leaf(shape, kind, lambda selection: read(fields, selection), cost)
    return {
        name: branch(shape + dtype[name].shape, dtype[name].base, read, cost, (*fields, name))
        for name in dtype.names
    }


def count_array(so_far: int, source: str) -> int:
    """One more than `so_far`.

    Raises:
        LogError: that is beyond all recordings.
    """
    if so_far >= MOST_ARRAYS:
        raise LogError(
            f"{source}: expected at most {MOST_ARRAYS} arrays and groups in a file, found more; split the file"
        )
    return so_far + 1


def leaves(tree: Tree, path: str = "") -> Iterator[tuple[str, Leaf]]:
    """Every array of a tree with its path."""
    for name, child in tree.items():
        if isinstance(child, Leaf):
            yield path + name, child
        else:
            yield from leaves(child, f"{path}{name}/")


def at(tree: Tree, path: str) -> Tree | Leaf | None:
    """What lies at a path, None where nothing does."""
    inner: Tree | Leaf | None = tree
    for name in filter(None, path.split("/")):
        inner = inner.get(name) if isinstance(inner, dict) else None
    return inner


# --- columns -------------------------------------------------------------------------------------


def columns_of(tree: Tree, config: LogConfig) -> dict[str, Column]:
    """Columns of all arrays of a recording."""
    lengths = _lengths(tree, config)
    return {
        name: column for path, leaf in leaves(tree) for name, column in _spread(path, leaf, lengths).items()
    }


def _spread(path: str, leaf: Leaf, lengths: set[int]) -> dict[str, Column]:
    """Columns of an array: one of its own name for a vector, `name[0]`, … for a matrix."""
    shape = leaf.shape
    if leaf.dtype.kind == "V" or len(shape) > 2:
        return {}
    if len(shape) < 2:
        return {path: Column(leaf)}
    axis = _samples_axis(shape, lengths)
    width = shape[1 - (axis or 0)]
    if width > MOST_COLUMNS:
        return {}
    columns = {f"{path}[{index}]": Column(leaf, index, axis) for index in range(width)}
    # In MATLAB every vector is a matrix.
    return {path: Column(leaf, 0, axis or 0)} | columns if min(shape) <= 1 else columns


def _samples_axis(shape: tuple[int, ...], lengths: set[int]) -> int | None:
    """Dimension that counts samples: as many as there are times, else the longer one; None: not to be told."""
    if 0 in shape:
        return shape.index(0)
    if shape[0] == shape[1]:
        return 0 if shape == (1, 1) else None
    timed = [axis for axis in (0, 1) if shape[axis] in lengths]
    return timed[0] if len(timed) == 1 else int(np.argmax(shape))


def _lengths(tree: Tree, config: LogConfig) -> set[int]:
    """Numbers of time stamps that a recording has."""
    found = (at(tree, path) for path in (config.columns.time, config.columns.force_time) if path)
    return {
        max(leaf.shape, default=1)
        for leaf in found
        if isinstance(leaf, Leaf) and len(leaf.shape) - leaf.shape.count(1) <= 1
    }


def _resolves(tree: Tree, config: LogConfig) -> bool:
    """Whether a branch holds a column of position of the name that is configured."""
    lengths = _lengths(tree, config)
    for axis in config.axes or AXES:
        name = of_axis(config.columns.position, axis)
        for path in (name, re.sub(r"\[\d+\]$", "", name)):
            leaf = at(tree, path)
            column = _spread(path, leaf, lengths).get(name) if isinstance(leaf, Leaf) else None
            # A single number is a setting.
            if column is not None and column.length != 1:
                return True
    return False


# --- recordings ----------------------------------------------------------------------------------


def recordings(tree: Tree, config: LogConfig) -> dict[str | None, Tree]:
    """Branches that are recordings, by the part of their path that tells them apart; None: the whole tree."""
    found = dict(_recordings(tree, config, ()))
    return {_short(path, found): branch for path, branch in found.items()}


def _recordings(
    tree: Tree, config: LogConfig, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Tree]]:
    """Outermost branches that hold a position, so that `log.root` reaches whatever lies deeper."""
    if _resolves(tree, config):
        yield path, tree
        return
    aligned = {key: part for key, part in _aligned(tree).items() if _resolves(part, config)}
    if aligned:
        yield from (((*path, key), part) for key, part in aligned.items())
        return
    for key, child in tree.items():
        if isinstance(child, dict):
            yield from _recordings(child, config, (*path, key))


def _aligned(tree: Tree) -> dict[str, Tree]:
    """Cell arrays side by side, as in `pos{3}` and `force{3}`: a branch for each index."""
    cells = {name: child for name, child in tree.items() if isinstance(child, Elements)}
    others = {name: child for name, child in tree.items() if isinstance(child, Leaf)}
    indices = dict.fromkeys(index for elements in cells.values() for index in elements)
    return {
        index: others | {name: elements[index] for name, elements in cells.items() if index in elements}
        for index in indices
    }


def _short(path: tuple[str, ...], paths: Iterable[tuple[str, ...]]) -> str | None:
    namesakes = [other for other in paths if other[-1:] == path[-1:]]
    depth = 1
    while len({other[-depth:] for other in namesakes}) < len(namesakes):
        depth += 1
    return "/".join(path[-depth:]) or None
