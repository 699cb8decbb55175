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
from collections.abc import Iterator, Mapping, Sequence
from math import isfinite, log1p, nan
from typing import Any, Final

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from jtqd.daemon.cli.running import NoDaemonError, choose_daemon, find_daemons, on_bus
from jtqd.daemon.live.reading import RUNNING, Daemon, Reading, Watch, content
from jtqd.daemon.shared.conditions import SEVERITIES
from jtqd.daemon.shared.counters import Shown, shown_in
from jtqd.daemon.shared.events import ERROR, WARNING
from jtqd.daemon.shared.reasons import contact_line, contact_of, silent_s
from jtqd.daemon.shared.runtime_dir import About
from jtqd.daemon.shared.snapshot import LATE_BIN_NS, WORK_BIN_NS, SnapshotReader, View
from jtqd.daemon.supervisor.display import COLOURS, PrintableView, first_that_fits, plain_line
from jtqd.drivers import nmt
from jtqd.estimator.command_line import command_parser
from jtqd.estimator.status import NAMES, PUBLISHED
from jtqd.estimator.text import NOTHING, counted, duration, number, percent, size

_EXAMPLES: Final = """examples:
  jtq status                     live view of the daemon on this machine; Ctrl-C ends the view
  jtq status --bus can0          of the daemon on can0
  jtq status --once              one text output, also for a file or a mail
  jtq status --json | jq '.joints[].torque_nm'

exit status: 0 running, 1 no daemon runs (or none that you may read), 2 usage, 3 stalled or still starting
you may read your own daemons, and those of root and of the services of your groups (usermod -a -G jtqd YOU)"""
_FAULTS: Final = shown_in(Shown.STATUS)
"""Counters shown when they are not zero."""
_LAST_NOTICES: Final = 4
_PERIOD_S: Final = 0.2
_PLAIN_PERIOD_S: Final = 1.0
_BETWEEN_S: Final = 0.3
"""Between the two readings of one view: bus load and reasons need what has changed."""
WINDOW_S: Final = 10.0
"""Of the sparklines and maxima of a live view: its counters are those since the start of the daemon."""
_HEAD: Final = "bold"
_HEADING: Final = 9
"""Width of the headings of lines."""
_FOOT_LINES: Final = 2
_BLOCKS: Final = "▁▂▃▄▅▆▇█"
_BAD: Final = "bold red"
_QUANTITIES: Final = {
    "torque": ("torque_nm", "Nm", 2),
    "sigma": ("sigma_nm", "Nm", 2),
    "sensor": ("reference_nm", "Nm", 2),
    "age": ("age_ms", "ms", 2),
    "current": ("current_a", "A", 2),
    "motor": ("motor_velocity_rad_s", "rad/s", 1),
    "temp.": ("temperature_c", "°C", 1),
}
"""Column of the joints -> its key in `content`, unit, decimals."""


# ---- terminal ----


class Columns:
    """A table that drops columns, in the order of `dispensable`, where the terminal is too narrow for all.

    Nothing is cut, and a line below names the columns that are not shown. left: number of columns aligned to the left.
    """

    def __init__(self, headings: Sequence[str], left: int, dispensable: tuple[str, ...]) -> None:
        self._headings, self._left, self._dispensable = headings, left, dispensable
        self._rows: list[Sequence[str | Text]] = []

    def add(self, *cells: str | Text) -> None:
        """Add a row, one cell per heading."""
        self._rows.append(cells)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the width of the terminal (called by rich)."""
        tables = [self._table(self._dispensable[:n]) for n in range(len(self._dispensable) + 1)]
        shown = first_that_fits(tables, console, options) or tables[-1]
        yield shown
        if dropped := self._dispensable[: tables.index(shown)]:
            names = [name for name in self._headings if name in dropped]
            yield Text(f"no room for: {', '.join(names)}", style="dim")

    def _table(self, dropped: Sequence[str]) -> Table:
        table = Table(
            box=None, pad_edge=False, padding=(0, 2, 0, 0), collapse_padding=True, header_style=_HEAD
        )
        shown = [n for n, name in enumerate(self._headings) if name not in dropped]
        for n in shown:
            table.add_column(self._headings[n], justify="left" if n < self._left else "right", no_wrap=True)
        for row in self._rows:
            table.add_row(*(row[n] for n in shown))
        return table


def _line(heading: str, text: str | Text, style: str = "") -> RenderableType:
    """Return a heading of fixed width and text that wraps beside it."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=_HEADING, no_wrap=True, style=_HEAD)
    grid.add_column(overflow="fold", style=style)
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


# ---- last seconds of a live view ----


