"""MCAP records as they lie in a file: framing, and parsing that believes no length (https://mcap.dev/spec)."""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, McapRecord

from jtqd.daemon.recording.mcap_file import bytes_of

HEAD = struct.Struct("<BQ")
"""Opcode, and the length of what follows."""
CHUNK = struct.Struct("<QQQII")
"""After the head: start time, end time, unpacked size, CRC, length of the compression's name."""
MESSAGE_BODY = 22
"""Bytes of a Message record between its head and the payload: channel, sequence, log time, publish time."""
PRIVATE = 0x80
"""Opcodes from here on are private; every reader skips them. `recover` turns what cannot be read into one."""
SUMMARY_OPCODES = frozenset(
    (
        Opcode.FOOTER,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.STATISTICS,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    )
)
"""Records that stand behind the data only."""

MAX_SMALL = 64 << 20
"""[byte] largest schema, channel, metadata or index record that is taken."""
_NEW_FIELDS = 64
_BLOCK = 1 << 20

_Record = TypeVar("_Record", bound=McapRecord)


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

    def blocks(self, start: int, end: int) -> Iterator[bytes]:
        """The bytes from `start` to `end` in pieces of at most 1 MiB."""
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
    """A record from the bytes behind its head; None where they do not make one."""
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


def private(length: int) -> bytes:
    """Head of a private record of `length` bytes in all (at least 9)."""
    return HEAD.pack(PRIVATE, length - HEAD.size)


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
    """Content of an attachment, checked against its CRC; None where the index does not point at it."""
    found = source.head(index.offset)
    if found is None or found[0] != Opcode.ATTACHMENT:
        return None
    end = found[1]
    if attachment_index(source, index.offset, end) is None:
        return None
    record = parse_attachment(source.read(index.offset + HEAD.size, end - index.offset - HEAD.size))
    return None if record is None else record.data


def parse_attachment(body: bytes) -> Attachment | None:
    """An Attachment record, of any size."""
    try:
        return Attachment.read(ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError):
        return None
