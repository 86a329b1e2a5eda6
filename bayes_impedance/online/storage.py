"""A predictor's state in one file: what cells have learned, to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.engines.local.cell import Cell, Sums
from bayes_impedance.engines.local.model import LocalModel
from bayes_impedance.errors import OutputError
from bayes_impedance.log import digest
from bayes_impedance.sealed import DamagedFileError, read_sealed, write_sealed

Arrays = Mapping[str, NDArray[Any]]


def state_of(local: LocalModel, scalars: Arrays) -> dict[str, NDArray[Any]]:
    """A copy of what `local` has learned, with `scalars` beside it."""
    codes = list(local.cells)
    arrays: dict[str, NDArray[Any]] = {f"scalar.{name}": values for name, values in scalars.items()}
    arrays["codes"] = np.array(codes, dtype=np.int64)
    for kind, known, fields in (("cell", local.cells, Cell._fields), ("sums", local.sums, Sums._fields)):
        for name in fields:
            values = [getattr(known[code], name) for code in codes]
            arrays[f"{kind}.{name}"] = np.stack(values) if values else np.zeros(0)
    return arrays


def write_state(path: Path, state: Arrays, local: LocalModel, group: str) -> None:
    """Write what `state_of` copied, of a group.

    Raises:
        OutputError: the file cannot be written.
    """
    write_sealed(path, state, {"model": fingerprint(local), "group": group})


def read_state(path: Path, local: LocalModel, group: str) -> dict[str, NDArray[Any]]:
    """Give `local`, which has learned nothing, what `write_state` wrote; the scalars beside it.

    Raises:
        OutputError: the file lacks, is damaged, or is of another model or group.
    """
    try:
        arrays, about = read_sealed(path)
    except OSError as error:
        raise OutputError(
            f"{path}: expected the state of a predictor, got: {error.strerror}; name the file that save wrote"
        ) from error
    except DamagedFileError as error:
        raise OutputError(
            f"{path}: expected the state of a predictor, found a damaged or another file; restore it, or begin anew "
            "from the model"
        ) from error
    if about != {"model": fingerprint(local), "group": group}:
        raise OutputError(
            f"{path}: expected the state of a predictor of this model, group and engine.local, found that of another; "
            "resume it with those that it was begun with"
        )
    for i, code in enumerate(arrays["codes"].tolist()):
        local.cells[code] = Cell(*(arrays[f"cell.{name}"][i].copy() for name in Cell._fields))
        local.sums[code] = Sums(*(arrays[f"sums.{name}"][i].copy() for name in Sums._fields))
    return {
        name.removeprefix("scalar."): values for name, values in arrays.items() if name.startswith("scalar.")
    }


def fingerprint(local: LocalModel) -> str:
    """Of hyperparameters, grid and settings."""
    numbers = {f"numbers.{name}": np.asarray(values) for name, values in local.numbers._asdict().items()}
    grid = {f"grid.{name}": values for name, values in local.grid._asdict().items()}
    return digest(local.settings.model_dump(mode="json"), {**numbers, **grid, "noise": local.noise})
