"""Recover logs that a crash left unfinished, or that were damaged later: `jtq recover`, and the recorder for its own.

A log of jtqd, and of its python-can writer, keeps every message in a chunk with a CRC. The file is read record by record;
what is whole is copied into a new file beside it, under a new summary. The copy is read back, is on the disk, and only then
takes the place of the file, in one step: an interrupted recovery leaves the file as it was and is simply repeated.

A record that is damaged is left out where its length leads to a whole record, else the next chunk is searched for, which
proves itself by its CRC. Nothing that fails its CRC is copied, and nothing is taken for a message that stands in no chunk.

The recorder runs `python -m jtqd.daemon.logs.recover DIRECTORY PREFIX RESERVE_BYTES` at the lowest priority for what an
earlier run left: files with its own kind of name that nobody has locked. One JSON line for each: {"file", "text", "lossy"}.
"""

from __future__ import annotations

import argparse
import errno
import fcntl
import json
import os
import struct
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Header,
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
    LogError,
    Source,
    Summary,
    Walk,
    attachment_index,
    chunk_head,
    footer_of,
    message_index,
    parse,
    read_summary,
    unpack,
    walk,
)
from jtqd.daemon.recording.mcap_file import MAGIC, bytes_of
from jtqd.daemon.recording.parts import ACTIVE, OwnFile, own_files

_PARTIAL = ".recovering"
"""Ending of the copy while it is written."""
_CHUNK_MARK, _CHUNK_MARK_AT = struct.pack("<I4s", 4, b"zstd"), HEAD.size + 28
"""What every chunk of ours has at this offset: the name of its compression."""
_WINDOW = 1 << 20
_LONGEST_TORN_CHUNK_S = 600.0
"""A torn chunk whose head claims more than this is not believed."""
_SUMMARY_KINDS: dict[int, type[Statistics] | type[ChunkIndex]] = {
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
}
"""Records that stand in the summary only."""


class RecoverError(LogError):
    """The file cannot be recovered, and is as it was; one line."""


@dataclass(frozen=True)
class Recovery:
    """What was found in a file and done to it.

    Attributes:
        path: the file as it is called now.
        changed: it was written anew, or would have been (`dry_run`).
        renamed: `.active` was taken off its name.
        lossy: something could not be read, or failed its CRC.
        messages, chunks, attachments: what the file holds now.
        seconds: from the first message to the last [s].
        lost_bytes, lost_chunks: what could not be read.
        lost_s: estimate of the time that stood there [s].
        findings: one line each.
    """

    path: Path
    changed: bool
    renamed: bool
    lossy: bool
    messages: int
    chunks: int
    attachments: int
    seconds: float
    lost_bytes: int
    lost_chunks: int
    lost_s: float
    findings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """For `json.dumps`."""
        return asdict(self) | {"path": str(self.path), "findings": list(self.findings)}


