"""Whether the elements of a MATLAB file of version 5 are what scipy takes for granted.

scipy looks up types by their number without asking whether there is one, and reads on into the next element where
one has too few parts: a damaged file would end the process.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import NamedTuple

from bayes_impedance.readers.arrays.tables import LARGEST

HEADER = 128
#: Types of elements.
INT8, INT32, UINT32, MATRIX, COMPRESSED = 1, 5, 6, 14, 15
NUMBERS_OR_TEXT = {*range(1, 8), 9, 12, 13, 16, 17, 18}
#: Classes of matrices.
CELL, STRUCT, OBJECT, CHARACTERS, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
NUMERIC = range(6, 16)
COMPLEX = 0x800
#: Deeper than any struct; scipy would run out of stack.
DEEPEST = 32


class _Element(NamedTuple):
    kind: int
    start: int
    size: int


def check_elements(data: bytes) -> None:
    """Go through all variables and the matrices within them.

    Raises:
        ValueError: one is not what it claims to be, or does not fit into what surrounds it.
    """
    order = "<" if data[HEADER - 2 : HEADER] == b"IM" else ">"
    unpacked, at = 0, HEADER
    while at + 8 <= len(data):
        element, at = _element(data, at, len(data), order, padded=False)
        if element.kind == COMPRESSED:
            packed = memoryview(data)[element.start : element.start + element.size]
            content = zlib.decompressobj().decompress(packed, LARGEST - unpacked + 1)
            unpacked += len(content)
            if unpacked > LARGEST:
                raise ValueError(f"more than {LARGEST / 2**30:g} GB once it is unpacked")
            inner, _ = _element(content, 0, len(content), order)
            _check(content, inner, order, 0)
        else:
            _check(data, element, order, 0)


def _element(data: bytes, at: int, end: int, order: str, *, padded: bool = True) -> tuple[_Element, int]:
    """The element at a place, and where the next begins."""
    kind, size = struct.unpack_from(f"{order}II", data, at)
    # Up to four bytes stand in the tag itself.
    if kind >> 16:
        if kind >> 16 > 4:
            raise ValueError(f"{kind >> 16} bytes where four have room")
        return _Element(kind & 0xFFFF, at + 4, kind >> 16), at + 8
    if size > end - at - 8:
        raise ValueError(f"an element of {size} bytes where {end - at - 8} are left")
    return _Element(kind, at + 8, size), at + 8 + size + (-size % 8 if padded else 0)


def _check(data: bytes, matrix: _Element, order: str, depth: int) -> None:
    """A matrix and all that lies in it."""
    if matrix.kind != MATRIX or depth > DEEPEST:
        raise ValueError(f"an element of type {matrix.kind} at a depth of {depth}")
    if matrix.size == 0:
        return
    parts: list[_Element] = []
    at, end = matrix.start, matrix.start + matrix.size
    while at + 8 <= end:
        part, at = _element(data, at, end, order)
        parts.append(part)
    if len(parts) < 3 or parts[0][::2] != (UINT32, 8):
        raise ValueError("a matrix without a head")
    (flags,) = struct.unpack_from(f"{order}I", data, parts[0].start)
    values, matrices = _expected(data, parts, flags, order)
    found = parts[len(parts) - values - matrices :]
    wrong = [part for part in found[:values] if part.kind not in NUMBERS_OR_TEXT]
    if wrong:
        raise ValueError(f"values of type {wrong[0].kind}")
    for part in found[values:]:
        _check(data, part, order, depth + 1)


def _expected(data: bytes, parts: list[_Element], flags: int, order: str) -> tuple[int, int]:
    """Number of parts with values and with matrices that stand after the head of a matrix."""
    kind, width = flags & 0xFF, 2 if flags & COMPLEX else 1
    # Flags, dimensions and name; an opaque one has three names, and no dimensions.
    head, count = 3, 0
    if kind != OPAQUE:
        sizes = struct.unpack_from(f"{order}{parts[1].size // 4}i", data, parts[1].start)
        count = math.prod(sizes)
        if min(sizes, default=0) < 0:
            raise ValueError(f"a matrix of size {sizes}")
    if kind in NUMERIC or kind == CHARACTERS:
        expected = width if kind in NUMERIC else 1, 0
    elif kind == SPARSE:
        expected = 2 + width, 0
    elif kind == CELL:
        expected = 0, count
    elif kind in (STRUCT, OBJECT):
        head += 2 if kind == STRUCT else 3
        if len(parts) < head or parts[head - 2].size != 4:
            raise ValueError("a struct without names of fields")
        (length,) = struct.unpack_from(f"{order}i", data, parts[head - 2].start)
        if length <= 0:
            raise ValueError(f"names of fields of {length} characters")
        expected = 0, count * (parts[head - 1].size // length)
    elif kind in (FUNCTION, OPAQUE):
        head += 1 if kind == OPAQUE else 0
        expected = 0, 1
    else:
        raise ValueError(f"a matrix of class {kind}")
    if len(parts) != head + sum(expected):
        raise ValueError(f"a matrix of {len(parts)} parts where {head + sum(expected)} are expected")
    return expected
