"""Running daemons of this machine: find them (`find_daemons`), read one (`Watch`), explain a status (`reason`).

Everything comes from the runtime directories: snapshot, `about.json`, notices, the recorder's account. Nothing is written,
and no lock is held that anybody waits for.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from jtqd.daemon.loop.joint import FLAG_MOTION, FLAG_POSITION
from jtqd.daemon.loop.joint_status import FLAG_NETWORK_SKIPPED, drive_status
from jtqd.daemon.recording.progress import Account, read_account
from jtqd.daemon.shared.cycle_record import MEANINGS
from jtqd.daemon.shared.notices import FILE as NOTICES
from jtqd.daemon.shared.notices import Notice, NoticesError, NoticesReader
from jtqd.daemon.shared.runtime_dir import FILE, About, AboutError, AboutJoint, read_about
from jtqd.daemon.shared.snapshot import JointView, SnapshotError, SnapshotReader, View
from jtqd.daemon.supervisor.health import stale_cause
from jtqd.estimator import status as st

_SHARED = ("/dev/shm", "/run/jtqd/*", "/run/user/*")
NMT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}
"""Heartbeat states of CiA 301."""
SILENT_AFTER = 3.0
"""Heartbeat periods without a heartbeat after which a node is silent."""
_FIRST_CYCLES = 20
_HELD = "held until enough cycles in a row were good"
"""Hysteresis of `daemon/loop/joint_status.py`."""
_STATE_WORD = {
    0x00: "not ready to switch on",
    0x40: "switch on disabled",
    0x21: "ready to switch on",
    0x23: "switched on, not enabled",
    0x27: "operation enabled",
    0x07: "quick stop active",
    0x0F: "fault reaction active",
    0x08: "fault",
}
STILL_S = 0.25
"""A loop whose SYNC is older stands still; the snapshot is written every 8th cycle."""
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
    """One daemon that runs."""

    directory: Path
    about: About


class DaemonSearch(NamedTuple):
    """Runtime directories of jtqd on this machine."""

    daemons: tuple[Daemon, ...]
    closed: tuple[Path, ...]
    """Runtime directories that this user may not look into."""
    left_over: tuple[Path, ...]
    """Runtime directories of daemons that were killed; the next start on the same bus takes them over."""


def places() -> list[Path]:
    """Where runtime directories may lie: this environment's, systemd's, those of the users, and /dev/shm."""
    named = [os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0], os.environ.get("XDG_RUNTIME_DIR", "")]
    found = [Path(each) for each in named if each]
    for pattern in _SHARED:
        found += sorted(Path("/").glob(pattern.lstrip("/")))
    return list(dict.fromkeys(found))


def find_daemons(roots: Iterable[Path] | None = None) -> DaemonSearch:
    """Every daemon that runs, by the name of its bus; `roots`: where to look instead of `places()`."""
    daemons, closed, left_over = [], [], []
    for root in places() if roots is None else roots:
        for directory in _subdirectories(root):
            try:
                os.scandir(directory).close()
                content = read_about(directory / FILE)
            except PermissionError:
                closed.append(directory)
            except (AboutError, OSError):
                left_over.append(directory)
            else:
                if content.running():
                    daemons.append(Daemon(directory, content))
                else:
                    left_over.append(directory)
    return DaemonSearch(
        tuple(sorted(daemons, key=lambda each: each.about.bus)), tuple(closed), tuple(left_over)
    )


def on_bus(search: DaemonSearch, bus: str) -> Daemon | None:
    """The daemon on `bus`: as its --bus was written, or as the name of its instance; "sim" is one that emulates."""
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
    """Return the daemon on `bus`, or the only one that runs.

    Raises:
        NoDaemonError: none runs there (exit status 1), or several run and no bus is named (2).
    """
    search = find_daemons()
    others = "".join(f"\n  --bus {each.about.instance:<24} pid {each.about.pid}" for each in search.daemons)
    closed = "".join(f"\n  {path} belongs to others: join its group to look at it" for path in search.closed)
    if bus is not None:
        daemon = on_bus(search, bus)
        if daemon is None:
            raise NoDaemonError(f"no jtqd runs on {bus}{others}{closed}", 1)
        return daemon
    if not search.daemons:
        raise NoDaemonError(f"no jtqd runs here{closed}", 1)
    if len(search.daemons) > 1:
        raise NoDaemonError(f"several daemons run: which one?{others}", 2)
    return search.daemons[0]


def _subdirectories(root: Path) -> list[Path]:
    try:
        return sorted(each for each in root.glob("jtqd-*-*") if each.is_dir())
    except OSError:
        return []


def drive_state(statusword: int) -> str:
    """State of a CiA 402 drive by its statusword (6041h)."""
    if statusword & 0x4F in (0x00, 0x40, 0x0F, 0x08):  # bit 5 does not count in these
        return _STATE_WORD[statusword & 0x4F]
    return _STATE_WORD.get(statusword & 0x6F, f"statusword {statusword:04X}h")


def silent_s(view: View, node: int, heartbeat_ms: int) -> float | None:
    """For how long a node has been silent [s]; None while its heartbeats come, or none has ever come."""
    heard = view.node_heard_ns[node]
    age_s = (view.sync_realtime_ns - heard) * 1e-9
    return age_s if heard and age_s > SILENT_AFTER * heartbeat_ms * 1e-3 else None


def reason(about: About, number: int, view: View, earlier: View) -> str:
    """Why joint 1 or 2 has its status; "" where nothing needs a reason.

    Args:
        about: of the daemon.
        number: 1 or 2.
        view: the reading.
        earlier: one from a moment before; what has been counted since then points at a cause.
    """
    joint, seen = about.joints[number - 1], view.joints[number - 1]
    if seen.latched:
        return f"latched: {_meanings(seen.latched)}; `jtq control reset` releases it"
    match seen.status:
        case st.STALE:
            why = _stale(about, joint, seen, view, earlier)
        case st.OFF | st.DRIVE_FAULT:
            state = f"drive {joint.node}: {drive_state(seen.statusword)} (6041h {seen.statusword:04X}h)"
            why = state if drive_status(seen.statusword) == seen.status else f"{state}; {_HELD}"
        case st.STARTING if view.cycle <= _FIRST_CYCLES:
            why = "the first cycles"
        case st.STARTING:
            why = "the observer starts again after a gap in the inputs"
        case st.STANDSTILL:
            why = "slower than the standstill velocity: friction hides the torque, sigma is half the interval"
        case st.DEGRADED:
            why = _degraded(joint, seen)
        case st.INVALID:
            faults = seen.input_flags >> 8
            why = _meanings(faults) if faults else f"a fault is over; {_HELD}"
        case _:
            why = ""
    return why


def _meanings(faults: int) -> str:
    return ", ".join(MEANINGS[bit] for bit in MEANINGS if faults & bit) or "an unknown fault"


def _stale(about: About, joint: AboutJoint, seen: JointView, view: View, earlier: View) -> str:
    silence = silent_s(view, joint.node, about.heartbeat_ms)
    if silence is not None:
        return f"node {joint.node} is silent: no heartbeat for {silence:.1f} s"
    both = FLAG_POSITION | FLAG_MOTION
    if seen.input_flags & both == both and view.counters["overruns"] == earlier.counters["overruns"]:
        return f"the inputs are back; {_HELD}"
    return stale_cause(joint.node, joint.inputs, seen, view, earlier.counters)


def _degraded(joint: AboutJoint, seen: JointView) -> str:
    if seen.input_flags & FLAG_NETWORK_SKIPPED:
        return "no time for the network in this cycle: physics only"
    if not isfinite(seen.network_nm):
        return "the network's answer is not a number: physics only"
    apart, trusted = abs(seen.network_nm - seen.physics_nm), joint.network_limit_nm
    if apart > trusted:
        return f"the network is {apart:.1f} Nm from physics, trusted to {trusted:.1f} Nm: physics only"
    return "outside what the network was trained on: physics, with less or nothing of the network"


@dataclass(frozen=True)
class CurrentLog:
    """What the recorder has left so far."""

    account: Account
    path: Path | None
    """The file that is being written."""
    size: int | None
    """Bytes of it."""
    disk_free: int | None
    disk_size: int | None


@dataclass(frozen=True)
class Reading:
    """State of a daemon at one moment; `view` and what follows only when its loop has begun."""

    daemon: Daemon
    state: str
    why: str
    """Why it does not run."""
    view: View | None
    earlier: View | None
    """A reading from a moment before, for what changes."""
    work: tuple[int, ...] = ()
    late: tuple[int, ...] = ()
    work_us: tuple[float, float, float] = (float("nan"),) * 3
    late_us: tuple[float, float, float] = (float("nan"),) * 3
    """Quantiles 0.5, 0.99 and 1."""
    log: CurrentLog | None = None
    notices: tuple[Notice, ...] = ()
    """The daemon's last notices about the bus."""


