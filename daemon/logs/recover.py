"""Recovery of logs that a crash left unfinished, or that were damaged later; `jtq recover`.

The intact contents of a log (`log_file.Contents`) are written by the recorder's own writer to a copy beside it, chunks as
they are packed. The copy is read back and synced, and replaces the file in one step: an interrupted recovery
leaves the file as it was and is repeated. Memory holds some chunks at a time.

The recorder runs `python -m jtqd.daemon.logs.recover DIRECTORY PREFIX RESERVE_BYTES` at the lowest priority for the files
of earlier runs: those with its own kind of name that nobody has locked. One JSON line for each: {"file", "text", "lossy"}.
"""

from __future__ import annotations

import argparse
import errno
import fcntl
import json
import os
import sys
from bisect import bisect
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec

from jtqd.daemon.logs.log_file import Contents, LogError, Source, sealed_chunk
from jtqd.daemon.recording.mcap_file import Head, McapFile, NamedData, SealedChunk, Span
from jtqd.daemon.recording.run_files import ACTIVE, PartFile, free_bytes, part_files
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.files import open_regular
from jtqd.estimator.text import counted

_PARTIAL = ".recovering"
"""Ending of the copy while it is written."""
_MB = 1 << 20
_WRITE_BYTES = 8 * _MB
"""Chunks are written and synced in pieces of this size."""
_LONGEST_TORN_CHUNK_S = 600.0
"""A torn chunk whose head claims more than this is not believed."""
_ENDINGS = (".mcap", ".mcap" + ACTIVE)


class RecoverError(LogError):
    """The file cannot be recovered, and is as it was; one line."""


class SkippedError(RecoverError):
    """The file is being written, or another program's: in a directory it is left out."""


