"""One MCAP file: its summary, the messages of its chunks as arrays, and the intact contents of a damaged file.

Records are parsed by the `mcap` library (https://mcap.dev/spec). A chunk of the recorder holds one topic whose messages have
one length, so that it is one array from its first byte to its last. Files of any origin are read without trust: every
length is checked against the file, every CRC is checked, and no chunk above 256 MB is unpacked.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
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
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from numpy.typing import NDArray

from jtqd.daemon.recording.mcap_file import MAGIC, SealedChunk, attachment_index, bytes_of, seal
from jtqd.daemon.recording.messages import CAN_FRAMES, JOINTS, SHADOWS
from jtqd.daemon.recording.run_files import ACTIVE
from jtqd.estimator.errors import OneLineError
from jtqd.estimator.files import open_regular

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
_FOOTER_SIZE = HEAD.size + 20
_TOGETHER = 1 << 20
"""[byte] messages outside of chunks that are made one array."""
_U2, _U4, _U8 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")


class LogError(OneLineError):
    """The log cannot be used; one line: file, topic, found, expected."""


class ChunkError(ValueError):
    """The chunk cannot be unpacked; the message is the reason."""


# ---- records ----

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


class _Bytes(ReadDataStream):  # type: ignore[misc]
    """The library's stream over bytes, faster: a log of an hour has 30 000 chunk indexes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._count = data, 0

    def read(self, length: int) -> bytes:
        begin, self._count = self._count, self._count + length
        if self._count > len(self._data):
            raise EndOfFile
        return self._data[begin : self._count]

    def _number(self, code: struct.Struct) -> int:
        value: int = code.unpack_from(self._data, self._count)[0]
        self._count += code.size
        return value

    def read2(self) -> int:
        return self._number(_U2)

    def read4(self) -> int:
        return self._number(_U4)

    def read8(self) -> int:
        return self._number(_U8)


def parse(opcode: int, body: bytes) -> Any:
    """Return the library's record of the bytes behind its head; None where they are not one."""
    kind = _KINDS.get(opcode)
    try:
        return None if kind is None else kind.read(_Bytes(body))
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

    def parsed(self, offset: int) -> Any:
        """Return the record at `offset`, intact to its last byte (an attachment's CRC is one of them); else None."""
        framed = self.head(offset)
        if framed is None or framed[1] - offset > MAX_CHUNK:
            return None
        data = self.read(offset, framed[1] - offset)
        record = parse(framed[0], data[HEAD.size :])
        return record if record is not None and bytes_of(record) == data else None

    def unpack(self, chunk: Chunk) -> bytes:
        """Content of a chunk, checked against its size and CRC; never more than its size is unpacked. Raises ChunkError."""
        size, packed = chunk.uncompressed_size, chunk.data
        if size > MAX_CHUNK:
            raise ChunkError(f"found {size} bytes unpacked in its head, expected at most {MAX_CHUNK}")
        try:
            if chunk.compression == "zstd":
                # The decompressor allocates what the frame's own head names, whatever the limit.
                framed = zstandard.frame_content_size(packed)
                if framed > size:
                    raise ChunkError(f"found {framed} bytes unpacked in its frame, expected {size}")
                data: bytes = self._zstd.decompress(packed, max_output_size=max(size, 1))
            elif chunk.compression == "lz4":
                data = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            elif chunk.compression:
                raise ChunkError(f"found compression {chunk.compression!r:.20}, expected zstd, lz4 or none")
            else:
                data = packed
        except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
            raise ChunkError(f"cannot be unpacked ({chunk.compression}): {error}") from None
        if len(data) != size:
            raise ChunkError(f"found {len(data)} bytes unpacked, expected {size}")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ChunkError("its CRC does not match")
        return data


