"""Recover logs that a crash left unfinished, or that were damaged later.

A log of jtqd, and of its python-can writer, keeps every message in a chunk with a CRC. What of it is whole
(`jtqd.daemon.logs.contents`) is copied, chunks as they are packed, into a new file beside it, under a new summary. The copy
is read back, is on the disk, and only then takes the place of the file, in one step: an interrupted recovery leaves the file
as it was and is simply repeated. Memory holds one chunk at a time.

The recorder runs `python -m jtqd.daemon.logs.recover DIRECTORY PREFIX RESERVE_BYTES` at the lowest priority for what an
earlier run left: files with its own kind of name that nobody has locked. One JSON line for each: {"file", "text", "lossy"}.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import struct
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode
from mcap.records import (
    ChunkIndex,
    Header,
    Statistics,
)

from jtqd.daemon.logs.container import (
    HEAD,
    HEAD_SIZE,
    LogError,
    Source,
    Summary,
    chunk_head,
    read_summary,
    walk,
)
from jtqd.daemon.logs.contents import Contents, Gap, WholeChunk, chunk_content, index_entries, is_whole, scan
from jtqd.daemon.recording.mcap_file import MAGIC, bytes_of
from jtqd.daemon.recording.own_files import ACTIVE, OwnFile, own_files
from jtqd.estimator.checked import counted

_PARTIAL = ".recovering"
"""Ending of the copy while it is written."""
_LONGEST_TORN_CHUNK_S = 600.0
"""A torn chunk whose head claims more than this is not believed."""


class RecoverError(LogError):
    """The file cannot be recovered, and is as it was; one line."""


class BeingWrittenError(RecoverError):
    """Its writer holds a lock on it."""


class OutsideChunksError(RecoverError):
    """Its messages stand in no chunks, where nothing proves them; `ended`: the file has a proper end."""

    def __init__(self, text: str, *, ended: bool) -> None:
        super().__init__(text)
        self.ended = ended


@dataclass(frozen=True)
class Recovery:
    """Result of a recovery.

    Attributes:
        path: the file as it is called now.
        changed: it was written anew, or would have been (`dry_run`).
        renamed: `.active` was taken off its name.
        lossy: something could not be read, or failed its CRC.
        messages, chunks, attachments: what the file holds now.
        seconds: from the first message to the last [s].
        lost_bytes, lost_chunks: what could not be read.
        lost_s: estimate of the time that stood there [s]; None where nothing tells.
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
    lost_s: float | None
    findings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the result for `json.dumps`."""
        return asdict(self) | {"path": str(self.path), "findings": list(self.findings)}


def recover(
    path: Path, *, dry_run: bool = False, keep_free: int = 0, attachments_are_enough: bool = False
) -> Recovery:
    """Recover a damaged file as far as it is intact, and remove `.active` from its name.

    A file that is whole is not touched; recovering again changes nothing.

    Args:
        path: `X.mcap.active` or `X.mcap`.
        dry_run: only report what would be done.
        keep_free: [byte] that must stay free on the disk beside the copy.
        attachments_are_enough: write anew also what has lost every message, but not all attachments.

    Raises:
        RecoverError: it is being written (its writer holds an flock on it), nothing in it can be saved, its messages stand
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
        found = scan(source, own)
        _refuse(path, found, own)
        now = os.fstat(descriptor)
        if (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
            raise RecoverError(f"{path}: found that it is being written, expected a closed file")
        final = _final_name(path)
        changed = not is_whole(found, own)
        report = _report(source, found, own) if changed else _Report()
        if report.lossy and not found.counts and not (attachments_are_enough and _has_attachments(found)):
            raise RecoverError(
                f"{path}: found no message that can be read ({report.findings[0]}), expected one at least: left as it is"
            )
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
        lost_s=None if report.lost_s is None else round(report.lost_s, 3),
        findings=tuple(report.findings),
    )


def _refuse(path: Path, found: Contents, own: Summary | None) -> None:
    """Raise RecoverError for a file without readable content, or with messages that would be lost."""
    foreign = found.header is not None and not found.header.library.startswith("jtqd")
    if found.loose_messages and (foreign or not found.chunks):
        raise OutsideChunksError(
            f"{path}: found messages outside chunks, expected a log of jtqd: every message in a chunk",
            ended=own is not None,
        )
    if not (found.header or found.chunks or _has_attachments(found)):
        raise RecoverError(f"{path}: found no readable content, expected an MCAP file")


def _has_attachments(found: Contents) -> bool:
    return bool(found.summary.attachments or found.summary.metadata)


# ---- what is lost ----


@dataclass
class _Report:
    findings: list[str] = field(default_factory=list)
    lossy: bool = False
    lost_bytes: int = 0
    lost_chunks: int = 0
    lost_s: float | None = 0.0


