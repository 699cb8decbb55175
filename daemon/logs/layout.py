"""Message definitions in `ros2msg`, and the fixed layout of their CDR messages as rows of a numpy array.

The layout of a message follows from its schema text, CDR's alignment (every primitive at a multiple of its own size,
counted from the first byte) and one example for the lengths in it. A message whose texts and sequences have the same lengths
every time lies in memory as a row of a structured array; `Layout.lengths` says where these lengths stand, so that every
message can be checked before it is taken for such a row.
"""

from __future__ import annotations

import re
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from jtqd.daemon.logs.container import LogError

PRIMITIVES = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    **{f"{sign}int{8 * size}": f"<{sign or 'i'}{size}" for sign in ("u", "") for size in (1, 2, 4, 8)},
    "float32": "<f4",
    "float64": "<f8",
}
"""Type -> numpy's code."""

_MAX_DEPTH = 32
"""Levels of nested types."""
_FIELD = re.compile(
    r"(?P<kind>[\w/]+)(?:<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?\s+(?P<name>[a-z]\w*)(?:\s+[^\s=].*)?$"
)
"""Type, array, name, default value."""
_CONSTANT = re.compile(r"[\w<=/]+\s+[A-Z]\w*\s*=")
_NESTED = re.compile(r"^=+\s*\nMSG: (\S+)[^\n]*\n", re.MULTILINE)
_COMMENT = re.compile(r"#.*")
_BUILT_IN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
}
"""Some writers leave their texts out."""
_EMPTY = "uint8 structure_needs_at_least_one_member\n"


class Field(NamedTuple):
    """One field. `elements`: of a fixed array; `sequence`: as many as the message says."""

    name: str
    kind: str
    elements: int | None = None
    sequence: bool = False

    @property
    def is_array(self) -> bool:
        """Several elements."""
        return self.sequence or self.elements is not None


class Types:
    """All types of one schema. Raises LogError for a text that is no ros2msg, when the type is asked for."""

    main = ""

    def __init__(self, text: str) -> None:
        first, *rest = _NESTED.split(text.replace("\r\n", "\n"))
        self._texts = {"": first}
        for name, body in zip(rest[::2], rest[1::2], strict=True):
            self._texts.setdefault(_bare(name), body)
        self._fields: dict[str, tuple[Field, ...]] = {}

    @cached_property
    def _by_last(self) -> dict[str, str]:
        return {name.rsplit("/", 1)[-1]: name for name in self._texts}

    def fields(self, name: str) -> tuple[Field, ...]:
        """Fields of a type; "" is the message itself."""
        if name not in self._fields:
            self._fields[name] = tuple(self._parse(self._text(name)))
        return self._fields[name]

    def _text(self, name: str) -> str:
        bare = _bare(name)
        found = self._texts.get(bare, _BUILT_IN.get(bare))
        if found is None and "/" not in bare and bare in self._by_last:
            found = self._texts[self._by_last[bare]]
        if found is None:
            raise LogError(f"found type {name!r} in a schema, expected its definition")
        return found if any(self._lines(found)) else _EMPTY

    @staticmethod
    def _lines(text: str) -> list[str]:
        lines = (_COMMENT.sub("", line).strip() for line in text.splitlines())
        return [line for line in lines if line and not _CONSTANT.match(line)]

    def _parse(self, text: str) -> list[Field]:
        fields = []
        for line in self._lines(text):
            found = _FIELD.match(line)
            if found is None:
                raise LogError(f"found {line!r} in a schema, expected a field")
            sequence = bool(found["array"]) and (found["bound"] is not None or not found["count"])
            count = int(found["count"]) if found["array"] and not sequence else None
            fields.append(Field(found["name"], found["kind"], count, sequence))
        names = [field.name for field in fields]
        if len(set(names)) != len(names):
            raise LogError("found two fields of one name in a schema")
        return fields


@lru_cache(maxsize=16)
def types_of(text: str) -> Types:
    """Return types of a schema, taken apart once however many chunks are of it."""
    return Types(text)


def _bare(name: str) -> str:
    return name.replace("/msg/", "/")


class Layout(NamedTuple):
    """Row of a structured array, and (offset, value) of every length within it, unsigned 32 bit."""

    dtype: np.dtype[Any]
    lengths: tuple[tuple[int, int], ...]


class VariableLayoutError(LogError):
    """Messages of this type cannot be rows of equal length: text in a sequence, or padding between its elements."""


def message_layout(types: Types, example: bytes) -> Layout:
    """Return the layout of a message after the encapsulation, with the lengths that `example` has. Raises LogError."""
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
        """Return the layout of type `name` that begins at byte `start`, and the byte after it."""
        if depth > _MAX_DEPTH:
            raise LogError(f"found types nested deeper than {_MAX_DEPTH} in a schema")
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
            raise LogError(f"found a schema without a fixed row: {error}") from None

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
                raise VariableLayoutError("found a string without its terminating zero")
            return np.dtype(f"S{length}"), begin, begin + length
        layout, end = self.of(kind, at, depth + 1)
        return layout, at, end

    def _array(
        self, kind: str, layout: np.dtype[Any], begin: int, count: int, depth: int
    ) -> tuple[np.dtype[Any], int, int]:
        """Return a row of equal elements; a nested type must end where its next element can begin."""
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
