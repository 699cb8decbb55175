"""MCAP file made of whole chunks: what is on disk is always a valid beginning of the file.

Attachments, schemas and channels come first, outside any chunk. Messages are collected in memory and become
one chunk at `flush`: one write of the compressed chunk with its message indexes, then `fdatasync`. A write
that fails is taken back (the file is cut to its last good length) and only that chunk is gone. Schemas and
channels are repeated inside every 60th chunk, so that a file whose head is damaged can still be read.

Compared with the library's Writer, the messages of a cycle enter as ready-made bytes: 0.5 us a message
instead of 3.5, and a failed chunk leaves no entry in the index.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import zlib
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
_COMPRESSION = "zstd"
_LEVEL = 3
"""On chunks of 500 cycles level 1 is 2 % larger for 0.08 % of a core less, 5 is 1 % smaller for 0.3 % more."""
_REPEAT_CHANNELS_EVERY = 60
_CHUNK = struct.Struct("<BQQQQII4sQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_MESSAGE = struct.Struct("<BQHIQQ")


class NamedData(NamedTuple):
    """One attachment."""

    name: str
    media_type: str
    data: bytes


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


class _Appender:
    """A file that only grows by whole pieces. Raises OSError, and then holds what it held before."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.offset = 0

    def append(self, data: bytes) -> None:
        if os.fstat(self._file).st_nlink == 0:
            raise FileNotFoundError(errno.ENOENT, "the file was removed while it was being written")
        try:
            view, at = memoryview(data), self.offset
            while view:
                written = os.pwrite(self._file, view, at)
                view, at = view[written:], at + written
            os.fdatasync(self._file)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self.offset)
            raise
        self.offset = at

    @property
    def removed(self) -> bool:
        return os.fstat(self._file).st_nlink == 0

    def close(self) -> None:
        os.close(self._file)


