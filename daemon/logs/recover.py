"""Repair an MCAP file in place: one left by a crash, torn at its end, or damaged somewhere within.

The file is scanned first (`logs.scan`), what must change is worked out (`logs.repair`), and only then is
anything written: room for the new end is taken before the first change, so that a full disk leaves the file as it was.
"""

from __future__ import annotations

import errno
import fcntl
import os
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.found import Scan
from jtqd.daemon.logs.records import Source
from jtqd.daemon.logs.repair import plan_repair
from jtqd.daemon.logs.repair_plan import Plan
from jtqd.daemon.logs.scan import scan
from jtqd.daemon.logs.tail import read_summary
from jtqd.daemon.recording.parts import ACTIVE

_ROUNDS = 3
"""What one repair uncovers (a message index that has its chunk again) the next one settles."""


class RecoverError(LogError):
    """The file cannot be repaired, and is as it was; one line."""


@dataclass(frozen=True)
class Recovery:
    """What was found in a file and done to it.

    Attributes:
        path: the file as it is called now.
        changed: bytes were written, or would have been (`dry_run`).
        renamed: `.active` was taken off its name.
        lossy: something could not be read, or a CRC covers it and does not match.
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


def recover(path: Path, *, dry_run: bool = False) -> Recovery:
    """Repair one file in place and take `.active` off its name.

    Bytes that cannot be read stay where they are, as a private record, except at the end, where they are cut off. A
    file that is whole is not touched. Running it again changes nothing.

    Args:
        path: `X.mcap.active` or `X.mcap`; of any writer.
        dry_run: only say what would be done.

    Raises:
        RecoverError: it is being written (its writer holds an flock on it), it holds nothing that can be read, or
            the new name is taken.
        OSError: it cannot be read or written.
    """
    descriptor = os.open(path, (os.O_RDONLY if dry_run else os.O_RDWR) | os.O_CLOEXEC)
    try:
        _lock(descriptor, path, shared=dry_run)
        before = os.fstat(descriptor)
        source = Source(descriptor)
        found, plan = _look(path, source)
        now = os.fstat(descriptor)
        if (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
            raise RecoverError(f"{path}: found that it is being written, expected a file at rest")
        final = _final_name(path)
        if not dry_run:
            if not plan.clean:
                _apply(descriptor, plan, now.st_size)
                found = _settle(descriptor, path, plan, found)
            if final != path:
                os.rename(path, final)
                _sync_directory(path.parent)
    finally:
        os.close(descriptor)
    return Recovery(
        path=path if dry_run else final,
        changed=not plan.clean,
        renamed=final != path,
        lossy=plan.damaged,
        messages=found.messages,
        chunks=len(found.chunks),
        attachments=len(found.attachments),
        seconds=(found.end_ns - found.start_ns) * 1e-9 if found.start_ns is not None else 0.0,
        lost_bytes=plan.lost_bytes,
        lost_chunks=plan.lost_chunks,
        lost_s=round(plan.lost_s, 3),
        findings=tuple(plan.findings),
    )


def _look(path: Path, source: Source) -> tuple[Scan, Plan]:
    own = read_summary(source)
    found = scan(source, own)
    try:
        return found, plan_repair(source, found, own)
    except LogError as error:
        raise RecoverError(f"{path}: {error}") from None


def _settle(descriptor: int, path: Path, plan: Plan, found: Scan) -> Scan:
    """Look again at a file that was changed within, until there is nothing more to do; adds to the first plan."""
    for _ in range(_ROUNDS if plan.patches else 0):
        source = Source(descriptor)
        found, more = _look(path, source)
        if more.clean:
            break
        _apply(descriptor, more, source.size)
        plan.findings += more.findings
        plan.lost_bytes += more.lost_bytes
        plan.lost_chunks += more.lost_chunks
        plan.lost_s += more.lost_s
        plan.damaged |= more.damaged
    return found


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


def _apply(descriptor: int, plan: Plan, size: int) -> None:
    """Write; what could be read before can be read after every single step."""
    new_size = plan.end + len(plan.tail)
    if new_size > size:
        try:
            os.posix_fallocate(descriptor, size, new_size - size)
        except OSError:
            with suppress(OSError):
                os.ftruncate(descriptor, size)
            raise
    for offset, data in plan.patches:
        _write(descriptor, data, offset)
    if plan.patches:
        os.fdatasync(descriptor)
    _write(descriptor, plan.tail, plan.end)
    os.ftruncate(descriptor, new_size)
    os.fdatasync(descriptor)


def _write(descriptor: int, data: bytes, offset: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _sync_directory(directory: Path) -> None:
    with suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
