"""Where the fields of a serialised message lie, and many messages decoded at once."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bayes_impedance.log import Array

#: Fields of each type of message, as rosbags parses a definition: `{type: (constants, [(field, description)])}`.
Definitions = Mapping[str, tuple[Any, Sequence[tuple[str, Any]]]]

NUMBERS = {
    "bool": "u1", "byte": "i1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
#: What rosbags calls the kinds of a description.
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
#: Longer arrays are images and clouds of points; their elements are not columns.
LONGEST_ARRAY = 1000
#: Fields of one message, those of nested messages included; more is no measurement of a robot.
MOST_FIELDS = 100_000
#: The one field of a message without fields, which only CDR writes.
EMPTY = [("structure_needs_at_least_one_member", (BASE, ("uint8", 0)))]


class MalformedError(ValueError):
    """Bytes that are not the message they should be."""


@dataclass(frozen=True)
class Field:
    """Numbers of one kind that lie in a row; `count` is None where it is one, not an array."""

    offset: int
    dtype: str
    count: int | None


@dataclass(frozen=True)
class Layout:
    """Offsets of the fields in all messages of one size that have the same lengths of strings and arrays.

    `lengths`: where those stand, and the bytes that each takes.
    """

    fields: Mapping[str, Field]
    texts: Mapping[str, slice]
    lengths: Mapping[int, int]

    def columns(self) -> Iterator[str]:
        """Every number by its name, such as wrench.force.x or effort[0]."""
        for path, field in self.fields.items():
            if field.count is None:
                yield path
            elif field.count <= LONGEST_ARRAY:
                yield from (f"{path}[{index}]" for index in range(field.count))

    def find(self, column: str) -> Field | None:
        """Where a number lies; None where this message has none of that name."""
        field = self.fields.get(column)
        if field is not None and field.count is None:
            return field
        element = re.fullmatch(r"(.+)\[(\d{1,9})\]", column)
        array = self.fields.get(element[1]) if element else None
        if element is None or array is None or array.count is None or int(element[2]) >= array.count:
            return None
        return Field(array.offset + int(element[2]) * np.dtype(array.dtype).itemsize, array.dtype, None)

    def fits(self, rows: npt.NDArray[np.uint8], first: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """`(n,)`: which of the messages `rows (n, size)` have the lengths of `first (size,)`, which has this layout."""
        at = np.array(
            [offset + byte for offset, n in self.lengths.items() for byte in range(n)], dtype=np.intp
        )
        return (rows[:, at] == first[at]).all(axis=1)


class Walker:
    """One message walked through from the first byte to the last.

    ROS 1 packs fields without gaps, little-endian. CDR begins with four bytes that tell the order of bytes, and aligns
    each number to its own size, counted from there.
    """

    def __init__(self, raw: bytes, definitions: Definitions, cdr: bool) -> None:
        self.raw, self.definitions, self.cdr = raw, definitions, cdr
        self.fields: dict[str, Field] = {}
        self.texts: dict[str, slice] = {}
        self.lengths: dict[int, int] = {}
        self.walked = 0
        self.at = self.start = 4 if cdr else 0
        self.order = "<"
        if cdr:
            if raw[:2] not in (b"\0\0", b"\0\1") or len(raw) < 4:
                raise MalformedError(
                    f"bytes {raw[:4].hex(' ') or 'none'} where CDR begins with 00 00 or 00 01"
                )
            self.order = "<" if raw[1] else ">"
            self.lengths[0] = 2

    def layout(self, kind: str) -> Layout:
        """Layout of the message, of type `kind`."""
        try:
            self._message("", kind)
        except RecursionError:
            raise MalformedError("messages nested without end") from None
        # CDR may be padded to a multiple of four.
        if not 0 <= len(self.raw) - self.at <= (3 if self.cdr else 0):
            raise MalformedError(f"{len(self.raw)} bytes where {self.at} make up the message")
        return Layout(self.fields, self.texts, self.lengths)

    def _message(self, path: str, kind: str) -> None:
        if kind not in self.definitions:
            raise MalformedError(f"no definition of the type {kind}")
        for name, description in self.definitions[kind][1] or EMPTY:
            if self.cdr or name != EMPTY[0][0]:
                self._field(f"{path}.{name}" if path else name, *description)

    def _field(self, path: str, node: int, description: Any) -> None:
        self.walked += 1
        if self.walked > MOST_FIELDS:
            raise MalformedError(f"more than {MOST_FIELDS} fields")
        if node == NAME:
            self._message(path, description)
        elif node == BASE and description[0] == "string":
            n = self._length()
            self.texts[path] = slice(self._take(n, 1), self.at - int(self.cdr))
        elif node == BASE:
            self._numbers(path, description[0], None)
        else:
            element, count = description
            if node == SEQUENCE:
                count = self._length()
            if element[0] == BASE and element[1][0] != "string":
                self._numbers(path, element[1][0], count)
            else:
                for index in range(count):
                    self._field(f"{path}[{index}]", *element)

    def _numbers(self, path: str, name: str, count: int | None) -> None:
        if name not in NUMBERS:
            raise MalformedError(f"a field {path} of type {name}, which is not supported")
        dtype = self.order + NUMBERS[name]
        size = np.dtype(dtype).itemsize
        n = 1 if count is None else count
        self.fields[path] = Field(self._take(n * size, size if n else 1), dtype, count)

    def _length(self) -> int:
        at = self._take(4, 4)
        self.lengths[at] = 4
        return int.from_bytes(self.raw[at : at + 4], "little" if self.order == "<" else "big")

    def _take(self, size: int, alignment: int) -> int:
        """Offset of the next `size` bytes."""
        gap = (self.start - self.at) % alignment if self.cdr else 0
        offset = self.at + gap
        self.at = offset + size
        if self.at > len(self.raw):
            raise MalformedError(f"{len(self.raw)} bytes, an end within the message")
        return offset


@dataclass
class Decoder:
    """Messages of a topic as columns. Those that agree in all lengths are decoded at once."""

    kind: str
    definitions: Definitions
    cdr: bool
    columns: Sequence[str]

    def decode(self, raws: Sequence[bytes]) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Values `(c, n)`, and which of them `(c, n)` the messages have.

        Raises:
            MalformedError: names the index of the message in `args[1]`.
        """
        values = np.full((len(self.columns), len(raws)), np.nan)
        present = np.zeros(values.shape, dtype=np.bool_)
        sizes = np.array([len(raw) for raw in raws])
        for size in np.unique(sizes):
            left = np.flatnonzero(sizes == size)
            rows = np.frombuffer(b"".join(raws[int(index)] for index in left), dtype=np.uint8).reshape(
                len(left), size
            )
            while len(left):
                try:
                    layout = Walker(raws[left[0]], self.definitions, self.cdr).layout(self.kind)
                except MalformedError as error:
                    raise MalformedError(str(error), int(left[0])) from error
                fits = layout.fits(rows, rows[0])
                for index, column in enumerate(self.columns):
                    if field := layout.find(column):
                        present[index, left[fits]] = True
                        end = field.offset + np.dtype(field.dtype).itemsize
                        numbers = np.ascontiguousarray(rows[fits, field.offset : end]).view(field.dtype)
                        values[index, left[fits]] = numbers[:, 0]
                left, rows = left[~fits], rows[~fits]
        return values, present