class Recent:
    """Readings of the last WINDOW_S seconds, each with its time [s]."""

    def __init__(self) -> None:
        self._readings: deque[tuple[float, Reading]] = deque()

    def add(self, time_s: float, reading: Reading) -> None:
        """Add a reading and drop those older than the window; a histogram that has shrunk is that of another daemon."""
        readings = self._readings
        if readings and sum(reading.work) < sum(readings[-1][1].work):
            readings.clear()
        readings.append((time_s, reading))
        while time_s - readings[0][0] > WINDOW_S:
            readings.popleft()

    @property
    def seconds(self) -> float:
        """Time from the first reading to the last [s]."""
        return self._readings[-1][0] - self._readings[0][0] if self._readings else 0.0

    def torques(self, joint: int) -> list[float]:
        """Return the torques of a joint (0, 1, ...) [Nm], oldest first; NaN: none."""
        joints = (view.joints for _, each in self._readings if (view := each.view) is not None)
        seen = (each[joint] for each in joints if joint < len(each))
        return [each.torque_nm if each.status in PUBLISHED else nan for each in seen]

    @property
    def contacts(self) -> int:
        """Number of contacts that have begun in the window."""
        views = [each.view for _, each in self._readings if each.view is not None]
        return views[-1].counters["contacts"] - views[0].counters["contacts"] if views else 0

    def largest_us(self, bin_us: float, *, late: bool) -> float | None:
        """Return the upper edge of the largest work time (or lateness) in the window [us]; None without a cycle."""
        if not self._readings:
            return None
        first, last = self._readings[0][1], self._readings[-1][1]
        before, now = (first.late, last.late) if late else (first.work, last.work)
        grown = [n for n, (old, new) in enumerate(zip(before, now, strict=True)) if new > old]
        return (grown[-1] + 1) * bin_us if grown else None


# ---- view ----


def _ago(now_ns: int, then_ns: int) -> str:
    return duration((now_ns - then_ns) * 1e-9)