def read_summary(source: Source) -> tuple[Summary, int] | None:
    """Return the summary and where the data section ends; None where the file ends too early, or its CRC is wrong."""
    at = source.size - len(MAGIC) - _FOOTER_SIZE
    footer = source.parsed(at) if at >= len(MAGIC) else None
    if not isinstance(footer, Footer) or source.read(at + _FOOTER_SIZE, len(MAGIC)) != MAGIC:
        return None
    begin = footer.summary_start or at
    if not len(MAGIC) <= begin <= at or at - begin > MAX_CHUNK:
        return None
    section = source.read(begin, source.size - begin)
    if footer.summary_crc and zlib.crc32(section[: -len(MAGIC) - 4]) != footer.summary_crc:
        return None
    data_end = begin - HEAD.size - 4
    if source.head(data_end) != (Opcode.DATA_END, begin):
        return None
    found = Summary()
    place = 0
    while place < at - begin:
        opcode, length = HEAD.unpack_from(section, place)
        match parse(opcode, section[place + HEAD.size : place + HEAD.size + length]):
            case ChunkIndex() as record:
                found.chunk_indexes.append(record)
            case Schema() as record:
                found.schemas[record.id] = record
            case Channel() as record:
                found.channels[record.id] = record
            case AttachmentIndex() as record:
                found.attachment_indexes.append(record)
            case MetadataIndex() as record:
                found.metadata_indexes.append(record)
            case Statistics() as record:
                found.statistics = record
            case _ if opcode != Opcode.SUMMARY_OFFSET:
                return None
        place += HEAD.size + length
    return found, data_end


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
    messages = (at for opcode, at, _ in _records_in(data) if opcode == Opcode.MESSAGE)
    offsets = np.fromiter(messages, np.int64)
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
        expected: messages of each channel by the summary, as far as the file is long enough for them.

    Raises:
        LogError: no MCAP file, or one that ends too early and is not called `.active`.
        OSError: it cannot be read, or is no regular file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._descriptor = open_regular(path)
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
        self.expected: dict[int, int] = {}
        self._outside, self._first_ns = False, 0
        found = read_summary(source)
        if found is not None:
            summary, _ = found
            self.schemas, self.channels = summary.schemas, summary.channels
            self.attachments, self._chunks = summary.attachment_indexes, summary.chunk_indexes
            statistics = summary.statistics
            if statistics is not None:
                most = source.size // _MESSAGE_INDEX_ENTRY
                counts = statistics.channel_message_counts
                self.expected = {channel: min(count, most) for channel, count in counts.items()}
                self._first_ns = int(statistics.message_start_time)
            self._outside = not self._chunks and (statistics is None or statistics.message_count > 0)
        elif self.path.suffix == ACTIVE:
            contents = Contents(source)
            self.schemas, self.channels = contents.schemas, contents.channels
            self.attachments = [index for _, index in contents.attachments]
            self._chunks = [chunk.index for chunk in contents.chunks]
        else:
            ended = source.read(source.size - len(MAGIC), len(MAGIC)) == MAGIC
            what = "its summary is damaged" if ended else "it ends too early"
            raise self._error(f"{what} (`jtq recover` saves what is intact)")

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
    def start_ns(self) -> int:
        """First log time; 0 without messages."""
        return min((int(chunk.message_start_time) for chunk in self._chunks), default=self._first_ns)

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
        for batch in self._without_index() if self._outside else ():
            if batch.channel in wanted:
                yield batch.only((batch.log_times >= first) & (batch.log_times <= last))
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

    def _without_index(self) -> Iterator[Batch]:
        """Yield all messages of a file without an index of chunks as the library reads it; they may be outside of chunks."""
        with open(os.dup(self._descriptor), "rb") as file:
            file.seek(0)
            outside: list[Message] = []
            size = 0
            try:
                for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK).records:
                    if isinstance(record, Chunk):
                        yield from batches_of(self._source.unpack(record))
                    if isinstance(record, Message):
                        outside.append(record)
                        size += len(record.data)
                    if size > _TOGETHER:
                        yield from batches_of(bytes_of(*outside))
                        outside, size = [], 0
                yield from batches_of(bytes_of(*outside)) if outside else ()
            except (McapError, ChunkError, struct.error) as error:
                raise self._error(f"{error} (byte {file.tell()})") from None

    def _batches_of(self, index: ChunkIndex) -> list[Batch]:
        at, length = index.chunk_start_offset, index.chunk_length
        try:
            record = self._source.read(at, length) if length <= MAX_CHUNK else b""
            if record[: HEAD.size] != HEAD.pack(Opcode.CHUNK, length - HEAD.size):
                raise ChunkError("found none, expected one")
            chunk = parse(Opcode.CHUNK, record[HEAD.size :])
            if chunk is None:
                raise ChunkError("its lengths do not agree")
            return batches_of(self._source.unpack(chunk))
        except ChunkError as error:
            raise self._error(f"chunk at byte {at}: {error} (`jtq recover` saves what is intact)") from None

    def attachment(self, index: AttachmentIndex) -> bytes:
        """Return the content of an attachment. Raises LogError where it is damaged."""
        record = self._source.parsed(index.offset)
        if not isinstance(record, Attachment):
            raise LogError(f"{self.path}: attachment {index.name!r} is damaged")
        data: bytes = record.data
        return data


# ---- the intact contents of a damaged or unfinished file ----

