"""Chunks of an MCAP file: unpacked within bounds, and taken apart into messages without a loop where that can be had."""

from __future__ import annotations

import struct
import zlib
from array import array
from typing import NamedTuple

import numpy as np
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.opcode import Opcode
from numpy.typing import NDArray

from jtqd.daemon.logs.records import CHUNK, HEAD, MESSAGE_BODY

MAX_CHUNK = 256 << 20
"""[byte] largest chunk that is taken, packed or unpacked. Writers make chunks of 1 to 10 MB."""
COMPRESSIONS = ("", "lz4", "zstd")

MESSAGE_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "sequence", "log_time", "publish_time"],
        "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8"],
        "offsets": [0, 1, 9, 11, 15, 23],
        "itemsize": 31,
    }
)


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

    def packed(self) -> bytes:
        """The record up to its packed bytes."""
        name = self.compression.encode()
        body = CHUNK.pack(self.start_ns, self.end_ns, self.unpacked_size, self.crc, len(name)) + name
        body += struct.pack("<Q", self.packed_size)
        return HEAD.pack(Opcode.CHUNK, len(body) + self.packed_size) + body


HEAD_SIZE = HEAD.size + CHUNK.size + 4 + 8
"""Bytes that hold any chunk's head."""


def chunk_head(data: bytes) -> ChunkHead | None:
    """Head of the chunk whose first bytes these are (opcode and length are not looked at); None: it is none."""
    if len(data) < HEAD.size + CHUNK.size:
        return None
    start, end, size, crc, name_length = CHUNK.unpack_from(data, HEAD.size)
    at = HEAD.size + CHUNK.size
    if name_length > 4 or len(data) < at + name_length + 8:
        return None
    name = data[at : at + name_length].decode("latin-1")
    if name not in COMPRESSIONS:
        return None
    at += name_length
    (packed,) = struct.unpack_from("<Q", data, at)
    return ChunkHead(start, end, size, crc, name, packed, at + 8)


def unpack(head: ChunkHead, packed: bytes, limit: int = MAX_CHUNK) -> bytes:
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


def unpack_data(compression: str, packed: bytes, limit: int) -> bytes:
    """Unpacked bytes, at most `limit`. Raises ChunkError."""
    if not compression:
        return packed
    try:
        if compression == "zstd":
            said = zstandard.frame_content_size(packed)
            if said > limit:
                raise ChunkError(f"says {said} bytes unpacked, expected at most {limit}")
            # Where the frame does not say its size, the decompressor makes room for what it is told.
            return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(limit, 1))
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
    """Heads of the Message records at these offsets, each at least 31 bytes before the end [n]."""
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
    """Offsets of the messages between `at` and `stop`, and the other records, one after the other."""
    offsets, others = array("q"), []
    unpack_head = HEAD.unpack_from
    while at < stop:
        if stop - at < HEAD.size:
            raise ChunkError("a record in it is cut")
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
