"""Messages collected into one MCAP chunk: compressed, with CRC and message indexes, ready to be put into any file. Pure.

Schemas and channels are repeated inside the first and every so many chunks, so that a file with a damaged head can be read.
Messages stand in the order of their log times: what is heard of late (a notice of the supervisor) goes to its place.

Compared with the library's Writer, the messages of a cycle enter as ready-made bytes: 0.5 us a message instead of 3.5, and a
chunk that could not be written leaves no entry in the index.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter

import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, McapRecord, Schema

from daemon.recording.mcap_bytes import bytes_of

_COMPRESSION = "zstd"
_LEVEL = 3
"""On chunks of 500 cycles level 1 is 2 % larger for 0.08 % of a core less, 5 is 1 % smaller for 0.3 % more."""
_CHUNK = struct.Struct("<BQQQQII4sQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_MESSAGE = struct.Struct("<BQHIQQ")
_BLOCK = -1
"""Stands for the channels of a cycle's messages."""
_Entry = tuple[int, int, bytes]
"""Log time [ns], channel or `_BLOCK`, Message records."""


@dataclass(frozen=True)
class SealedChunk:
    """A chunk with its message indexes.

    Attributes:
        data: bytes of the Chunk record and its MessageIndex records.
        length: bytes of the Chunk record alone.
        start_ns, end_ns: first and last log time.
        raw_size, packed_size: bytes of the messages before and after compression.
        counts: messages of each channel.
        index_offsets: where the MessageIndex of each channel begins within `data`.
        cycles: blocks in it.
    """

    data: bytes
    length: int
    start_ns: int
    end_ns: int
    raw_size: int
    packed_size: int
    counts: dict[int, int]
    index_offsets: dict[int, int]
    cycles: int

    def index(self, at: int) -> McapRecord:
        """ChunkIndex record of this chunk in a file where it begins at byte `at`."""
        return ChunkIndex(
            chunk_length=self.length,
            chunk_start_offset=at,
            compression=_COMPRESSION,
            compressed_size=self.packed_size,
            message_end_time=self.end_ns,
            message_index_length=len(self.data) - self.length,
            message_index_offsets={channel: at + start for channel, start in self.index_offsets.items()},
            message_start_time=self.start_ns,
            uncompressed_size=self.raw_size,
        )


class ChunkBuilder:
    """Collects messages until `seal`.

    Args:
        schemas, channels: of mcap.records, repeated in some chunks; their identifiers are the caller's.
        block_parts: (channel, start) of the Message records within what `add_block` gets.
        repeat_every: schemas and channels are in the first chunk and every so many.
    """

    def __init__(
        self,
        schemas: Sequence[Schema],
        channels: Sequence[Channel],
        block_parts: Sequence[tuple[int, int]],
        repeat_every: int,
    ) -> None:
        self._definitions = bytes_of(*schemas, *channels)
        self._block_parts = block_parts
        self._repeat_every = repeat_every
        self._compress = zstandard.ZstdCompressor(level=_LEVEL).compress
        self._sealed = 0
        self._begin()

    def restart(self) -> None:
        """A file begins: its next chunk repeats schemas and channels (the one after it, if this one has begun)."""
        if self._entries:
            self._sealed = 0 if self._repeats else -1
        else:
            self._sealed = 0
            self._begin()

    def _begin(self) -> None:
        self._repeats = self._sealed % self._repeat_every == 0
        self._length = len(self._definitions) if self._repeats else 0
        self._entries: list[_Entry] = []

    @property
    def pending(self) -> int:
        """Bytes that wait for `seal`."""
        return self._length

    def add_block(self, block: bytes, time_ns: int) -> None:
        """Add one cycle's Message records (laid out as `block_parts` says), all of the same log time."""
        self._entries.append((time_ns, _BLOCK, block))
        self._length += len(block)

    def add(self, channel: int, time_ns: int, payload: bytes, sequence: int = 0) -> None:
        """Add one message; log time and publish time are the same."""
        head = _MESSAGE.pack(Opcode.MESSAGE, 22 + len(payload), channel, sequence, time_ns, time_ns)
        self._entries.append((time_ns, channel, head + payload))
        self._length += len(head) + len(payload)

    def _indexes(self, at: int) -> tuple[dict[int, list[int]], int]:
        """Log time and offset of every message, one after the other, by channel; and the number of blocks.

        `at`: where the first of them begins within the chunk.
        """
        flat: dict[int, list[int]] = {}
        times, starts = [], []
        for time, channel, data in self._entries:
            if channel == _BLOCK:
                times.append(time)
                starts.append(at)
            else:
                flat.setdefault(channel, []).extend((time, at))
            at += len(data)
        for channel, start in self._block_parts if times else ():
            entries = [0] * (2 * len(times))
            entries[0::2] = times
            entries[1::2] = [begin + start for begin in starts]
            flat.setdefault(channel, []).extend(entries)
        return flat, len(times)

    def seal(self) -> SealedChunk | None:
        """What was added since the last time as one chunk; None when that is nothing."""
        if not self._entries:
            return None
        self._entries = _by_time(self._entries)
        times = [time for time, _, _ in self._entries]
        start, end = min(times), max(times)
        definitions = self._definitions if self._repeats else b""
        raw = b"".join([definitions, *(data for _, _, data in self._entries)])
        packed = self._compress(raw)
        rest = _CHUNK.size - 9 + len(packed)
        head = _CHUNK.pack(
            Opcode.CHUNK, rest, start, end, len(raw), zlib.crc32(raw), 4, _COMPRESSION.encode(), len(packed)
        )
        flat, cycles = self._indexes(len(definitions))
        indexes = {channel: _index_record(channel, entries) for channel, entries in flat.items()}
        offsets, position = {}, len(head) + len(packed)
        for channel, record in indexes.items():
            offsets[channel] = position
            position += len(record)
        sealed = SealedChunk(
            data=b"".join((head, packed, *indexes.values())),
            length=len(head) + len(packed),
            start_ns=start,
            end_ns=end,
            raw_size=len(raw),
            packed_size=len(packed),
            counts={channel: len(entries) // 2 for channel, entries in flat.items()},
            index_offsets=offsets,
            cycles=cycles,
        )
        self._sealed += 1
        self._begin()
        return sealed


def _by_time(entries: list[_Entry]) -> list[_Entry]:
    """In the order of log times; as they came where the clock was set back: cycles keep their order whatever it says."""
    cycles = [time for time, channel, _ in entries if channel == _BLOCK]
    if any(later < earlier for earlier, later in pairwise(cycles)):
        return entries
    return sorted(entries, key=itemgetter(0))


def _index_record(channel: int, entries: Sequence[int]) -> bytes:
    """Message Index record: `entries` are log times and offsets by turns."""
    size = 8 * len(entries)
    head = _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size)
    return head + struct.pack(f"<{len(entries)}Q", *entries)
