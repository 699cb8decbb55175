"""One MCAP file: its summary, the messages of its chunks as arrays, and the intact contents of a damaged file.

Records are parsed by the `mcap` library (https://mcap.dev/spec). A chunk of the recorder holds one topic whose messages have
one length, so that it is one array from its first byte to its last. Files of any origin are read without trust: every
length is checked against the file, every CRC is checked, and no chunk above 256 MB is unpacked.
"""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.summary import Summary
from numpy.typing import NDArray

from jtqd.daemon.recording.mcap_file import MAGIC, SealedChunk, attachment_index, bytes_of, index_record
from jtqd.daemon.recording.messages import CAN_FRAMES, JOINTS
from jtqd.daemon.recording.run_files import ACTIVE

HEAD = struct.Struct("<BQ")
"""Opcode, and the length of what follows."""
MAX_CHUNK = 256 << 20
"""[byte] largest record that is read, packed or unpacked. Writers make chunks of 1 to 10 MB."""
MESSAGE_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log_time"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8"],
        "offsets": [0, 1, 9, 11, 15],
        "itemsize": 31,
    }
)
MESSAGE_BODY = MESSAGE_HEAD.itemsize - HEAD.size
"""Bytes of a Message record between opcode and length and the payload."""
_MESSAGE_INDEX_ENTRY = 16
"""[byte] the least that a message takes of a file."""
_U2, _U4, _U8 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class LogError(ValueError):
    """The log cannot be used; one line: file, topic, found, expected."""


class ChunkError(ValueError):
    """The chunk cannot be unpacked; the message is the reason."""


# ---- records ----


class _Body(ReadDataStream):  # type: ignore[misc]
    """Body of one record for the library's parsers; a read past its end raises EndOfFile or struct.error."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def count(self) -> int:
        return self._at

    def read(self, length: int) -> bytes:
        begin, self._at = self._at, self._at + length
        if self._at > len(self._data):
            raise EndOfFile
        return self._data[begin : self._at]

    def _number(self, code: struct.Struct) -> int:
        value: int = code.unpack_from(self._data, self._at)[0]
        self._at += code.size
        return value

    def read2(self) -> int:
        return self._number(_U2)

    def read4(self) -> int:
        return self._number(_U4)

    def read8(self) -> int:
        return self._number(_U8)


_DATA_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
"""Records of the data section beside chunks and message indexes."""
_SUMMARY_KINDS: dict[int, Any] = {
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}
"""Records that stand in the summary only."""
_KINDS = _DATA_KINDS | _SUMMARY_KINDS | {Opcode.CHUNK: Chunk, Opcode.FOOTER: Footer}


def parse(opcode: int, body: bytes) -> Any:
    """Return a record of the library from the bytes behind its head; None where they do not make one."""
    kind = _KINDS.get(opcode)
    try:
        return None if kind is None else kind.read(_Body(body))
    except (McapError, struct.error, ValueError):
        return None


class Source:
    """Records of an open file by their offset. Every method raises OSError."""

    def __init__(self, descriptor: int) -> None:
        self._file = descriptor
        self.size = os.fstat(descriptor).st_size
        self._zstd = zstandard.ZstdDecompressor()

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes from `offset` on."""
        return os.pread(self._file, length, offset)

    def head(self, offset: int) -> tuple[int, int] | None:
        """(opcode, offset behind the record) of the record at `offset`; None where it would leave the file."""
        found = self.read(offset, HEAD.size)
        if len(found) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(found)
        end = offset + HEAD.size + length
        return (opcode, end) if end <= self.size else None

    def record(self, offset: int, end: int) -> bytes:
        """Bytes of a record; empty for one that is too large to be read."""
        return self.read(offset, end - offset) if end - offset <= MAX_CHUNK else b""

    def parsed(self, offset: int, opcode: int) -> Any:
        """Return the record of this kind at `offset`, intact to its last byte; None where there is none.

        The CRC of an attachment is checked.
        """
        framed = self.head(offset)
        if framed is None or framed[0] != opcode:
            return None
        data = self.record(offset, framed[1])
        record = parse(opcode, data[HEAD.size :])
        return record if record is not None and bytes_of(record) == data else None

    def unpack(self, chunk: Chunk) -> bytes:
        """Content of a chunk, checked against its size and CRC. Raises ChunkError."""
        size = chunk.uncompressed_size
        if size > MAX_CHUNK:
            raise ChunkError(f"found {size} bytes unpacked in its head, expected at most {MAX_CHUNK}")
        try:
            data = self._decompressed(chunk.compression, chunk.data, size)
        except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
            raise ChunkError(f"cannot be unpacked ({chunk.compression}): {error}") from None
        if len(data) != size:
            raise ChunkError(f"found {len(data)} bytes unpacked, expected {size}")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ChunkError("its CRC does not match")
        return data

    def _decompressed(self, compression: str, packed: bytes, size: int) -> bytes:
        """Never more than `size` + 1 bytes."""
        if compression == "zstd":
            # The decompressor allocates what the frame's own head names, whatever the limit.
            framed = zstandard.frame_content_size(packed)
            if framed > size:
                raise ChunkError(f"found {framed} bytes unpacked in its frame, expected {size}")
            return self._zstd.decompress(packed, max_output_size=max(size, 1))
        if compression == "lz4":
            data: bytes = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            return data
        if compression:
            raise ChunkError(f"found compression {compression!r:.20}, expected zstd, lz4 or none")
        return packed


