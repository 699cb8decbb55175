"""Read what jtqd recorded: messages of one topic of an MCAP file as one structured array.

The layout comes from the schema text in the file (ros2msg) and CDR's alignment rules, not from jtqd's code.
All messages of jtqd's cycle topics have the same length (the only text in them is the constant frame_id), so
that the layout of the first message is that of all, and a topic is one array without a loop over its fields.
"""

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray
from zstandard import ZstdError

Records = NDArray[np.void]

_PRIMITIVES = {
    "bool": "?",
    "byte": "u1",
    "char": "u1",
    **{f"{sign}int{8 * size}": f"<{sign or 'i'}{size}" for sign in ("u", "") for size in (1, 2, 4, 8)},
    "float32": "<f4",
    "float64": "<f8",
}
_FIELD = re.compile(r"([\w/]+)(?:\[(\d+)\])?\s+([a-z]\w*)$")
_CONSTANT = re.compile(r"\w+\s+[A-Z]\w*\s*=")
_NESTED = re.compile(r"^=+\nMSG: (\S+)\n", re.MULTILINE)
_ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little endian


class LogError(ValueError):
    """The log cannot be used; one line: file, topic, found, expected."""


def read_topic(path: Path, topic: str) -> Records:
    """All messages of a topic in the order of the file, one field per field of the schema [n].

    Nested messages are nested fields, `header.stamp.sec` is ["header"]["stamp"]["sec"]. Raises LogError, OSError.
    """
    payloads: list[bytes] = []
    text = ""
    try:
        with path.open("rb") as file:
            for schema, _, message in make_reader(file, validate_crcs=True).iter_messages([topic]):
                if schema is None or schema.encoding != "ros2msg":
                    raise LogError(f"{path}: {topic}: found no ros2msg schema, expected one")
                text = schema.data.decode()
                payloads.append(message.data)
    except (McapError, ZstdError, struct.error, EOFError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: not a readable MCAP file: {error or type(error).__name__}") from None
    if not payloads:
        raise LogError(f"{path}: found no message on {topic}, expected one per cycle")
    first = payloads[0]
    if any(len(payload) != len(first) or payload[:4] != _ENCAPSULATION for payload in payloads):
        raise LogError(f"{path}: {topic}: found messages of different form, expected equal ones in CDR")
    layout = message_layout(text, first[4:])
    body = len(first) - 4
    if not 0 <= body - layout.itemsize < 8:  # what is left can only be padding
        raise LogError(f"{path}: {topic}: found {body} bytes, expected {layout.itemsize} by the schema")
    return np.frombuffer(b"".join(payload[4 : 4 + layout.itemsize] for payload in payloads), layout)


def message_layout(schema: str, example: bytes) -> np.dtype[Any]:
    """Layout of a message after the encapsulation; lengths of strings are those of `example`. Raises LogError."""
    main, *rest = _NESTED.split(schema)
    types = {None: main, **dict(zip(rest[::2], rest[1::2], strict=True))}
    return _Layout(types, example).of(None, 0)[0]


class _Layout:
    """Offsets by CDR: every primitive at a multiple of its own size, counted from the first byte."""

    def __init__(self, types: dict[str | None, str], example: bytes) -> None:
        self._types = types
        self._example = example

    def of(self, name: str | None, start: int) -> tuple[np.dtype[Any], int]:
        """Layout of type `name` that begins at byte `start`, and the byte after it."""
        names, formats, offsets = [], [], []
        at = start
        for line in self._types[name].splitlines():
            bare = line.split("#")[0].strip()
            if not bare or _CONSTANT.match(bare):
                continue
            found = _FIELD.match(bare)
            if found is None:
                raise LogError(f"found {bare!r} in a schema, expected a field of fixed size")
            kind, count, field = found.groups()
            layout, begin, at = self._one(kind, at)
            if count is not None:
                layout, at = self._array(kind, layout, begin, int(count))
            names.append(field)
            formats.append(layout)
            offsets.append(begin - start)
        made = {"names": names, "formats": formats, "offsets": offsets, "itemsize": at - start}
        return np.dtype(made), at  # type: ignore[call-overload]

    def _one(self, kind: str, at: int) -> tuple[np.dtype[Any], int, int]:
        if kind in _PRIMITIVES:
            layout = np.dtype(_PRIMITIVES[kind])
            begin = at + -at % layout.itemsize
            return layout, begin, begin + layout.itemsize
        if kind == "string":
            at += -at % 4
            length = int.from_bytes(self._example[at : at + 4], "little")  # with the closing zero
            return np.dtype(f"S{length}"), at + 4, at + 4 + length
        if kind not in self._types:
            raise LogError(f"found type {kind!r} in a schema, expected its definition")
        layout, end = self.of(kind, at)
        return layout, at, end

    def _array(self, kind: str, layout: np.dtype[Any], begin: int, count: int) -> tuple[np.dtype[Any], int]:
        """A row of equal elements; a nested type must end where its next element can begin."""
        again, _, end = self._one(kind, begin + layout.itemsize)
        if again != layout or end != begin + 2 * layout.itemsize:
            raise LogError(f"found an array of {kind} with padding between its elements, expected none")
        return np.dtype((layout, (count,))), begin + count * layout.itemsize
