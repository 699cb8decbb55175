"""MCAP file made of whole chunks: what is on disk is always a valid beginning of the file.

Header, the metadata `jtqd`, attachments, schemas and channels come first, outside any chunk. Each chunk is one write with
its message indexes, then `fdatasync`. A write that fails is taken back and only that chunk is gone. Blocks for the summary
are taken from the disk before they are needed, so that a file can be ended on a disk that has become full.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from daemon.recording.appender import Appender
from daemon.recording.chunk import SealedChunk
from daemon.recording.mcap_bytes import MAGIC, bytes_of, tail_bytes

METADATA = "jtqd"
"""Name of the record that says which run and part a file is."""
_ROOM_FOR_NEXT = 1024
"""Of the summary that one more chunk makes longer, and of the footer."""


class NamedData(NamedTuple):
    """One attachment."""

    name: str
    media_type: str
    data: bytes


class Head(NamedTuple):
    """What every file of a run begins with; identifiers of schemas and channels are the caller's."""

    schemas: Sequence[Schema]
    channels: Sequence[Channel]
    attachments: Sequence[NamedData]


class McapFile:
    """One file being written. `append` and `finish` raise OSError.

    Args:
        path: must not exist yet; its directory must.
        head: schemas, channels and attachments.
        metadata: of this file.
        time_ns: creation time of the attachments.

    Raises:
        OSError: the file cannot be created, or its head cannot be written (it is removed again then).
    """

    def __init__(self, path: Path, head: Head, metadata: Mapping[str, str], time_ns: int) -> None:
        self._head = head
        self._attachment_index: list[AttachmentIndex] = []
        self._metadata_index: list[MetadataIndex] = []
        self._chunk_index = bytearray()
        self.chunks = 0
        self.counts: dict[int, int] = {channel.id: 0 for channel in head.channels}
        self._start_ns, self._end_ns = 0, 0
        self._name = path.name
        self._directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            self._file = Appender(self._name, self._directory)
        except OSError:
            os.close(self._directory)
            raise
        try:
            data = self._beginning(metadata, time_ns)
            self._file.append(data, self._room())
            self._sync_directory()
        except OSError:
            self._file.close()
            with contextlib.suppress(OSError):
                os.unlink(self._name, dir_fd=self._directory)
            os.close(self._directory)
            raise

    def _beginning(self, metadata: Mapping[str, str], time_ns: int) -> bytes:
        data = bytearray(MAGIC + bytes_of(Header(profile="ros2", library="jtqd")))
        record = bytes_of(Metadata(METADATA, dict(metadata)))
        self._metadata_index.append(MetadataIndex(len(data), len(record), METADATA))
        data += record
        for item in self._head.attachments:
            record = bytes_of(Attachment(time_ns, time_ns, item.name, item.media_type, item.data))
            self._attachment_index.append(
                AttachmentIndex(
                    offset=len(data),
                    length=len(record),
                    log_time=time_ns,
                    create_time=time_ns,
                    data_size=len(item.data),
                    name=item.name,
                    media_type=item.media_type,
                )
            )
            data += record
        # Everything of the summary that does not grow.
        self._constant_room = len(bytes_of(*self._attachment_index, *self._metadata_index))
        definitions = bytes_of(*self._head.schemas, *self._head.channels)
        self._constant_room += len(definitions)
        return bytes(data + definitions)

    def _room(self) -> int:
        """Bytes that the summary would take after one more chunk."""
        return self._constant_room + len(self._chunk_index) + 10 * len(self.counts) + _ROOM_FOR_NEXT

    def _sync_directory(self) -> None:
        """Have a new or changed name on the disk, where the file system can do that."""
        with contextlib.suppress(OSError):
            os.fsync(self._directory)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return self._file.offset

    @property
    def removed(self) -> bool:
        """The file has no name any more: nothing of it will be found."""
        return self._file.removed

    @property
    def free_bytes(self) -> int:
        """Free space of its file system. Raises OSError."""
        return self._file.free_bytes

    def append(self, chunk: SealedChunk) -> None:
        """Have a chunk on the disk.

        Raises:
            OSError: it is not in the file.
        """
        at = self._file.offset
        self._file.append(chunk.data, self._room())
        self._start_ns = min(self._start_ns, chunk.start_ns) if self.chunks else chunk.start_ns
        self._end_ns = max(self._end_ns, chunk.end_ns)
        self.chunks += 1
        for channel, number in chunk.counts.items():
            self.counts[channel] += number
        self._chunk_index += bytes_of(chunk.index(at))

    def _tail(self) -> bytes:
        """Everything after the data section."""
        statistics = Statistics(
            attachment_count=len(self._attachment_index),
            channel_count=len(self._head.channels),
            channel_message_counts=self.counts,
            chunk_count=self.chunks,
            message_count=sum(self.counts.values()),
            metadata_count=len(self._metadata_index),
            message_start_time=self._start_ns,
            message_end_time=self._end_ns,
            schema_count=len(self._head.schemas),
        )
        groups = (
            (Opcode.SCHEMA, bytes_of(*self._head.schemas)),
            (Opcode.CHANNEL, bytes_of(*self._head.channels)),
            (Opcode.STATISTICS, bytes_of(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_index)),
            (Opcode.ATTACHMENT_INDEX, bytes_of(*self._attachment_index)),
            (Opcode.METADATA_INDEX, bytes_of(*self._metadata_index)),
        )
        return tail_bytes(groups, self._file.offset)

    def finish(self, final_name: str) -> None:
        """Write the summary of what has been appended, close, and give the file its final name.

        Raises:
            OSError: the file has no summary and keeps its name; its chunks are readable one after the other.
        """
        try:
            try:
                self._file.append(self._tail())
            finally:
                self._file.close()
            os.rename(self._name, final_name, src_dir_fd=self._directory, dst_dir_fd=self._directory)
            self._sync_directory()
        finally:
            os.close(self._directory)

    def abandon(self, *, remove: bool = False) -> None:
        """Close it as it is; with `remove` take it away, for one that holds nothing."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            if remove:
                os.unlink(self._name, dir_fd=self._directory)
        os.close(self._directory)
