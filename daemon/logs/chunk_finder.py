"""Find whole chunks in a damaged MCAP file, and make their heads right where only these are wrong.

A chunk proves itself by its CRC, whatever its opcode and lengths say; one whose head is gone is where the summary's index
says that it is.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema
from numpy.typing import NDArray

from jtqd.daemon.logs.chunks import (
    HEAD_SIZE,
    MAX_CHUNK,
    ChunkError,
    ChunkHead,
    Walk,
    chunk_head,
    unpack_data,
    walk,
)
from jtqd.daemon.logs.definitions import Definition, Definitions
from jtqd.daemon.logs.records import CHUNK, HEAD, MAX_SMALL, MESSAGE_BODY, Source, parse
from jtqd.daemon.recording.mcap_file import bytes_of

_KINDS = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel}


@dataclass
class FoundChunk:
    """A chunk that is whole. `head` is as it should be; `healed` where the file says otherwise."""

    offset: int
    end: int
    head: ChunkHead
    healed: bool
    counts: Counter[int]
    index: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Channel -> (offset, length) of the message indexes behind it that are right."""
    wrong_index: list[tuple[int, int, int]] = field(default_factory=list)
    """(start, end, channel) of message indexes that are not."""
    index_end: int = 0


class Whole(NamedTuple):
    """A whole chunk, and the definitions in it."""

    chunk: FoundChunk
    definitions: list[Definition]


class _IndexRecord(NamedTuple):
    start: int
    end: int
    channel: int
    entries: bytes


class ChunkFinder:
    """Looks for chunks in one file.

    Args:
        source: the file.
        indexed: chunks that its summary names.
    """

    def __init__(self, source: Source, indexed: list[ChunkIndex]) -> None:
        self._source = source
        self._indexed = {each.chunk_start_offset: each for each in indexed}
        self._places = sorted(self._indexed)
        self.work = (64 << 20) + 16 * source.size
        """Bytes that may be unpacked in vain: a file made to look like many chunks ends the search, not the machine."""

    def indexed_between(self, start: int, end: int) -> list[int]:
        """Offsets in this stretch at which the summary names a chunk."""
        return self._places[bisect_left(self._places, start) : bisect_left(self._places, end)]

    def proven(self, at: int) -> bool:
        """There is a whole chunk."""
        return any(self._content(at, head) is not None for head in self._heads(at, search=True))

    def framed(self, at: int) -> bool:
        """There is a chunk whose lengths agree with each other, whatever it holds."""
        said = self._source.head(at)
        if said is None or said[0] != Opcode.CHUNK:
            return False
        head = chunk_head(self._source.read(at, HEAD_SIZE))
        return head is not None and at + head.data_start + head.packed_size == said[1]

    def whole(self, at: int, known: Definitions) -> Whole | None:
        """The chunk at `at` with the message indexes behind it; `known`: definitions so far."""
        prefix = self._source.read(at, HEAD_SIZE)
        for head in self._heads(at, search=False):
            data = self._content(at, head)
            if data is None:
                continue
            end = at + head.data_start + head.packed_size
            indexes = self._indexes(end)
            try:
                records = walk(data, _hint(indexes))
            except ChunkError:
                continue
            crc = head.crc or (zlib.crc32(data) if at in self._indexed and chunk_head(prefix) != head else 0)
            sizes = head._replace(unpacked_size=len(data), crc=crc)
            return _whole(FoundChunk(at, end, sizes, False, Counter()), prefix, data, records, indexes)
        return self._torn_plain(at, prefix, known)

    def _heads(self, at: int, *, search: bool) -> list[ChunkHead]:
        """What the chunk's head may be, the likeliest first."""
        source, heads = self._source, []
        said = source.head(at)
        framed = said is not None and said[0] == Opcode.CHUNK
        head = chunk_head(source.read(at, HEAD_SIZE))
        if head is not None and said is not None and framed:
            by_frame = said[1] - at - head.data_start
            # Searching, a chunk without a CRC must at least agree with itself.
            if head.crc or not search or by_frame == head.packed_size:
                heads.append(head)
            if by_frame != head.packed_size and (head.crc or not search):
                heads.append(head._replace(packed_size=by_frame))
        elif head is not None and head.crc and self.work > 0:
            heads.append(head)
        index = self._indexed.get(at)
        if index is not None and index.compression in ("", "lz4", "zstd"):
            start = HEAD.size + CHUNK.size + len(index.compression) + 8
            times = (index.message_start_time, index.message_end_time)
            named = ChunkHead(
                *times, index.uncompressed_size, 0, index.compression, index.compressed_size, start
            )
            heads.append(named if head is None else named._replace(crc=head.crc))
        return heads

    def _content(self, at: int, head: ChunkHead) -> bytes | None:
        """What a chunk holds if this is its head; None if it cannot be."""
        begin = at + head.data_start
        if not 0 <= head.packed_size <= MAX_CHUNK or begin + head.packed_size > self._source.size:
            return None
        packed = self._source.read(begin, head.packed_size)
        limit = min(head.unpacked_size, MAX_CHUNK)
        try:
            data = unpack_data(head.compression, packed, limit)
        except ChunkError:
            self.work -= len(packed) + limit
            return None
        if zlib.crc32(data) != head.crc if head.crc else len(data) != head.unpacked_size:
            self.work -= len(packed) + len(data)
            return None
        return data

    def _indexes(self, at: int) -> list[_IndexRecord]:
        """Message indexes from `at` on."""
        records: list[_IndexRecord] = []
        source = self._source
        while (found := source.head(at)) is not None and found[0] == Opcode.MESSAGE_INDEX:
            end = found[1]
            if end - at - HEAD.size < 6 or end - at > MAX_SMALL:
                break
            body = source.read(at + HEAD.size, end - at - HEAD.size)
            length = int.from_bytes(body[2:6], "little")
            if length != len(body) - 6 or length % 16:
                break
            records.append(_IndexRecord(at, end, int.from_bytes(body[:2], "little"), body[6:]))
            at = end
        return records

    def _torn_plain(self, at: int, prefix: bytes, known: Definitions) -> Whole | None:
        """A chunk that is not packed and was being written when the file ended: its whole records, as a shorter chunk."""
        head = chunk_head(prefix)
        if head is None or head.compression or prefix[0] != Opcode.CHUNK:
            return None
        begin = at + head.data_start
        if begin + head.packed_size <= self._source.size:
            return None
        data = self._source.read(begin, min(MAX_CHUNK, self._source.size - begin))
        data = data[: _whole_records(data, known)]
        if not data:
            return None
        size = len(data)
        head = head._replace(packed_size=size, unpacked_size=size, crc=zlib.crc32(data))
        return _whole(FoundChunk(at, begin + size, head, True, Counter()), prefix, data, walk(data), [])


