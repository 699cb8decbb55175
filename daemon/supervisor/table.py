"""Live table of the running loop on a terminal; a line every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterable
from types import TracebackType

from rich.box import HEAVY_HEAD, Box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from jtqd.daemon.shared.events import OperatorLog, Priority
from jtqd.daemon.shared.reasons import contact_of, contact_text
from jtqd.daemon.shared.snapshot import JointView, SnapshotReader, View
from jtqd.estimator.status import NAMES, PUBLISHED
from jtqd.estimator.text import number, percent

COLOURS = {"valid": "green", "degraded": "yellow", "standstill": "cyan", "starting": "blue", "off": "dim"}
"""Style of a status; what is not here is bad news."""

_COLUMNS = {
    "joint": 5,
    "torque [Nm]": 10,
    "sigma [Nm]": 10,
    "sensor [Nm]": 10,
    "error [Nm]": 10,
    "contact": 8,
    "status": max(map(len, NAMES.values())),
}
"""Heading and least width, so that the table does not jump when a value gets longer."""
_DISPENSABLE = ("sensor [Nm]", "error [Nm]", "sigma [Nm]")
_CONTACT = "contact"
"""A column, and in the line below a count, where contacts are watched."""


def bus_load(previous: View, now: View, bitrate: int) -> float:
    """Return the bus load between two views with worst-case stuffing; NaN without time in between."""
    seconds = (now.sync_realtime_ns - previous.sync_realtime_ns) * 1e-9
    bits = now.counters["bits_worst_case"] - previous.counters["bits_worst_case"]
    return bits / seconds / bitrate if previous.sync_realtime_ns and seconds > 0 else float("nan")


def first_that_fits(tables: Iterable[Table], console: Console, options: ConsoleOptions) -> Table | None:
    """Return the first of the tables that the terminal has room for without cutting; None: none of them."""
    unlimited = options.update(max_width=1000)
    fitting = (
        table for table in tables if Measurement.get(console, unlimited, table).maximum <= options.max_width
    )
    return next(fitting, None)


class LiveTable:
    """Live table of the loop, as wide as the terminal allows; the status is shown at any width.

    In a narrow terminal columns go in the order of `_DISPENSABLE`, then the frame, and in the end each joint is a line.
    """

    def __init__(
        self,
        reader: SnapshotReader,
        previous: View,
        view: View,
        bitrate: int,
        title: str,
        *,
        contacts: bool = False,
    ) -> None:
        self._title = title
        self._columns = [name for name in _COLUMNS if contacts or name != _CONTACT]
        self._line = loop_line(reader, previous, view, bitrate, contacts=contacts)
        self._rows = [_cells(number, joint) for number, joint in enumerate(view.joints, start=1)]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the width of the terminal (called by rich)."""
        yield self._widest_that_fits(console, options)
        yield Text(self._line)

    def _widest_that_fits(self, console: Console, options: ConsoleOptions) -> RenderableType:
        tables = (
            self._table([name for name in self._columns if name not in _DISPENSABLE[:dropped]], box)
            for dropped in range(len(_DISPENSABLE) + 1)
            for box in ((HEAVY_HEAD, None) if dropped == len(_DISPENSABLE) else (HEAVY_HEAD,))
        )
        table = first_that_fits(tables, console, options)
        if table is not None:
            return table
        lines = (
            Text.assemble(
                f"{row['joint']}: {_with_unit(row['torque [Nm]'])}", row["status"], self._touched(row)
            )
            for row in self._rows
        )
        return Group(self._title, *lines)

    def _touched(self, row: dict[str, str | Text]) -> str | Text:
        shown = row[_CONTACT]
        there = _CONTACT in self._columns and isinstance(shown, Text)
        return Text.assemble(" contact ", shown) if there else ""

    def _table(self, names: list[str], box: Box | None) -> Table:
        table = Table(title=self._title, title_justify="left", box=box, pad_edge=box is not None)
        for name in names:
            table.add_column(
                name, justify="right" if "[Nm]" in name else "left", min_width=_COLUMNS[name], no_wrap=True
            )
        for row in self._rows:
            table.add_row(*(row[name] for name in names))
        return table


