"""The MCAP container (https://mcap.dev/spec): records, chunks and the summary of a file, read without trusting a length.

A damaged or hostile file must neither raise anything unexpected nor take memory: every length is checked against what is
there, no chunk above 256 MB is unpacked, and what has a CRC is checked against it.
"""

from __future__ import annotations

import io
import os
import struct
import threading
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from jtqd.daemon.recording.mcap_file import MAGIC, bytes_of, tail_bytes

HEAD = struct.Struct("<BQ")
"""Opcode, and the length of what follows."""
MESSAGE_BODY = 22
"""Bytes of a Message record between its head and the payload: channel, sequence, log time, publish time."""
MAX_SMALL = 64 << 20
"""[byte] largest schema, channel, metadata or index record that is taken."""
MAX_CHUNK = 256 << 20
"""[byte] largest chunk that is taken, packed or unpacked. Writers make chunks of 1 to 10 MB."""
MESSAGE_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log_time", "publish_time"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
        "offsets": [0, 1, 9, 11, 15, 23],
        "itemsize": 31,
    }
)
MESSAGE_TIME = 15
"""Offset of the log time in a Message record."""
_CHUNK = struct.Struct("<QQQII")
"""After the head: start time, end time, unpacked size, CRC, length of the compression's name."""
_COMPRESSIONS = ("", "lz4", "zstd")
_NEW_FIELDS = 64
_BLOCK = 1 << 20

_Record = TypeVar("_Record", bound=McapRecord)


class LogError(ValueError):
    """The log cannot be used; one line: file, topic, found, expected."""


# ---- records ----


class Source:
    """Bytes of an open file by offset, through one block of cache. Raises OSError; reads short at the end."""

    def __init__(self, descriptor: int) -> None:
        self._file = descriptor
        self.size = os.fstat(descriptor).st_size
        self._at = 0
        self._block = b""

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes from `offset` on."""
        begin = offset - self._at
        if begin >= 0 and begin + length <= len(self._block):
            return self._block[begin : begin + length]
        if length > _BLOCK:
            return b"".join(self.blocks(offset, min(self.size, offset + length)))
        self._block, self._at = os.pread(self._file, _BLOCK, offset), offset
        return self._block[:length]

    def read_apart(self, offset: int, length: int) -> bytes:
        """As `read`, past the cache: nothing beside these bytes is fetched."""
        return os.pread(self._file, length, offset)

    def blocks(self, start: int, end: int) -> Iterator[bytes]:
        """Yield the bytes from `start` to `end` in pieces of at most 1 MiB."""
        while start < end:
            block = os.pread(self._file, min(_BLOCK, end - start), start)
            if not block:
                return
            yield block
            start += len(block)

    def crc(self, start: int, end: int) -> int:
        """CRC-32 of a stretch."""
        value = 0
        for block in self.blocks(start, end):
            value = zlib.crc32(block, value)
        return value

    def head(self, offset: int) -> tuple[int, int] | None:
        """(opcode, offset behind the record) of the record that begins here; None where it would leave the file."""
        found = self.read(offset, HEAD.size)
        if len(found) < HEAD.size:
            return None
        opcode, length = HEAD.unpack(found)
        end = offset + HEAD.size + length
        return (opcode, end) if end <= self.size else None


def parse(kind: type[_Record], body: bytes) -> _Record | None:
    """Return a record from the bytes behind its head; None where they do not make one."""
    if len(body) > MAX_SMALL:
        return None
    stream = ReadDataStream(io.BytesIO(body))
    try:
        record: _Record = kind.read(stream)
    except (McapError, struct.error, ValueError, OverflowError):
        return None
    # The library takes a text that ends too early for a shorter one; a later version may have added fields.
    again = bytes_of(record)[HEAD.size :]
    return record if body.startswith(again) and len(body) <= len(again) + _NEW_FIELDS else None


# ---- attachments ----


def attachment_index(source: Source, offset: int, end: int) -> AttachmentIndex | None:
    """Index entry of the attachment at `offset`; None where the record does not hold together or fails its CRC."""
    size = end - offset - HEAD.size
    head = source.read(offset + HEAD.size, min(size, 1 << 16))  # names are shorter than that
    stream = ReadDataStream(io.BytesIO(head))
    try:
        log_time, create_time = stream.read8(), stream.read8()
        name, media_type = stream.read_prefixed_string(), stream.read_prefixed_string()
        data_size = stream.read8()
    except (McapError, struct.error, ValueError, OverflowError):
        return None
    if stream.count + data_size + 4 != size:
        return None
    crc = int.from_bytes(source.read(end - 4, 4), "little")
    if crc and crc != source.crc(offset + HEAD.size, end - 4):
        return None
    return AttachmentIndex(
        offset=offset,
        length=end - offset,
        log_time=log_time,
        create_time=create_time,
        data_size=data_size,
        name=name,
        media_type=media_type,
    )


def attachment_data(source: Source, index: AttachmentIndex) -> bytes | None:
    """Return the content of an attachment, checked against its CRC; None where the index does not point at it."""
    found = source.head(index.offset)
    if found is None or found[0] != Opcode.ATTACHMENT:
        return None
    end = found[1]
    if attachment_index(source, index.offset, end) is None:
        return None
    body = source.read(index.offset + HEAD.size, end - index.offset - HEAD.size)
    try:
        data: bytes = Attachment.read(ReadDataStream(io.BytesIO(body))).data
    except (McapError, struct.error, ValueError, OverflowError):
        return None
    return data


# ---- chunks ----


class ChunkError(ValueError):
    """The chunk cannot be unpacked; says why."""


class ChunkHead(NamedTuple):
    """What stands before the packed bytes; `data_start` counts from the record's first byte."""

    start_ns: int
    end_ns: int
    unpacked_size: int
    crc: int
    compression: str
    packed_size: int
    data_start: int


