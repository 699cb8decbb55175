"""What of a log is whole: its data section gone through record by record, whatever a crash or a damaged disk did to it.

Chunks and attachments prove themselves by their CRC; a record without one must parse to its last byte. A record that is
damaged is left out where its length leads to a whole record, else the scan goes on where the summary says that there is
one, or at the next chunk of zstd, which is searched for by the mark in its head. Nothing is taken for a message that stands
in no chunk. Definitions under a CRC are believed before those at the head of the file. Where something is missing, chunks of
our cycles that lack the others of their span are left out (`spans`).
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from jtqd.daemon.logs.container import (
    HEAD,
    HEAD_SIZE,
    MAX_CHUNK,
    MAX_SMALL,
    ChunkError,
    ChunkHead,
    Source,
    Summary,
    Walk,
    attachment_index,
    chunk_head,
    message_index,
    parse,
    unpack,
    walk,
)
from jtqd.daemon.logs.spans import cycle_channels, torn
from jtqd.daemon.recording.mcap_file import MAGIC

_CHUNK_MARK, _CHUNK_MARK_AT = struct.pack("<I4s", 4, b"zstd"), HEAD.size + 28
"""What every chunk of ours has at this offset: the name of its compression."""
_WINDOW = 1 << 20
_PRIVATE = 0x80
_SMALL_KINDS: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.MESSAGE_INDEX: MessageIndex,
}
"""Records of the data section that no CRC covers."""
_TIMELESS = (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
"""Records that hold no messages."""
_SUMMARY_KINDS: dict[int, type[McapRecord]] = {
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
}
"""Records that stand in the summary only."""


class WholeChunk(NamedTuple):
    """A whole chunk. `index` is right; `head_right`, `indexed`: so are the times in its head, its message indexes.

    `marks`: of the numbers and times of its messages, by channel; equal in the chunks of one span.
    `index_end`: offset behind its message indexes.
    """

    index: ChunkIndex
    counts: Counter[int]
    head_right: bool
    indexed: bool
    marks: dict[int, int]
    index_end: int

    @property
    def end(self) -> int:
        """Offset behind the chunk record."""
        return int(self.index.chunk_start_offset + self.index.chunk_length)


@dataclass
class Gap:
    """Bytes that cannot be read. `chunks`: that begin there; `restored`: what stood there is made anew.

    `seconds`: the time for which they stand; None where nothing tells.
    """

    start: int
    end: int
    chunks: int
    restored: bool = False
    seconds: float | None = None


@dataclass
class Contents:
    """The whole records of a file. `summary`: definitions, attachments and metadata; its chunks are `chunks`."""

    magic: bool = False
    header: Header | None = None
    summary: Summary = field(default_factory=Summary)
    unchecked: dict[tuple[type, int], Schema | Channel] = field(default_factory=dict)
    """Definitions that no CRC covers, by kind and number."""
    chunks: list[WholeChunk] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    open_gap: Gap | None = None
    """The next chunk tells for how long it stands."""
    loose_messages: int = 0
    undefined: int = 0
    """Chunks that were left out since a channel in them is defined nowhere."""
    unproven: bool = False
    """Definitions had to be taken that no CRC covers."""
    contradicted: bool = False
    """Definitions at the head are not what the chunks say."""
    cycles: frozenset[int] = frozenset()
    """Channels of our cycles."""
    end: int = 0

    @property
    def counts(self) -> Counter[int]:
        """Messages of each channel."""
        return sum((chunk.counts for chunk in self.chunks), Counter())

    @property
    def timed(self) -> list[WholeChunk]:
        """Return the chunks that tell what time is there: those with cycles, if any, else those with messages."""
        chunks = [chunk for chunk in self.chunks if chunk.counts]
        return [chunk for chunk in chunks if not self.cycles.isdisjoint(chunk.counts)] or chunks

    @property
    def start_ns(self) -> int:
        """First log time; 0 without messages."""
        return min((int(c.index.message_start_time) for c in self.chunks if c.counts), default=0)

    @property
    def end_ns(self) -> int:
        """Last log time; 0 without messages."""
        return max((int(c.index.message_end_time) for c in self.chunks if c.counts), default=0)


def scan(source: Source, own: Summary | None) -> Contents:
    """Go through the data section. `own` is the file's summary, where that holds together. Raises OSError."""
    found = Contents()
    limit, places = source.size, []
    if own is not None and own.data_end:
        places = [chunk.chunk_start_offset for chunk in own.chunks]
        places = sorted(places + [each.offset for each in (*own.metadata, *own.attachments)])
        found.summary.schemas, found.summary.channels = dict(own.schemas), dict(own.channels)
        limit = own.data_end
    found.magic = source.read(0, len(MAGIC)) == MAGIC
    at = len(MAGIC)
    while at < limit:
        end = _take(source, at, limit, found)
        if end is None and own is not None and at not in places:
            end = _private_end(source, at, limit)
        if end is None and _data_end_here(source, at):
            break
        if end is None:
            end = _next_whole(source, at, limit, places)
            _leave_out(source, at, end, found)
        at = end
    found.end = min(at, limit)
    _settle_definitions(found)
    found.cycles = cycle_channels(found.header, found.summary.channels)
    if found.gaps or own is None:
        _leave_out_torn(found)
    return found