@dataclass(frozen=True)
class Recovery:
    """Result of a recovery.

    Attributes:
        path: the file as it is called now.
        changed: it was rewritten, or would have been (`dry_run`).
        renamed: `.active` was taken off its name.
        lossy: something could not be read, or failed its CRC.
        messages, chunks, attachments: what the file holds now.
        seconds: from the first message to the last [s].
        lost_bytes, lost_chunks: what could not be kept.
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


def recover(
    path: Path, *, dry_run: bool = False, keep_free: int = 0, attachments_are_enough: bool = False
) -> Recovery:
    """Recover a damaged file as far as it is intact, and remove `.active` from its name.

    A file that is whole is not touched; recovering again changes nothing.

    Args:
        path: `X.mcap.active` or `X.mcap`.
        dry_run: only report what would be done.
        keep_free: [byte] that must stay free on the disk beside the copy.
        attachments_are_enough: rewrite also what has lost every message, but not all attachments.

    Raises:
        RecoverError: it is being written (its writer holds an flock on it), nothing in it can be saved, another program
            wrote it, or the new name is taken.
        OSError: it cannot be read or written, or there is no room for the copy.
    """
    descriptor = open_regular(path, os.O_RDONLY if dry_run else os.O_RDWR)
    try:
        _lock(descriptor, path, shared=dry_run)
        before = os.fstat(descriptor)
        source = Source(descriptor)
        found = Contents(source)
        attached = bool(found.attachments or found.metadata)
        if found.header is not None and found.foreign:
            raise SkippedError(
                f"{path}: found a log of {found.header.library!r:.60}, expected one of jtqd (others: `mcap recover`)"
            )
        if not (found.header or found.chunks or attached):
            raise RecoverError(f"{path}: found no readable content, expected an MCAP file")
        now = os.fstat(descriptor)
        if (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
            raise SkippedError(f"{path}: found that it is being written, expected a closed file")
        final = _final_name(path)
        changed = not found.whole
        missing, torn = _missing(found), bool(found.gaps) or found.unproven
        lossy = changed and (torn or missing > 0)
        findings = _findings(source, found) if changed else []
        if lossy and not found.counts and not (attachments_are_enough and attached):
            raise RecoverError(
                f"{path}: found no message that can be read ({findings[0]}), expected one at least: left as it is"
            )
        if changed and not dry_run:
            _replace(path, source, found, keep_free)
        if final != path and not dry_run:
            os.rename(path, final)
            _sync_directory(path.parent)
    finally:
        os.close(descriptor)
    start_ns, end_ns = _times(found)
    lost_s: float | None = 0.0
    if lossy and not torn:
        lost_s = None
    elif changed:
        lost_s = _lost_s(found)
    return Recovery(
        path=path if dry_run else final,
        changed=changed,
        renamed=final != path,
        lossy=lossy,
        messages=sum(found.counts.values()),
        chunks=len(found.chunks),
        attachments=len(found.attachments),
        seconds=(end_ns - start_ns) * 1e-9,
        lost_bytes=sum(gap.end - gap.start for gap in found.gaps),
        lost_chunks=sum(gap.is_chunk for gap in found.gaps),
        lost_s=None if lost_s is None else round(lost_s, 3),
        findings=tuple(findings),
    )


def _lock(descriptor: int, path: Path, *, shared: bool) -> None:
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise SkippedError(
                f"{path}: found that a recorder is writing it, expected a closed file"
            ) from None
        # A file system without locks: the check remains that the file does not change meanwhile.


def _final_name(path: Path) -> Path:
    if path.suffix != ACTIVE:
        return path
    final = path.with_suffix("")
    if final.exists():
        raise RecoverError(f"{path}: found {final.name} beside it, expected that name to be free")
    return final


# ---- what is lost ----


def _times(found: Contents) -> tuple[int, int]:
    """First and last log time; 0 without messages."""
    indexes = [chunk.index for chunk in found.chunks if chunk.counts]
    first = min((index.message_start_time for index in indexes), default=0)
    return first, max((index.message_end_time for index in indexes), default=0)


def _missing(found: Contents) -> int:
    """Messages of the summary that were not found."""
    statistics = None if found.tail is None else found.tail[0].statistics
    return 0 if statistics is None else statistics.message_count - sum(found.counts.values())


def _zeros(source: Source, start: int, end: int) -> bool:
    """Return whether these bytes are zeros."""
    return not any(any(source.read(at, min(end - at, _MB))) for at in range(start, end, _MB))


def _findings(source: Source, found: Contents) -> list[str]:
    """Return the findings about a file that must be rewritten, one line each."""
    lines = []
    for gap in sorted(found.gaps):
        size = gap.end - gap.start
        if gap.end < found.end or found.tail is not None:
            what = f"bytes {gap.start} to {gap.end} cannot be read{' (a chunk)' if gap.is_chunk else ''}"
        elif _zeros(source, gap.start, gap.end):
            what = f"{counted(size, 'byte')} of zeros at the end"
        else:
            what = f"truncated at byte {gap.start}: the last {counted(size, 'byte')} cannot be read"
        lines.append(what)
    missing = 0 if found.gaps or found.unproven else _missing(found)
    rebuilt = sum(not chunk.unchanged for chunk in found.chunks)
    for is_so, line in (
        (missing > 0, f"{counted(missing, 'message')} of the summary are not in the file"),
        (found.undefined, f"{counted(found.undefined, 'chunk')} with an undefined channel"),
        (found.unproven, "no readable chunk has schemas and channels: taken from the head, unchecked"),
        (
            found.contradicted,
            "schemas or channels at the head are damaged: taken from a chunk or the summary",
        ),
        (not found.magic or found.header is None, "magic bytes or header damaged: rewritten"),
        (rebuilt, f"head or message indexes of {counted(rebuilt, 'chunk')} rewritten"),
    ):
        if is_so:
            lines.append(line)
    return [*lines, "no summary: written" if found.tail is None else "summary rewritten"]


def _lost_s(found: Contents) -> float | None:
    """Time for which the gaps stand [s]: between the chunks around each; None where one of them has no such neighbours.

    Before the first and behind the last chunk the summary tells, at a torn end the head of the torn chunk, else the rate of
    bytes so far.
    """
    chunks = [chunk for chunk in found.chunks if not found.cycles.isdisjoint(chunk.counts)]
    timed = [chunk.index for chunk in chunks or found.chunks if chunk.counts]
    statistics = None if found.tail is None else found.tail[0].statistics
    starts = [index.chunk_start_offset for index in timed]
    total = 0.0
    for place in {bisect(starts, gap.start) for gap in found.gaps}:
        gaps = [gap for gap in found.gaps if bisect(starts, gap.start) == place]
        if 0 < place < len(timed):
            seconds = (timed[place].message_start_time - timed[place - 1].message_end_time) * 1e-9
        elif not timed:
            return None
        elif statistics is not None:
            first, last = timed[0].message_start_time, timed[-1].message_end_time
            lost = statistics.message_end_time - last if place else first - statistics.message_start_time
            seconds = lost * 1e-9
        elif place == 0:
            return None
        else:
            ends = [gap.end_ns for gap in gaps if gap.end_ns is not None]
            seconds = (max(ends, default=0) - timed[-1].message_end_time) * 1e-9
            if not 0.0 <= seconds < _LONGEST_TORN_CHUNK_S:
                first, last = _times(found)
                size = sum(gap.end - gap.start for gap in gaps)
                seconds = (last - first) * 1e-9 * size / max(gaps[0].start - starts[0], 1)
        total += max(0.0, seconds)
    return total


# ---- the copy ----


def _replace(path: Path, source: Source, found: Contents, keep_free: int) -> None:
    """Write the intact contents beside the file, check the copy and replace the file.

    Raises:
        RecoverError: the copy does not read back.
        OSError: it cannot be written; the file is as it was, and the copy is gone.
    """
    target = Path(os.path.realpath(path))
    partial = target.with_name(target.name + _PARTIAL)
    with suppress(FileNotFoundError):  # of a recovery that was interrupted
        partial.unlink()
    if free_bytes(target.parent) < found.end + keep_free:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    before = os.stat(target)
    try:
        _write(partial, source, found)
        with suppress(OSError):
            os.chmod(partial, before.st_mode & 0o777)
            os.chown(partial, before.st_uid, before.st_gid)
        with open(partial, "rb") as copy:
            again = Contents(Source(copy.fileno()))
        if not again.whole or again.counts != found.counts:
            raise RecoverError(
                f"{path}: found a copy that reads back differently, expected the written content"
            )
        os.replace(partial, target)
        _sync_directory(target.parent)
    except BaseException:
        with suppress(OSError):
            partial.unlink()
        raise


def _write(path: Path, source: Source, found: Contents) -> None:
    """Write the whole file: head, chunks as they are packed, and the summary."""
    attachments = [NamedData(each.name, each.media_type, each.data) for each, _ in found.attachments]
    head = Head([*found.schemas.values()], [*found.channels.values()], attachments)
    metadata = found.metadata[0][0].metadata if found.metadata else None
    time_ns = found.attachments[0][0].log_time if found.attachments else 0
    file = McapFile(path, head, metadata, time_ns)
    try:
        chunks: list[SealedChunk] = []
        for n, chunk in enumerate(found.chunks, start=1):
            made = sealed_chunk(source, chunk.index.chunk_start_offset)
            assert made is not None, "the file changed while it was locked"
            chunks.append(made[0])
            if n == len(found.chunks) or sum(len(each.data) for each in chunks) >= _WRITE_BYTES:
                file.append(Span(tuple(chunks), 0))
                chunks = []
    except OSError:
        file.abandon()
        raise
    file.finish(path.name)


def _sync_directory(directory: Path) -> None:
    with suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# ---- files of earlier runs of the recorder ----


def recover_unfinished(file: PartFile, keep_free: int = 0) -> tuple[str, bool] | None:
    """Recover one file of an earlier run: what was done, and whether something was lost. None: it is being written."""
    path = file.path
    try:
        with open(open_regular(path), "rb") as opened:
            try:
                fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return None
            except OSError:  # a file system without locks
                pass
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


def _recover_earlier_runs(arguments: list[str]) -> int:
    """Recover all files of earlier runs; exit status 0, or 2 for wrong use."""
    if len(arguments) != 3 or not arguments[2].isdigit():
        print("usage: python -m jtqd.daemon.logs.recover DIRECTORY PREFIX RESERVE_BYTES", file=sys.stderr)
        return 2
    with suppress(OSError):
        os.nice(19)
    for file in part_files(Path(arguments[0]), arguments[1]):
        result = recover_unfinished(file, int(arguments[2])) if file.active else None
        if result is not None:
            print(json.dumps({"file": str(file.path), "text": result[0], "lossy": result[1]}), flush=True)
    return 0


# ---- jtq recover ----

_EXAMPLES = """examples:
  jtq recover /var/log/jtqd                       every damaged or unfinished file in the directory
  jtq recover run.mcap.active                     becomes run.mcap
  jtq recover --dry-run --json run.mcap           check every byte, change nothing

