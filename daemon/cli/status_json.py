"""What `jtq status --json` prints: a reading as plain data.

Everything the picture of `jtq status` shows; null for unknown numbers.
"""

from __future__ import annotations

import time
from math import nan
from typing import Any

from jtqd.daemon.cli.running import RUNNING, CurrentLog, Reading
from jtqd.daemon.shared.conditions import SEVERITIES, Condition
from jtqd.daemon.shared.contacts import contact_of
from jtqd.daemon.shared.notices import Notice
from jtqd.daemon.shared.reasons import drive_state, joint_reason
from jtqd.daemon.shared.snapshot import NMT_STATES, InputView, View
from jtqd.daemon.supervisor.table import bus_load
from jtqd.estimator.checked import finite
from jtqd.estimator.status import NAMES, PUBLISHED

SCHEMA = "jtq.status/1"


def content(reading: Reading) -> dict[str, Any]:
    """Return everything the view shows; null for unknown numbers."""
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
    return result | {
        "cycle": view.cycle,
        "joints": [_joint(reading, number) for number in range(1, len(view.joints) + 1)],
        "inputs": [_input(name, each, view) for name, each in zip(about.inputs, view.inputs, strict=False)],
        "work_us": _quantiles(reading.work_us),
        "late_us": _quantiles(reading.late_us),
        "bus_load": {
            "now": finite(bus_load(reading.earlier, view, about.bitrate)),
            "worst_case": view.worst_load,
        },
        "bus_state": dict(reading.bus),
        "counters": view.counters,
        "nodes": [_node(node, what, view) for node, what in sorted(about.nodes.items())],
        "notices": [_notice(each) for each in reading.notices],
        "conditions": [_condition(each, time.monotonic_ns()) for each in reading.conditions],
        "recorder": reading.log and _recorder(reading.log),
    }


def _joint(reading: Reading, number: int) -> dict[str, Any]:
    about, view, earlier = reading.daemon.about, reading.view, reading.earlier
    assert view is not None
    assert earlier is not None
    n = number - 1
    seen, measured = view.joints[n], view.measured[n]
    running = reading.state == RUNNING
    known = seen.status in PUBLISHED and running
    return {
        "joint": number,
        "name": about.joints[n].name,
        "status": NAMES.get(seen.status, str(seen.status)),
        "reason": joint_reason(about, number, view, earlier) or None,
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
        "zeros": view.zeros[n].content(),
        "contact": contact_of(seen) if running else None,
        "contact_nm": finite(seen.contact_nm if running else nan),
        "contact_threshold_nm": about.joints[n].contact_threshold_nm,
        "torque_rate_nm_s": finite(seen.torque_rate_nm_s if running else nan),
        "current_a": finite(measured.current_a),
        "motor_velocity_rad_s": finite(measured.motor_velocity_rad_s),
        "temperature_c": finite(measured.temperature_c),
        "drive": drive_state(seen.statusword),
        "cycles": {
            NAMES.get(code, str(code)): count for code, count in enumerate(view.status_cycles[n]) if count
        },
    }


def _input(name: str, each: InputView, view: View) -> dict[str, Any]:
    return {
        "name": name,
        "age_s": (view.sync_monotonic_ns - each.used_ns) * 1e-9 if each.used_ns else None,
        "after_sync_us": each.delay_ns / 1000 if each.used_ns else None,
        "usual_us": [each.low_ns / 1000, each.high_ns / 1000] if each.low_ns <= each.high_ns else None,
        "late": each.late,
        "lost": each.lost,
        "duplicates": each.duplicates,
        "rejected": each.rejected,
    }


def _node(node: int, what: str, view: View) -> dict[str, Any]:
    heard_ns = view.node_heard_ns[node]
    return {
        "node": node,
        "what": what,
        "state": NMT_STATES.get(view.node_states[node]) if heard_ns else None,
        "heartbeat_age_s": (view.sync_realtime_ns - heard_ns) * 1e-9 if heard_ns else None,
        "configured": node not in view.unconfigured,
    }


def _notice(each: Notice) -> dict[str, Any]:
    return {
        "realtime_ns": each.realtime_ns,
        "level": each.level,
        "node": each.node or None,
        "topic": each.topic,
        "text": each.text,
    }


def _condition(each: Condition, now_ns: int) -> dict[str, Any]:
    return {
        "name": each.name,
        "subject": each.subject,
        "severity": SEVERITIES[each.severity],
        "text": each.text,
        "for_s": (now_ns - each.since_ns) * 1e-9,
    }


def _recorder(log: CurrentLog) -> dict[str, Any]:
    return {
        "path": str(log.path) if log.path else None,
        "bytes": log.size,
        "written": log.account.written,
        "lost": log.account.lost,
        "let_go": log.account.let_go,
        "disk_free": log.disk_free,
        "disk_size": log.disk_size,
    }


def _quantiles(values: tuple[float, float, float]) -> dict[str, float | None]:
    return dict(zip(("p50", "p99", "max"), map(finite, values), strict=True))