HEAD_SIZE = HEAD.size + _CHUNK.size + 4 + 8
"""Bytes that hold any chunk's head."""


def chunk_head(data: bytes) -> ChunkHead | None:
    """Head of the chunk whose first bytes these are (opcode and length are not looked at); None: it is none."""
    if len(data) < HEAD.size + _CHUNK.size:
        return None
    start, end, size, crc, name_length = _CHUNK.unpack_from(data, HEAD.size)
    at = HEAD.size + _CHUNK.size
    if name_length > 4 or len(data) < at + name_length + 8:
        return None
    name = data[at : at + name_length].decode("latin-1")
    if name not in _COMPRESSIONS:
        return None
    at += name_length
    (packed,) = struct.unpack_from("<Q", data, at)
    return ChunkHead(start, end, size, crc, name, packed, at + 8)


class _OfThread(threading.local):
    """A decompressor is for one thread; its tables are made once instead of for every chunk."""

    def __init__(self) -> None:
        self.decompress = zstandard.ZstdDecompressor().decompress


_ZSTD = _OfThread()


def unpack(head: ChunkHead, packed: bytes | memoryview, limit: int = MAX_CHUNK) -> bytes:
    """Content of a chunk, checked against its size and CRC; never more than `limit` bytes are made. Raises ChunkError."""
    if head.unpacked_size > limit:
        raise ChunkError(f"says {head.unpacked_size} bytes unpacked, expected at most {limit}")
    if len(packed) != head.packed_size:
        raise ChunkError(f"found {len(packed)} packed bytes, expected {head.packed_size}")
    data = unpack_data(head.compression, packed, head.unpacked_size)
    if len(data) != head.unpacked_size:
        raise ChunkError(f"found {len(data)} bytes unpacked, expected {head.unpacked_size}")
    if head.crc and zlib.crc32(data) != head.crc:
        raise ChunkError("its CRC does not match")
    return data


def unpack_data(compression: str, packed: bytes | memoryview, limit: int) -> bytes:
    """Unpacked bytes, at most `limit`. Raises ChunkError."""
    if not compression:
        return bytes(packed)
    try:
        if compression == "zstd":
            said = zstandard.frame_content_size(packed)
            if said > limit:
                raise ChunkError(f"says {said} bytes unpacked, expected at most {limit}")
            # Where the frame does not say its size, the decompressor makes room for what it is told.
            return _ZSTD.decompress(packed, max_output_size=max(limit, 1))
        frame = LZ4FrameDecompressor()
        data: bytes = frame.decompress(packed, max_length=limit + 1)
        if len(data) > limit:
            raise ChunkError(f"holds more than {limit} bytes unpacked")
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError) as error:
        if isinstance(error, ChunkError):
            raise
        raise ChunkError(f"cannot be unpacked ({compression}): {error}") from None
    if not frame.eof:
        raise ChunkError("ends too early")
    return data


