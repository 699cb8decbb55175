"""Running daemons of this machine, read-only from their runtime directories: snapshot, about.json, notices, conditions."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from jtqd.daemon.recording.run_files import Account, read_account
from jtqd.daemon.shared.conditions import Condition, read_conditions
from jtqd.daemon.shared.events import FILE as NOTICES
from jtqd.daemon.shared.events import Notice, NoticesReader
from jtqd.daemon.shared.runtime_dir import FILE, About, AboutError, SharedMemoryError, json_of, read_about
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.estimator.files import trusted_users
from jtqd.estimator.text import counted

_SHARED = ("/dev/shm", "/run/jtqd/*", "/run/user/*")
STILL_S = 0.25
"""A loop whose last SYNC is older is stalled; the snapshot is written every 8th cycle."""
STARTING, RUNNING, STILL = "starting", "running", "still"
_NOTICES = 20
_PROCESS = {
    "T": "stopped (SIGSTOP)",
    "t": "stopped by a debugger",
    "D": "waiting for the kernel",
    "R": "busy",
    "S": "asleep",
}


class Daemon(NamedTuple):
    """One running daemon."""

    directory: Path
    about: About


class DaemonSearch(NamedTuple):
    """Runtime directories of jtqd on this machine."""

    daemons: tuple[Daemon, ...]
    closed: tuple[Path, ...]
    """Runtime directories that this user may not read."""
    abandoned: tuple[Path, ...]
    """Runtime directories of killed daemons; the next start on the same bus reuses them."""
    foreign: tuple[Path, ...] = ()
    """What users made who are neither root nor this user nor a service's: not read."""


def places() -> list[Path]:
    """Return the possible runtime directories: this environment's, systemd's, those of the users, and /dev/shm."""
    named = [os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0], os.environ.get("XDG_RUNTIME_DIR", "")]
    found = [Path(each) for each in named if each]
    for pattern in _SHARED:
        found += sorted(Path("/").glob(pattern.lstrip("/")))
    return list(dict.fromkeys(found))


def find_daemons(roots: Iterable[Path] | None = None) -> DaemonSearch:
    """Return every running daemon, by the name of its bus; `roots`: directories instead of `places()`."""
    daemons, closed, abandoned, foreign, users = [], [], [], [], trusted_users()
    for root in places() if roots is None else roots:
        for directory in _subdirectories(root):
            try:
                if directory.lstat().st_uid not in users:
                    foreign.append(directory)
                    continue
                os.scandir(directory).close()
                content = read_about(directory / FILE)
            except PermissionError:
                closed.append(directory)
            except (AboutError, OSError):
                abandoned.append(directory)
            else:
                if content.running():
                    daemons.append(Daemon(directory, content))
                else:
                    abandoned.append(directory)
    return DaemonSearch(
        tuple(sorted(daemons, key=lambda each: each.about.bus)),
        tuple(closed),
        tuple(abandoned),
        tuple(foreign),
    )


def on_bus(search: DaemonSearch, bus: str) -> Daemon | None:
    """Return the daemon on `bus` (its --bus or the name of its instance); "sim" is one that emulates."""
    for daemon in search.daemons:
        if bus in (daemon.about.bus, daemon.about.instance):
            return daemon
    return None


class NoDaemonError(Exception):
    """No daemon to talk to, or more than one; the message is for the operator."""

    def __init__(self, message: str, exit_status: int) -> None:
        super().__init__(message)
        self.exit_status = exit_status


def choose_daemon(bus: str | None) -> Daemon:
    """Return the daemon on `bus`, or the only running one.

    Raises:
        NoDaemonError: none runs there (exit status 1), or several run and no bus is named (2).
    """
    search = find_daemons()
    others = "".join(f"\n  --bus {each.about.instance:<24} pid {each.about.pid}" for each in search.daemons)
    closed = "".join(
        f"\n  {path} belongs to another user: join its group to read it" for path in search.closed
    )
    if search.foreign:
        what = counted(len(search.foreign), "directory", "directories")
        closed = f" ({what} of other users not read){closed}"
    if bus is not None:
        daemon = on_bus(search, bus)
        if daemon is None:
            raise NoDaemonError(f"no jtqd runs on {bus}{closed}{others}", 1)
        return daemon
    if not search.daemons:
        raise NoDaemonError(f"no jtqd runs on this machine{closed}", 1)
    if len(search.daemons) > 1:
        raise NoDaemonError(f"several daemons run; select one with --bus:{others}", 2)
    return search.daemons[0]


