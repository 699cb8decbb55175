"""The table that `jtqd` shows while it runs: torque, sigma and status of both joints, and how the loop is doing."""

from __future__ import annotations

from math import isfinite

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from daemon.snapshot import SnapshotReader, View
from estimator.status import NAMES

_COLOURS = {"valid": "green", "degraded": "yellow", "standstill": "cyan", "starting": "blue", "off": "dim"}


def bus_load(previous: View, now: View, bitrate: int) -> float:
    """Share of the bus that the frames between two views took with worst-case stuffing; NaN without time in between."""
    seconds = (now.sync_realtime_ns - previous.sync_realtime_ns) * 1e-9
    bits = now.counters["bits_worst_case"] - previous.counters["bits_worst_case"]
    return bits / seconds / bitrate if previous.sync_realtime_ns and seconds > 0 else float("nan")


def live_table(
    reader: SnapshotReader, previous: View, view: View, bitrate: int, title: str
) -> RenderableType:
    """One picture of the running loop."""
    table = Table(title=title, title_justify="left", expand=False)
    for name, justify in (
        ("joint", "left"),
        ("torque [Nm]", "right"),
        ("sigma [Nm]", "right"),
        ("sensor [Nm]", "right"),
        ("error [Nm]", "right"),
        ("status", "left"),
    ):
        table.add_column(name, justify="left" if justify == "left" else "right", min_width=10)
    for number, joint in enumerate(view.joints, start=1):
        name = NAMES.get(joint.status, str(joint.status))
        known = name in ("valid", "degraded", "standstill")
        table.add_row(
            str(number),
            _number(joint.torque_nm) if known else "-",
            _number(joint.sigma_nm) if known else "-",
            _number(joint.sensor_nm),
            _number(joint.torque_nm - joint.sensor_nm) if known else "-",
            Text(name, style=_COLOURS.get(name, "bold red")),
        )
    return Group(table, Text(loop_line(reader, previous, view, bitrate)))


def loop_line(reader: SnapshotReader, previous: View, view: View, bitrate: int) -> str:
    """Cycle time, missed cycles and bus load in one line."""
    p50, p99, worst = reader.work_us(0.5, 0.99, 1.0)
    counters = view.counters
    load = bus_load(previous, view, bitrate)
    load_text = f"{100 * load:.1f} %" if isfinite(load) else "-"
    return (
        f"cycle {counters['cycles']}  work p50 {p50:.0f} us, p99 {p99:.0f} us, max {worst:.0f} us  "
        f"missed {counters['missed']}  stale inputs {counters['stale_inputs']}  bus load {load_text}"
    )


def plain_line(reader: SnapshotReader, previous: View, view: View, bitrate: int) -> str:
    """The same for a log: one line without control characters."""
    joints = "  ".join(
        f"joint {n} {_number(joint.torque_nm)} Nm +- {_number(joint.sigma_nm)} {NAMES.get(joint.status, joint.status)}"
        for n, joint in enumerate(view.joints, start=1)
    )
    return f"{joints}  {loop_line(reader, previous, view, bitrate)}"


def _number(value: float) -> str:
    return f"{value:.2f}" if isfinite(value) else "-"
