"""Generic decoder of CDR messages by their ros2msg schema: for texts and sequences whose lengths change.

Slow beside `jtqd.daemon.logs.layout`: every field is read on its own. Nothing in a message is believed: a length beyond
its end is a LogError.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.layout import MAX_DEPTH
from jtqd.daemon.logs.ros2msg import PRIMITIVES, Field, Types

_LETTERS = {
    "u1": "B",
    "i1": "b",
    "u2": "H",
    "i2": "h",
    "u4": "I",
    "i4": "i",
    "u8": "Q",
    "i8": "q",
    "f4": "f",
    "f8": "d",
}
_LETTERS["b1"] = "?"
"""numpy's code -> that of `struct`."""

_Read = Callable[["_Cursor"], Any]


class _Cursor:
    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order, self.at = data, order, 0

    def take(self, size: int, align: int) -> int:
        """Offset of `size` aligned bytes, and go behind them."""
        begin = self.at + -self.at % align
        end = begin + size
        if end > len(self.data):
            raise LogError("found a message that is shorter than its schema")
        self.at = end
        return begin

    def length(self) -> int:
        """A length, of texts and sequences."""
        return int(struct.unpack_from(self.order + "I", self.data, self.take(4, 4))[0])


class Decoder:
    """Messages of one type as rows of a structured array.

    Numbers are columns of their type; texts, and sequences of changing length, are objects (str, numpy array, list).
    Nested messages are nested fields; within a sequence they are dictionaries.
    """

    def __init__(self, types: Types) -> None:
        self._types = types
        self.dtype, self._read = self._struct(types.main, 0)

    def rows(self, payloads: list[bytes]) -> np.ndarray[Any, np.dtype[Any]]:
        """The messages [n]. Raises LogError."""
        found = np.empty(len(payloads), self.dtype)
        for n, payload in enumerate(payloads):
            found[n] = self.row(payload)
        return found

    def row(self, payload: bytes) -> tuple[Any, ...]:
        """One message, as nested tuples. Raises LogError."""
        if len(payload) < 4 or payload[0] != 0 or payload[1] > 1:
            raise LogError(f"found encapsulation {payload[:4].hex()}, expected plain CDR")
        return tuple(self._read(_Cursor(payload[4:], "<" if payload[1] else ">")))

    def _struct(self, name: str, depth: int) -> tuple[np.dtype[Any], _Read]:
        if depth > MAX_DEPTH:
            raise LogError(f"found types nested deeper than {MAX_DEPTH} in a schema")
        columns, readers = [], []
        for field in self._types.fields(name):
            kind, read = self._field(field, depth)
            columns.append((field.name, kind))
            readers.append(read)

        def struct_of(cursor: _Cursor) -> tuple[Any, ...]:
            return tuple([read(cursor) for read in readers])

        return np.dtype(columns), struct_of

    def _field(self, field: Field, depth: int) -> tuple[Any, _Read]:
        if field.kind in PRIMITIVES:
            return self._numbers(field)
        if field.kind == "string":
            kind: np.dtype[Any] = np.dtype(object)
            one: _Read = _text
        else:
            kind, one = self._struct(field.kind, depth + 1)
        if field.elements is None and not field.sequence:
            return kind, one
        count = field.elements
        names = kind.names

        def several(cursor: _Cursor) -> list[Any]:
            number = cursor.length() if count is None else count
            if number > len(cursor.data):  # every element takes at least one byte
                raise LogError(f"found a length of {number} in a message of {len(cursor.data)} bytes")
            found = [one(cursor) for _ in range(number)]
            return found if names is None else [_named(kind, each) for each in found]

        return np.dtype(object), several

    @staticmethod
    def _numbers(field: Field) -> tuple[Any, _Read]:
        code = np.dtype(PRIMITIVES[field.kind])
        size = code.itemsize
        big = code.newbyteorder(">")
        if field.elements is None and not field.sequence:
            letter = _LETTERS[code.str.lstrip("<|")]

            def one(cursor: _Cursor) -> Any:
                return struct.unpack_from(cursor.order + letter, cursor.data, cursor.take(size, size))[0]

            return code, one
        count = field.elements

        def several(cursor: _Cursor) -> Any:
            number = cursor.length() if count is None else count
            begin = cursor.take(number * size, size if number else 1)
            found = np.frombuffer(cursor.data, code if cursor.order == "<" else big, number, begin)
            return found.astype(code, copy=False)

        return (object if count is None else (code, (count,))), several


def _named(kind: np.dtype[Any], values: tuple[Any, ...]) -> dict[str, Any]:
    """Nested tuples as dictionaries."""
    found = {}
    for name, value in zip(kind.names or (), values, strict=True):
        inner = kind[name]
        found[name] = _named(inner, value) if inner.names is not None else value
    return found


def _text(cursor: _Cursor) -> str:
    length = cursor.length()
    begin = cursor.take(length, 1)
    return cursor.data[begin : begin + max(length - 1, 0)].decode("utf-8", "replace")
