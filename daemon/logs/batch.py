"""Messages of one channel out of one chunk, and the checks that an index is believed by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from jtqd.daemon.logs.chunks import heads_at
from jtqd.daemon.logs.records import HEAD, MAX_SMALL, MESSAGE_BODY, Source


class Batch(NamedTuple):
    """Messages of one channel out of one chunk: `data` holds them, `offsets` is where each record begins [n]."""

    channel: int
    data: bytes
    offsets: NDArray[np.int64]
    log_times: NDArray[np.uint64]
    lengths: NDArray[np.uint64]
    """Of the payloads, which begin 31 bytes behind the offsets."""


@dataclass
class ChunkPlace:
    """A chunk of a file."""

    offset: int
    start_ns: int
    end_ns: int
    index: dict[int, int] = field(default_factory=dict)
    """Channel -> offset of its message index; empty: not known."""


def read_index(source: Source, at: int, channel: int) -> NDArray[np.uint64] | None:
    """(log time, offset) [n, 2] of a message index; None where there is none of that channel."""
    found = source.head(at)
    if found is None or found[0] != Opcode.MESSAGE_INDEX or found[1] - at > MAX_SMALL:
        return None
    body = source.read(at + HEAD.size, found[1] - at - HEAD.size)
    if int.from_bytes(body[:2], "little") != channel or len(body) < 6:
        return None
    length = int.from_bytes(body[2:6], "little")
    if length != len(body) - 6 or length % 16:
        return None
    return np.frombuffer(body, "<u8", offset=6).reshape(-1, 2)


def believed(data: bytes, channel: int, entries: NDArray[np.uint64]) -> Batch | None:
    """Messages where an index says; None where at one of these places there is none."""
    offsets = entries[:, 1].astype(np.int64)
    if not len(offsets):
        return Batch(channel, data, offsets, entries[:, 0], entries[:, 0])
    if offsets.min() < 0 or offsets.max() > len(data) - HEAD.size - MESSAGE_BODY:
        return None
    if len(offsets) > 1 and (np.diff(offsets) <= 0).any():  # by time, in some writers' files
        order = np.argsort(offsets)
        offsets, entries = offsets[order], entries[order]
    heads = heads_at(data, offsets)
    lengths = heads["length"]
    good = (
        (heads["opcode"] == Opcode.MESSAGE)
        & (heads["channel"] == channel)
        & (heads["log_time"] == entries[:, 0])
    )
    good &= (lengths >= MESSAGE_BODY) & (lengths <= len(data))
    ends = offsets + HEAD.size + lengths.astype(np.int64)
    if not good.all() or ends[-1] > len(data) or (ends[:-1] > offsets[1:]).any():
        return None
    return Batch(channel, data, offsets, entries[:, 0], lengths - MESSAGE_BODY)


def between(batch: Batch, first: int, last: int) -> Batch:
    """Those with a log time from `first` to `last`."""
    inside = (batch.log_times >= first) & (batch.log_times <= last)
    return Batch(
        batch.channel, batch.data, batch.offsets[inside], batch.log_times[inside], batch.lengths[inside]
    )
