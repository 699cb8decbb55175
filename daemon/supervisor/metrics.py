"""The daemon's counters as a Prometheus text file, for a node exporter's textfile collector.

Written by the supervisor under another name and then renamed: a reader never sees half of it. Off unless the configuration
has `metrics: {file: PATH}`; a name without a directory lies in the runtime directory.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from daemon.shared.snapshot import SnapshotReader, View

_GAUGES = frozenset(("work_max_ns", "late_max_ns"))
_SHARES = (0.5, 0.99, 1.0)


def metrics_text(view: View, reader: SnapshotReader, bus: str, recorder_lost: int) -> str:
    """The whole file; label `bus` tells daemons apart."""
    label = bus.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    lines: list[str] = []

    def metric(name: str, kind: str, text: str, rows: list[tuple[str, float]]) -> None:
        lines.extend((f"# HELP jtqd_{name} {text}", f"# TYPE jtqd_{name} {kind}"))
        lines.extend(f'jtqd_{name}{{bus="{label}"{more}}} {_number(value)}' for more, value in rows)

    for name, value in view.counters.items():
        kind = "gauge" if name in _GAUGES else "counter"
        metric(
            name if kind == "gauge" else f"{name}_total",
            kind,
            f"Counter {name} of the loop (docs/bus.md).",
            [("", value)],
        )
    metric("recorder_lost_total", "counter", "Cycles missing in the log.", [("", recorder_lost)])
    joints = [(f',joint="{number}"', joint) for number, joint in enumerate(view.joints, start=1)]
    metric(
        "torque_nm", "gauge", "Estimated torque, joint side.", [(at, each.torque_nm) for at, each in joints]
    )
    metric("sigma_nm", "gauge", "Its standard deviation.", [(at, each.sigma_nm) for at, each in joints])
    metric("status", "gauge", "Status as in the estimate PDO.", [(at, each.status) for at, each in joints])
    work = zip(_SHARES, reader.work_us(*_SHARES), strict=True)
    late = zip(_SHARES, reader.late_us(*_SHARES), strict=True)
    metric(
        "work_us", "gauge", "Work per cycle by quantile.", [(f',quantile="{q}"', value) for q, value in work]
    )
    metric(
        "late_us",
        "gauge",
        "Lateness of SYNC by quantile.",
        [(f',quantile="{q}"', value) for q, value in late],
    )
    return "\n".join(lines) + "\n"


def write_metrics(path: Path, text: str) -> None:
    """Replace the file at once. Raises OSError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def _number(value: float) -> str:
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return repr(value)