_CHUNK_MARK, _CHUNK_MARK_AT = struct.pack("<I4s", 4, b"zstd"), HEAD.size + 28
"""What every chunk of the recorder has at this offset: the name of its compression."""
_CHUNK_SIZES = struct.Struct("<BQQQ20xQ")
"""Opcode, length, start and end time, and length of the packed bytes of such a chunk."""
_WINDOW = 1 << 20
_CYCLE_TOPICS = {topic.name for topic in (CAN_FRAMES, *JOINTS, *SHADOWS)}


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

    @property
    def gap(self) -> Gap:
        """Return what is missing without it."""
        return Gap(self.index.chunk_start_offset, self.end, True, self.index.message_end_time)


class Gap(NamedTuple):
    """Bytes that cannot be kept; `end_ns`: last log time of the chunk that stood there, where its head tells."""

    start: int
    end: int
    is_chunk: bool = False
    end_ns: int | None = None


class Contents:
    """Intact records of a file, found by going through the data section record by record, past damaged ones.

    A chunk is intact by its CRC, another record where it parses to its last byte. Behind a damaged record the scan goes
    on where its length leads to an intact one, where the summary has one, or at the next zstd chunk. Chunks of the
    recorder's cycles that lack the others of their span are left out: readers take the arrays of two joints for arrays of
    the same cycles. Raises OSError.

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

    def __init__(self, source: Source) -> None:
        self._source = source
        self.tail = read_summary(source)
        self.magic = source.read(0, len(MAGIC)) == MAGIC
        self.header: Header | None = None
        self.attachments: list[tuple[Attachment, AttachmentIndex]] = []
        self.metadata: list[tuple[Metadata, MetadataIndex]] = []
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.unproven = self.contradicted = False
        self.undefined = 0
        self.chunks: list[IntactChunk] = []
        self.gaps: list[Gap] = []
        self.cycles: frozenset[int] = frozenset()
        self._head: list[Schema | Channel] = []
        """Definitions that no CRC covers."""
        self._rebuilt_to = 0
        """Message indexes before this offset are rebuilt from the chunk before them."""
        self._limit = source.size
        self._places: list[int] = []
        if self.tail is not None:
            summary, self._limit = self.tail
            self.schemas, self.channels = dict(summary.schemas), dict(summary.channels)
            self._places = [chunk.chunk_start_offset for chunk in summary.chunk_indexes]
            self._places += [each.offset for each in (*summary.metadata_indexes, *summary.attachment_indexes)]
        self._scan()
        self._settle_definitions()
        if not self.foreign:
            self.cycles = frozenset(n for n, each in self.channels.items() if each.topic in _CYCLE_TOPICS)
        if self.gaps or self.tail is None:
            for place in reversed(_torn([chunk.marks for chunk in self.chunks], self.cycles)):
                self.gaps.append(self.chunks.pop(place).gap)

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

    def _scan(self) -> None:
        at = len(MAGIC)
        while at < self._limit:
            found = self._intact(at)
            if found is not None:
                at = self._take(at, *found)
                continue
            if self.tail is None and self._summary_begins(at):
                break
            end = self._resume(at)
            self._leave_out(at, end)
            at = end
        self.end = min(at, self._limit)

    def _intact(self, at: int) -> tuple[Any, int] | None:
        """Return the intact record at `at` (a chunk as `sealed_chunk` returns it) and where it ends; else None."""
        framed = self._source.head(at)
        if framed is None or framed[1] > self._limit:
            return None
        opcode, end = framed
        if opcode == Opcode.MESSAGE_INDEX:  # of a chunk that is left out, or whose indexes are rebuilt
            size = int.from_bytes(self._source.read(at + HEAD.size + 2, 4), "little")
            whole = end - at == HEAD.size + 6 + size and size % _MESSAGE_INDEX_ENTRY == 0
            return (None, end) if whole else None
        if opcode == Opcode.CHUNK:
            record: Any = sealed_chunk(self._source, at)
        else:
            record = self._source.parsed(at) if opcode in _DATA_KINDS else None
        return None if record is None else (record, end)

    def _take(self, at: int, record: Any, end: int) -> int:
        """Keep an intact record; returns where the next one begins."""
        match record:
            case Header():
                self.header = record
            case Attachment():
                self.attachments.append((record, attachment_index(record, at, end - at)))
            case Metadata():
                self.metadata.append((record, MetadataIndex(at, end - at, record.name)))
            case Schema() | Channel():
                self._head.append(record)
            case (sealed, data, batches):
                return self._take_chunk(at, sealed, data, batches)
        return end

    def _take_chunk(self, at: int, sealed: SealedChunk, data: bytes, batches: list[Batch]) -> int:
        unchanged = self._source.read(at, len(sealed.data)) == sealed.data
        self._rebuilt_to = at + len(sealed.data)
        end = self._rebuilt_to if unchanged else at + sealed.length
        marks = {each.channel: zlib.crc32(pieces(data, each.offsets + 11, 12).tobytes()) for each in batches}
        self.chunks.append(IntactChunk(sealed.index(at), end, sealed.counts, marks, unchanged))
        if not any(each.step for each in batches):
            for opcode, begin, behind in _records_in(data):
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    record = parse(opcode, data[begin + HEAD.size : behind])
                    if record is not None:
                        self._known(record).setdefault(record.id, record)
        return end

    def _summary_begins(self, at: int) -> bool:
        """Return whether the data section ends at `at`: there is DataEnd, or a record that stands in the summary only."""
        opcode, end = self._source.head(at) or (0, 0)
        if opcode == Opcode.DATA_END:
            return end - at == HEAD.size + 4
        return opcode in _SUMMARY_KINDS and self._source.parsed(at) is not None

    def _resume(self, at: int) -> int:
        """Return where the scan goes on behind a damaged record at `at`."""
        source, limit = self._source, self._limit
        framed = source.head(at)
        for place in (*([] if framed is None else [framed[1]]), self._rebuilt_to, *sorted(self._places)):
            if at < place <= limit and (
                place == limit
                or self._is_framed_chunk(place)
                or self._intact(place) is not None
                or self._summary_begins(place)
            ):
                return place
        for begin in range(at + 1, limit, _WINDOW):
            window = source.read(begin, min(_WINDOW + _CHUNK_MARK_AT + len(_CHUNK_MARK), limit - begin))
            place = window.find(_CHUNK_MARK, _CHUNK_MARK_AT)
            while place >= 0:
                start = begin + place - _CHUNK_MARK_AT
                if self._is_framed_chunk(start) and sealed_chunk(source, start) is not None:
                    return start
                place = window.find(_CHUNK_MARK, place + 1)
        return limit

    def _is_framed_chunk(self, at: int) -> bool:
        """Return whether a zstd chunk begins at `at` whose lengths agree; its content is not looked at."""
        head = self._source.read(at, _CHUNK_SIZES.size)
        if len(head) < _CHUNK_SIZES.size or head[_CHUNK_MARK_AT:][: len(_CHUNK_MARK)] != _CHUNK_MARK:
            return False
        opcode, length, _, _, packed = _CHUNK_SIZES.unpack(head)
        behind = at + HEAD.size + length
        return bool(opcode == Opcode.CHUNK and at + _CHUNK_SIZES.size + packed == behind <= self._limit)

    def _leave_out(self, start: int, end: int) -> None:
        """Note the damaged bytes from `start` to `end`, as far as they are not rebuilt from others."""
        framed, start = self._source.head(start), max(start, self._rebuilt_to)
        if start >= end:
            return
        if framed is not None and framed[1] == end and framed[0] in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.contradicted = True  # known from elsewhere, or its chunks are left out
            return
        head = self._source.read(start, _CHUNK_SIZES.size)
        is_chunk = head[:1] == bytes([Opcode.CHUNK])
        end_ns = _CHUNK_SIZES.unpack(head)[3] if is_chunk and len(head) == _CHUNK_SIZES.size else None
        self.gaps.append(Gap(start, end, is_chunk, end_ns))

    def _known(self, record: Schema | Channel) -> dict[int, Any]:
        return self.schemas if isinstance(record, Schema) else self.channels

    def _settle_definitions(self) -> None:
        """Choose definitions, those that a CRC covers before others; leave out chunks with an undefined channel."""
        unproven = set()
        for record in self._head:
            chosen = self._known(record).setdefault(record.id, record)
            self.contradicted |= chosen != record
            if chosen is record:
                unproven.add((type(record), record.id))
        for number, channel in list(self.channels.items()):
            if channel.schema_id and channel.schema_id not in self.schemas:
                del self.channels[number]
        for place, chunk in reversed(list(enumerate(self.chunks))):
            if not chunk.counts.keys() <= self.channels.keys():
                self.undefined += 1
                self.gaps.append(self.chunks.pop(place).gap)
        self.unproven = any(
            not unproven.isdisjoint(((Channel, number), (Schema, self.channels[number].schema_id)))
            for number in self.counts
        )


def sealed_chunk(source: Source, at: int) -> tuple[SealedChunk, bytes, list[Batch]] | None:
    """Return the zstd chunk at `at` with the size, times and message indexes that follow from its content.

    The second value is its unpacked content, the third its messages. None: its content is damaged.
    """
    chunk = source.parsed(at)
    if not isinstance(chunk, Chunk) or chunk.compression != "zstd" or not chunk.uncompressed_crc:
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
    indexed = {
        each.channel: np.stack([each.log_times, each.offsets.astype(np.uint64)], axis=1).ravel().tolist()
        for each in batches
    }
    return seal(chunk, indexed), data, batches


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