def _cells(joint_number: int, joint: JointView) -> dict[str, str | Text]:
    """Return the cells of one joint."""
    name = NAMES.get(joint.status, str(joint.status))
    known = joint.status in PUBLISHED
    touched = contact_text(joint)
    return {
        "joint": str(joint_number),
        "torque [Nm]": number(joint.torque_nm) if known else "-",
        "sigma [Nm]": number(joint.sigma_nm) if known else "-",
        "sensor [Nm]": number(joint.reference_nm),
        "error [Nm]": number(joint.torque_nm - joint.reference_nm) if known else "-",
        _CONTACT: Text(touched, style="bold red") if contact_of(joint) else touched,
        "status": Text(name, style=COLOURS.get(name, "bold red")),
    }


def loop_line(reader: SnapshotReader, previous: View, view: View, bitrate: int, *, contacts: bool) -> str:
    """Return cycle time, missed cycles, bus load and, where they are watched, contacts in one line."""
    p50, p99, worst = reader.work_us(0.5, 0.99, 1.0)
    counters = view.counters
    load = bus_load(previous, view, bitrate)
    return (
        f"cycle {counters['cycles']}  work p50 {p50:.0f} us, p99 {p99:.0f} us, max {worst:.0f} us  "
        f"missed {counters['missed']}  stale inputs {counters['stale_inputs']}  bus load {percent(load)}"
        + (f"  contacts {counters['contacts']}" if contacts else "")
    )


def plain_line(
    reader: SnapshotReader, previous: View, view: View, bitrate: int, *, contacts: bool = False
) -> str:
    """Return the state as one line without control characters, for a log."""
    joints = "  ".join(f"joint {n} {_plain(joint)}" for n, joint in enumerate(view.joints, start=1))
    return f"{joints}  {loop_line(reader, previous, view, bitrate, contacts=contacts)}"


def _plain(joint: JointView) -> str:
    name = NAMES.get(joint.status, str(joint.status))
    touched = f", contact {contact_text(joint)}" if contact_of(joint) else ""
    if joint.status not in PUBLISHED:
        return name + touched
    return f"{name} {number(joint.torque_nm)} +- {number(joint.sigma_nm)} Nm{touched}"


def _with_unit(torque: str | Text) -> str:
    return "" if str(torque) == "-" else f"{torque} Nm "


_TABLE_PERIOD_S = 0.2
_LOG_PERIOD_S = 5.0


class Display:
    """Use it as a context manager; `turn` whenever there is time.

    Args:
        reader: of the loop's snapshot.
        bitrate: of the bus [bit/s].
        title: of the table.
        log: takes the lines.
        contacts: they are watched.
    """

    def __init__(
        self, reader: SnapshotReader, bitrate: int, title: str, log: OperatorLog, *, contacts: bool = False
    ) -> None:
        console = Console(stderr=True)
        self._terminal = console.is_terminal
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._reader, self._bitrate, self._title, self._log = reader, bitrate, title, log
        self._contacts = contacts
        self._previous = reader.read()
        self._shown = time.monotonic()

    def __enter__(self) -> Display:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def turn(self, now: float) -> None:
        """Show what is due at `now` (CLOCK_MONOTONIC [s])."""
        if now - self._shown < (_TABLE_PERIOD_S if self._terminal else _LOG_PERIOD_S):
            return
        view = self._reader.read()
        if self._terminal:
            table = LiveTable(
                self._reader, self._previous, view, self._bitrate, self._title, contacts=self._contacts
            )
            self._live.update(table, refresh=True)
        else:
            line = plain_line(self._reader, self._previous, view, self._bitrate, contacts=self._contacts)
            self._log(line.removeprefix("jtqd: "), Priority.INFO)
        self._previous, self._shown = view, now
