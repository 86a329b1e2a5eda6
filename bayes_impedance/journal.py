"""What a training has computed, kept on disk as it goes, so that one that was killed continues where it stopped.

The objective is a function of the point alone. Training looks each point up here before it computes, and appends what
it computed; the optimiser is deterministic, so the second time it walks the same path at no cost, restarts and Laplace
step included, and ends with the same bits.

The file: a line that says what it is; a line of JSON, all that the objective depends on; then records of two lengths,
a digest, the point and the values as little-endian float64. What a crash tore off the end is dropped.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import struct
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from filelock import lock_descriptor
from numpy.typing import NDArray

from bayes_impedance.errors import JournalWarning, OutputError

Array = NDArray[np.float64]

MAGIC = b"bayes_impedance training journal 1\n"
RECORD = struct.Struct("<II16s")
#: Only a power cut can take what was written and not synchronised; a kill cannot [s].
SYNC_INTERVAL = 1.0


class Journal:
    """Values of an objective by point, those of an earlier run included; open one with `open_journal`.

    Raises:
        OutputError: the file is no journal.
    """

    def __init__(self, path: Path, file: io.FileIO) -> None:
        self.path = path
        self._file: io.FileIO | None = file
        content = file.readall()
        if not (content.startswith(MAGIC) or MAGIC.startswith(content)):
            raise OutputError(
                f"{path}: expected the journal of a training, found another file; rename it, or "
                "train with another --out"
            )
        self._identity, self._known, end = _read(content)
        if not self._known:
            # Nothing is lost by beginning anew, with whatever settings.
            self._identity, end = None, 0
        file.truncate(end)
        self._synchronised = time.monotonic()

    def __len__(self) -> int:
        """Number of evaluations."""
        return len(self._known)

    def begin(self, identity: Mapping[str, Any]) -> None:
        """State, as plain JSON, what the objective depends on, and check that the journal is of the same.

        Raises:
            OutputError: the journal is of another objective, or cannot be written.
        """
        if self._identity is None:
            self._identity = dict(identity)
            try:
                self._write(MAGIC + json.dumps(self._identity).encode() + b"\n")
            except OSError as error:
                raise _unwritable(self.path, error) from error
        difference = _difference(self._identity, dict(identity))
        if difference is not None:
            raise OutputError(
                f"{self.path}: expected the journal of this training, found one of another {difference}; continue "
                "with what it was started with, or delete the file to start anew"
            )

    def find(self, point: Array) -> Array | None:
        """Values that were kept for exactly this point."""
        return self._known.get(_bits(point))

    def keep(self, point: Array, values: Array) -> None:
        """Remember `values` of the objective at `point`.

        Warns (JournalWarning), once, where the file takes no more: training goes on without it.
        """
        key, content = _bits(point), _bits(values)
        self._known[key] = values
        if self._file is None:
            return
        try:
            self._write(RECORD.pack(len(key), len(content), _digest(key + content)) + key + content)
            if time.monotonic() - self._synchronised >= SYNC_INTERVAL:
                os.fsync(self._file.fileno())
                self._synchronised = time.monotonic()
        except OSError as error:
            self.close()
            warnings.warn(
                f"{self.path}: could not be written: {error.strerror or error}; training goes on, but if it is "
                "killed, --resume loses what it computes from here on",
                JournalWarning,
                stacklevel=2,
            )

    def remove(self) -> None:
        """Delete the file: what it remembers is no longer needed."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Keep nothing on disk from here on."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, content: bytes) -> None:
        assert self._file is not None
        end = os.fstat(self._file.fileno()).st_size
        try:
            # A disk that fills up takes a part first, and only then refuses.
            rest = memoryview(content)
            while rest:
                rest = rest[self._file.write(rest) :]
        except BaseException:
            # Ctrl-C included: what would come after half a record could not be read.
            self._file.truncate(end)
            raise


@contextmanager
def open_journal(path: str | Path) -> Iterator[Journal]:
    """The journal at `path`, new where there is none; one process at a time. It vanishes if nothing was kept.

    Raises:
        OutputError: another process has it open, it cannot be written, or the file is something else.
    """
    place = Path(path)
    if place.exists() and not place.is_file():
        raise OutputError(
            f"{place}: expected the journal of a training, found a folder or device; rename it, or "
            "train with another --out"
        )
    try:
        file = place.open("a+b", buffering=0)
    except OSError as error:
        raise _unwritable(place, error) from error
    with file:
        if not _lock(file, place):
            raise OutputError(
                f"{place}: expected no other training into the same model, found one at work; wait for it, or train "
                "with another --out"
            )
        file.seek(0)
        journal = Journal(place, file)
        try:
            yield journal
        finally:
            # While it is locked, so that nobody else can have begun to use it.
            if not journal:
                journal.remove()
            journal.close()


def _lock(file: io.FileIO, path: Path) -> bool:
    # Some network drives know no locks: better without one than no training.
    with contextlib.suppress(OSError):
        if not lock_descriptor(file.fileno(), blocking=False):
            return False
    # Whoever had it before may have removed it between our opening and locking it.
    return path.exists() and os.path.samestat(path.stat(), os.fstat(file.fileno()))


def _read(content: bytes) -> tuple[dict[str, Any] | None, dict[bytes, Array], int]:
    """What the objective depends on, the values by point, and where the last whole record ends."""
    line, newline, _ = content.removeprefix(MAGIC).partition(b"\n")
    known: dict[bytes, Array] = {}
    if not newline or not content.startswith(MAGIC):
        return None, known, 0
    end = len(MAGIC) + len(line) + 1
    while len(content) >= end + RECORD.size:
        n, m, digest = RECORD.unpack_from(content, end)
        start, stop = end + RECORD.size, end + RECORD.size + n + m
        body = content[start:stop]
        if len(body) < n + m or _digest(body) != digest:
            break
        known[body[:n]] = np.frombuffer(body[n:], dtype="<f8").astype(np.float64)
        end = stop
    return json.loads(line), known, end


def _difference(theirs: Any, mine: Any, at: str = "") -> str | None:
    """The first key of nested mappings under which they differ, with both values."""
    if isinstance(theirs, dict) and isinstance(mine, dict):
        for key in {**mine, **theirs}:
            found = _difference(theirs.get(key), mine.get(key), f"{at}.{key}" if at else key)
            if found is not None:
                return found
        return None
    return None if theirs == mine else f"{at} ({theirs!r}, now {mine!r})"


def _unwritable(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{path}: could not be written: {error.strerror or error}; make room, or train with another --out"
    )


def _bits(values: Array) -> bytes:
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=16).digest()
