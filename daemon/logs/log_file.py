"""Open one MCAP file for reading: where its chunks are, what its channels are, and the bytes of each message.

A finished file is read by its summary. One without (`.active`: being written, or left by a crash) is gone through from
its beginning as far as it is whole.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Header, Metadata, Schema
from numpy.typing import NDArray

from jtqd.daemon.logs.container import (
    HEAD,
    HEAD_SIZE,
    MAX_CHUNK,
    MAX_SMALL,
    MESSAGE_BODY,
    MESSAGE_TIME,
    ChunkError,
    LogError,
    Source,
    attachment_data,
    attachment_index,
    chunk_head,
    footer_of,
    heads_at,
    message_index,
    parse,
    read_summary,
    unpack,
    walk,
)
from jtqd.daemon.logs.spans import cycle_channels, torn
from jtqd.daemon.recording.mcap_file import MAGIC
from jtqd.daemon.recording.own_files import ACTIVE

_FLAT_PIECE = 8 << 20
"""[byte] messages outside chunks are read in pieces of this size."""
_INDEX_ENTRY = 16
"""[byte] the least that a message takes of a file: its entry in a message index."""


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


@dataclass
class _ChunkPlace:
    """A chunk of a file."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    index: dict[int, int] = field(default_factory=dict)
    """Channel -> offset of its message index; empty: unknown."""