def _private_end(source: Source, at: int, limit: int) -> int | None:
    """Return where a private record ends (opcode 80h and above), which every reader skips; None where there is none."""
    framed = source.head(at)
    return framed[1] if framed is not None and framed[0] >= _PRIVATE and framed[1] <= limit else None


def _take(source: Source, at: int, limit: int, found: Contents) -> int | None:
    """Add the record at `at` to what was found; returns where it ends, None where it is not whole."""
    framed = source.head(at)
    if framed is None or framed[1] > limit:
        return None
    opcode, end = framed
    if opcode == Opcode.CHUNK:
        return _take_chunk(source, at, end, found)
    if opcode == Opcode.ATTACHMENT:
        attachment = attachment_index(source, at, end)
        found.summary.attachments += [] if attachment is None else [attachment]
        return None if attachment is None else end
    kind = _SMALL_KINDS.get(opcode)
    record = None if kind is None else parse(kind, _small_body(source, at, end))
    if isinstance(record, Header):
        found.header = record
    elif isinstance(record, Schema | Channel):
        found.unchecked.setdefault((type(record), record.id), record)
    elif isinstance(record, Metadata):
        found.summary.metadata.append(MetadataIndex(at, end - at, record.name))
    return (
        None if record is None else end
    )  # message indexes: of a chunk that was left out, or one that is made anew


def _small_body(source: Source, at: int, end: int) -> bytes:
    return source.read(at + HEAD.size, min(end - at - HEAD.size, MAX_SMALL + 1))


def _take_chunk(source: Source, at: int, end: int, found: Contents) -> int | None:
    """Return the same of a chunk and the message indexes that follow it."""
    head = _framed_chunk(source, at, end)
    data = None if head is None else chunk_content(source, at, head)
    if head is None or data is None:
        return None
    entries, offsets, index_end = _message_indexes(source, end)
    try:
        records = walk(
            data, np.concatenate([e[:, 1] for e in entries.values()]).astype(np.int64) if entries else None
        )
    except ChunkError:
        return None
    times = records.heads["log_time"]
    first, last = (int(times.min()), int(times.max())) if len(times) else (head.start_ns, head.end_ns)
    expected = index_entries(records)
    indexed = expected.keys() == entries.keys() and all(
        np.array_equal(entries[channel][np.argsort(entries[channel][:, 1])], rows)
        for channel, rows in expected.items()
    )
    for definition in _definitions(data, records):
        if not head.crc:
            found.unchecked.setdefault((type(definition), definition.id), definition)
        elif isinstance(definition, Schema):
            found.summary.schemas.setdefault(definition.id, definition)
        else:
            found.summary.channels.setdefault(definition.id, definition)
    index = ChunkIndex(
        chunk_length=end - at,
        chunk_start_offset=at,
        compression=head.compression,
        compressed_size=head.packed_size,
        message_end_time=last,
        message_index_length=index_end - end if indexed else 0,
        message_index_offsets=offsets if indexed else {},
        message_start_time=first,
        uncompressed_size=head.unpacked_size,
    )
    counts = Counter({channel: len(rows) for channel, rows in expected.items()})
    if counts and found.open_gap is not None:
        if any(chunk.counts for chunk in found.chunks):
            found.open_gap.seconds = max(0, first - found.end_ns) * 1e-9
        found.open_gap = None
    head_right = (first, last) == (head.start_ns, head.end_ns)
    found.chunks.append(WholeChunk(index, counts, head_right, indexed, _marks(records), index_end))
    return index_end