class StatusView:
    """Rich view of one reading; recent: the last seconds of a live view."""

    def __init__(self, reading: Reading, recent: Recent | None = None) -> None:
        self._reading, self._recent = reading, recent

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the width of the terminal (called by rich)."""
        reading, width = self._reading, options.max_width
        about, view, data = reading.daemon.about, reading.view, content(reading)
        yield _title(about, view)
        still = reading.state != RUNNING
        if still:
            yield Text(f"NOT RUNNING: {reading.why}" if view else reading.why, style=_BAD)
        if view is None:
            return
        now_ns = time.monotonic_ns()
        conditions = (
            (SEVERITIES[each.severity], f"{each.line} (for {_ago(now_ns, each.since_ns)})", each.severity)
            for each in reading.conditions
        )
        notices = (
            (time.strftime("%H:%M:%S", time.localtime(each.realtime_ns * 1e-9)), each.text, each.level)
            for each in reading.notices[-_LAST_NOTICES:]
        )
        details = () if still else _details(about, view, data["joints"], self._recent, width)
        for section in (
            [_joints(data["joints"], still=still), *details],
            [_inputs(data["inputs"], view.period_s)],
            [*_loop(reading, view.counters, width), *_bus(data, view.counters)],
            [_nodes(data["nodes"], about, view)],
            [*_recorder(data["recorder"])],
            [_line(heading, text, _style_of(level)) for heading, text, level in conditions],
            [_line(heading, text, _style_of(level)) for heading, text, level in notices],
        ):
            if section:
                yield ""
                yield from section


def _title(about: About, view: View | None) -> Text:
    text = Text(f"jtqd on {about.instance}", style=_HEAD, overflow="fold")
    text.append(f"  node {about.node:02X}h  {about.method}  pid {about.pid}", style="")
    if view is not None:
        text.append(f"  cycle {view.cycle}  up {duration(view.cycle * view.period_s)}", style="")
    text.append(f"\n{about.configuration}  {about.configuration_sha256[:8]}", style="dim")
    return text


def _joints(joints: Sequence[Mapping[str, Any]], *, still: bool) -> Columns:
    dispensable = ("age", "with a torque", "motor", "temp.", "current", "sensor", "sigma")
    table = Columns(("joint", "status", *_QUANTITIES, "with a torque"), 2, dispensable)
    for each in joints:
        values = each if each["torque_nm"] is not None else {**each, "age_ms": None}
        published = sum(each["cycles"].get(NAMES[code], 0) for code in PUBLISHED)
        share = percent(published / max(1, sum(each["cycles"].values())))
        style = "dim" if still else COLOURS.get(each["status"], _BAD)
        shadows = ((f"  {name}", shadow, "dim", "") for name, shadow in each["shadow"].items())
        for title, of_row, colour, last in (
            (f"{each['joint']} {each['name']}", values, style, share),
            *shadows,
        ):
            known = ((of_row.get(key), n, unit) for key, unit, n in _QUANTITIES.values())
            cells = (NOTHING if value is None else f"{number(value, n)} {unit}" for value, n, unit in known)
            table.add(title, Text(of_row["status"], style=colour), *cells, last)
    return table


def _details(
    about: About, view: View, joints: Sequence[Mapping[str, Any]], recent: Recent | None, width: int
) -> Iterator[RenderableType]:
    """Return status with its reason, zeros and contact of each joint, and what a live view remembers.

    A joint always has its line, so that the view keeps its height. A short contact falls between two readings: contacts
    are counted as well.
    """
    for each in joints:
        status, why = each["status"], each["reason"]
        lasting = (f"{status} for {duration(each['since_s'])}", COLOURS.get(status, _BAD))
        yield Text.assemble(f"joint {each['joint']} ", lasting, f": {why}" if why else "")
    for each in joints:
        if each["shadow"]:
            errors = {about.method: each, **each["shadow"]}
            found = (f"{name} {number(one['rmse_nm'] or nan)}" for name, one in errors.items())
            yield _line(
                f"RMSE {each['joint']}", f"{', '.join(found)} Nm, each against the sensor as old as it"
            )
    for joint, zeros in zip(about.joints, view.zeros, strict=False):
        if zeros.tracked:
            yield _line(f"zeros {joint.number}", zeros.text, "" if zeros.plausible else "yellow")
    watched = False
    for joint, seen in zip(about.joints, view.joints, strict=False):
        if joint.contact_threshold_nm is not None:
            watched, contact = True, contact_of(seen)
            style = _BAD if contact else "yellow" if contact is None else ""
            yield _line(f"contact {joint.number}", contact_line(seen, joint.contact_threshold_nm), style)
    if watched:
        text = Text(f"{view.counters['contacts'] or 'none'} since the start")
        if recent is not None:
            style = _BAD if recent.contacts else ""
            text.append(f", {recent.contacts} in the last {recent.seconds:.0f} s", style=style)
        yield _line("contacts", text)
    if recent is not None:
        yield from _last_seconds(recent, len(joints), width)


def _last_seconds(recent: Recent, joints: int, width: int) -> Iterator[RenderableType]:
    """Return the torque of each joint as a sparkline, and the slowest cycle, of the last seconds."""
    columns = min(50, max(10, width - 40))
    for joint in range(joints):
        torques = recent.torques(joint)
        known = [each for each in torques if isfinite(each)]
        extent = f"{min(known):.2f} to {max(known):.2f} Nm" if known else "no torque"
        yield _line(f"torque {joint + 1}", Text.assemble((sparkline(torques, columns), "cyan"), f" {extent}"))
    work = recent.largest_us(WORK_BIN_NS / 1000, late=False)
    late = recent.largest_us(LATE_BIN_NS / 1000, late=True)
    if work is not None and late is not None:
        text = f"work at most {work:.0f} us, SYNC late by at most {late:.0f} us"
        yield _line(f"last {recent.seconds:.0f} s", text)


def _inputs(inputs: Sequence[Mapping[str, Any]], period_s: float) -> Columns:
    headings = ("input", "age", "after SYNC", "usual", "missed", "late", "lost", "twice", "wrong")
    table = Columns(headings, 1, ("wrong", "twice", "usual", "lost", "late"))
    for each in inputs:
        age_s, usual = each["age_s"], each["usual_us"]
        old = age_s is None or age_s > 2 * 8 * period_s  # read every 8th cycle
        table.add(
            each["name"],
            Text("never" if age_s is None else duration(age_s), style=_BAD if old else ""),
            NOTHING if age_s is None else after_sync(each["after_sync_us"]),
            f"{usual[0]:.0f}..{usual[1]:.0f} us" if usual else NOTHING,
            *(str(each[key]) for key in ("missed", "late", "lost", "duplicates", "rejected")),
        )
    return table


def after_sync(delay_us: float) -> str:
    """Return the arrival of an input after its SYNC; the age of an acyclic input, which arrived before it.

    >>> after_sync(426.0), after_sync(-4803.0)
    ('426 us', '4803 us old')
    """
    return f"{delay_us:.0f} us" if delay_us >= 0 else f"{-delay_us:.0f} us old"


def _loop(reading: Reading, counters: Mapping[str, int], width: int) -> Iterator[RenderableType]:
    columns = min(60, max(10, width - 66))
    for name, values, bins, bin_ns in (
        ("work", reading.work_us, reading.work, WORK_BIN_NS),
        ("lateness", reading.late_us, reading.late, LATE_BIN_NS),
    ):
        p50, p99, largest = (number(each, 0) for each in values)
        text = f"p50 {p50}  p99 {p99}  max {largest} us"
        yield _line(name, Text.assemble(text.ljust(31), (histogram(bins, bin_ns / 1000, columns), "cyan")))
    cycles, missed = counters["cycles"], counters["missed"]
    incomplete = cycles - counters["complete"]
    shown = Text(f"{missed} of {max(1, cycles + missed)} cycles", style="yellow" if missed else "")
    shown.append(f", an input missing in {incomplete}", style="yellow" if incomplete else "default")
    yield _line("missed", shown)


def _bus(data: Mapping[str, Any], counters: Mapping[str, int]) -> Iterator[RenderableType]:
    """Return load, state and error frames of the bus, where they are known, and the counters of faults."""
    load, state = data["bus_load"], data["bus_state"]
    now = percent(nan if load["now"] is None else load["now"])
    worst = percent(load["worst_case"])
    yield _line("bus load", f"{now} now, with worst-case stuff bits; {worst} by configuration")
    if state.get("state") is not None:
        names = ("protocol_errors", "no_acknowledge", "overruns", "bus_offs")
        errors = sum(state.get("counts", {}).get(name, 0) for name in names)
        yield _line("bus state", f"{state['state']}, {counted(errors, 'error frame')}")
    faults = [f"{name.replace('_', ' ')} {counters[name]}" for name in _FAULTS if counters[name]]
    if faults:
        yield _line("counted", ", ".join(faults))


def _nodes(nodes: Sequence[Mapping[str, Any]], about: About, view: View) -> Columns:
    table = Columns(("node", "what", "state", "heartbeat"), 3, ("what",))
    for each in nodes:
        age_s, name = each["heartbeat_age_s"], each["state"] or "?"
        state = Text("no heartbeat yet" if age_s is None else name)
        if silent_s(view, each["node"], about.heartbeat_ms) is not None:
            state = Text(f"silent, last {name}", style=_BAD)
        elif not each["configured"]:
            state = Text("restarted, not configured yet", style=_BAD)
        elif age_s is not None and name != nmt.STATES[nmt.OPERATIONAL]:
            state.stylize("yellow")
        heard = NOTHING if age_s is None else f"{duration(max(0.0, age_s))} ago"
        table.add(f"{each['node']:02X}h", each["what"], state, heard)
    return table


def _recorder(log: Mapping[str, Any] | None) -> Iterator[RenderableType]:
    if log is None:
        yield _line("recorder", "no recording")
        return
    lost = (f"{log['lost']} lost", _BAD if log["lost"] else "")
    discarded = f", {log['let_go']} discarded (flight recorder)" if log["let_go"] else ""
    written = f"{counted(log['written'], 'cycle')} written, "
    yield _line("recorder", Text.assemble(written, lost, f"{discarded}, {size(log['bytes'])} in this file"))
    yield _line("", log["path"] or "no file is being written")
    yield _line("disk", f"{size(log['disk_free'])} free of {size(log['disk_size'])}")


def _style_of(level: int) -> str:
    return _BAD if level >= ERROR else "yellow" if level >= WARNING else ""


# ---- command ----


def parser() -> argparse.ArgumentParser:
    """Return the arguments of `jtq status`."""
    result = command_parser(
        "jtq status",
        "Show the state of a running jtqd: torque, status with its reason, inputs, timing, bus, nodes, log.",
        _EXAMPLES,
    )
    bus = "bus of the daemon: can0, unix:PATH or sim (default: the only running one)"
    result.add_argument("--bus", help=bus)
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
        console = Console(markup=False)
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
        Console(markup=False).print(PrintableView(StatusView(reading)))
    return 0 if reading.state == RUNNING else 3


def _live(console: Console, daemon: Daemon) -> int:
    """Show the live view until Ctrl-C; a restarted daemon is found again."""
    watch, recent, number = Watch(daemon), Recent(), 0
    with Keys() as keys, Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            if daemon.about.running():
                reading = watch.read()
                if reading.state == RUNNING:
                    recent.add(time.monotonic(), reading)
                shown, number = paged(console, PrintableView(StatusView(reading, recent)), number)
                live.update(shown, refresh=True)
            else:
                ended = f"jtqd on {daemon.about.instance} has ended; waiting for its restart"
                live.update(ended, refresh=True)
                again = on_bus(find_daemons(), daemon.about.instance)
                if again is not None:
                    daemon, watch, recent = again, Watch(again), Recent()
            number += keys.turned(_PERIOD_S)


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


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