def read_summary(source: Source) -> tuple[Summary, int] | None:
    """Return the summary and where the data section ends; None where the file ends too early, or its CRC is wrong."""
    footer_size = HEAD.size + 20
    at = source.size - len(MAGIC) - footer_size
    if at < len(MAGIC) or source.read(at + footer_size, len(MAGIC)) != MAGIC:
        return None
    footer = source.parsed(at, Opcode.FOOTER)
    begin = at if footer is None else footer.summary_start or at
    if footer is None or not len(MAGIC) <= begin <= at or at - begin > MAX_CHUNK:
        return None
    section = source.read(begin, at + footer_size - 4 - begin)
    if footer.summary_crc and zlib.crc32(section) != footer.summary_crc:
        return None
    data_end = begin - HEAD.size - 4
    if source.head(data_end) != (Opcode.DATA_END, begin):
        return None
    found = Summary()
    place = 0
    while place < at - begin:
        opcode, length = HEAD.unpack_from(section, place)
        body = section[place + HEAD.size : place + HEAD.size + length]
        record = parse(opcode, body)
        if record is None and opcode != Opcode.SUMMARY_OFFSET:
            return None
        _put(found, record)
        place += HEAD.size + length
    return found, data_end


def _put(summary: Summary, record: Any) -> None:
    if isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, ChunkIndex):
        summary.chunk_indexes.append(record)
    elif isinstance(record, AttachmentIndex):
        summary.attachment_indexes.append(record)
    elif isinstance(record, MetadataIndex):
        summary.metadata_indexes.append(record)


# ---- messages of a chunk ----


class Batch(NamedTuple):
    """Messages of one channel out of one chunk: `data` holds them, `offsets` is where each record begins [n]."""

    channel: int
    data: bytes
    offsets: NDArray[np.int64]
    log_times: NDArray[np.uint64]
    lengths: NDArray[np.uint64]
    """Of the payloads, which begin 31 bytes behind the offsets."""
    step: int = 0
    """Bytes from each record to the next, where they are all of one length; 0: unknown."""

    def only(self, wanted: NDArray[np.bool_]) -> Batch:
        """Return the messages that are wanted [n]."""
        return Batch(
            self.channel, self.data, self.offsets[wanted], self.log_times[wanted], self.lengths[wanted]
        )


def pieces(data: bytes, offsets: NDArray[np.int64], size: int) -> NDArray[np.void]:
    """`size` bytes from each of these offsets, every one within `data`, as one array [n] of plain bytes."""
    count = max(0, len(data) - size + 1)
    # Plain bytes are copied many times faster than records with fields.
    return np.ndarray((count,), np.dtype(("V", size)), data, strides=(1,))[offsets]


