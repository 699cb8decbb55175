"""The state of one running daemon from its runtime directory, read-only, and as plain data: `jtq.status/1`.

`Watch` reads snapshot, about.json, notices, conditions and the recorder's account; `content` is what `jtq status --json`
prints and the page in the browser shows.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import isfinite, nan
from pathlib import Path
from typing import Any, Final, NamedTuple

from jtqd.daemon.recording.run_files import Account, read_account
from jtqd.daemon.shared.conditions import DEVIATION_SIGMAS, SEVERITIES, Condition, read_conditions
from jtqd.daemon.shared.events import FILE as NOTICES
from jtqd.daemon.shared.events import Notice, NoticesReader
from jtqd.daemon.shared.reasons import contact_of, drive_state, joint_reason
from jtqd.daemon.shared.runtime_dir import About, AboutJoint, SharedMemoryError, json_of
from jtqd.daemon.shared.snapshot import JointView, SnapshotReader, View, bus_load
from jtqd.drivers import nmt
from jtqd.estimator.status import NAMES, PUBLISHED, Zeros
from jtqd.estimator.text import finite

SCHEMA: Final = "jtq.status/1"
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


# ---- as plain data ----


def _ago_s(now_ns: int, then_ns: int) -> float | None:
    """Return the age of a stamp; None for one that has never been set."""
    return (now_ns - then_ns) * 1e-9 if then_ns else None


def content(reading: Reading) -> dict[str, Any]:
    """Return the state as plain data, as `--json` prints it; null for unknown numbers."""
    about, view = reading.daemon.about, reading.view
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "bus": about.bus,
        "instance": about.instance,
        "pid": about.pid,
        "state": reading.state,
        "why": reading.why or None,
        "started": about.started,
        "configuration": {"path": about.configuration, "sha256": about.configuration_sha256},
        "method": about.method,
        "versions": about.versions,
    }
    if view is None or reading.earlier is None:
        return result
    now_ns = time.monotonic_ns()
    inputs = [
        {
            "name": name,
            "age_s": _ago_s(view.sync_monotonic_ns, each.used_ns),
            "after_sync_us": each.delay_ns / 1000 if each.used_ns else None,
            "usual_us": [each.low_ns / 1000, each.high_ns / 1000] if each.low_ns <= each.high_ns else None,
            "missed": each.missed,
            "late": each.late,
            "lost": each.lost,
            "duplicates": each.duplicates,
            "rejected": each.rejected,
        }
        for name, each in zip(about.inputs, view.inputs, strict=False)
    ]
    nodes = [
        {
            "node": node,
            "what": what,
            "state": nmt.STATES.get(view.node_states[node]) if view.node_heard_ns[node] else None,
            "heartbeat_age_s": _ago_s(view.sync_realtime_ns, view.node_heard_ns[node]),
            "configured": node not in view.unconfigured,
        }
        for node, what in sorted(about.nodes.items())
    ]
    notices = [
        {
            "realtime_ns": each.realtime_ns,
            "level": each.level,
            "node": each.node or None,
            "topic": each.topic,
            "text": each.text,
        }
        for each in reading.notices
    ]
    conditions = [
        {
            "name": each.name,
            "subject": each.subject,
            "severity": SEVERITIES[each.severity],
            "text": each.text,
            "for_s": (now_ns - each.since_ns) * 1e-9,
        }
        for each in reading.conditions
    ]
    load = finite(bus_load(reading.earlier, view, about.bitrate))
    return result | {
        "cycle": view.cycle,
        "joints": [_joint_content(reading, view, reading.earlier, n) for n in range(len(view.joints))],
        "inputs": inputs,
        "work_us": dict(zip(("p50", "p99", "max"), map(finite, reading.work_us), strict=True)),
        "late_us": dict(zip(("p50", "p99", "max"), map(finite, reading.late_us), strict=True)),
        "bus_load": {"now": load, "worst_case": view.worst_load},
        "bus_state": dict(reading.bus),
        "counters": view.counters,
        "nodes": nodes,
        "notices": notices,
        "conditions": conditions,
        "recorder": reading.recorder,
    }


def _ratios(joint: AboutJoint, seen: JointView, zeros: Zeros, *, known: bool) -> dict[str, float]:
    """Return what is watched as a share of its limit, where it is known; above 1 a condition or a status follows."""
    shares = {
        "sensor": abs(seen.torque_nm - seen.reference_nm) / (DEVIATION_SIGMAS * seen.sigma_nm or nan)
        if known
        else nan,
        "network": abs(seen.network_nm - seen.physics_nm) / (joint.network_limit_nm or nan),
        "link_zero": abs(zeros.link_rad) / (zeros.limit_rad or nan) if zeros.learned else nan,
        "contact": abs(seen.contact_nm) / (joint.contact_threshold_nm or nan),
    }
    return {name: share for name, share in shares.items() if isfinite(share)}


def _joint_content(reading: Reading, view: View, earlier: View, n: int) -> dict[str, Any]:
    about, seen, measured = reading.daemon.about, view.joints[n], view.measured[n]
    running = reading.state == RUNNING
    known = seen.status in PUBLISHED and running
    return {
        "joint": n + 1,
        "name": about.joints[n].name,
        "status": NAMES.get(seen.status, str(seen.status)),
        "reason": joint_reason(about, n + 1, view, earlier) or None,
        "since_s": (view.cycle - view.status_since[n]) * view.period_s,
        "torque_nm": finite(seen.torque_nm if known else nan),
        "sigma_nm": finite(seen.sigma_nm if known else nan),
        "physics_nm": finite(seen.physics_nm),
        "network_nm": finite(seen.network_nm),
        "sensor_nm": finite(seen.sensor_nm),
        "reference_nm": finite(seen.reference_nm),
        "error_nm": finite(seen.torque_nm - seen.reference_nm if known else nan),
        "rmse_nm": finite(view.rmse_nm[n]),
        "age_ms": finite(seen.age_ms),
        "shadow": {name: each.content() for name, each in view.shadows[n].items()},
        "zeros": view.zeros[n].content(),
        "ratios": _ratios(about.joints[n], seen, view.zeros[n], known=known) if running else {},
        "contact": contact_of(seen) if running else None,
        "contact_nm": finite(seen.contact_nm if running else nan),
        "contact_threshold_nm": about.joints[n].contact_threshold_nm,
        "torque_rate_nm_s": finite(seen.torque_rate_nm_s if running else nan),
        "current_a": finite(measured.current_a),
        "motor_velocity_rad_s": finite(measured.motor_velocity_rad_s),
        "temperature_c": finite(measured.temperature_c),
        "drive": drive_state(seen.statusword),
        "cycles": {NAMES.get(code, str(code)): k for code, k in enumerate(view.status_cycles[n]) if k},
    }