def _subdirectories(root: Path) -> list[Path]:
    try:
        return sorted(each for each in root.glob("jtqd-*-*") if each.is_dir() and not each.is_symlink())
    except OSError:
        return []


@dataclass(frozen=True)
class Reading:
    """State of a daemon at one moment; `view` and what follows only once its loop has begun.

    why: why it does not run; earlier: the reading before this one; work, late: histograms; work_us, late_us: their
    quantiles 0.5, 0.99 and 1; recorder: see `_recorder`; notices: last ones about the bus; conditions: present ones, the
    worst first; bus: content of `bus.json`, empty where it cannot be read.
    """

    daemon: Daemon
    state: str
    why: str
    view: View | None = None
    earlier: View | None = None
    work: tuple[int, ...] = ()
    late: tuple[int, ...] = ()
    work_us: Sequence[float] = ()
    late_us: Sequence[float] = ()
    recorder: dict[str, Any] | None = None
    notices: tuple[Notice, ...] = ()
    conditions: tuple[Condition, ...] = ()
    bus: Mapping[str, Any] = field(default_factory=dict)


class Watch:
    """Reads one daemon repeatedly."""

    def __init__(self, daemon: Daemon) -> None:
        self.daemon = daemon
        self._reader: SnapshotReader | None = None
        self._earlier: View | None = None
        self._notices_reader: NoticesReader | None = None
        self._notices: deque[Notice] = deque(maxlen=_NOTICES)

    def read(self) -> Reading:
        """Read the present state."""
        booting = Reading(self.daemon, STARTING, "booting its nodes")
        try:
            self._reader = self._reader or SnapshotReader(self.daemon.directory / "snapshot")
            view = self._reader.read()
        except SharedMemoryError as error:
            return Reading(self.daemon, STILL, f"not read: {error}") if self._reader else booting
        if not view.sync_monotonic_ns:
            return booting
        earlier, self._earlier = self._earlier or view, view
        state, why = _state(view)
        reader, directory = self._reader, self.daemon.directory
        return Reading(
            self.daemon,
            state,
            why,
            view,
            earlier,
            reader.work_bins(),
            reader.late_bins(),
            reader.work_us(0.5, 0.99, 1.0),
            reader.late_us(0.5, 0.99, 1.0),
            _recorder(self.daemon),
            self._read_notices(),
            tuple(read_conditions(directory)),
            _bus(directory),
        )

    def _read_notices(self) -> tuple[Notice, ...]:
        if self._notices_reader is None:
            try:
                self._notices_reader = NoticesReader(self.daemon.directory / NOTICES)
            except SharedMemoryError:
                return ()
        self._notices.extend(self._notices_reader.read()[0])
        return tuple(self._notices)


def _bus(directory: Path) -> dict[str, Any]:
    try:
        content = json_of(directory / "bus.json")
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _state(view: View) -> tuple[str, str]:
    age_s = time.monotonic() - view.sync_monotonic_ns * 1e-9
    if age_s <= max(STILL_S, 50 * view.period_s):
        return RUNNING, ""
    try:
        code = Path(f"/proc/{view.pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return STILL, f"the loop (process {view.pid}) has gone; no cycle for {age_s:.1f} s"
    return STILL, f"the loop (process {view.pid}) is {_PROCESS.get(code, code)}: no cycle for {age_s:.1f} s"


def _recorder(daemon: Daemon) -> dict[str, Any] | None:
    """Return the account of the recorder, the file that is being written with its size, and the disk [bytes].

    None: it does not record; a value that is not known is None.
    """
    about = daemon.about
    if about.log_directory is None:
        return None
    directory = Path(about.log_directory)
    account = read_account(daemon.directory / "recorded") or Account()
    path = length = free = total = None
    with suppress(OSError):  # a file that has just been renamed, or a closed directory
        active = directory.glob(f"{about.log_prefix}*.mcap.active")
        newest = max(active, key=lambda each: each.stat().st_mtime_ns, default=None)
        if newest is not None:
            path, length = str(newest), newest.stat().st_size
    with suppress(OSError):
        disk = os.statvfs(directory)
        free, total = disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
    return {
        "path": path,
        "bytes": length,
        "written": account.written,
        "lost": account.lost,
        "let_go": account.let_go,
        "disk_free": free,
        "disk_size": total,
    }
