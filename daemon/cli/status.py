"""`jtq status`: state of a running jtqd on a terminal or as JSON, read from shared memory without effect on its loop."""

from __future__ import annotations

import argparse
import json
import os
import select
import sys
import termios
import time
import tty
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isfinite, log1p, nan
from typing import Any, Final

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from jtqd.daemon.cli.running import (
    RUNNING,
    CurrentLog,
    Daemon,
    NoDaemonError,
    Reading,
    Watch,
    choose_daemon,
    find_daemons,
    on_bus,
)
from jtqd.daemon.shared.conditions import SEVERITIES, Condition
from jtqd.daemon.shared.counters import Shown, shown_in
from jtqd.daemon.shared.events import ERROR, WARNING, Notice
from jtqd.daemon.shared.reasons import contact_line, contact_of, drive_state, joint_reason, silent_s
from jtqd.daemon.shared.runtime_dir import About
from jtqd.daemon.shared.snapshot import LATE_BIN_NS, WORK_BIN_NS, SnapshotReader, View
from jtqd.daemon.supervisor.display import COLOURS, bus_load, first_that_fits, plain_line
from jtqd.drivers import nmt
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.status import NAMES, PUBLISHED
from jtqd.estimator.text import NOTHING, counted, duration, finite, number, percent, size

HEAD: Final = "bold"
HEADING: Final = 9
"""Width of the headings of lines."""
_FOOT_LINES: Final = 2
_BLOCKS: Final = "▁▂▃▄▅▆▇█"