def _whole(
    chunk: FoundChunk, prefix: bytes, data: bytes, records: Walk, indexes: list[_IndexRecord]
) -> Whole:
    """Fill in what a chunk holds."""
    heads = records.heads
    channels, numbers = np.unique(heads["channel"], return_counts=True)
    chunk.counts = Counter(dict(zip(channels.tolist(), numbers.tolist(), strict=True)))
    if len(heads):
        times = heads["log_time"]
        chunk.head = chunk.head._replace(start_ns=int(times.min()), end_ns=int(times.max()))
    chunk.healed = chunk.head.packed() != prefix[: chunk.head.data_start]
    definitions = []
    for opcode, start, stop in records.others:
        definition = (
            parse(_KINDS[Opcode(opcode)], data[start + HEAD.size : stop]) if opcode in _KINDS else None
        )
        definitions += [] if definition is None else [definition]
    chunk.index_end = chunk.end
    for start, stop, channel, entries in indexes:
        if channel not in chunk.index and _same_entries(entries, index_entries(records, channel)):
            chunk.index[channel] = (start, stop - start)
        else:
            chunk.wrong_index.append((start, stop, channel))
        chunk.index_end = stop
    return Whole(chunk, definitions)


def _hint(indexes: list[_IndexRecord]) -> NDArray[np.int64] | None:
    """Offsets that message indexes give."""
    if not indexes:
        return None
    return np.concatenate([np.frombuffer(each.entries, "<u8")[1::2].astype(np.int64) for each in indexes])


def index_entries(records: Walk, channel: int) -> bytes:
    """Content of the message index of one channel: (log time, offset) of each of its messages."""
    mine = records.heads["channel"] == channel
    entries = np.empty((int(mine.sum()), 2), "<u8")
    entries[:, 0] = records.heads["log_time"][mine]
    entries[:, 1] = records.offsets[mine]
    return entries.tobytes()


def _same_entries(one: bytes, other: bytes) -> bool:
    """Equal but for the order."""
    if one == other:
        return True
    if len(one) != len(other):
        return False
    pairs = (np.frombuffer(entries, "<u8").reshape(-1, 2) for entries in (one, other))
    first, second = (table[np.lexsort(table.T)] for table in pairs)
    return bool((first == second).all())


def _whole_records(data: bytes, known: Definitions) -> int:
    """Bytes of the whole records at the beginning of a chunk that is not packed."""
    at = 0
    channels: set[int] = set()
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        end = at + HEAD.size + length
        if end > len(data) or opcode not in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            break
        number = int.from_bytes(data[at + HEAD.size : at + HEAD.size + 2], "little")
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_BODY or not (
                number in channels or known.knows(number) or (not channels and known.may_be(number))
            ):
                break
        else:
            record = parse(_KINDS[opcode], data[at + HEAD.size : end])
            if record is None or bytes_of(record) != data[at:end]:
                break
            channels |= {number} if opcode == Opcode.CHANNEL else set()
        at = end
    return at
