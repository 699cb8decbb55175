"""Places in damaged bytes at which a record may begin: what a search looks at closely. Pure, about 1 ns a byte."""

from __future__ import annotations

import re

import numpy as np

from jtqd.daemon.logs.records import CHUNK, HEAD

_NAMES = (re.compile(rb"\x03\x00\x00\x00lz4"), re.compile(rb"\x04\x00\x00\x00zstd"))
"""Length and name of a chunk's compression. Each on its own: the search for plain bytes is the fast one."""
_NAME_AT = HEAD.size + CHUNK.size - 4
"""Where that stands in a chunk."""
_HIGH_AT = 5
"""Upper half of a record's length; zero below 4 GB."""
_PLAIN_CHUNK, _PLAIN_AT = 0x06, HEAD.size + CHUNK.size - 4
"""A chunk that is not packed: the length of its compression's name is zero."""
_OTHERS = np.zeros(256, np.bool_)
_OTHERS[[0x03, 0x04, 0x05, 0x07, 0x09, 0x0C, 0x0F]] = True
"""Schema, channel, message, message index, attachment, metadata, end of the data."""


def packed_chunks(window: bytes) -> set[int]:
    """Offsets of chunks by the name of their compression; may be negative: the chunk began before the window."""
    return {match.start() - _NAME_AT for name in _NAMES for match in name.finditer(window)}


def other_records(window: bytes) -> list[int]:
    """Offsets at which there may be a chunk that is not packed, or another record of less than 4 GB."""
    data = np.frombuffer(window, np.uint8)
    zero = data == 0
    zeros = zero[:-3] & zero[1:-2] & zero[2:-1] & zero[3:]
    plain = np.flatnonzero((data[: max(len(zeros) - _PLAIN_AT, 0)] == _PLAIN_CHUNK) & zeros[_PLAIN_AT:])
    others = np.flatnonzero(_OTHERS[data[: max(len(zeros) - _HIGH_AT, 0)]] & zeros[_HIGH_AT:])
    return [*plain.tolist(), *others.tolist()]