def recover(path: Path, *, dry_run: bool = False, keep_free: int = 0) -> Recovery:
    """Write a damaged file anew, as far as it is whole, and take `.active` off its name.

    A file that is whole is not touched; recovering again changes nothing.

    Args:
        path: `X.mcap.active` or `X.mcap`.
        dry_run: only report what would be done.
        keep_free: [byte] that must stay free on the disk beside the copy.

    Raises:
        RecoverError: it is being written (its writer holds an flock on it), nothing in it can be read, its messages stand
            in no chunks, or the new name is taken.
        OSError: it cannot be read or written, or there is no room for the copy.
    """
    descriptor = os.open(path, (os.O_RDONLY if dry_run else os.O_RDWR) | os.O_CLOEXEC)
    copy = -1
    try:
        _lock(descriptor, path, shared=dry_run)
        before = os.fstat(descriptor)
        source = Source(descriptor)
        own = read_summary(source)
        found = _scan(source, own)
        _refuse(path, found)
        now = os.fstat(descriptor)
        if (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
            raise RecoverError(f"{path}: found that it is being written, expected a file at rest")
        final = _final_name(path)
        changed = not _is_whole(found, own)
        report = _report(source, found, own) if changed else _Report()
        if changed and not dry_run:
            copy = _replace(path, source, found, keep_free)
        if final != path and not dry_run:
            os.rename(path, final)
            _sync_directory(path.parent)
    finally:
        os.close(descriptor)
        if copy >= 0:
            os.close(copy)
    return Recovery(
        path=path if dry_run else final,
        changed=changed,
        renamed=final != path,
        lossy=report.lossy,
        messages=sum(found.counts.values()),
        chunks=len(found.chunks),
        attachments=len(found.summary.attachments),
        seconds=(found.end_ns - found.start_ns) * 1e-9,
        lost_bytes=report.lost_bytes,
        lost_chunks=report.lost_chunks,
        lost_s=round(report.lost_s, 3),
        findings=tuple(report.findings),
    )


# ---- what of a file is whole ----


class _Chunk(NamedTuple):
    """A whole chunk. `index` is right; `head_right`, `indexed`: so are the times in its head, its message indexes."""

    index: ChunkIndex
    counts: Counter[int]
    head_right: bool
    indexed: bool

    @property
    def end(self) -> int:
        """Offset behind the chunk record."""
        return int(self.index.chunk_start_offset + self.index.chunk_length)


@dataclass
class _Gap:
    """Bytes that cannot be read. `chunks`: that begin there; `index`: only message indexes stood there."""

    start: int
    end: int
    chunks: int
    index: bool = False
    seconds: float = 0.0


@dataclass
class _Contents:
    """The whole records of a file. `summary`: definitions, attachments and metadata; its chunks are `chunks`."""

    magic: bool = False
    header: Header | None = None
    summary: Summary = field(default_factory=Summary)
    unchecked: dict[tuple[type, int], Schema | Channel] = field(default_factory=dict)
    """Definitions that no CRC covers, by kind and number."""
    chunks: list[_Chunk] = field(default_factory=list)
    gaps: list[_Gap] = field(default_factory=list)
    open_gap: _Gap | None = None
    """The next chunk tells for how long it stands."""
    loose_messages: int = 0
    undefined: int = 0
    """Chunks that were left out since a channel in them is defined nowhere."""
    unproven: bool = False
    """Definitions had to be taken that no CRC covers."""
    contradicted: bool = False
    """Definitions at the head are not what the chunks say."""
    end: int = 0

    @property
    def counts(self) -> Counter[int]:
        """Messages of each channel."""
        return sum((chunk.counts for chunk in self.chunks), Counter())

    @property
    def start_ns(self) -> int:
        """First log time; 0 without messages."""
        return min((int(c.index.message_start_time) for c in self.chunks if c.counts), default=0)

    @property
    def end_ns(self) -> int:
        """Last log time; 0 without messages."""
        return max((int(c.index.message_end_time) for c in self.chunks if c.counts), default=0)


def _scan(source: Source, own: Summary | None) -> _Contents:
    """Go through the data section. `own` is the file's summary, where that holds together. Raises OSError."""
    found = _Contents()
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
        if end is None and _data_end_here(source, at):
            break
        if end is None:
            end = _next_whole(source, at, limit, places)
            _leave_out(source, at, end, found)
        at = end
    found.end = min(at, limit)
    _settle_definitions(found)
    return found


def _take(source: Source, at: int, limit: int, found: _Contents) -> int | None:
    """Add the record at `at` to what was found; returns where it ends, None where it is not whole."""
    framed = source.head(at)
    if framed is None or framed[1] > limit:
        return None
    opcode, end = framed
    body = b"" if opcode == Opcode.CHUNK else _small_body(source, at, end)
    good = False
    if opcode == Opcode.CHUNK:
        return _take_chunk(source, at, end, found)
    if opcode == Opcode.HEADER and at == len(MAGIC):
        found.header = parse(Header, body)
        good = found.header is not None
    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        definition = parse(Schema if opcode == Opcode.SCHEMA else Channel, body)
        good = definition is not None
        if definition is not None:
            found.unchecked.setdefault((type(definition), definition.id), definition)
    elif opcode == Opcode.METADATA:
        metadata = parse(Metadata, body)
        good = metadata is not None
        if metadata is not None:
            found.summary.metadata.append(MetadataIndex(at, end - at, metadata.name))
    elif opcode == Opcode.ATTACHMENT:
        attachment = attachment_index(source, at, end)
        good = attachment is not None
        if attachment is not None:
            found.summary.attachments.append(attachment)
    elif opcode == Opcode.MESSAGE_INDEX:  # of a chunk that was left out, or one that is made anew
        good = parse(MessageIndex, body) is not None
    return end if good else None


def _small_body(source: Source, at: int, end: int) -> bytes:
    return source.read(at + HEAD.size, min(end - at - HEAD.size, MAX_SMALL + 1))


def _take_chunk(source: Source, at: int, end: int, found: _Contents) -> int | None:
    """The same of a chunk and the message indexes that follow it."""
    head = _framed_chunk(source, at, end)
    data = None if head is None else _content(source, at, head)
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
    expected = _entries(records)
    indexed = expected.keys() == entries.keys() and all(
        np.array_equal(entries[channel][np.argsort(entries[channel][:, 1])], rows)
        for channel, rows in expected.items()
    )
    for definition in _definitions(data, records):
        known: dict[int, Any] = (
            found.summary.schemas if isinstance(definition, Schema) else found.summary.channels
        )
        if head.crc:
            known.setdefault(definition.id, definition)
        else:
            found.unchecked.setdefault((type(definition), definition.id), definition)
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
        found.open_gap.seconds = max(0, first - found.end_ns) * 1e-9 if found.chunks else 0.0
        found.open_gap = None
    found.chunks.append(_Chunk(index, counts, (first, last) == (head.start_ns, head.end_ns), indexed))
    return index_end


def _framed_chunk(source: Source, at: int, limit: int) -> ChunkHead | None:
    """Head of the chunk at `at`, where its lengths agree with each other; its content is not looked at."""
    framed = source.head(at)
    if framed is None or framed[0] != Opcode.CHUNK or framed[1] > limit:
        return None
    head = chunk_head(source.read(at, HEAD_SIZE))
    agrees = head is not None and at + head.data_start + head.packed_size == framed[1]
    return head if agrees and head is not None and head.packed_size <= MAX_CHUNK else None


def _content(source: Source, at: int, head: ChunkHead) -> bytes | None:
    """What is in a chunk; None where it is not whole."""
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


def _entries(records: Walk) -> dict[int, NDArray[np.uint64]]:
    """Entries that the message indexes of a chunk must have, by channel: log time and offset [n, 2], by offset."""
    rows = np.stack([records.heads["log_time"], records.offsets.astype(np.uint64)], axis=1)
    channels = records.heads["channel"]
    return {channel: rows[channels == channel] for channel in np.unique(channels).tolist()}


def _definitions(data: bytes, records: Walk) -> Iterator[Schema | Channel]:
    for opcode, start, end in records.others:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definition = parse(Schema if opcode == Opcode.SCHEMA else Channel, data[start + HEAD.size : end])
            if definition is not None:
                yield definition


def _data_end_here(source: Source, at: int) -> bool:
    """The data section ends at `at`: there is DataEnd, or a record that stands in the summary only."""
    framed = source.head(at)
    if framed is None:
        return False
    opcode, end = framed
    if opcode == Opcode.DATA_END:
        return end - at == HEAD.size + 4
    kind = _SUMMARY_KINDS.get(opcode)
    return kind is not None and parse(kind, _small_body(source, at, end)) is not None


def _next_whole(source: Source, at: int, limit: int, places: list[int]) -> int:
    """Where to go on behind a damaged record: where its length leads, at the next chunk, or the end of the data.

    `places`: where the summary says that there are records.
    """
    framed = source.head(at)
    if framed is not None and framed[1] <= limit:
        end = framed[1]
        if end == limit or _data_end_here(source, end) or _framed_chunk(source, end, limit) is not None:
            return end
        if _take(source, end, limit, _Contents()) is not None:
            return end
    for place in places:
        if place > at and _take(source, place, limit, _Contents()) is not None:
            return place
    begin = at + 1
    while begin < limit:
        window = source.read(begin, min(_WINDOW + _CHUNK_MARK_AT + len(_CHUNK_MARK), limit - begin))
        place = window.find(_CHUNK_MARK, _CHUNK_MARK_AT)
        while place >= 0:
            start = begin + place - _CHUNK_MARK_AT
            head = _framed_chunk(source, start, limit)
            if head is not None and _content(source, start, head) is not None:
                return start
            place = window.find(_CHUNK_MARK, place + 1)
        begin += _WINDOW
    return limit


def _leave_out(source: Source, start: int, end: int, found: _Contents) -> None:
    opcode = source.read(start, 1)
    found.loose_messages += opcode == bytes([Opcode.MESSAGE])
    chunk = opcode == bytes([Opcode.CHUNK])
    last = found.gaps[-1] if found.gaps else None
    index = opcode == bytes([Opcode.MESSAGE_INDEX]) and bool(found.chunks) and not found.chunks[-1].indexed
    if last is not None and last.end == start and not last.index and not index:
        last.end, last.chunks = end, last.chunks + chunk
    else:
        found.gaps.append(_Gap(start, end, int(chunk), index))
        found.open_gap = found.open_gap if index else found.gaps[-1]


def _settle_definitions(found: _Contents) -> None:
    """Choose definitions, those that a CRC covers before others; leave out chunks with a channel that has none."""
    known: dict[type, dict[int, Any]] = {Schema: found.summary.schemas, Channel: found.summary.channels}
    taken = set()
    for (kind, number), definition in found.unchecked.items():
        have = known[kind].setdefault(number, definition)
        found.contradicted |= have != definition
        if have is definition:
            taken.add((kind, number))
    schemas, channels = found.summary.schemas, found.summary.channels
    for number in [
        n for n, channel in channels.items() if channel.schema_id and channel.schema_id not in schemas
    ]:
        del channels[number]
    kept = []
    for chunk in found.chunks:
        if chunk.counts.keys() <= channels.keys():
            kept.append(chunk)
            continue
        found.undefined += 1
        seconds = (chunk.index.message_end_time - chunk.index.message_start_time) * 1e-9
        found.gaps.append(_Gap(chunk.index.chunk_start_offset, chunk.end, 1, seconds=seconds))
    found.chunks = kept
    found.unproven = any(
        (Channel, number) in taken or (Schema, channels[number].schema_id) in taken for number in found.counts
    )


def _refuse(path: Path, found: _Contents) -> None:
    """Raise RecoverError for a file that has nothing to copy, or messages that would be lost by it."""
    foreign = found.header is not None and not found.header.library.startswith("jtqd")
    if found.loose_messages and (foreign or not found.chunks):
        raise RecoverError(
            f"{path}: found messages outside chunks, expected a log of jtqd: every message in a chunk"
        )
    summary = found.summary
    if not (found.header or found.chunks or summary.attachments or summary.metadata):
        raise RecoverError(f"{path}: found nothing that can be read, expected an MCAP file")


def _is_whole(found: _Contents, own: Summary | None) -> bool:
    """The file ends with a summary that names everything that was found in it, and nothing else."""
    if own is None or not found.magic or found.header is None or found.contradicted or found.undefined:
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


# ---- what is lost ----


@dataclass
class _Report:
    findings: list[str] = field(default_factory=list)
    lossy: bool = False
    lost_bytes: int = 0
    lost_chunks: int = 0
    lost_s: float = 0.0


def _report(source: Source, found: _Contents, own: Summary | None) -> _Report:
    """Findings about a file that must be written anew."""
    report = _Report()
    for gap in sorted(found.gaps, key=lambda each: each.start):
        size = gap.end - gap.start
        if gap.index:
            continue
        at_end = gap.end == found.end and own is None
        zeros = at_end and all(block.count(0) == len(block) for block in source.blocks(gap.start, gap.end))
        if zeros:
            what = f"{_count(size, 'byte')} of zeros at the end"
        elif at_end:
            what = f"torn at byte {gap.start}: the last {_count(size, 'byte')} cannot be read"
        else:
            what = f"bytes {gap.start} to {gap.end} cannot be read{' (a chunk)' if gap.chunks else ''}"
        report.findings.append(what)
        report.lost_bytes += size
        report.lost_chunks += gap.chunks
        report.lost_s += _torn_seconds(source, gap, found) if at_end else gap.seconds
        report.lossy = True
    if own is not None and not report.lossy and own.statistics is not None:
        missing = own.statistics.message_count - sum(found.counts.values())
        if missing > 0:
            report.findings.append(f"{_count(missing, 'message')} of the summary are not in the file")
            report.lossy = True
    if found.undefined:
        report.findings.append(f"{_count(found.undefined, 'chunk')} with a channel that is defined nowhere")
    if found.unproven:
        report.findings.append(
            "schemas and channels are in no chunk that can be read: taken from the head, unchecked"
        )
        report.lossy = True
    if found.contradicted:
        report.findings.append(
            "schemas or channels at the head are damaged: taken from a chunk or the summary"
        )
    if not found.magic or found.header is None:
        report.findings.append("magic bytes or header damaged: written anew")
    anew = sum(not chunk.indexed for chunk in found.chunks)
    if anew:
        report.findings.append(f"message indexes of {_count(anew, 'chunk')} written anew")
    report.findings.append("no summary: written" if own is None else "summary written anew")
    return report


def _torn_seconds(source: Source, gap: _Gap, found: _Contents) -> float:
    """Time for which the torn end of a file stood [s]: by the head of its chunk, else by the rate so far."""
    if not found.chunks:
        return 0.0
    head = chunk_head(source.read(gap.start, HEAD_SIZE))
    if gap.chunks and head is not None:
        seconds = (head.end_ns - found.end_ns) * 1e-9
        if 0.0 <= seconds < _LONGEST_TORN_CHUNK_S:
            return seconds
    data = gap.start - int(found.chunks[0].index.chunk_start_offset)
    return (found.end_ns - found.start_ns) * 1e-9 * (gap.end - gap.start) / max(data, 1)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


# ---- the copy ----


class _Copy:
    """A file that is being written."""

    def __init__(self, descriptor: int) -> None:
        self._file = descriptor
        self.at = 0

    def write(self, data: bytes) -> int:
        """Write all of it; returns where it begins."""
        begin, view = self.at, memoryview(data)
        while view:
            written = os.write(self._file, view)
            view, self.at = view[written:], self.at + written
        return begin

    def take(self, source: Source, start: int, end: int) -> int:
        """Copy a stretch of another file; returns where it begins."""
        begin = self.at
        for block in source.blocks(start, end):
            self.write(block)
        return begin


def _replace(path: Path, source: Source, found: _Contents, keep_free: int) -> int:
    """Write what was found beside the file, check it and put it in its place; returns its descriptor, which is locked.

    Raises:
        RecoverError: the copy does not read back.
        OSError: it cannot be written; the file is as it was, and the copy is gone.
    """
    target = Path(os.path.realpath(path))
    partial = target.with_name(target.name + _PARTIAL)
    with suppress(FileNotFoundError):  # of a recovery that was interrupted
        partial.unlink()
    copy = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    try:
        with suppress(OSError):
            fcntl.flock(copy, fcntl.LOCK_EX | fcntl.LOCK_NB)
        before = os.stat(target)
        with suppress(OSError):
            os.fchmod(copy, before.st_mode & 0o777)
            os.fchown(copy, before.st_uid, before.st_gid)
        disk = os.fstatvfs(copy)
        if disk.f_bavail * disk.f_frsize < found.end + keep_free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        _write(_Copy(copy), source, found)
        os.fsync(copy)
        written = Source(copy)
        own = read_summary(written)
        again = _scan(written, own)
        if not _is_whole(again, own) or again.counts != found.counts:
            raise RecoverError(f"{path}: found a copy that does not read back, expected what was written")
        os.replace(partial, target)
        _sync_directory(target.parent)
    except BaseException:
        os.close(copy)
        with suppress(OSError):
            partial.unlink()
        raise
    return copy


def _write(copy: _Copy, source: Source, found: _Contents) -> None:
    """The whole file: header, metadata, attachments, definitions, chunks, summary."""
    copy.write(MAGIC + bytes_of(found.header or Header("ros2", "jtqd")))
    summary = Summary(dict(found.summary.schemas), dict(found.summary.channels))
    for metadata in found.summary.metadata:
        at = copy.take(source, metadata.offset, metadata.offset + metadata.length)
        summary.metadata.append(replace(metadata, offset=at))
    for attachment in found.summary.attachments:
        at = copy.take(source, attachment.offset, attachment.offset + attachment.length)
        summary.attachments.append(replace(attachment, offset=at))
    copy.write(bytes_of(*summary.schemas.values(), *summary.channels.values()))
    for chunk in found.chunks:
        summary.chunks.append(_copy_chunk(copy, source, chunk))
    counts = found.counts
    summary.statistics = Statistics(
        attachment_count=len(summary.attachments),
        channel_count=len(summary.channels),
        channel_message_counts={number: counts[number] for number in summary.channels},
        chunk_count=len(summary.chunks),
        message_count=sum(counts.values()),
        metadata_count=len(summary.metadata),
        message_start_time=found.start_ns,
        message_end_time=found.end_ns,
        schema_count=len(summary.schemas),
    )
    copy.write(summary.to_bytes(copy.at))


def _copy_chunk(copy: _Copy, source: Source, chunk: _Chunk) -> ChunkIndex:
    """Copy a chunk as it is packed, with the right times in its head, and its message indexes; returns its index entry."""
    index = chunk.index
    start = index.chunk_start_offset
    at = copy.write(
        source.read(start, HEAD.size) + struct.pack("<QQ", index.message_start_time, index.message_end_time)
    )
    copy.take(source, start + HEAD.size + 16, chunk.end)
    behind = copy.at
    if chunk.indexed:
        copy.take(source, chunk.end, chunk.end + index.message_index_length)
        offsets = {channel: place + at - start for channel, place in index.message_index_offsets.items()}
    else:
        offsets = {}
        head = chunk_head(source.read(start, HEAD_SIZE))
        data = None if head is None else _content(source, start, head)
        for channel, rows in _entries(walk(data or b"")).items():
            body = struct.pack("<HI", channel, rows.nbytes) + rows.astype("<u8").tobytes()
            offsets[channel] = copy.write(HEAD.pack(Opcode.MESSAGE_INDEX, len(body)) + body)
    return replace(
        index, chunk_start_offset=at, message_index_offsets=offsets, message_index_length=copy.at - behind
    )


def _lock(descriptor: int, path: Path, *, shared: bool) -> None:
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise RecoverError(
                f"{path}: a recorder is writing it, expected a file that nobody writes"
            ) from None
        # A file system without locks: what is left is the check that the file does not change meanwhile.


def _final_name(path: Path) -> Path:
    if path.suffix != ACTIVE:
        return path
    final = path.with_suffix("")
    if final.exists():
        raise RecoverError(f"{path}: found {final.name} beside it, expected that name to be free")
    return final


def _sync_directory(directory: Path) -> None:
    with suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# ---- what a crash of the recorder left ----


def recover_leftover(file: OwnFile, keep_free: int = 0) -> tuple[str, bool] | None:
    """Recover one file of an earlier run: what was done, and whether something was lost. None: somebody is writing it."""
    path = file.path
    if _is_being_written(path):
        return None
    try:
        if path.stat().st_size == 0:  # its recorder died before the first byte
            path.unlink()
            return f"{path.name} was empty: removed", False
        found = recover(path, keep_free=keep_free)
    except RecoverError as error:
        return str(error), True
    except OSError as error:
        return f"{path.name} cannot be repaired: {error.strerror}", True
    text = f"{found.path.name} repaired: {_count(found.chunks, 'chunk')} kept"
    if found.lost_bytes:
        text += f", {found.lost_bytes} B ({found.lost_s:.1f} s) unreadable"
    return text, found.lossy


def _is_being_written(path: Path) -> bool:
    with suppress(OSError), open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _leftovers(arguments: list[str]) -> int:
    """Recover all files that an earlier run left; exit status 0, or 2 for wrong use."""
    if len(arguments) != 3 or not arguments[2].isdigit():
        print("usage: python -m jtqd.daemon.logs.recover DIRECTORY PREFIX RESERVE_BYTES", file=sys.stderr)
        return 2
    with suppress(OSError):
        os.nice(19)
    for file in own_files(Path(arguments[0]), arguments[1]):
        result = recover_leftover(file, int(arguments[2])) if file.active else None
        if result is not None:
            print(json.dumps({"file": str(file.path), "text": result[0], "lossy": result[1]}), flush=True)
    return 0


# ---- jtq recover ----


_ENDINGS = (".mcap", ".mcap" + ACTIVE)
_EXAMPLES = """examples:
  jtq recover /var/log/jtqd                       every file there that a crash has left
  jtq recover run.mcap.active                     becomes run.mcap
  jtq recover --dry-run --json run.mcap           check every byte, change nothing

In a directory: every *.mcap.active, and every *.mcap that has no proper end. A file named on the command line is
checked from its first byte to its last. Files that a recorder is writing are refused (in a directory: left out).
The recovered file is written beside the old one, which it then replaces: as much room as the file has must be free.

exit status: 0 nothing lost, 3 recovered with loss, 1 failure, 2 usage"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq recover`."""
    result = argparse.ArgumentParser(
        prog="jtq recover",
        description="Recover logs of jtqd that were torn by a crash, cut short or damaged: every whole chunk is kept.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("logs", nargs="+", type=Path, metavar="FILE|DIR")
    result.add_argument("--json", action="store_true", help="results as JSON on standard output")
    result.add_argument("--dry-run", action="store_true", help="report what would be done, change nothing")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run `jtq recover`; returns its exit status."""
    options = parser().parse_args(argv)
    for path in options.logs:
        if not path.is_dir() and not path.name.endswith(_ENDINGS):
            parser().error(f"found {path}, expected a directory or a file named *.mcap or *.mcap{ACTIVE}")
    results: list[Recovery] = []
    failures: list[dict[str, str]] = []
    for path in _files(options.logs):
        try:
            results.append(recover(path, dry_run=options.dry_run))
        except (LogError, OSError) as error:
            text = f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error)
            failures.append({"path": str(path), "error": text})
            print(f"jtq recover: {text}", file=sys.stderr)
            continue
        if not options.json:
            print(_text(results[-1], options.dry_run), flush=True)
    if options.json:
        print(json.dumps({"files": [each.as_json() for each in results], "failures": failures}))
    elif not results and not failures:
        print("nothing to recover")
    if failures:
        return 1
    return 3 if any(each.lossy for each in results) else 0


def _files(paths: list[Path]) -> Iterator[Path]:
    for path in paths:
        if not path.is_dir():
            yield path
            continue
        for each in sorted(path.iterdir()):
            if each.is_file() and (
                each.name.endswith(_ENDINGS[1]) or (each.suffix == ".mcap" and not _has_footer(each))
            ):
                yield each


def _has_footer(path: Path) -> bool:
    """The file ends properly; also True for one that cannot be opened."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return True
    try:
        return footer_of(Source(descriptor)) is not None
    finally:
        os.close(descriptor)


def _text(result: Recovery, dry_run: bool) -> str:
    would = "would be " if dry_run else ""
    state = f"{would}repaired" if result.changed else f"{would}renamed" if result.renamed else "whole"
    lines = [
        f"{result.path}: {state}: {_count(result.messages, 'message')}, {_count(result.chunks, 'chunk')}, "
        f"{_count(result.attachments, 'attachment')}, {result.seconds:.1f} s"
    ]
    lines += [f"  {finding}" for finding in result.findings]
    if result.lossy:
        lines.append(
            f"  lost: {_count(result.lost_bytes, 'byte')}, {_count(result.lost_chunks, 'chunk')}, "
            f"about {result.lost_s:.2f} s"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(_leftovers(sys.argv[1:]))