def _framed_chunk(source: Source, at: int, limit: int) -> ChunkHead | None:
    """Head of the chunk at `at`, where its lengths agree with each other; its content is not looked at."""
    framed = source.head(at)
    if framed is None or framed[0] != Opcode.CHUNK or framed[1] > limit:
        return None
    head = chunk_head(source.read(at, HEAD_SIZE))
    agrees = head is not None and at + head.data_start + head.packed_size == framed[1]
    return head if agrees and head is not None and head.packed_size <= MAX_CHUNK else None


def chunk_content(source: Source, at: int, head: ChunkHead) -> bytes | None:
    """Return what is in a chunk; None where it is not whole."""
    try:
        return unpack(head, source.read(at + head.data_start, head.packed_size))
    except ChunkError:
        return None


def _message_indexes(source: Source, at: int) -> tuple[dict[int, NDArray[np.uint64]], dict[int, int], int]:
    """Message indexes that begin at `at`: entries and offset of each by channel, and where they end."""
    entries: dict[int, NDArray[np.uint64]] = {}
    offsets: dict[int, int] = {}
    while (framed := source.head(at)) is not None and framed[0] == Opcode.MESSAGE_INDEX:
        channel = int.from_bytes(source.read(at + HEAD.size, 2), "little")
        rows = message_index(source, at, channel)
        if rows is None or channel in entries:
            break
        entries[channel], offsets[channel], at = rows, at, framed[1]
    return entries, offsets, at


def index_entries(records: Walk) -> dict[int, NDArray[np.uint64]]:
    """Entries that the message indexes of a chunk must have, by channel: log time and offset [n, 2], by offset."""
    rows = np.stack([records.heads["log_time"], records.offsets.astype(np.uint64)], axis=1)
    channels = records.heads["channel"]
    return {channel: rows[channels == channel] for channel in np.unique(channels).tolist()}


def _marks(records: Walk) -> dict[int, int]:
    heads = records.heads
    channels, numbers, times = heads["channel"], heads["sequence"], heads["log_time"]
    found = {}
    for channel in np.unique(channels).tolist():
        mine = channels == channel
        found[channel] = zlib.crc32(times[mine].tobytes(), zlib.crc32(numbers[mine].tobytes()))
    return found


def _definitions(data: bytes, records: Walk) -> Iterator[Schema | Channel]:
    for opcode, start, end in records.others:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definition = parse(Schema if opcode == Opcode.SCHEMA else Channel, data[start + HEAD.size : end])
            if definition is not None:
                yield definition


def _data_end_here(source: Source, at: int) -> bool:
    """Return whether the data section ends at `at`: there is DataEnd, or a record that stands in the summary only."""
    framed = source.head(at)
    if framed is None:
        return False
    opcode, end = framed
    if opcode == Opcode.DATA_END:
        return end - at == HEAD.size + 4
    kind = _SUMMARY_KINDS.get(opcode)
    return kind is not None and parse(kind, _small_body(source, at, end)) is not None


def _next_whole(source: Source, at: int, limit: int, places: list[int]) -> int:
    """Return where to go on behind a damaged record: where its length leads, at the next chunk, or the end of the data.

    `places`: where the summary says that there are records.
    """
    framed = source.head(at)
    if framed is not None and framed[1] <= limit:
        end = framed[1]
        if end == limit or _data_end_here(source, end) or _framed_chunk(source, end, limit) is not None:
            return end
        if _take(source, end, limit, Contents()) is not None:
            return end
    for place in places:
        if place > at and _take(source, place, limit, Contents()) is not None:
            return place
    begin = at + 1
    while begin < limit:
        window = source.read(begin, min(_WINDOW + _CHUNK_MARK_AT + len(_CHUNK_MARK), limit - begin))
        place = window.find(_CHUNK_MARK, _CHUNK_MARK_AT)
        while place >= 0:
            start = begin + place - _CHUNK_MARK_AT
            head = _framed_chunk(source, start, limit)
            if head is not None and chunk_content(source, start, head) is not None:
                return start
            place = window.find(_CHUNK_MARK, place + 1)
        begin += _WINDOW
    return limit


