"""Bounds on what a corrupt file can make the library rosbags reserve: no read beyond the file, no endless chunk."""

from __future__ import annotations

import bz2
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap

#: Largest chunk, unpacked [byte]; recorders close a chunk at about a megabyte, or after one large message.
LARGEST_CHUNK = 1 << 28
STEP = 1 << 20


class _BoundedFile(io.BufferedReader):
    """A file of which no more is read than there is: Python reserves what it is asked for, before it reads."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.end = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """At most `size` bytes, or all that remain."""
        remaining = max(0, self.end - self.tell())
        return super().read(remaining if size is None or not 0 <= size <= remaining else size)


class BoundedPath(type(Path())):  # type: ignore[misc]
    """A path, and the paths within it, of whose files no more is read than there is."""

    def open(self, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        """As `Path.open`."""
        return _BoundedFile(self) if mode == "rb" else super().open(mode, *arguments, **options)

    def __format__(self, _: str) -> str:
        """As in a URI, which rosbags makes of it to open SQLite; there # and ? would end the path."""
        return quote(str(self))


def unpack(decompressor: Any, data: bytes) -> bytes:
    """`data` unpacked piece by piece, for the size that it claims may be anything.

    `decompressor` has the interface of `bz2.BZ2Decompressor`, which those of LZ4 and Zstandard share.
    """
    parts = []
    total = 0
    while not decompressor.eof:
        parts.append(decompressor.decompress(data, max_length=STEP))
        data = b""
        total += len(parts[-1])
        if total > LARGEST_CHUNK:
            raise ValueError(f"a chunk that unpacks to more than {LARGEST_CHUNK >> 20} MB")
        if not parts[-1] and decompressor.needs_input:
            raise ValueError("a compressed chunk that ends too early")
    return b"".join(parts)


def bound_chunks() -> None:
    """Unpack the chunks of all bags by `unpack`: rosbags itself reserves the size that a chunk claims."""
    makers: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": LZ4FrameDecompressor,
        "zstd": storage_mcap.zstd.ZstdDecompressor,
    }
    for table in (rosbag1.decompressors, storage_mcap.DECOMPRESSORS):
        for name in table.keys() & makers.keys():
            table[name] = lambda data, *_, make=makers[name]: unpack(make(), data)