def batches_of(data: bytes) -> list[Batch]:
    """Return the messages of an unpacked chunk by channel, in the order of their first ones.

    Raises:
        ChunkError: its records do not fill it.
    """
    alone = _of_one_length(data)
    if alone is not None:
        return [alone]
    offsets = _message_offsets(data)
    heads = pieces(data, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
    found = []
    channels, firsts = np.unique(heads["channel"], return_index=True)
    for channel in channels[np.argsort(firsts)].tolist():
        own = heads["channel"] == channel
        mine = heads[own]
        found.append(Batch(channel, data, offsets[own], mine["log_time"], mine["length"] - MESSAGE_BODY))
    return found


def _of_one_length(data: bytes) -> Batch | None:
    """Return the messages of a chunk that holds nothing but those of one channel, all of one length; else None."""
    if len(data) < MESSAGE_HEAD.itemsize:
        return None
    opcode, length, channel = struct.unpack_from("<BQH", data)
    step = HEAD.size + length
    if opcode != Opcode.MESSAGE or length < MESSAGE_BODY or len(data) % step:
        return None
    count = len(data) // step
    fixed = np.ndarray((count, 11), np.uint8, data, strides=(step, 1))  # opcode, length and channel
    if not (fixed == fixed[0]).all():
        return None
    times = np.ndarray((count,), "<u8", data, 15, (step,))
    lengths = np.full(count, length - MESSAGE_BODY, np.uint64)
    return Batch(channel, data, np.arange(0, len(data), step), times, lengths, step)


def _message_offsets(data: bytes) -> NDArray[np.int64]:
    offsets = array("q", (at for opcode, at, _ in _records_in(data) if opcode == Opcode.MESSAGE))
    return np.frombuffer(offsets, np.int64) if offsets else np.empty(0, np.int64)


def _records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start, end) of the records of an unpacked chunk. Raises ChunkError."""
    at, stop, unpack = 0, len(data), HEAD.unpack_from
    while at < stop:
        if stop - at < HEAD.size:
            raise ChunkError("a record in it is truncated")
        opcode, length = unpack(data, at)
        end = at + HEAD.size + length
        if end > stop:
            raise ChunkError("a record in it is longer than the chunk")
        if opcode == Opcode.MESSAGE and length < MESSAGE_BODY:
            raise ChunkError("a message in it is too short")
        yield opcode, at, end
        at = end


# ---- an open log ----


class LogFile:
    """An open log. Use as a context manager.

    Args:
        path: `X.mcap`, or `X.mcap.active` as far as it is intact.

    Attributes:
        schemas, channels: records of the library by their numbers.
        attachments: index records.
        counts: messages of each channel; empty where the file does not tell.

    Raises:
        LogError: no MCAP file, one that ends too early and is not called `.active`, or messages outside chunks.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            self._source = Source(self._descriptor)
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        source = self._source
        if source.read(0, len(MAGIC)) != MAGIC:
            raise self._error("its first bytes are not MCAP's")
        self.counts: Mapping[int, int] = {}
        found = read_summary(source)
        if found is not None:
            summary, _ = found
            self.schemas, self.channels = summary.schemas, summary.channels
            self.attachments, self._chunks = summary.attachment_indexes, summary.chunk_indexes
            statistics = summary.statistics
            if statistics is not None:
                self.counts = statistics.channel_message_counts
            if not self._chunks and (statistics is None or statistics.message_count):
                raise self._error("found no index of chunks, expected every message in one (`mcap compress`)")
        elif self.path.suffix == ACTIVE:
            contents = scan(source)
            self.schemas, self.channels = contents.schemas, contents.channels
            self.attachments = [index for _, index in contents.attachments]
            self._chunks = [chunk.index for chunk in contents.chunks]
        else:
            ended = source.read(source.size - len(MAGIC), len(MAGIC)) == MAGIC
            what = "its summary is damaged" if ended else "it ends too early"
            raise self._error(f"{what} (`jtq recover` repairs it)")

    def _error(self, what: str) -> LogError:
        return LogError(f"{self.path}: not a readable MCAP file: {what}")

    def __enter__(self) -> LogFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    @property
    def expected(self) -> dict[int, int]:
        """Channel -> messages by the summary, as far as the file is long enough for them."""
        most = self._source.size // _MESSAGE_INDEX_ENTRY
        return {channel: min(count, most) for channel, count in self.counts.items()}

    @property
    def start_ns(self) -> int:
        """First log time; 0 without messages."""
        return min((int(chunk.message_start_time) for chunk in self._chunks), default=0)

    def batches(
        self, channels: Collection[int], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Batch]:
        """Yield messages in the order of the file, at most one batch of each channel from a chunk.

        Args:
            channels: numbers of those that are wanted.
            start_ns, end_ns: log times from the first on, up to but without the second; None: no bound.

        Raises:
            LogError: a chunk is damaged.
            OSError: the file cannot be read.
        """
        wanted = set(channels)
        first = 0 if start_ns is None else start_ns
        last = (1 << 64) - 1 if end_ns is None else end_ns - 1
        for chunk in self._chunks:
            indexed = chunk.message_index_offsets
            if chunk.message_end_time < first or chunk.message_start_time > last:
                continue
            if indexed and wanted.isdisjoint(indexed):
                continue
            whole = chunk.message_start_time >= first and chunk.message_end_time <= last
            for batch in self._batches_of(chunk):
                if batch.channel in wanted:
                    inside = (batch.log_times >= first) & (batch.log_times <= last) if not whole else None
                    yield batch if inside is None else batch.only(inside)

    def _batches_of(self, index: ChunkIndex) -> list[Batch]:
        at, length = index.chunk_start_offset, index.chunk_length
        record = self._source.record(at, at + length)
        try:
            if record[: HEAD.size] != HEAD.pack(Opcode.CHUNK, length - HEAD.size):
                raise ChunkError("found none, expected one")
            chunk = parse(Opcode.CHUNK, record[HEAD.size :])
            if chunk is None:
                raise ChunkError("its lengths do not agree")
            return batches_of(self._source.unpack(chunk))
        except ChunkError as error:
            raise self._error(f"chunk at byte {at}: {error} (`jtq recover` repairs it)") from None

    def attachment(self, index: AttachmentIndex) -> bytes:
        """Return the content of an attachment. Raises LogError where it is damaged."""
        record = self._source.parsed(index.offset, Opcode.ATTACHMENT)
        if record is None:
            raise LogError(f"{self.path}: attachment {index.name!r} is damaged")
        data: bytes = record.data
        return data