class LogFile:
    """An open log. Use as a context manager.

    Args:
        path: `X.mcap`, or `X.mcap.active` as far as it is there.

    Raises:
        LogError: no MCAP file, or one that ends too early and is not called `.active`.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: list[AttachmentIndex] = []
        self.header = Header("", "")
        self.metadata: list[Metadata] = []
        self.counts: dict[int, int] = {}
        """Channel -> messages, where the summary says it."""
        self._chunks: list[_ChunkPlace] = []
        self._flat = array("q")
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            self._source = Source(self._descriptor)
            self._open()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> LogFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)

    # ---- what is where ----

    def _open(self) -> None:
        source = self._source
        if source.read(0, len(MAGIC)) != MAGIC:
            raise LogError(f"{self.path}: not a readable MCAP file: its first bytes are not MCAP's")
        found = source.head(len(MAGIC))
        if found is not None and found[0] == Opcode.HEADER and found[1] < MAX_SMALL:
            self.header = parse(Header, self._body(len(MAGIC), found[1])) or self.header
        summary = read_summary(source)
        if summary is not None and (
            summary.chunks or (summary.statistics and not summary.statistics.message_count)
        ):
            self.schemas, self.channels = summary.schemas, summary.channels
            self.attachments = summary.attachments
            self.counts = {} if summary.statistics is None else summary.statistics.channel_message_counts
            self._chunks = [
                _ChunkPlace(
                    c.chunk_start_offset,
                    c.chunk_length,
                    c.message_start_time,
                    c.message_end_time,
                    c.message_index_offsets,
                )
                for c in sorted(summary.chunks, key=lambda c: c.chunk_start_offset)
            ]
            for index in summary.metadata:
                self._add_metadata(index.offset)
            return
        if summary is None and self.path.suffix != ACTIVE:
            what = "its summary is damaged" if footer_of(source) else "it ends too early"
            raise LogError(f"{self.path}: not a readable MCAP file: {what} (`jtq recover` repairs it)")
        if summary is not None:
            self.schemas, self.channels = dict(summary.schemas), dict(summary.channels)
        self._outline()

    def _body(self, at: int, end: int) -> bytes:
        return self._source.read(at + HEAD.size, end - at - HEAD.size)

    def _add_metadata(self, at: int) -> None:
        found = self._source.head(at)
        if found is not None and found[0] == Opcode.METADATA and found[1] - at < MAX_SMALL:
            record = parse(Metadata, self._body(at, found[1]))
            self.metadata += [] if record is None else [record]

    def _outline(self) -> None:
        """Go from record to record, as far as they are whole."""
        source, at = self._source, len(MAGIC)
        while (found := source.head(at)) is not None:
            opcode, end = found
            if opcode == Opcode.CHUNK:
                head = chunk_head(source.read(at, HEAD_SIZE))
                if head is None:
                    break
                self._chunks.append(_ChunkPlace(at, end - at, head.start_ns, head.end_ns))
            elif opcode == Opcode.MESSAGE_INDEX and self._chunks:
                self._chunks[-1].index[int.from_bytes(source.read(at + HEAD.size, 2), "little")] = at
            elif opcode == Opcode.MESSAGE:
                self._flat.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and end - at < MAX_SMALL:
                self._define(opcode, self._body(at, end))
            elif opcode == Opcode.ATTACHMENT:
                index = attachment_index(source, at, end)
                self.attachments += [] if index is None else [index]
            elif opcode == Opcode.METADATA:
                self._add_metadata(at)
            elif opcode in (0, Opcode.DATA_END, Opcode.FOOTER):
                break
            at = end
        if self._chunks and not self._flat:
            self._learn()

    def _learn(self) -> None:
        """Definitions that stand in chunks only, and what may be incomplete at the end: indexes, and our last span."""
        self._chunks[-1].index = {}
        for chunk in () if self.channels else self._chunks:
            data = self._unpacked(chunk)
            if data is not None:
                self._definitions(data, walk(data, None).others)
        cycles = cycle_channels(self.header, self.channels)
        if self.path.suffix != ACTIVE or len(cycles) < 2:
            return
        there = [dict.fromkeys(chunk.index) for chunk in self._chunks]
        last = self._unpacked(self._chunks[-1])
        if last is not None:
            there[-1] = dict.fromkeys(np.unique(walk(last).heads["channel"]).tolist())
        for place in reversed(torn(there, cycles)):
            del self._chunks[place]

    def _define(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = parse(Schema, body)
            if schema is not None:
                self.schemas.setdefault(schema.id, schema)
        else:
            channel = parse(Channel, body)
            if channel is not None:
                self.channels.setdefault(channel.id, channel)

    def _definitions(self, data: bytes, others: Sequence[tuple[int, int, int]]) -> None:
        for opcode, start, end in others:
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, data[start + HEAD.size : end])

    @property
    def expected(self) -> dict[int, int]:
        """Channel -> messages as the summary says, as far as the file is long enough for them."""
        most = self._source.size // _INDEX_ENTRY
        return {channel: min(count, most) for channel, count in self.counts.items()}

    @property
    def start_ns(self) -> int:
        """First log time; 0 without messages."""
        if self._chunks:
            return min(chunk.start_ns for chunk in self._chunks)
        first = self._source.read(self._flat[0] + HEAD.size + 6, 8) if self._flat else b""
        return int.from_bytes(first, "little")

    # ---- messages ----

    def batches(
        self, channels: Sequence[int] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Batch]:
        """Yield messages in the order of the file, at most one batch of each channel from a chunk.

        Args:
            channels: numbers of those that are wanted; None: all.
            start_ns, end_ns: log times from the first on, up to but without the second; None: no bound.

        Raises:
            LogError: a chunk is damaged.
            OSError: the file cannot be read.
        """
        wanted = None if channels is None else set(channels)
        first = 0 if start_ns is None else start_ns
        last = (1 << 64) - 1 if end_ns is None else end_ns - 1
        for chunk in self._chunks:
            if chunk.end_ns < first or chunk.start_ns > last:
                continue
            if wanted is not None and chunk.index and not wanted & chunk.index.keys():
                continue
            data = self._unpacked(chunk)
            if data is not None:
                yield from self._of_chunk(chunk, data, wanted, first, last)
        yield from self._of_flat(wanted, first, last)

    def _unpacked(self, chunk: _ChunkPlace) -> bytes | None:
        """Return the content of a chunk; None for the torn last one of a file that is being written."""
        try:
            if chunk.length > MAX_CHUNK + HEAD_SIZE:
                raise ChunkError(f"is {chunk.length} bytes long, expected at most {MAX_CHUNK}")
            record = self._source.read_apart(chunk.offset, chunk.length)
            head = chunk_head(record)
            if head is None or HEAD.unpack_from(record) != (Opcode.CHUNK, chunk.length - HEAD.size):
                raise ChunkError("there is none")
            return unpack(head, memoryview(record)[head.data_start :])
        except ChunkError as error:
            if chunk is self._chunks[-1] and self.path.suffix == ACTIVE:
                return None
            raise LogError(
                f"{self.path}: not a readable MCAP file: chunk at byte {chunk.offset}: {error} (`jtq recover` repairs it)"
            ) from None

    def _of_chunk(
        self, chunk: _ChunkPlace, data: bytes, wanted: set[int] | None, first: int, last: int
    ) -> Iterator[Batch]:
        alone = _of_equal_length(data, wanted)
        if alone is not None:
            whole = chunk.start_ns >= first and chunk.end_ns <= last
            yield alone if whole else _within(alone, first, last)
            return
        batches = []
        for channel in sorted(chunk.index.keys() if wanted is None else wanted & chunk.index.keys()):
            entries = message_index(self._source, chunk.index[channel], channel)
            batch = None if entries is None else _indexed(data, channel, entries)
            if batch is None:  # nothing of this chunk's indexes is believed then
                break
            batches.append(batch)
        else:
            if chunk.index:
                whole = chunk.start_ns >= first and chunk.end_ns <= last
                yield from batches if whole else (_within(batch, first, last) for batch in batches)
                return
        yield from self._of_walk(data, wanted, first, last)

    def _of_walk(self, data: bytes, wanted: set[int] | None, first: int, last: int) -> Iterator[Batch]:
        """Yield all messages of a chunk whose indexes are missing or wrong."""
        try:
            records = walk(data)
        except ChunkError as error:
            raise LogError(
                f"{self.path}: not a readable MCAP file: a chunk is wrong inside: {error}"
            ) from None
        self._definitions(data, records.others)
        heads = records.heads
        for channel in np.unique(heads["channel"]).tolist():
            if wanted is None or channel in wanted:
                mine = heads["channel"] == channel
                times = heads["log_time"][mine]
                batch = Batch(
                    channel, data, records.offsets[mine], times, heads["length"][mine] - MESSAGE_BODY
                )
                yield _within(batch, first, last)

    def _of_flat(self, wanted: set[int] | None, first: int, last: int) -> Iterator[Batch]:
        """Yield messages outside chunks, piece by piece."""
        offsets = np.frombuffer(self._flat, np.int64) if self._flat else np.empty(0, np.int64)
        begin = 0
        while begin < len(offsets):
            start = int(offsets[begin])
            stop = max(begin + 1, int(np.searchsorted(offsets, start + _FLAT_PIECE)))
            found = self._source.head(int(offsets[stop - 1]))
            if found is None:
                return
            # Records in between (attachments) are no messages: their bytes are there all the same.
            data = self._source.read(start, found[1] - start)
            here = offsets[begin:stop] - start
            begin = stop
            if int(here[-1]) + HEAD.size + MESSAGE_BODY > len(data):
                return
            heads = heads_at(data, here)
            for channel in np.unique(heads["channel"]).tolist():
                if wanted is None or channel in wanted:
                    mine = heads["channel"] == channel
                    lengths = heads["length"][mine]
                    if (lengths < MESSAGE_BODY).any():
                        raise LogError(f"{self.path}: not a readable MCAP file: a message is too short")
                    batch = Batch(channel, data, here[mine], heads["log_time"][mine], lengths - MESSAGE_BODY)
                    yield _within(batch, first, last)

    # ---- attachments ----

    def attachment(self, index: AttachmentIndex) -> bytes:
        """Return the content of an attachment. Raises LogError where it is damaged."""
        data = attachment_data(self._source, index)
        if data is None:
            raise LogError(f"{self.path}: attachment {index.name!r} is damaged")
        return data


def _of_equal_length(data: bytes, wanted: set[int] | None) -> Batch | None:
    """Return the messages of a chunk that holds nothing but those of one wanted channel, all of one length, else None.

    Records that follow one another from the first byte to the last need no index.
    """
    if len(data) < HEAD.size + MESSAGE_BODY:
        return None
    length = int.from_bytes(data[1 : HEAD.size], "little")
    step, channel = HEAD.size + length, int.from_bytes(data[HEAD.size : HEAD.size + 2], "little")
    if data[0] != Opcode.MESSAGE or length < MESSAGE_BODY or len(data) % step:
        return None
    if wanted is not None and channel not in wanted:
        return None
    count = len(data) // step
    fixed = np.ndarray(
        (count, HEAD.size + 2), np.uint8, data, strides=(step, 1)
    )  # opcode, length and channel
    if not (fixed == fixed[0]).all():
        return None
    times = np.ndarray((count,), "<u8", data, MESSAGE_TIME, (step,))
    lengths = np.full(count, length - MESSAGE_BODY, np.uint64)
    return Batch(channel, data, np.arange(0, len(data), step), times, lengths, step)


def _indexed(data: bytes, channel: int, entries: NDArray[np.uint64]) -> Batch | None:
    """Return messages where an index says; None where at one of these places there is none."""
    offsets = entries[:, 1].astype(np.int64)
    if not len(offsets):
        return Batch(channel, data, offsets, entries[:, 0], entries[:, 0])
    if len(offsets) > 1 and (offsets[1:] <= offsets[:-1]).any():  # by time, in some writers' files
        order = np.argsort(offsets)
        offsets, entries = offsets[order], entries[order]
    if offsets[0] < 0 or offsets[-1] > len(data) - HEAD.size - MESSAGE_BODY:
        return None
    heads = heads_at(data, offsets)
    log_times = entries[:, 0]
    if not (heads["log_time"] == log_times).all():
        return None
    lengths = heads["length"]
    good = (heads["opcode"] == Opcode.MESSAGE) & (heads["channel"] == channel)
    good &= (lengths >= MESSAGE_BODY) & (lengths <= len(data))
    ends = offsets + HEAD.size + lengths.astype(np.int64)
    if not good.all() or ends[-1] > len(data) or (ends[:-1] > offsets[1:]).any():
        return None
    return Batch(channel, data, offsets, log_times, lengths - MESSAGE_BODY)


def _within(batch: Batch, first: int, last: int) -> Batch:
    """Those with a log time from `first` to `last`."""
    inside = (batch.log_times >= first) & (batch.log_times <= last)
    return Batch(
        batch.channel, batch.data, batch.offsets[inside], batch.log_times[inside], batch.lengths[inside]
    )