def _report(source: Source, found: Contents, own: Summary | None) -> _Report:
    """Return the findings about a file that must be rewritten."""
    report = _Report()
    for gap in sorted(found.gaps, key=lambda each: each.start):
        size = gap.end - gap.start
        if gap.restored:
            continue
        at_end = gap.end == found.end and own is None
        zeros = at_end and all(block.count(0) == len(block) for block in source.blocks(gap.start, gap.end))
        if zeros:
            what = f"{counted(size, 'byte')} of zeros at the end"
        elif at_end:
            what = f"truncated at byte {gap.start}: the last {counted(size, 'byte')} cannot be read"
        else:
            what = f"bytes {gap.start} to {gap.end} cannot be read{' (a chunk)' if gap.chunks else ''}"
        report.findings.append(what)
        report.lost_bytes += size
        report.lost_chunks += gap.chunks
        seconds = _torn_seconds(source, gap, found) if at_end else _seconds(gap, found, own)
        report.lost_s = None if report.lost_s is None or seconds is None else report.lost_s + seconds
        report.lossy = True
    if own is not None and not report.lossy and own.statistics is not None:
        missing = own.statistics.message_count - sum(found.counts.values())
        if missing > 0:
            report.findings.append(f"{counted(missing, 'message')} of the summary are not in the file")
            report.lossy, report.lost_s = True, None
    if found.undefined:
        report.findings.append(f"{counted(found.undefined, 'chunk')} with an undefined channel")
    if found.unproven:
        report.findings.append("no readable chunk has schemas and channels: taken from the head, unchecked")
        report.lossy = True
    if found.contradicted:
        report.findings.append(
            "schemas or channels at the head are damaged: taken from a chunk or the summary"
        )
    if not found.magic or found.header is None:
        report.findings.append("magic bytes or header damaged: rewritten")
    anew = sum(not chunk.indexed for chunk in found.chunks)
    if anew:
        report.findings.append(f"message indexes of {counted(anew, 'chunk')} rewritten")
    report.findings.append("no summary: written" if own is None else "summary rewritten")
    return report


def _seconds(gap: Gap, found: Contents, own: Summary | None) -> float | None:
    """Time for which a gap stands [s]: between its neighbours, else what the summary says of the first or last message."""
    if gap.seconds is not None or own is None or own.statistics is None or not found.counts:
        return gap.seconds
    statistics = own.statistics
    timed = [chunk.index for chunk in found.timed]
    if gap.start < timed[0].chunk_start_offset:
        return max(0, int(timed[0].message_start_time) - int(statistics.message_start_time)) * 1e-9
    if gap.start > timed[-1].chunk_start_offset:
        return max(0, int(statistics.message_end_time) - _last_ns(found)) * 1e-9
    return None


def _last_ns(found: Contents) -> int:
    """Log time of the last cycle; of the last message of another writer's log."""
    return max(int(chunk.index.message_end_time) for chunk in found.timed)


def _torn_seconds(source: Source, gap: Gap, found: Contents) -> float | None:
    """Return the time for which the torn end of a file stood [s]: by the head of its chunk, else by the rate so far."""
    if not found.counts:
        return None
    head = chunk_head(source.read(gap.start, HEAD_SIZE))
    if gap.chunks and head is not None:
        seconds = (head.end_ns - _last_ns(found)) * 1e-9
        if 0.0 <= seconds < _LONGEST_TORN_CHUNK_S:
            return seconds
    data = gap.start - int(found.chunks[0].index.chunk_start_offset)
    return (found.end_ns - found.start_ns) * 1e-9 * (gap.end - gap.start) / max(data, 1)


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


def _replace(path: Path, source: Source, found: Contents, keep_free: int) -> int:
    """Write the intact content beside the file, check it and replace the file; return its locked descriptor.

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
        again = scan(written, own)
        if not is_whole(again, own) or again.counts != found.counts:
            raise RecoverError(
                f"{path}: found a copy that reads back differently, expected the written content"
            )
        os.replace(partial, target)
        _sync_directory(target.parent)
    except BaseException:
        os.close(copy)
        with suppress(OSError):
            partial.unlink()
        raise
    return copy


def _write(copy: _Copy, source: Source, found: Contents) -> None:
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


def _copy_chunk(copy: _Copy, source: Source, chunk: WholeChunk) -> ChunkIndex:
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
        data = None if head is None else chunk_content(source, start, head)
        for channel, rows in index_entries(walk(data or b"")).items():
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
            raise BeingWrittenError(
                f"{path}: found that a recorder is writing it, expected a closed file"
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
        found = recover(path, keep_free=keep_free, attachments_are_enough=True)
    except RecoverError as error:
        return str(error), True
    except OSError as error:
        return f"{path.name} cannot be repaired: {error.strerror}", True
    text = f"{found.path.name} repaired: {counted(found.chunks, 'chunk')} kept"
    if found.lost_bytes:
        time = "unknown time" if found.lost_s is None else f"{found.lost_s:.1f} s"
        text += f", {found.lost_bytes} B ({time}) unreadable"
    return text, found.lossy


def _is_being_written(path: Path) -> bool:
    with suppress(OSError), open(path, "rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _leftovers(arguments: list[str]) -> int:
    """Recover all files of earlier runs; exit status 0, or 2 for wrong use."""
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


if __name__ == "__main__":
    sys.exit(_leftovers(sys.argv[1:]))
