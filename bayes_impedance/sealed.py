"""Arrays in a file of safetensors that tells when it was changed, and what it is of."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from bayes_impedance.log import digest
from bayes_impedance.outputs import whole_file

#: Under which the header of a file of safetensors keeps strings of ours.
METADATA = "__metadata__"
DIGEST = "digest"

Arrays = dict[str, NDArray[np.generic]]


class DamagedFileError(ValueError):
    """A file is not what was written."""


def write_sealed(path: Path, arrays: Mapping[str, NDArray[np.generic]], about: Mapping[str, str]) -> None:
    """Write arrays, what they are `about`, and a digest of both, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    contiguous = {name: np.array(values, order="C") for name, values in arrays.items()}
    with whole_file(path) as temporary:
        temporary.write_bytes(save(contiguous, {**about, DIGEST: digest(about, contiguous)}))


def read_sealed(path: Path) -> tuple[Arrays, dict[str, str]]:
    """What `write_sealed` wrote.

    Raises:
        OSError: there is no such file, or it cannot be read.
        DamagedFileError: it is not what was written.
    """
    content = path.read_bytes()
    try:
        arrays, about = load(content), _metadata(content)
        whole = about.pop(DIGEST, None) == digest(about, arrays)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DamagedFileError(str(path)) from error
    if not whole:
        raise DamagedFileError(str(path))
    return arrays, about


def _metadata(content: bytes) -> dict[str, str]:
    length = int.from_bytes(content[:8], "little")
    return dict(json.loads(content[8 : 8 + length])[METADATA])