class Walk(NamedTuple):
    """Records of one chunk: head of every message [n], where it begins [n], and (opcode, start, end) of the others."""

    heads: NDArray[np.void]
    offsets: NDArray[np.int64]
    others: list[tuple[int, int, int]]

    def ends(self) -> NDArray[np.int64]:
        """Offset behind each message [n]."""
        return self.offsets + HEAD.size + self.heads["length"].astype(np.int64)


def walk(data: bytes, hint: NDArray[np.int64] | None = None) -> Walk:
    """Take a chunk's content apart.

    Args:
        data: unpacked.
        hint: where messages should begin (the message indexes) [n]; believed as far as the bytes agree.

    Raises:
        ChunkError: the records do not fill the chunk.
    """
    if hint is not None and len(hint):
        found = _hinted(data, np.unique(hint))
        if found is not None:
            return found
    offsets, others = _stepped(data, 0, len(data))
    return Walk(heads_at(data, offsets), offsets, others)


def heads_at(data: bytes, offsets: NDArray[np.int64]) -> NDArray[np.void]:
    """Return heads of the Message records at these offsets, each at least 31 bytes before the end [n]."""
    return pieces(data, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)


def pieces(data: bytes, offsets: NDArray[np.int64], size: int) -> NDArray[np.void]:
    """`size` bytes from each of these offsets, every one within `data`, as one array [n] of plain bytes."""
    room = max(0, len(data) - size + 1)
    # Plain bytes are copied many times faster than records with fields.
    return np.ndarray((room,), np.dtype(("V", size)), data, strides=(1,))[offsets]


def _hinted(data: bytes, offsets: NDArray[np.int64]) -> Walk | None:
    """As `walk`, by offsets in ascending order; None where they are wrong."""
    if offsets[0] < 0 or offsets[-1] > len(data) - MESSAGE_HEAD.itemsize:
        return None
    heads = heads_at(data, offsets)
    lengths = heads["length"]
    if (heads["opcode"] != Opcode.MESSAGE).any() or lengths.min() < MESSAGE_BODY or lengths.max() > len(data):
        return None
    ends = offsets + HEAD.size + lengths.astype(np.int64)
    begins = np.append(offsets, len(data))
    between = begins - np.insert(ends, 0, 0)
    if between.min() < 0:
        return None
    others = []
    for n in np.flatnonzero(between):
        try:
            messages, more = _stepped(data, int(begins[n] - between[n]), int(begins[n]))
        except ChunkError:
            return None
        if len(messages):  # the indexes leave some out
            return None
        others += more
    return Walk(heads, offsets, others)


def _stepped(data: bytes, at: int, stop: int) -> tuple[NDArray[np.int64], list[tuple[int, int, int]]]:
    """Return offsets of the messages between `at` and `stop`, and the other records, one after the other."""
    offsets, others = array("q"), []
    unpack_head = HEAD.unpack_from
    while at < stop:
        if stop - at < HEAD.size:
            raise ChunkError("a record in it is truncated")
        opcode, length = unpack_head(data, at)
        end = at + HEAD.size + length
        if end > stop:
            raise ChunkError("a record in it is longer than the chunk")
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE_BODY:
                raise ChunkError("a message in it is too short")
            offsets.append(at)
        else:
            others.append((opcode, at, end))
        at = end
    return np.frombuffer(offsets, np.int64) if offsets else np.empty(0, np.int64), others


def message_index(source: Source, at: int, channel: int) -> NDArray[np.uint64] | None:
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


# ---- summary ----


FOOTER_SIZE = HEAD.size + 20
_KINDS: dict[int, type[McapRecord]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}


_INDEX_START, _INDEX_END = struct.Struct("<QQQQI"), struct.Struct("<QQ")