class McapFile:
    """One file being written. `flush` and `finish` raise OSError; nothing else touches the disk.

    Args:
        path: must not exist yet.
        schemas: of mcap.records; their identifiers are the caller's.
        channels: likewise.
        attachments: written first.
        block_parts: (channel, start) of the Message records within what `add_block` gets.
        time_ns: creation time of the attachments.

    Raises:
        OSError: the file cannot be created, or its head cannot be written (it is removed again then).
    """

    def __init__(
        self,
        path: Path,
        *,
        schemas: Sequence[Schema],
        channels: Sequence[Channel],
        attachments: Sequence[NamedData],
        block_parts: Sequence[tuple[int, int]],
        time_ns: int,
    ) -> None:
        self._schemas, self._channels, self._block_parts = schemas, channels, block_parts
        self._definitions = _bytes_of(*schemas, *channels)
        self._compress = zstandard.ZstdCompressor(level=_LEVEL).compress
        self._attachment_index: list[AttachmentIndex] = []
        self._chunk_index = bytearray()
        self.chunks = 0
        self.counts: dict[int, int] = {channel.id: 0 for channel in channels}
        self._start_ns, self._end_ns = 0, 0
        self._file = _Appender(path)
        try:
            self._file.append(self._head(attachments, time_ns))
        except OSError:
            self._file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        self._begin_chunk()

    def _head(self, attachments: Sequence[NamedData], time_ns: int) -> bytes:
        head = bytearray(MAGIC + _bytes_of(Header(profile="ros2", library="jtqd")))
        for item in attachments:
            record = _bytes_of(Attachment(time_ns, time_ns, item.name, item.media_type, item.data))
            self._attachment_index.append(
                AttachmentIndex(
                    offset=len(head),
                    length=len(record),
                    log_time=time_ns,
                    create_time=time_ns,
                    data_size=len(item.data),
                    name=item.name,
                    media_type=item.media_type,
                )
            )
            head += record
        return bytes(head + self._definitions)

    def _begin_chunk(self) -> None:
        self._parts: list[bytes] = [self._definitions] if self.chunks % _REPEAT_CHANNELS_EVERY == 0 else []
        self._length = sum(map(len, self._parts))
        self._block_times: list[int] = []
        self._block_starts: list[int] = []
        self._single: dict[int, list[tuple[int, int]]] = {}

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._file.offset

    @property
    def pending(self) -> int:
        """Bytes of messages that wait for `flush`."""
        return self._length

    @property
    def removed(self) -> bool:
        """The file has no name any more: nothing of it will be found."""
        return self._file.removed

    def add_block(self, block: bytes, time_ns: int) -> None:
        """Add one cycle's Message records (laid out as `block_parts` says), all of the same log time."""
        self._parts.append(block)
        self._block_times.append(time_ns)
        self._block_starts.append(self._length)
        self._length += len(block)

    def add(self, channel: int, time_ns: int, payload: bytes, sequence: int = 0) -> None:
        """Add one message; log time and publish time are the same."""
        head = _MESSAGE.pack(Opcode.MESSAGE, 22 + len(payload), channel, sequence, time_ns, time_ns)
        self._single.setdefault(channel, []).append((time_ns, self._length))
        self._parts.append(head + payload)
        self._length += len(head) + len(payload)

    def _indexes(self) -> dict[int, bytes]:
        """Message Index record of each channel that has messages in this chunk."""
        flat: dict[int, list[int]] = {}
        if self._block_times:
            for channel, start in self._block_parts:
                entries = [0] * (2 * len(self._block_times))
                entries[0::2] = self._block_times
                entries[1::2] = [at + start for at in self._block_starts]
                flat[channel] = entries
        for channel, pairs in self._single.items():
            flat.setdefault(channel, []).extend(chain.from_iterable(pairs))
        return {
            channel: _MESSAGE_INDEX.pack(
                Opcode.MESSAGE_INDEX, 6 + 8 * len(entries), channel, 8 * len(entries)
            )
            + struct.pack(f"<{len(entries)}Q", *entries)
            for channel, entries in flat.items()
        }

    def flush(self) -> None:
        """Write what was added as one chunk and have it on the disk.

        Raises:
            OSError: the chunk is not in the file, and what was added is dropped.
        """
        if not self._block_times and not self._single:
            return
        times = self._block_times + [time for pairs in self._single.values() for time, _ in pairs]
        start, end = min(times), max(times)
        data = b"".join(self._parts)
        packed = self._compress(data)
        head = _CHUNK.pack(
            Opcode.CHUNK,
            _CHUNK.size - 9 + len(packed),
            start,
            end,
            len(data),
            zlib.crc32(data),
            4,
            b"zstd",
            len(packed),
        )
        indexes = self._indexes()
        at = self._file.offset
        offsets, position = {}, at + len(head) + len(packed)
        for channel, record in indexes.items():
            offsets[channel] = position
            position += len(record)
        blocks, singles = (
            len(self._block_times),
            {channel: len(pairs) for channel, pairs in self._single.items()},
        )
        try:
            self._file.append(b"".join((head, packed, *indexes.values())))
        except OSError:
            self._begin_chunk()
            raise
        self._start_ns = min(self._start_ns, start) if self.chunks else start
        self._end_ns = max(self._end_ns, end)
        self.chunks += 1
        for channel, _ in self._block_parts:
            self.counts[channel] += blocks
        for channel, number in singles.items():
            self.counts[channel] += number
        self._chunk_index += _bytes_of(
            ChunkIndex(
                chunk_length=len(head) + len(packed),
                chunk_start_offset=at,
                compression=_COMPRESSION,
                compressed_size=len(packed),
                message_end_time=end,
                message_index_length=sum(map(len, indexes.values())),
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(data),
            )
        )
        self._begin_chunk()

    def _summary(self, start: int) -> bytes:
        """Everything after the data section, for a summary that begins at `start`."""
        statistics = Statistics(
            attachment_count=len(self._attachment_index),
            channel_count=len(self._channels),
            channel_message_counts=self.counts,
            chunk_count=self.chunks,
            message_count=sum(self.counts.values()),
            metadata_count=0,
            message_start_time=self._start_ns,
            message_end_time=self._end_ns,
            schema_count=len(self._schemas),
        )
        groups = (
            (Opcode.SCHEMA, _bytes_of(*self._schemas)),
            (Opcode.CHANNEL, _bytes_of(*self._channels)),
            (Opcode.STATISTICS, _bytes_of(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_index)),
            (Opcode.ATTACHMENT_INDEX, _bytes_of(*self._attachment_index)),
        )
        summary, offsets = b"", []
        for opcode, data in groups:
            if data:
                offsets.append(SummaryOffset(opcode, start + len(summary), len(data)))
                summary += data
        offsets_at = start + len(summary)
        summary += _bytes_of(*offsets)
        # The CRC covers the footer up to its own field.
        beginning = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_at)
        footer = Footer(start, offsets_at, zlib.crc32(summary + beginning))
        return summary + _bytes_of(footer) + MAGIC

    def finish(self) -> None:
        """Write the summary of what has been flushed, and close.

        Raises:
            OSError: the file has no summary; its chunks are readable one after the other.
        """
        end = _bytes_of(DataEnd(0))
        try:
            self._file.append(end + self._summary(self._file.offset + len(end)))
        finally:
            self._file.close()
