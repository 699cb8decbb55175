"""Fixed layout of a message: from its schema text (ros2msg), CDR's alignment, and one example for the lengths in it.

A message whose texts and sequences have the same lengths every time lies in memory as a row of a structured array.
`Layout.lengths` says where these lengths stand, so that every message can be checked before it is taken for such a row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.ros2msg import PRIMITIVES, Field, Types

MAX_DEPTH = 32
"""Levels of nested types."""


class Layout(NamedTuple):
    """Row of a structured array, and (offset, value) of every length within it, unsigned 32 bit."""

    dtype: np.dtype[Any]
    lengths: tuple[tuple[int, int], ...]


class VariableLayoutError(LogError):
    """Messages of this type cannot be rows of equal length: text in a sequence, or padding between its elements."""


def message_layout(types: Types, example: bytes) -> Layout:
    """Layout of a message after the encapsulation, with the lengths that `example` has. Raises LogError."""
    builder = _Builder(types, example)
    dtype = builder.of(types.main, 0, 0)[0]
    return Layout(dtype, tuple(builder.lengths))


class _Builder:
    """Offsets by CDR: every primitive at a multiple of its own size, counted from the first byte."""

    def __init__(self, types: Types, example: bytes) -> None:
        self._types = types
        self._example = example
        self.lengths: list[tuple[int, int]] = []

    def of(self, name: str, start: int, depth: int) -> tuple[np.dtype[Any], int]:
        """Layout of type `name` that begins at byte `start`, and the byte after it."""
        if depth > MAX_DEPTH:
            raise LogError(f"found types nested deeper than {MAX_DEPTH} in a schema")
        names, formats, offsets = [], [], []
        at = start
        for field in self._types.fields(name):
            layout, begin, at = self._field(field, at, depth)
            names.append(field.name)
            formats.append(layout)
            offsets.append(begin - start)
        made = {"names": names, "formats": formats, "offsets": offsets, "itemsize": at - start}
        try:
            return np.dtype(made), at  # type: ignore[call-overload]
        except (ValueError, OverflowError) as error:
            raise LogError(f"found a schema that makes no row: {error}") from None

    def _field(self, field: Field, at: int, depth: int) -> tuple[np.dtype[Any], int, int]:
        count = field.elements
        if field.sequence:
            at, count = self._length(at)
            if count == 0:
                return np.dtype(("u1", (0,))), at, at
        layout, begin, end = self._one(field.kind, at, depth)
        if count is None:
            return layout, begin, end
        return self._array(field.kind, layout, begin, count, depth)

    def _length(self, at: int) -> tuple[int, int]:
        """Offset behind a length, and the length."""
        at += -at % 4
        if at + 4 > len(self._example):
            raise LogError("found a message that is shorter than its schema")
        length = int.from_bytes(self._example[at : at + 4], "little")
        if length > len(self._example):
            raise LogError(f"found a length of {length} in a message of {len(self._example)} bytes")
        self.lengths.append((at, length))
        return at + 4, length

    def _one(self, kind: str, at: int, depth: int) -> tuple[np.dtype[Any], int, int]:
        if kind in PRIMITIVES:
            layout = np.dtype(PRIMITIVES[kind])
            begin = at + -at % layout.itemsize
            return layout, begin, begin + layout.itemsize
        if kind == "string":
            begin, length = self._length(at)  # with the closing zero
            if length == 0:
                raise VariableLayoutError("found a text without its closing zero")
            return np.dtype(f"S{length}"), begin, begin + length
        layout, end = self.of(kind, at, depth + 1)
        return layout, at, end

    def _array(
        self, kind: str, layout: np.dtype[Any], begin: int, count: int, depth: int
    ) -> tuple[np.dtype[Any], int, int]:
        """A row of equal elements; a nested type must end where its next element can begin."""
        if count * max(layout.itemsize, 1) > len(self._example):
            raise LogError(f"found an array of {count} {kind} in a message of {len(self._example)} bytes")
        known = len(self.lengths)
        if count > 1:
            again, _, end = self._one(kind, begin + layout.itemsize, depth)
            if (
                again != layout
                or end != begin + 2 * layout.itemsize
                or len(self.lengths) != known
                or kind == "string"
            ):
                raise VariableLayoutError(f"found an array of {kind} whose elements have no equal length")
        return np.dtype((layout, (count,))), begin, begin + count * layout.itemsize