def chunk_index(body: bytes) -> ChunkIndex | None:
    """Chunk Index record from the bytes behind its head, as `parse` makes it: a summary has many of them."""
    if len(body) < _INDEX_START.size:
        return None
    start_ns, end_ns, offset, length, size = _INDEX_START.unpack_from(body)
    at = _INDEX_START.size
    behind = at + size
    if size % 10 or len(body) < behind + 12:
        return None
    offsets = dict(struct.iter_unpack("<HQ", body[at:behind]))
    index_length, name_length = struct.unpack_from("<QI", body, behind)
    at = behind + 12 + name_length
    if (
        len(offsets) != size // 10
        or not at + _INDEX_END.size <= len(body) <= at + _INDEX_END.size + _NEW_FIELDS
    ):
        return None
    try:
        compression = body[behind + 12 : at].decode()
    except UnicodeDecodeError:
        return None
    compressed, unpacked = _INDEX_END.unpack_from(body, at)
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=offset,
        compression=compression,
        compressed_size=compressed,
        message_end_time=end_ns,
        message_index_length=index_length,
        message_index_offsets=offsets,
        message_start_time=start_ns,
        uncompressed_size=unpacked,
    )


@dataclass
class Summary:
    """Content of a summary section."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    data_end: int = 0
    """Offset of the DataEnd record."""
    data_crc: int = 0
    """As DataEnd gives it; 0: it says nothing."""

    def to_bytes(self, data_end: int) -> bytes:
        """DataEnd, summary, footer and magic of a file whose data end at `data_end`."""
        groups: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [] if self.statistics is None else [self.statistics]),
            (Opcode.CHUNK_INDEX, list(self.chunks)),
            (Opcode.ATTACHMENT_INDEX, list(self.attachments)),
            (Opcode.METADATA_INDEX, list(self.metadata)),
        )
        return tail_bytes(((opcode, bytes_of(*records)) for opcode, records in groups), data_end)


def footer_of(source: Source) -> Footer | None:
    """Return the footer where the file ends as it should."""
    at = source.size - len(MAGIC) - FOOTER_SIZE
    if at < len(MAGIC) or source.read(at + FOOTER_SIZE, len(MAGIC)) != MAGIC:
        return None
    if source.head(at) != (Opcode.FOOTER, at + FOOTER_SIZE):
        return None
    footer = parse(Footer, source.read(at + HEAD.size, 20))
    return None if footer is None or footer.summary_start > at else footer


def read_summary(source: Source) -> Summary | None:
    """Return the summary at the end of the file, checked against its CRC; None where it does not hold together.

    A file that ends properly without any summary gives an empty one with `data_end` 0.
    """
    footer = footer_of(source)
    if footer is None:
        return None
    end = source.size - len(MAGIC) - FOOTER_SIZE
    found = Summary()
    if footer.summary_start == 0:
        return found
    if footer.summary_crc and footer.summary_crc != source.crc(
        footer.summary_start, source.size - len(MAGIC) - 4
    ):
        return None
    data_end = footer.summary_start - HEAD.size - 4
    if data_end < 0 or source.head(data_end) != (Opcode.DATA_END, footer.summary_start):
        return None
    for opcode, body in _records(source, footer.summary_start, end):
        record: McapRecord | None = None
        if opcode == Opcode.CHUNK_INDEX:
            record = chunk_index(body)
        elif opcode in _KINDS:
            record = parse(_KINDS[opcode], body)
        if record is not None:
            _put(found, record)
        elif opcode == -1 or opcode in _KINDS:
            return None
    found.data_end = data_end
    found.data_crc = int.from_bytes(source.read(data_end + HEAD.size, 4), "little")
    return found


def _put(summary: Summary, record: McapRecord) -> None:
    if isinstance(record, Schema):
        summary.schemas[record.id] = record
    elif isinstance(record, Channel):
        summary.channels[record.id] = record
    elif isinstance(record, Statistics):
        summary.statistics = record
    elif isinstance(record, ChunkIndex):
        summary.chunks.append(record)
    elif isinstance(record, AttachmentIndex):
        summary.attachments.append(record)
    elif isinstance(record, MetadataIndex):
        summary.metadata.append(record)


def _records(source: Source, at: int, end: int) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of the records between two offsets; opcode -1 where they do not fill them."""
    while at < end:
        found = source.head(at)
        if found is None or found[1] > end or found[1] - at > MAX_SMALL:
            yield -1, b""
            return
        yield found[0], source.read(at + HEAD.size, found[1] - at - HEAD.size)
        at = found[1]
