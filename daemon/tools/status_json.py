"""A reading as plain data for JSON: `jtq status --json`."""

from __future__ import annotations

from math import isfinite, nan
from typing import Any

from daemon.supervisor.live_table import bus_load
from daemon.tools.reading import RUNNING, Reading
from daemon.tools.reasons import NMT_STATES, drive_state, reason
from estimator.status import NAMES, PUBLISHED

SCHEMA = "jtq.status/1"


def content(reading: Reading) -> dict[str, Any]:
    """Everything the picture shows; null where a number is not known."""
    about, view = reading.daemon.about, reading.view
    found: dict[str, Any] = {
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
        return found
    found |= {
        "cycle": view.cycle,
        "joints": [_joint(reading, number) for number in (1, 2)],
        "inputs": [
            {"name": name}
            | {
                "age_s": (view.sync_monotonic_ns - each.used_ns) * 1e-9 if each.used_ns else None,
                "after_sync_us": each.delay_ns / 1000 if each.used_ns else None,
                "usual_us": [each.low_ns / 1000, each.high_ns / 1000]
                if each.low_ns <= each.high_ns
                else None,
                "late": each.late,
                "lost": each.lost,
                "duplicates": each.duplicates,
                "rejected": each.rejected,
            }
            for name, each in zip(about.inputs, view.inputs, strict=False)
        ],
        "work_us": _quantiles(reading.work_us),
        "late_us": _quantiles(reading.late_us),
        "bus_load": {
            "now": _number(bus_load(reading.earlier, view, about.bitrate)),
            "worst_case": view.worst_load,
        },
        "counters": view.counters,
        "nodes": [
            {
                "node": node,
                "what": what,
                "state": NMT_STATES.get(view.node_states[node]) if view.node_heard_ns[node] else None,
                "heartbeat_age_s": (view.sync_realtime_ns - view.node_heard_ns[node]) * 1e-9
                if view.node_heard_ns[node]
                else None,
                "configured": node not in view.unconfigured,
            }
            for node, what in sorted(about.nodes.items())
        ],
    }
    found["notices"] = [
        {
            "realtime_ns": each.realtime_ns,
            "level": each.level,
            "node": each.node or None,
            "topic": each.topic,
            "text": each.text,
        }
        for each in reading.notices
    ]
    log = reading.log
    found["recorder"] = log and {
        "path": str(log.path) if log.path else None,
        "bytes": log.size,
        "written": log.account.written,
        "lost": log.account.lost,
        "let_go": log.account.let_go,
        "disk_free": log.disk_free,
        "disk_size": log.disk_size,
    }
    return found


def _joint(reading: Reading, number: int) -> dict[str, Any]:
    about, view, earlier = reading.daemon.about, reading.view, reading.earlier
    assert view is not None
    assert earlier is not None
    n = number - 1
    seen, measured = view.joints[n], view.measured[n]
    known = seen.status in PUBLISHED and reading.state == RUNNING
    return {
        "joint": number,
        "name": about.joints[n].name,
        "status": NAMES.get(seen.status, str(seen.status)),
        "reason": reason(about, number, view, earlier) or None,
        "since_s": (view.cycle - view.status_since[n]) * view.period_s,
        "torque_nm": _number(seen.torque_nm if known else nan),
        "sigma_nm": _number(seen.sigma_nm if known else nan),
        "physics_nm": _number(seen.physics_nm),
        "network_nm": _number(seen.network_nm),
        "sensor_nm": _number(seen.sensor_nm),
        "current_a": _number(measured.current_a),
        "motor_velocity_rad_s": _number(measured.motor_velocity_rad_s),
        "temperature_c": _number(measured.temperature_c),
        "drive": drive_state(seen.statusword),
        "cycles": {
            NAMES.get(code, str(code)): count for code, count in enumerate(view.status_cycles[n]) if count
        },
    }


def _quantiles(values: tuple[float, float, float]) -> dict[str, float | None]:
    return dict(zip(("p50", "p99", "max"), map(_number, values), strict=True))


def _number(value: float) -> float | None:
    return value if isfinite(value) else None