# ---- the intact contents of a damaged or unfinished file ----

_CHUNK_MARK, _CHUNK_MARK_AT = struct.pack("<I4s", 4, b"zstd"), HEAD.size + 28
"""What every chunk of the recorder has at this offset: the name of its compression."""
_CHUNK_SIZES = struct.Struct("<BQQQ20xQ")
"""Opcode, length, start and end time, and length of the packed bytes of such a chunk."""
_WINDOW = 1 << 20
_CYCLE_TOPICS = {CAN_FRAMES.name, *(topic.name for topic in JOINTS)}


class IntactChunk(NamedTuple):
    """An intact chunk of the file.

    Attributes:
        index: index record of the chunk and its message indexes as they must be.
        end: offset behind the chunk and the message indexes that are right.
        counts: messages of each channel.
        marks: of the numbers and times of its messages, by channel; equal in the chunks of one span.
        unchanged: its head and its message indexes are right.
    """

    index: ChunkIndex
    end: int
    counts: Mapping[int, int]
    marks: Mapping[int, int]
    unchanged: bool


class Gap(NamedTuple):
    """Bytes that cannot be kept; `end_ns`: last log time of the chunk that stood there, where its head tells."""

    start: int
    end: int
    is_chunk: bool = False
    end_ns: int | None = None