class Columns:
    """A table that drops columns, in the order of `dispensable`, where the terminal is too narrow for all.

    Nothing is cut, and a line below names the columns that are not shown.
    """

    def __init__(self, headings: dict[str, str], dispensable: tuple[str, ...] = ()) -> None:
        self._headings = headings
        self._dispensable = dispensable
        self._rows: list[dict[str, str | Text]] = []

    def add(self, *cells: str | Text) -> None:
        """Add a row, one cell per heading."""
        self._rows.append(dict(zip(self._headings, cells, strict=True)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the width of the terminal (called by rich)."""
        tables = [
            self._table([name for name in self._headings if name not in self._dispensable[:dropped]])
            for dropped in range(len(self._dispensable) + 1)
        ]
        shown = first_that_fits(tables, console, options) or tables[-1]
        yield shown
        if dropped := self._dispensable[: tables.index(shown)]:
            names = [name for name in self._headings if name in dropped]
            yield Text(f"no room for: {', '.join(names)}", style="dim")

    def _table(self, names: list[str]) -> Table:
        table = Table(
            box=None, pad_edge=False, padding=(0, 2, 0, 0), collapse_padding=True, header_style=HEAD
        )
        for name in names:
            right = self._headings[name] == "right"
            table.add_column(name, justify="right" if right else "left", no_wrap=True)
        for row in self._rows:
            table.add_row(*(row[name] for name in names))
        return table


def line(heading: str, text: str | Text) -> RenderableType:
    """Return a heading of fixed width and text that wraps beside it."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=HEADING, no_wrap=True, style=HEAD)
    grid.add_column(overflow="fold")
    grid.add_row(heading, text)
    return grid


def paged(console: Console, view: RenderableType, number: int) -> tuple[RenderableType, int]:
    """Return one page of a view, with a line below, and its number.

    number: of the wanted page, counted on beyond the last page, which is followed by the first.
    """
    lines = console.render_lines(view, console.options.update(height=None), pad=False)
    height = max(console.height - _FOOT_LINES, 1)
    count = max(1, -(-len(lines) // height))
    number %= count
    rows = [Segments([*each, Segment.line()]) for each in lines[number * height : (number + 1) * height]]
    pages = f"page {number + 1} of {count}, SPACE turns; " if count > 1 else ""
    foot = time.strftime(f"%H:%M:%S  {pages}Ctrl-C ends this view; jtqd continues")
    return Group(*rows, Padding(Text(foot, style="dim"), (1, 0, 0, 0))), number


class Keys:
    """Keys of the terminal, without their echo, while a view is shown; nothing where standard input is none."""

    def __enter__(self) -> Keys:
        self._before: list[Any] | None = None
        if sys.stdin.isatty():
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin.fileno())
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def turned(self, wait_s: float) -> int:
        """Wait, at most until a key comes; return how many pages to turn: SPACE, n forward, b, p back."""
        if self._before is None:
            time.sleep(wait_s)
            return 0
        if not select.select([sys.stdin.fileno()], [], [], wait_s)[0]:
            return 0
        pressed = os.read(sys.stdin.fileno(), 64)
        if not pressed:  # the terminal is closed
            time.sleep(wait_s)
        return sum(pressed.count(key) for key in b" n") - sum(pressed.count(key) for key in b"bp")


def sparkline(values: Sequence[float], columns: int) -> str:
    """Return the newest values as at most `columns` blocks between their extremes; a gap for each that is no number.

    >>> sparkline([0.0, 1.0, float("nan"), 7.0], 8)
    '▁▂ █'
    """
    shown = list(values)[-columns:]
    known = [each for each in shown if isfinite(each)] or [0.0]
    low, span = min(known), (max(known) - min(known)) or 1.0
    top = len(_BLOCKS) - 1
    return "".join(_BLOCKS[round(top * (each - low) / span)] if isfinite(each) else " " for each in shown)


def histogram(bins: Sequence[int], bin_us: float, columns: int) -> str:
    """Return bins as a line of at most `columns` blocks between its edges, e.g. "84 ▇█▂▁ 212 us"; "" without data.

    From the first bin that holds something to the last, which takes everything above it. The height is logarithmic, so that
    one cycle in a million can be seen.
    """
    filled = [n for n, count in enumerate(bins) if count]
    if not filled:
        return ""
    first, last = filled[0], filled[-1]
    width = -(-(last - first + 1) // columns)
    sums = [sum(bins[n : n + width]) for n in range(first, last + 1, width)]
    top = log1p(max(sums))
    heights = (max(1, round(8 * log1p(each) / top)) if each else 0 for each in sums)
    blocks = "".join((" " + _BLOCKS)[height] for height in heights)
    high = min(first + len(sums) * width, len(bins)) * bin_us
    more = " and more" if last == len(bins) - 1 else ""
    return f"{first * bin_us:.0f} {blocks} {high:.0f} us{more}"


SCHEMA: Final = "jtq.status/1"
_FAULTS: Final = shown_in(Shown.STATUS)
"""Counters shown when they are not zero."""
_LAST_NOTICES: Final = 4
_EXAMPLES: Final = """examples:
  jtq status                     live view of the daemon on this machine; Ctrl-C ends the view
  jtq status --bus can0          of the daemon on can0
  jtq status --once              one text output, also for a file or a mail
  jtq status --json | jq '.joints[].torque_nm'

exit status: 0 running, 1 no daemon runs (or none that you may read), 2 usage, 3 stalled or still starting
you may read your own daemons and those of your groups (usermod -a -G jtqd YOU)"""
_PERIOD_S: Final = 0.2
_PLAIN_PERIOD_S: Final = 1.0
_BETWEEN_S: Final = 0.3
"""Between the two readings of one view: bus load and reasons need what has changed."""
WINDOW_S: Final = 10.0
"""Of the sparklines and maxima of a live view: its counters are those since the start of the daemon."""


# ---- last seconds of a live view ----


@dataclass(frozen=True)
class Moment:
    """One reading: time of the view [s], torques [Nm] (NaN: none), histograms of work and lateness, contacts until then."""

    time_s: float
    torques: tuple[float, ...]
    work: tuple[int, ...]
    late: tuple[int, ...]
    contacts: int = 0


class Recent:
    """Readings of the last WINDOW_S seconds."""

    def __init__(self) -> None:
        self._moments: deque[Moment] = deque()

    def add(self, moment: Moment) -> None:
        """Add a reading and drop those older than the window; a histogram that has shrunk is that of another daemon."""
        if self._moments and sum(moment.work) < sum(self._moments[-1].work):
            self._moments.clear()
        self._moments.append(moment)
        while moment.time_s - self._moments[0].time_s > WINDOW_S:
            self._moments.popleft()

    @property
    def seconds(self) -> float:
        """Time from the first reading to the last [s]."""
        return self._moments[-1].time_s - self._moments[0].time_s if self._moments else 0.0

    def torques(self, joint: int) -> list[float]:
        """Return the torques of a joint (0, 1, ...), oldest first."""
        return [each.torques[joint] for each in self._moments if joint < len(each.torques)]

    @property
    def contacts(self) -> int:
        """Number of contacts that have begun in the window."""
        return self._moments[-1].contacts - self._moments[0].contacts if self._moments else 0

    def largest_us(self, bin_us: float, *, late: bool) -> float | None:
        """Return the upper edge of the largest work time (or lateness) in the window [us]; None without a cycle."""
        if not self._moments:
            return None
        first, last = self._moments[0], self._moments[-1]
        before, now = (first.late, last.late) if late else (first.work, last.work)
        grown = [n for n, (old, new) in enumerate(zip(before, now, strict=True)) if new > old]
        return (grown[-1] + 1) * bin_us if grown else None


# ---- view ----


class StatusView:
    """Rich view of one reading; recent: the last seconds of a live view."""

    def __init__(self, reading: Reading, recent: Recent | None = None) -> None:
        self._reading, self._recent = reading, recent

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the width of the terminal (called by rich)."""
        reading, width = self._reading, options.max_width
        yield _title(reading)
        if reading.state != RUNNING:
            yield Text(f"NOT RUNNING: {reading.why}" if reading.view else reading.why, style="bold red")
        if reading.view is None or reading.earlier is None:
            return
        about, view = reading.daemon.about, reading.view
        still = reading.state != RUNNING
        yield ""
        yield _joints(about, view, still=still)
        if not still:
            yield from _reasons(about, view, reading.earlier)
            for joint, zeros in zip(about.joints, view.zeros, strict=False):
                if zeros.tracked:
                    style = "" if zeros.plausible else "yellow"
                    yield line(f"zeros {joint.number}", Text(zeros.text, style=style))
            yield from _contacts(about, view, self._recent)
            if self._recent is not None:
                yield from _last_seconds(self._recent, len(about.joints), width)
        yield ""
        yield _inputs(about, view)
        yield ""
        yield _loop(reading, view, width)
        load = percent(bus_load(reading.earlier, view, about.bitrate))
        worst = percent(view.worst_load)
        yield line("bus load", f"{load} now, with worst-case stuff bits; {worst} by configuration")
        yield from _bus_state(reading)
        faults = [
            f"{name.replace('_', ' ')} {view.counters[name]}" for name in _FAULTS if view.counters[name]
        ]
        if faults:
            yield line("counted", ", ".join(faults))
        yield ""
        yield _nodes(about, view)
        yield ""
        yield from _log(reading.log)
        yield from _conditions(reading.conditions)
        yield from _notices(reading.notices)


def _status_name(status: int) -> str:
    return NAMES.get(status, str(status))


def _title(reading: Reading) -> Text:
    about, view = reading.daemon.about, reading.view
    text = Text(f"jtqd on {about.instance}", style=HEAD)
    text.append(f"  node {about.node:02X}h  {about.method}  pid {about.pid}", style="")
    if view is not None:
        text.append(f"  cycle {view.cycle}  up {duration(view.cycle * view.period_s)}", style="")
    text.append(f"\n{about.configuration}  {about.configuration_sha256[:8]}", style="dim")
    text.overflow = "fold"
    return text


def _quantity(value: float, unit: str, decimals: int = 2) -> str:
    return f"{number(value, decimals)} {unit}" if isfinite(value) else NOTHING


def _joints(about: About, view: View, *, still: bool) -> Columns:
    headings = {"joint": "left", "status": "left"} | dict.fromkeys(
        ("torque", "sigma", "sensor", "age", "current", "motor", "temp.", "with a torque"), "right"
    )
    table = Columns(headings, ("age", "with a torque", "motor", "temp.", "current", "sensor", "sigma"))
    for n, (joint, seen) in enumerate(zip(about.joints, view.joints, strict=True)):
        known = seen.status in PUBLISHED and not still
        measured, cycles = view.measured[n], view.status_cycles[n]
        name = _status_name(seen.status)
        table.add(
            f"{joint.number} {joint.name}",
            Text(name, style="dim" if still else COLOURS.get(name, "bold red")),
            _quantity(seen.torque_nm if known else nan, "Nm"),
            _quantity(seen.sigma_nm if known else nan, "Nm"),
            _quantity(seen.reference_nm, "Nm"),
            _quantity(seen.age_ms if known else nan, "ms"),
            _quantity(measured.current_a, "A"),
            _quantity(measured.motor_velocity_rad_s, "rad/s", 1),
            _quantity(measured.temperature_c, "°C", 1),
            percent(sum(cycles[code] for code in PUBLISHED) / max(1, sum(cycles))),
        )
    return table


def _reasons(about: About, view: View, earlier: View) -> Iterator[Text]:
    """Return one line per joint, so that the view keeps its height."""
    for joint, seen, since in zip(about.joints, view.joints, view.status_since, strict=True):
        why = joint_reason(about, joint.number, view, earlier)
        name = _status_name(seen.status)
        lasting = duration((view.cycle - since) * view.period_s)
        yield Text.assemble(
            f"joint {joint.number} ",
            (f"{name} for {lasting}", COLOURS.get(name, "bold red")),
            f": {why}" if why else "",
        )


def _contacts(about: About, view: View, recent: Recent | None) -> Iterator[RenderableType]:
    """Return a line per joint that is watched, and their number: a short contact falls between two readings."""
    watched = [
        (joint, seen)
        for joint, seen in zip(about.joints, view.joints, strict=False)
        if joint.contact_threshold_nm is not None
    ]
    for joint, seen in watched:
        contact, threshold_nm = contact_of(seen), joint.contact_threshold_nm or nan
        style = "bold red" if contact else "yellow" if contact is None else ""
        yield line(f"contact {joint.number}", Text(contact_line(seen, threshold_nm), style=style))
    if watched:
        text = Text(f"{view.counters['contacts'] or 'none'} since the start")
        if recent is not None:
            style = "bold red" if recent.contacts else ""
            text.append(f", {recent.contacts} in the last {recent.seconds:.0f} s", style=style)
        yield line("contacts", text)


def _last_seconds(recent: Recent, joints: int, width: int) -> Iterator[RenderableType]:
    """Return the torque of each joint as a sparkline, and the slowest cycle, of the last seconds."""
    columns = min(50, max(10, width - 40))
    for joint in range(joints):
        torques = recent.torques(joint)
        known = [each for each in torques if isfinite(each)]
        extent = f"{min(known):.2f} to {max(known):.2f} Nm" if known else "no torque"
        yield line(f"torque {joint + 1}", Text.assemble((sparkline(torques, columns), "cyan"), f" {extent}"))
    work = recent.largest_us(WORK_BIN_NS / 1000, late=False)
    late = recent.largest_us(LATE_BIN_NS / 1000, late=True)
    if work is not None and late is not None:
        text = f"work at most {work:.0f} us, SYNC late by at most {late:.0f} us"
        yield line(f"last {recent.seconds:.0f} s", text)


def _inputs(about: About, view: View) -> Columns:
    headings = {"input": "left"} | dict.fromkeys(
        ("age", "after SYNC", "usual", "missed", "late", "lost", "twice", "wrong"), "right"
    )
    table = Columns(headings, ("wrong", "twice", "usual", "lost", "late"))
    for name, each in zip(about.inputs, view.inputs, strict=False):
        age_s = (view.sync_monotonic_ns - each.used_ns) * 1e-9 if each.used_ns else nan
        old = not age_s <= 2 * 8 * view.period_s  # read every 8th cycle
        band = f"{each.low_ns / 1000:.0f}..{each.high_ns / 1000:.0f} us"
        table.add(
            name,
            Text("never" if not each.used_ns else duration(age_s), style="bold red" if old else ""),
            after_sync(each.delay_ns) if each.used_ns else NOTHING,
            band if each.low_ns <= each.high_ns else NOTHING,
            *map(str, (each.missed, each.late, each.lost, each.duplicates, each.rejected)),
        )
    return table


def after_sync(delay_ns: int) -> str:
    """Return the arrival of an input after its SYNC; the age of an acyclic input, which arrived before it.

    >>> after_sync(426_000), after_sync(-4_803_000)
    ('426 us', '4803 us old')
    """
    return f"{delay_ns / 1000:.0f} us" if delay_ns >= 0 else f"{-delay_ns / 1000:.0f} us old"


def _loop(reading: Reading, view: View, width: int) -> RenderableType:
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=HEADING, no_wrap=True, style=HEAD)
    grid.add_column()
    columns = min(60, max(10, width - 66))
    for name, values, bins, bin_ns in (
        ("work", reading.work_us, reading.work, WORK_BIN_NS),
        ("lateness", reading.late_us, reading.late, LATE_BIN_NS),
    ):
        p50, p99, largest = (number(each, 0) for each in values)
        text = f"p50 {p50}  p99 {p99}  max {largest} us"
        grid.add_row(name, Text.assemble(text.ljust(31), (histogram(bins, bin_ns / 1000, columns), "cyan")))
    cycles, missed = view.counters["cycles"], view.counters["missed"]
    incomplete = cycles - view.counters["complete"]
    shown = Text(f"{missed} of {max(1, cycles + missed)} cycles", style="yellow" if missed else "")
    shown.append(f", an input missing in {incomplete}", style="yellow" if incomplete else "default")
    grid.add_row("missed", shown)
    return grid


def _bus_state(reading: Reading) -> Iterator[RenderableType]:
    """Return state and error frames of the CAN controller, where they are known."""
    state, counts = reading.bus.get("state"), reading.bus.get("counts", {})
    if state is not None:
        names = ("protocol_errors", "no_acknowledge", "overruns", "bus_offs")
        errors = sum(counts.get(name, 0) for name in names)
        yield line("bus state", f"{state}, {counted(errors, 'error frame')}")


def _nodes(about: About, view: View) -> Columns:
    table = Columns({"node": "left", "what": "left", "state": "left", "heartbeat": "right"}, ("what",))
    for node, what in sorted(about.nodes.items()):
        heard = view.node_heard_ns[node]
        state = Text(nmt.STATES.get(view.node_states[node], "?") if heard else "no heartbeat yet")
        if silent_s(view, node, about.heartbeat_ms) is not None:
            state = Text(f"silent, last {state.plain}", style="bold red")
        elif node in view.unconfigured:
            state = Text("restarted, not configured yet", style="bold red")
        elif heard and view.node_states[node] != nmt.OPERATIONAL:
            state.stylize("yellow")
        age = duration(max(0, view.sync_realtime_ns - heard) * 1e-9) + " ago" if heard else NOTHING
        table.add(f"{node:02X}h", what, state, age)
    return table


def _log(log: CurrentLog | None) -> Iterator[RenderableType]:
    if log is None:
        yield line("recorder", "no recording")
        return
    account = log.account
    lost = Text(f"{account.lost} lost", style="bold red" if account.lost else "")
    discarded = f", {account.let_go} discarded (flight recorder)" if account.let_go else ""
    written = f"{counted(account.written, 'cycle')} written, "
    yield line("recorder", Text.assemble(written, lost, f"{discarded}, {size(log.size)} in this file"))
    yield line("", str(log.path) if log.path else "no file is being written")
    yield line("disk", f"{size(log.disk_free)} free of {size(log.disk_size)}")


def _style_of(level: int) -> str:
    return "bold red" if level >= ERROR else "yellow" if level >= WARNING else ""


def _conditions(conditions: Sequence[Condition]) -> Iterator[RenderableType]:
    """Return the present conditions and their durations."""
    if conditions:
        yield ""
    now_ns = time.monotonic_ns()
    for each in conditions:
        text = f"{each.line} (for {duration((now_ns - each.since_ns) * 1e-9)})"
        yield line(SEVERITIES[each.severity], Text(text, style=_style_of(each.severity)))


def _notices(notices: Sequence[Notice]) -> Iterator[RenderableType]:
    if notices:
        yield ""
    for each in notices[-_LAST_NOTICES:]:
        when = time.strftime("%H:%M:%S", time.localtime(each.realtime_ns * 1e-9))
        yield line(when, Text(each.text, style=_style_of(each.level)))


# ---- JSON ----


def content(reading: Reading) -> dict[str, Any]:
    """Return everything that the view shows as plain data; null for unknown numbers."""
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
    return result | {
        "cycle": view.cycle,
        "joints": [_joint_content(reading, view, reading.earlier, n) for n in range(len(view.joints))],
        "inputs": _inputs_content(about, view),
        "work_us": _quantiles(reading.work_us),
        "late_us": _quantiles(reading.late_us),
        "bus_load": {
            "now": finite(bus_load(reading.earlier, view, about.bitrate)),
            "worst_case": view.worst_load,
        },
        "bus_state": dict(reading.bus),
        "counters": view.counters,
        "nodes": _nodes_content(about, view),
        "notices": [
            {
                "realtime_ns": each.realtime_ns,
                "level": each.level,
                "node": each.node or None,
                "topic": each.topic,
                "text": each.text,
            }
            for each in reading.notices
        ],
        "conditions": [
            {
                "name": each.name,
                "subject": each.subject,
                "severity": SEVERITIES[each.severity],
                "text": each.text,
                "for_s": (now_ns - each.since_ns) * 1e-9,
            }
            for each in reading.conditions
        ],
        "recorder": reading.log and _log_content(reading.log),
    }


def _joint_content(reading: Reading, view: View, earlier: View, n: int) -> dict[str, Any]:
    about, seen, measured = reading.daemon.about, view.joints[n], view.measured[n]
    running = reading.state == RUNNING
    known = seen.status in PUBLISHED and running
    cycles = enumerate(view.status_cycles[n])
    return {
        "joint": n + 1,
        "name": about.joints[n].name,
        "status": _status_name(seen.status),
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
        "zeros": view.zeros[n].content(),
        "contact": contact_of(seen) if running else None,
        "contact_nm": finite(seen.contact_nm if running else nan),
        "contact_threshold_nm": about.joints[n].contact_threshold_nm,
        "torque_rate_nm_s": finite(seen.torque_rate_nm_s if running else nan),
        "current_a": finite(measured.current_a),
        "motor_velocity_rad_s": finite(measured.motor_velocity_rad_s),
        "temperature_c": finite(measured.temperature_c),
        "drive": drive_state(seen.statusword),
        "cycles": {_status_name(code): count for code, count in cycles if count},
    }


def _inputs_content(about: About, view: View) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "age_s": (view.sync_monotonic_ns - each.used_ns) * 1e-9 if each.used_ns else None,
            "after_sync_us": each.delay_ns / 1000 if each.used_ns else None,
            "usual_us": [each.low_ns / 1000, each.high_ns / 1000] if each.low_ns <= each.high_ns else None,
            "late": each.late,
            "lost": each.lost,
            "duplicates": each.duplicates,
            "rejected": each.rejected,
        }
        for name, each in zip(about.inputs, view.inputs, strict=False)
    ]


def _nodes_content(about: About, view: View) -> list[dict[str, Any]]:
    heard = view.node_heard_ns
    return [
        {
            "node": node,
            "what": what,
            "state": nmt.STATES.get(view.node_states[node]) if heard[node] else None,
            "heartbeat_age_s": (view.sync_realtime_ns - heard[node]) * 1e-9 if heard[node] else None,
            "configured": node not in view.unconfigured,
        }
        for node, what in sorted(about.nodes.items())
    ]


def _log_content(log: CurrentLog) -> dict[str, Any]:
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


# ---- command ----


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq status`."""
    result = command_parser(
        "jtq status",
        "Show the state of a running jtqd: torque, status with its reason, inputs, timing, bus, nodes, log.",
        _EXAMPLES,
    )
    result.add_argument(
        "--bus", help="bus of the daemon: can0, unix:PATH or sim (default: the only running one)"
    )
    result.add_argument("--once", action="store_true", help="print once, then end")
    result.add_argument("--json", action="store_true", help="print once as JSON, then end")
    return result


def main(argv: list[str]) -> int:
    """Show the state; return the exit status."""
    arguments = parser().parse_args(argv)
    try:
        daemon = choose_daemon(arguments.bus)
        if arguments.json or arguments.once:
            return _once(daemon, as_json=arguments.json)
        os.nice(5)
        console = Console()
        return _live(console, daemon) if console.is_terminal else _lines(daemon)
    except NoDaemonError as error:
        print(f"jtq status: {error}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        return 0


def _once(daemon: Daemon, *, as_json: bool) -> int:
    watch = Watch(daemon)
    watch.read()
    time.sleep(_BETWEEN_S)
    reading = watch.read()
    if as_json:
        print(json.dumps(content(reading)))
    else:
        Console().print(StatusView(reading))
    return 0 if reading.state == RUNNING else 3


def _live(console: Console, daemon: Daemon) -> int:
    """Show the live view until Ctrl-C; a restarted daemon is found again."""
    watch, recent, number = Watch(daemon), Recent(), 0
    with Keys() as keys, Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            if daemon.about.running():
                reading = watch.read()
                _remember(recent, reading)
                shown, number = paged(console, StatusView(reading, recent), number)
                live.update(shown, refresh=True)
            else:
                ended = f"jtqd on {daemon.about.instance} has ended; waiting for its restart"
                live.update(ended, refresh=True)
                again = on_bus(find_daemons(), daemon.about.instance)
                if again is not None:
                    daemon, watch, recent = again, Watch(again), Recent()
            number += keys.turned(_PERIOD_S)


def _remember(recent: Recent, reading: Reading) -> None:
    view = reading.view
    if view is None or reading.state != RUNNING:
        return
    torques = tuple(each.torque_nm if each.status in PUBLISHED else nan for each in view.joints)
    moment = Moment(time.monotonic(), torques, reading.work, reading.late, view.counters["contacts"])
    recent.add(moment)


def _lines(daemon: Daemon) -> int:
    """Print one line per second until the daemon ends, for output that is no terminal."""
    watch = Watch(daemon)
    watched = any(each.contact_threshold_nm is not None for each in daemon.about.joints)
    while daemon.about.running():
        reading = watch.read()
        if reading.state != RUNNING or reading.view is None or reading.earlier is None:
            print(f"not running: {reading.why}", flush=True)
        else:
            reader = SnapshotReader(daemon.directory / "snapshot")
            bitrate = daemon.about.bitrate
            print(plain_line(reader, reading.earlier, reading.view, bitrate, contacts=watched), flush=True)
        time.sleep(_PLAIN_PERIOD_S)
    return 0