class Watch:
    """Reads one daemon again and again."""

    def __init__(self, daemon: Daemon) -> None:
        self.daemon = daemon
        self._reader: SnapshotReader | None = None
        self._earlier: View | None = None
        self._notices_reader: NoticesReader | None = None
        self._notices: deque[Notice] = deque(maxlen=_NOTICES)

    def read(self) -> Reading:
        """Read its state now."""
        view = self._view()
        if view is None:
            return Reading(self.daemon, STARTING, "its nodes are being booted", None, None)
        assert self._reader is not None
        earlier, self._earlier = self._earlier or view, view
        state, why = _state(view)
        return Reading(
            self.daemon,
            state,
            why,
            view,
            earlier,
            self._reader.work_bins(),
            self._reader.late_bins(),
            _three(self._reader.work_us(0.5, 0.99, 1.0)),
            _three(self._reader.late_us(0.5, 0.99, 1.0)),
            _log(self.daemon),
            self._read_notices(),
        )

    def _read_notices(self) -> tuple[Notice, ...]:
        if self._notices_reader is None:
            try:
                self._notices_reader = NoticesReader(self.daemon.directory / NOTICES)
            except NoticesError:
                return ()
        self._notices.extend(self._notices_reader.read()[0])
        return tuple(self._notices)

    def _view(self) -> View | None:
        if self._reader is None:
            try:
                self._reader = SnapshotReader(self.daemon.directory / "snapshot")
            except SnapshotError:
                return None
        view = self._reader.read()
        return view if view.sync_monotonic_ns else None


def _three(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


def _state(view: View) -> tuple[str, str]:
    age_s = time.monotonic() - view.sync_monotonic_ns * 1e-9
    if age_s <= max(STILL_S, 50 * view.period_s):
        return RUNNING, ""
    try:
        code = Path(f"/proc/{view.pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return STILL, f"the loop (process {view.pid}) has gone; no cycle for {age_s:.1f} s"
    return STILL, f"the loop (process {view.pid}) is {_PROCESS.get(code, code)}: no cycle for {age_s:.1f} s"


def _log(daemon: Daemon) -> CurrentLog | None:
    about = daemon.about
    if about.log_directory is None:
        return None
    directory = Path(about.log_directory)
    account = read_account(daemon.directory / "recorded") or Account()
    path, size, free, total = None, None, None, None
    try:
        files = [
            (each.stat().st_mtime_ns, each) for each in directory.glob(f"{about.log_prefix}*.mcap.active")
        ]
        if files:
            path = max(files)[1]
            size = path.stat().st_size
    except OSError:
        pass  # a file that has just been renamed, or a directory that is not ours to read
    try:
        disk = os.statvfs(directory)
        free, total = disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
    except OSError:
        pass
    return CurrentLog(account, path, size, free, total)