@dataclass
class Contents:
    """Intact records of a file.

    Attributes:
        tail: summary, and where the data section ends; None without an intact summary.
        end: where the scan ended.
        magic: the file begins as it must.
        attachments, metadata: with their index records.
        schemas, channels: definitions; one that a CRC covers goes before one at the head.
        unproven: a definition had to be taken that no CRC covers.
        contradicted: definitions at the head are damaged.
        undefined: chunks that were left out since a channel in them is defined nowhere.
        chunks: whose channels are defined, and whose spans are whole.
        cycles: channels with a message in every cycle.
    """

    tail: tuple[Summary, int] | None
    end: int = 0
    magic: bool = False
    header: Header | None = None
    attachments: list[tuple[Attachment, AttachmentIndex]] = field(default_factory=list)
    metadata: list[tuple[Metadata, MetadataIndex]] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    unproven: bool = False
    contradicted: bool = False
    undefined: int = 0
    chunks: list[IntactChunk] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    cycles: frozenset[int] = frozenset()
    head: list[Schema | Channel] = field(default_factory=list)
    """Definitions that no CRC covers."""
    rebuilt_to: int = 0
    """Message indexes before this offset are rebuilt from the chunk before them."""

    @property
    def counts(self) -> Counter[int]:
        """Messages of each channel."""
        return sum((Counter(chunk.counts) for chunk in self.chunks), Counter())

    @property
    def foreign(self) -> bool:
        """Return whether another program wrote the file."""
        return self.header is not None and not self.header.library.startswith("jtqd")

    @property
    def whole(self) -> bool:
        """Return whether the file ends with a summary of exactly what was found in it, and nothing is damaged."""
        if self.tail is None or not self.magic or self.header is None or self.contradicted or self.gaps:
            return False
        own = self.tail[0]
        if own.statistics is not None and own.statistics.message_count != sum(self.counts.values()):
            return False
        return (
            all(chunk.unchanged for chunk in self.chunks)
            and own.chunk_indexes == [chunk.index for chunk in self.chunks]
            and own.attachment_indexes == [index for _, index in self.attachments]
            and own.metadata_indexes == [index for _, index in self.metadata]
            and all(own.channels.get(number) == self.channels[number] for number in self.counts)
        )


def scan(source: Source) -> Contents:
    """Go through the data section record by record, past damaged ones.

    A chunk is intact by its CRC, another record where it parses to its last byte. Behind a damaged record the scan goes
    on where its length leads to an intact one, where the summary has one, or at the next zstd chunk. Chunks of the
    recorder's cycles that lack the others of their span are left out: readers take the arrays of two joints for arrays of
    the same cycles.
    """
    found = Contents(read_summary(source))
    limit, places = source.size, []
    if found.tail is not None:
        summary, limit = found.tail
        found.schemas, found.channels = dict(summary.schemas), dict(summary.channels)
        places = [chunk.chunk_start_offset for chunk in summary.chunk_indexes]
        places += [each.offset for each in (*summary.metadata_indexes, *summary.attachment_indexes)]
    found.magic = source.read(0, len(MAGIC)) == MAGIC
    at = len(MAGIC)
    while at < limit:
        end = _take(source, at, limit, found)
        if end is None and found.tail is None and _summary_begins(source, at):
            break
        if end is None:
            end = _resume(source, at, limit, [found.rebuilt_to, *sorted(places)])
            _leave_out(source, at, end, found)
        at = end
    found.end = min(at, limit)
    _settle_definitions(found)
    if not found.foreign:
        found.cycles = frozenset(n for n, each in found.channels.items() if each.topic in _CYCLE_TOPICS)
    if found.gaps or found.tail is None:
        for place in reversed(_torn([chunk.marks for chunk in found.chunks], found.cycles)):
            found.gaps.append(_gap_of(found.chunks.pop(place)))
    return found