def _leave_out(source: Source, start: int, end: int, found: Contents) -> None:
    opcode = source.read(start, 1)[0]
    framed = source.head(start)
    found.loose_messages += opcode == Opcode.MESSAGE
    chunk = int(opcode == Opcode.CHUNK)
    # Message indexes are made anew; a definition is known elsewhere, or its chunks are left out.
    restored = opcode == Opcode.MESSAGE_INDEX and bool(found.chunks) and not found.chunks[-1].indexed
    restored |= opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and framed is not None and framed[1] == end
    timeless = framed is not None and framed[1] == end and opcode in _TIMELESS
    last = found.gaps[-1] if found.gaps else None
    if last is not None and last.end == start and not last.restored and not restored:
        last.end, last.chunks = end, last.chunks + chunk
        last.seconds = last.seconds if timeless else None
    else:
        found.gaps.append(Gap(start, end, chunk, restored, 0.0 if timeless else None))
        found.open_gap = found.open_gap if restored else found.gaps[-1]


def _settle_definitions(found: Contents) -> None:
    """Choose definitions, those that a CRC covers before others; leave out chunks with a channel that has none."""
    known: dict[type, dict[int, Any]] = {Schema: found.summary.schemas, Channel: found.summary.channels}
    taken = set()
    for (kind, number), definition in found.unchecked.items():
        have = known[kind].setdefault(number, definition)
        found.contradicted |= have != definition
        if have is definition:
            taken.add((kind, number))
    schemas, channels = found.summary.schemas, found.summary.channels
    for number, channel in list(channels.items()):
        if channel.schema_id and channel.schema_id not in schemas:
            del channels[number]
    kept = []
    for chunk in found.chunks:
        if chunk.counts.keys() <= channels.keys():
            kept.append(chunk)
            continue
        found.undefined += 1
        seconds = (chunk.index.message_end_time - chunk.index.message_start_time) * 1e-9
        found.gaps.append(Gap(chunk.index.chunk_start_offset, chunk.end, 1, seconds=seconds))
    found.chunks = kept
    found.unproven = any(
        (Channel, number) in taken or (Schema, channels[number].schema_id) in taken for number in found.counts
    )


def _leave_out_torn(found: Contents) -> None:
    """Leave out chunks whose cycles lack messages of other topics, as one gap with what is missing beside them."""
    places = torn((chunk.marks for chunk in found.chunks), found.cycles)
    if not places:
        return
    left_out = [found.chunks.pop(place) for place in reversed(places)]
    gaps = [Gap(chunk.index.chunk_start_offset, chunk.index_end, 1) for chunk in left_out]
    starts = [chunk.index.chunk_start_offset for chunk in found.chunks]
    merged: list[Gap] = []
    for gap in sorted((gap for gap in found.gaps + gaps if not gap.restored), key=lambda gap: gap.start):
        before = merged[-1] if merged else None
        if before is None or bisect(starts, before.start) != bisect(starts, gap.start):
            merged.append(gap)
        else:
            merged[-1] = Gap(before.start, gap.end, before.chunks + gap.chunks)
    for gap in merged:
        if gap.chunks and gap.seconds is None:
            gap.seconds = _between(gap, found.timed)
    found.gaps = [gap for gap in found.gaps if gap.restored] + merged


def _between(gap: Gap, timed: Sequence[WholeChunk]) -> float | None:
    """Time between the neighbours of a gap [s]; None where it has only one."""
    before = [chunk for chunk in timed if chunk.index.chunk_start_offset < gap.start]
    behind = [chunk for chunk in timed if chunk.index.chunk_start_offset > gap.start]
    if not before or not behind:
        return None
    return max(0, int(behind[0].index.message_start_time) - int(before[-1].index.message_end_time)) * 1e-9


def is_whole(found: Contents, own: Summary | None) -> bool:
    """Return whether the file ends with a summary that names everything that was found in it, and nothing else."""
    if own is None or not found.magic or found.header is None or found.contradicted or found.gaps:
        return False
    expected = [chunk.index for chunk in found.chunks]
    if not all(chunk.head_right and chunk.indexed for chunk in found.chunks):
        return False
    if own.statistics is not None:
        counts = (own.statistics.message_count, own.statistics.chunk_count)
        if counts != (sum(found.counts.values()), len(expected)):
            return False
    named = sorted(own.chunks, key=lambda chunk: chunk.chunk_start_offset)
    return (
        list(map(_essence, named)) == list(map(_essence, expected))
        and own.attachments == found.summary.attachments
        and own.metadata == found.summary.metadata
        and all(own.channels.get(number) == found.summary.channels[number] for number in found.counts)
    )


def _essence(index: ChunkIndex) -> tuple[Any, ...]:
    return (
        *(index.chunk_start_offset, index.chunk_length, index.compression),
        *(index.compressed_size, index.uncompressed_size),
        *(index.message_start_time, index.message_end_time, index.message_index_offsets),
    )
