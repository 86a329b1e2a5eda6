"""Files of named arrays: the recordings in a tree of arrays as tables."""

from __future__ import annotations

import difflib
import warnings
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from bayes_impedance.config import LogConfig
from bayes_impedance.errors import LogError
from bayes_impedance.log import AXES, RowNumbers
from bayes_impedance.readers.arrays.tree import Column, Leaf, Tree, Values, at, columns_of, leaves, recordings
from bayes_impedance.readers.cells import brief
from bayes_impedance.readers.columns import of_axis
from bayes_impedance.readers.table import Opened, Stream, Table

#: Bytes of one file that are read: 500 million numbers, a day of six columns at 1 kHz.
LARGEST = 4 * 2**30


@contextmanager
def broken_file(source: str, expected: str) -> Iterator[None]:
    """Whatever a library makes of a file that is not what it claims to be, as one error.

    Raises:
        LogError: the library raised something.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        except LogError:
            raise
        # Damaged files end in errors of every kind, from struct.error to SystemError.
        except Exception as error:
            raise LogError(
                f"{source}: expected {expected}, found one that is truncated or something else ({brief(error)}); "
                "save it anew, or rename it by its format"
            ) from error


def open_arrays(tree: Tree, source: str, config: LogConfig, expected: str) -> Opened:
    """A table for each recording in a tree of arrays; `expected` names the format.

    Raises:
        LogError: there is no array, or nothing at `log.root`.
    """
    if not any(True for _ in leaves(tree)):
        raise LogError(
            f"{source}: expected named arrays, found none; save matrices, or structs or groups of them"
        )
    root = at(tree, config.root or "")
    if not isinstance(root, dict):
        raise LogError(
            f"{source}: expected a group or struct {config.root!r}, found {_listed(tree)}; mend log.root"
        )
    keyed = recordings(root, config)
    budget: dict[str | None, int] = {}
    if not keyed:
        # Whoever inspects the file wants to see what it holds all the same.
        table = _table(root, None, source, config, expected, budget)
        lacking = {"position": _positionless(root, source, config)}
        return Opened((replace(table, absent=lacking),), config)
    whole = config.root.strip("/").split("/")[-1] if config.root else None
    return Opened(
        tuple(
            _table(branch, key or whole, source, config, expected, budget) for key, branch in keyed.items()
        ),
        config,
    )


def _table(
    tree: Tree,
    trial: str | None,
    source: str,
    config: LogConfig,
    expected: str,
    budget: dict[str | None, int],
) -> Table:
    columns = columns_of(tree, config)
    where = source if trial is None else f"{source}, trial {trial!r}"
    leading = {of_axis(config.columns.position, axis) for axis in AXES}

    def load(names: Sequence[str], labels: Collection[str]) -> list[Stream]:
        wanted = {name: columns[name] for name in names}
        for name, column in wanted.items():
            _check(where, name, column)
        spans = _spans(wanted)
        _check_size(where, spans, budget, trial)
        series: dict[str, Any] = {}
        for (leaf, axis), (low, high) in spans.items():
            with broken_file(where, expected):
                block = _block(leaf, axis, low, high)
            for name, column in wanted.items():
                if (column.leaf, column.axis) == (leaf, axis):
                    series[name] = _cells(block[:, (column.component or 0) - low])
        return _streams({name: series[name] for name in names}, labels, leading)

    return Table(source, tuple(columns), load, trial)


def _check(where: str, name: str, column: Column) -> None:
    leaf = column.leaf
    if column.axis is None:
        raise LogError(
            f"{where}, column {name!r}: expected an array with more samples than columns, found shape {leaf.shape}, "
            "which does not tell the samples from the columns; save a column as an array of its own"
        )
    if column.length == 0:
        raise LogError(
            f"{where}, column {name!r}: expected samples, found an array of shape {leaf.shape}; leave the recording "
            "out with log.root, or save it anew"
        )
    if leaf.dtype.kind == "c":
        raise LogError(
            f"{where}, column {name!r}: expected real numbers, found complex ones; save the real part"
        )
    if leaf.dtype.kind == "O":
        raise _pickled(where, name)


def _spans(wanted: Mapping[str, Column]) -> dict[tuple[Leaf, int | None], tuple[int, int]]:
    """First and last component, exclusive, that is wanted of each array."""
    components: dict[tuple[Leaf, int | None], list[int]] = defaultdict(list)
    for column in wanted.values():
        components[column.leaf, column.axis].append(column.component or 0)
    return {key: (min(indices), max(indices) + 1) for key, indices in components.items()}


def _check_size(
    where: str,
    spans: Mapping[tuple[Leaf, int | None], tuple[int, int]],
    budget: dict[str | None, int],
    trial: str | None,
) -> None:
    """Before anything is read, for a file of a few bytes can declare arrays of any size."""
    budget[trial] = sum(
        leaf.cost + (leaf.shape[axis or 0] if leaf.shape else 1) * (high - low) * 8
        for (leaf, axis), (low, high) in spans.items()
    )
    if sum(budget.values()) > LARGEST:
        raise LogError(
            f"{where}: expected at most {LARGEST / 2**30:g} GB in the columns of a file, found arrays that are "
            f"declared to take {sum(budget.values()) / 2**30:.3g} GB; split the recording, or check the file"
        )


def _block(leaf: Leaf, axis: int | None, low: int, high: int) -> Values:
    """Components `low` to `high` of an array as `(n, c)`."""
    if len(leaf.shape) < 2:
        return leaf.read((slice(None),) * len(leaf.shape)).reshape(-1, 1)
    if axis == 0:
        return leaf.read((slice(None), slice(low, high)))
    return leaf.read((slice(low, high), slice(None))).T


def _cells(values: Values) -> pd.Series[Any]:
    """A column; what is neither number nor text is for the checks of cells to refuse."""
    if values.dtype.kind in "iuf":
        # A copy, so that the block it comes from can go.
        return pd.Series(np.array(values, dtype=np.float64, order="C"))
    if values.dtype.kind in "SUO":
        # Samples of one label share its text.
        distinct, codes = np.unique(values, return_inverse=True)
        texts = [
            value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value) for value in distinct
        ]
        return pd.Series(np.array(texts, dtype=object)[codes])
    return pd.Series(values.copy())


def _streams(
    series: Mapping[str, pd.Series[Any]], labels: Collection[str], leading: Collection[str]
) -> list[Stream]:
    """Columns of one length share a stream; a label that stands there once holds for every position."""
    length = next((len(column) for name, column in series.items() if name in leading), 1)
    parts: dict[int, dict[str, pd.Series[Any]]] = defaultdict(dict)
    for name, column in series.items():
        if name in labels and len(column) == 1:
            column = pd.Series([column.iloc[0]] * length, dtype=column.dtype)
        parts[len(column)][name] = column
    return [
        Stream("" if len(parts) == 1 else next(iter(part)), part, RowNumbers("row", np.arange(1, n + 1)))
        for n, part in parts.items()
    ]


# --- sentences -----------------------------------------------------------------------------------


def _positionless(tree: Tree, source: str, config: LogConfig) -> LogError:
    name = of_axis(config.columns.position, (config.axes or AXES)[0])
    pickled = next((path for path, leaf in leaves(tree) if leaf.dtype.kind == "O"), None)
    if pickled is not None:
        return _pickled(source, pickled)
    # A name in the configuration is relative to the recording, so every end of a path is a candidate.
    ends: dict[str, str] = {}
    for path in list(columns_of(tree, config))[:2000]:
        parts = path.split("/")
        for start in range(len(parts)):
            end = "/".join(parts[start:])
            ends.setdefault(end.lower(), end)
    near = difflib.get_close_matches(name.lower(), ends, n=1, cutoff=0.3)
    nearest = f"the nearest is {ends[near[0]]!r}; " if near else ""
    return LogError(
        f"{source}: expected column {name!r} in the file or in one of its groups, found none of that name "
        f"({nearest}there is {_listed(tree)}); set log.columns.position to the path within a recording"
    )


def _pickled(where: str, name: str) -> LogError:
    return LogError(
        f"{where}: expected numbers or text, found Python objects in {name!r}, which are not read, for "
        "that would run code from the file; save plain arrays"
    )


def _listed(tree: Tree) -> str:
    found = list(leaves(tree))
    shown = ", ".join(f"{path[:60]} {leaf.shape}" for path, leaf in found[:5])
    return (shown or "nothing") + (", …" if len(found) > 5 else "")