def _take(source: Source, at: int, limit: int, found: Contents) -> int | None:
    """Add the record at `at` to what was found; returns where it ends, None where it is not intact."""
    framed = source.head(at)
    if framed is None or framed[1] > limit:
        return None
    opcode, end = framed
    if opcode == Opcode.CHUNK:
        return _take_chunk(source, at, found)
    if opcode == Opcode.MESSAGE_INDEX:  # of a chunk that is left out, or whose indexes are rebuilt
        size = int.from_bytes(source.read(at + HEAD.size + 2, 4), "little")
        return end if end - at == HEAD.size + 6 + size and size % _MESSAGE_INDEX_ENTRY == 0 else None
    record = source.parsed(at, opcode) if opcode in _DATA_KINDS else None
    if record is None:
        return None
    if isinstance(record, Header):
        found.header = record
    elif isinstance(record, Attachment):
        found.attachments.append((record, attachment_index(record, at, end - at)))
    elif isinstance(record, Metadata):
        found.metadata.append((record, MetadataIndex(at, end - at, record.name)))
    else:
        found.head.append(record)
    return end


def _take_chunk(source: Source, at: int, found: Contents) -> int | None:
    made = sealed_chunk(source, at)
    if made is None:
        return None
    sealed, data, batches = made
    unchanged = source.read(at, len(sealed.data)) == sealed.data
    found.rebuilt_to = at + len(sealed.data)
    end = found.rebuilt_to if unchanged else at + sealed.length
    marks = {each.channel: zlib.crc32(pieces(data, each.offsets + 11, 12).tobytes()) for each in batches}
    found.chunks.append(IntactChunk(sealed.index(at), end, sealed.counts, marks, unchanged))
    if not any(each.step for each in batches):
        for opcode, begin, behind in _records_in(data):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                record = parse(opcode, data[begin + HEAD.size : behind])
                known: dict[int, Any] = found.schemas if opcode == Opcode.SCHEMA else found.channels
                if record is not None:
                    known.setdefault(record.id, record)
    return end


def sealed_chunk(source: Source, at: int) -> tuple[SealedChunk, bytes, list[Batch]] | None:
    """Return the zstd chunk at `at` with the size, times and message indexes that follow from its content.

    The second value is its unpacked content, the third its messages. None: its content is damaged.
    """
    chunk = source.parsed(at, Opcode.CHUNK)
    if chunk is None or chunk.compression != "zstd" or not chunk.uncompressed_crc:
        return None
    try:
        size = zstandard.frame_content_size(chunk.data)
        chunk.uncompressed_size = size if size > 0 else chunk.uncompressed_size
        data = source.unpack(chunk)
        batches = batches_of(data)
    except (ChunkError, zstandard.ZstdError):
        return None
    if any(len(each.offsets) for each in batches):
        chunk.message_start_time = min(int(each.log_times.min()) for each in batches)
        chunk.message_end_time = max(int(each.log_times.max()) for each in batches)
    record = bytes_of(chunk)
    indexes, offsets, end = [], {}, len(record)
    for each in batches:
        entries = np.stack([each.log_times, each.offsets.astype(np.uint64)], axis=1)
        indexes.append(index_record(each.channel, entries.ravel().tolist()))
        offsets[each.channel] = end
        end += len(indexes[-1])
    sealed = SealedChunk(
        data=b"".join((record, *indexes)),
        length=len(record),
        start_ns=chunk.message_start_time,
        end_ns=chunk.message_end_time,
        raw_size=chunk.uncompressed_size,
        packed_size=len(chunk.data),
        counts={each.channel: len(each.offsets) for each in batches},
        index_offsets=offsets,
    )
    return sealed, data, batches


def _summary_begins(source: Source, at: int) -> bool:
    """Return whether the data section ends at `at`: there is DataEnd, or a record that stands in the summary only."""
    framed = source.head(at)
    if framed is None or framed[0] not in (Opcode.DATA_END, *_SUMMARY_KINDS):
        return False
    return (
        framed[1] - at == HEAD.size + 4
        if framed[0] == Opcode.DATA_END
        else bool(source.parsed(at, framed[0]))
    )


