"""Chains on disk as they go, so that a run that was killed continues where it stopped, with the same draws.

A folder of safetensors, one file a chain: the arrays of its state, and as metadata what is being sampled and a digest
of both.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.errors import OutputError
from bayes_impedance.outputs import prepare_folder
from bayes_impedance.sealed import DamagedFileError, read_sealed, write_sealed


@dataclass(frozen=True)
class Checkpoint:
    """States of chains in `folder`, written `every` so often [s].

    `fingerprint` says by name what is sampled: model, data, settings.

    Example:
        >>> import numpy as np
        >>> checkpoint = Checkpoint(Path("posterior.nc.unfinished"), {"model": "5f0c", "seed": "0"})
        >>> checkpoint.write(0, {"done": np.array(7)})
        >>> int(checkpoint.read(0)["done"]), checkpoint.read(1)
        (7, None)
        >>> checkpoint.remove()
    """

    folder: Path
    fingerprint: Mapping[str, str]
    every: float = 3.0

    def path(self, chain: int) -> Path:
        """File of a chain, numbered from 1 as people do."""
        return self.folder / f"chain-{chain + 1}.safetensors"

    def write(self, chain: int, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Keep the state of a chain, whole or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        prepare_folder(self.folder)
        write_sealed(self.path(chain), state, self.fingerprint)

    def read(self, chain: int) -> dict[str, NDArray[np.generic]] | None:
        """State that was kept of a chain, None where none was.

        Raises:
            OutputError: the file is damaged, cannot be read, or is of another model, other data or other settings.
        """
        path = self.path(chain)
        try:
            arrays, about = read_sealed(path)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OutputError(
                f"{path}: expected a checkpoint that can be read, got: {error.strerror}; delete it to start anew"
            ) from error
        except DamagedFileError as error:
            raise OutputError(
                f"{path}: expected the checkpoint of a chain, found a damaged file; delete it, and that chain starts "
                "anew"
            ) from error
        for name in {**self.fingerprint, **about}:
            mine, theirs = self.fingerprint.get(name), about.get(name)
            if mine != theirs:
                raise OutputError(
                    f"{path}: expected a checkpoint of what is sampled now, found one of another {name} "
                    f"({theirs or 'none'}, now {mine or 'none'}); go on with what it was started with, write to "
                    f"another --out, or delete {self.folder} to start anew"
                )
        return arrays

    def remove(self) -> None:
        """Delete the files: the draws are elsewhere by now."""
        for path in self.folder.glob("chain-*.safetensors"):
            path.unlink(missing_ok=True)
        # Whatever else somebody has put there stays.
        with contextlib.suppress(OSError):
            self.folder.rmdir()