Every file is checked completely; intact files of a directory (*.mcap, *.mcap.active) are not listed. Files that a
recorder is writing, and logs of other programs, are refused (in a directory: left out). A file without a readable message
stays as it is. The recovered file is written beside the old one and then replaces it: the free space must be at least the
file's size.

exit status: 0 nothing lost, 3 recovered with loss, 1 failure, 2 usage"""


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq recover`."""
    description = "Recover truncated or damaged logs of jtqd; every intact chunk is kept."
    result = command_parser("jtq recover", description, _EXAMPLES)
    result.add_argument("logs", nargs="+", type=Path, metavar="FILE|DIR")
    result.add_argument("--json", action="store_true", help="results as JSON on standard output")
    result.add_argument("--dry-run", action="store_true", help="report only, change nothing")
    return result


def main(argv: list[str] | None = None) -> int:
    """Run `jtq recover`; returns its exit status."""
    options = parser().parse_args(argv)
    for path in options.logs:
        if not path.is_dir() and not path.name.endswith(_ENDINGS):
            parser().error(f"found {path}, expected a directory or a file named *.mcap or *.mcap{ACTIVE}")
    results: list[Recovery] = []
    failures: list[dict[str, str]] = []
    for path, in_directory in _files(options.logs):
        try:
            found = recover(path, dry_run=in_directory or options.dry_run)
            if in_directory and not (found.changed or found.renamed):
                continue
            results.append(found if options.dry_run or not in_directory else recover(path))
        except (LogError, OSError) as error:
            text = f"{path}: {error.strerror}" if isinstance(error, OSError) else str(error)
            if in_directory and isinstance(error, SkippedError):
                text = f"left out: {text}"
            else:
                failures.append({"path": str(path), "error": text})
            print(f"jtq recover: {text}", file=sys.stderr)
            continue
        if not options.json:
            print(_text(results[-1], options.dry_run), flush=True)
    if options.json:
        print(json.dumps(msgspec.to_builtins({"files": results, "failures": failures}, enc_hook=str)))
    elif not results and not failures:
        print("nothing to recover")
    if failures:
        return 1
    return 3 if any(each.lossy for each in results) else 0


def _files(paths: Sequence[Path]) -> Iterator[tuple[Path, bool]]:
    """Yield every file, and whether it was named by its directory only."""
    for path in paths:
        if not path.is_dir():
            yield path, False
            continue
        for each in sorted(path.iterdir()):
            if each.is_file() and each.name.endswith(_ENDINGS):
                yield each, True


def _text(result: Recovery, dry_run: bool) -> str:
    would = "would be " if dry_run else ""
    state = f"{would}repaired" if result.changed else f"{would}renamed" if result.renamed else "whole"
    lines = [
        f"{result.path}: {state}: {counted(result.messages, 'message')}, {counted(result.chunks, 'chunk')}, "
        f"{counted(result.attachments, 'attachment')}, {result.seconds:.1f} s"
    ]
    lines += [f"  {finding}" for finding in result.findings]
    if result.lossy:
        time = "unknown time" if result.lost_s is None else f"about {result.lost_s:.2f} s"
        lines.append(
            f"  lost: {counted(result.lost_bytes, 'byte')}, {counted(result.lost_chunks, 'chunk')}, {time}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(_recover_earlier_runs(sys.argv[1:]))