def _resume(source: Source, at: int, limit: int, places: Iterable[int]) -> int:
    """Return where the scan goes on behind a damaged record at `at`; `places`: where other records should begin."""
    framed = source.head(at)
    for place in ([] if framed is None else [framed[1]]) + list(places):
        if at < place <= limit and (
            place == limit
            or _is_framed_chunk(source, place, limit)
            or _take(source, place, limit, Contents(None)) is not None
            or _summary_begins(source, place)
        ):
            return place
    begin = at + 1
    while begin < limit:
        window = source.read(begin, min(_WINDOW + _CHUNK_MARK_AT + len(_CHUNK_MARK), limit - begin))
        place = window.find(_CHUNK_MARK, _CHUNK_MARK_AT)
        while place >= 0:
            start = begin + place - _CHUNK_MARK_AT
            if _is_framed_chunk(source, start, limit) and sealed_chunk(source, start) is not None:
                return start
            place = window.find(_CHUNK_MARK, place + 1)
        begin += _WINDOW
    return limit


def _is_framed_chunk(source: Source, at: int, limit: int) -> bool:
    """Return whether a zstd chunk begins at `at` whose lengths agree; its content is not looked at."""
    head = source.read(at, _CHUNK_SIZES.size)
    if len(head) < _CHUNK_SIZES.size or head[_CHUNK_MARK_AT:][: len(_CHUNK_MARK)] != _CHUNK_MARK:
        return False
    opcode, length, _, _, packed = _CHUNK_SIZES.unpack(head)
    behind = at + HEAD.size + length
    return bool(opcode == Opcode.CHUNK and at + _CHUNK_SIZES.size + packed == behind <= limit)


def _leave_out(source: Source, start: int, end: int, found: Contents) -> None:
    """Note the damaged bytes from `start` to `end`, as far as they are not rebuilt from others."""
    framed, start = source.head(start), max(start, found.rebuilt_to)
    if start >= end:
        return
    if framed is not None and framed[1] == end and framed[0] in (Opcode.SCHEMA, Opcode.CHANNEL):
        found.contradicted = True  # known from elsewhere, or its chunks are left out
        return
    head = source.read(start, _CHUNK_SIZES.size)
    is_chunk = head[:1] == bytes([Opcode.CHUNK])
    end_ns = _CHUNK_SIZES.unpack(head)[3] if is_chunk and len(head) == _CHUNK_SIZES.size else None
    found.gaps.append(Gap(start, end, is_chunk, end_ns))


def _gap_of(chunk: IntactChunk) -> Gap:
    return Gap(chunk.index.chunk_start_offset, chunk.end, True, chunk.index.message_end_time)


def _settle_definitions(found: Contents) -> None:
    """Choose definitions, those that a CRC covers before others; leave out chunks with an undefined channel."""
    unproven = set()
    for record in found.head:
        known: dict[int, Any] = found.schemas if isinstance(record, Schema) else found.channels
        chosen = known.setdefault(record.id, record)
        found.contradicted |= chosen != record
        if chosen is record:
            unproven.add((type(record), record.id))
    for number, channel in list(found.channels.items()):
        if channel.schema_id and channel.schema_id not in found.schemas:
            del found.channels[number]
    for place, chunk in reversed(list(enumerate(found.chunks))):
        if not chunk.counts.keys() <= found.channels.keys():
            found.undefined += 1
            found.gaps.append(_gap_of(found.chunks.pop(place)))
    found.unproven = any(
        not unproven.isdisjoint(((Channel, number), (Schema, found.channels[number].schema_id)))
        for number in found.counts
    )


def _torn(chunks: Iterable[Mapping[int, int]], cycles: frozenset[int]) -> list[int]:
    """Return the places of the chunks with cycles whose span is not whole.

    Args:
        chunks: in the order of the file; of each its channels, and a mark of its messages' cycles, equal throughout a span.
        cycles: channels of the cycles.
    """
    torn: list[int] = []
    span: dict[int, int] = {}
    places: list[int] = []
    for place, chunk in enumerate(chunks):
        mine = {channel: mark for channel, mark in chunk.items() if channel in cycles}
        if not mine:
            continue
        if not mine.keys().isdisjoint(span) or not {*mine.values()} <= {*(span or mine).values()}:
            torn += places
            span, places = {}, []
        span |= mine
        places.append(place)
        if span.keys() == cycles:
            span, places = {}, []
    return torn + places
