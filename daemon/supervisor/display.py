"""What the operator sees of a run: the live table on a terminal or a line every few seconds, and the final summary."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import starmap
from math import inf, isfinite
from types import TracebackType
from typing import Any

from rich.box import HEAVY_HEAD, Box
from rich.console import Console, ConsoleOptions, Group, JustifyMethod, RenderableType, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from jtqd.daemon.shared.conditions import CATALOGUE, Occurrences
from jtqd.daemon.shared.counters import Shown, shown_in
from jtqd.daemon.shared.events import INFO, OperatorLog, Priority
from jtqd.daemon.shared.reasons import contact_of, contact_text
from jtqd.daemon.shared.snapshot import JointView, ShadowView, SnapshotReader, View, bus_load
from jtqd.estimator.status import NAMES, PUBLISHED, STALE
from jtqd.estimator.text import counted, finite, number, percent, printable

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
        self._rows = [
            cells
            for number, joint in enumerate(view.joints, start=1)
            for cells in (_cells(number, joint), *starmap(_shadow_cells, view.shadows[number - 1].items()))
        ]

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
        return Group(self._title, *map(self._short, self._rows))

    def _short(self, row: dict[str, str | Text]) -> Text:
        """Return a joint as one line."""
        torque, contact = row["torque [Nm]"], row[_CONTACT]
        line = Text.assemble(f"{row['joint']}: ", "" if torque == "-" else f"{torque} Nm ", row["status"])
        there = _CONTACT in self._columns and isinstance(contact, Text)
        return Text.assemble(line, " contact ", contact) if there else line

    def _table(self, names: list[str], box: Box | None) -> Table:
        table = Table(title=self._title, title_justify="left", box=box, pad_edge=box is not None)
        for name in names:
            side: JustifyMethod = "right" if "[Nm]" in name else "left"
            table.add_column(name, justify=side, min_width=_COLUMNS[name], no_wrap=True)
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


def _shadow_cells(method: str, shadow: ShadowView) -> dict[str, str | Text]:
    """Return the cells of one shadow method, below those of its joint."""
    name = NAMES.get(shadow.status, str(shadow.status))
    return {
        "joint": method,
        "torque [Nm]": number(shadow.torque_nm),
        "sigma [Nm]": number(shadow.sigma_nm),
        "sensor [Nm]": number(shadow.reference_nm),
        "error [Nm]": number(shadow.torque_nm - shadow.reference_nm),
        _CONTACT: "",
        "status": Text(name, style="dim"),
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


_TABLE_PERIOD_S = 0.2
_LOG_PERIOD_S = 5.0


class PrintableView:
    """A view whose texts are `printable`; markup in them is text on a console with `markup=False`."""

    def __init__(self, view: RenderableType) -> None:
        self._view = view

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render what is inside (called by rich)."""
        for text, style, control in console.render(self._view, options):
            yield Segment(text if control else printable(text), style, control)


class Display:
    """Use it as a context manager; `turn` whenever there is time. bitrate [bit/s]; contacts: they are watched."""

    def __init__(
        self, reader: SnapshotReader, bitrate: int, title: str, log: OperatorLog, *, contacts: bool = False
    ) -> None:
        console = Console(stderr=True, markup=False)
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
            self._live.update(PrintableView(table), refresh=True)
        else:
            line = plain_line(self._reader, self._previous, view, self._bitrate, contacts=self._contacts)
            self._log(line.removeprefix("jtqd: "), Priority.INFO)
        self._previous, self._shown = view, now


# The final summary ----


def _against_sensor(rmse_nm: float, now_nm: float, age_ms: float) -> str:
    """Return the RMSE in motion against the sensor as old as the estimate, and against the sensor now."""
    if not isfinite(rmse_nm):
        return "no reference"
    older = f", both {age_ms:.2f} ms old ({now_nm:.3f} Nm against it now)" if age_ms > 0.0 else " now"
    return f"{rmse_nm:.3f} Nm against the sensor in motion{older}"


_LOST = 0.05
"""Share of missed slots beyond which real time is reported as not kept."""


@dataclass(frozen=True)
class Summary:
    """Final figures of one run."""

    view: View
    """Last reading of the snapshot."""
    work_us: Sequence[float]
    late_us: Sequence[float]
    """p50, p99 and maximum of the work per cycle and of the SYNC's lateness [us]."""
    refused: Sequence[str] = ()
    """Real-time settings that the kernel did not grant."""
    recording: dict[str, Any] | None = None
    """The recorder's account; None where nothing was recorded."""
    error: str | None = None
    inputs: dict[str, dict[str, int]] = field(default_factory=dict)
    """Late, lost, duplicate and rejected frames of each PDO by its name."""
    conditions: Sequence[Occurrences] = ()
    """Those that were present at any time; `first_s` counts from the begin of the run."""
    stolen_s: float = 0.0
    """Processor time that a hypervisor took."""
    contacts: bool = False
    """They were watched."""
    deadline_us: float = inf
    """After SYNC, for inputs."""
    bench: bool = False
    """The nodes were those of `--bus sim`."""

    @property
    def exit_status(self) -> int:
        """Return the exit status: 0 done, 1 ended by a failure or without an estimate, 3 cycles are missing in the log."""
        if self.error or self.no_estimate:
            return 1
        return 3 if self.recording is not None and self.recording.get("lost", 0) else 0

    @property
    def no_estimate(self) -> str:
        """Return what was late in a run that was stale for most of its time and had no estimate; "" for any other."""
        of_joints, cycles = self.view.status_cycles, self.view.counters["cycles"]
        stale = sum(each[STALE] for each in of_joints)
        if 2 * stale <= sum(map(sum, of_joints)) or any(each[s] for each in of_joints for s in PUBLISHED):
            return ""
        late, lost = (sum(each[kind] for each in self.inputs.values()) for kind in ("late", "lost"))
        inputs = f"inputs came later than {self.deadline_us:.0f} us after SYNC {late} times, and {lost} times not at all"
        if self._missed > _LOST or self.late_us[1] > self.deadline_us:
            who = f"this machine: {100.0 * self._missed:.0f} % of the slots missed, SYNC {self.late_us[1]:.0f} us late (p99)"
        else:
            who = (
                f"the {'emulated bench (on a busy machine)' if self.bench else 'bus or its nodes'}: {inputs}"
            )
        return f"in {cycles} cycles; late was {who}"

    @property
    def _missed(self) -> float:
        cycles, missed = self.view.counters["cycles"], self.view.counters["missed"]
        return missed / max(cycles + missed, 1)

    def content(self) -> dict[str, Any]:
        """Return the summary as plain data for JSON."""
        view, counters = self.view, self.view.counters
        deviations = Counter(
            {each.subject: each.times for each in self.conditions if each.name == "deviation"}
        )

        def by_joint(values: Iterable[Any]) -> dict[str, Any]:
            return {f"joint_{n}": value for n, value in enumerate(values, start=1)}

        return {
            "cycles": counters["cycles"],
            "missed": counters["missed"],
            "stale_inputs": counters["stale_inputs"],
            "work_us": dict(zip(("p50", "p99", "max"), map(finite, self.work_us), strict=True)),
            "late_us": dict(zip(("p50", "p99", "max"), map(finite, self.late_us), strict=True)),
            "rmse_nm": by_joint(map(finite, view.rmse_nm)),
            "rmse_now_nm": by_joint(map(finite, view.rmse_now_nm)),
            "shadow": by_joint(
                {name: each.content() for name, each in joint.items()} for joint in view.shadows
            ),
            "age_ms": by_joint(finite(each.age_ms) for each in view.joints),
            "zeros": by_joint(each.content() for each in view.zeros),
            "contacts": counters["contacts"] if self.contacts else None,
            "deviations": by_joint(deviations[f"joint {n}"] for n in range(1, len(view.joints) + 1)),
            "conditions": [
                each._asdict() | {"total_s": round(each.total_s, 3), "first_s": round(each.first_s, 3)}
                for each in self.conditions
            ],
            "counters": counters,
            "stolen_s": round(self.stolen_s, 2),
            "not_granted": list(self.refused),
            "inputs": self.inputs,
            "recording": self.recording,
            "no_estimate": self.no_estimate or None,
            "error": self.error,
        }

    def _timing(self) -> list[str]:
        counters = self.view.counters
        cycles, missed = counters["cycles"], counters["missed"]
        quantiles = "p50 {:.0f} us, p99 {:.0f} us, max {:.0f} us"
        lines = [
            f"cycles        {cycles}, missed {missed}, stale inputs {counters['stale_inputs']}",
            f"cycle work    {quantiles.format(*self.work_us)} (from wake-up to hand-over)",
            f"SYNC lateness {quantiles.format(*self.late_us)}",
        ]
        if self._missed > _LOST:
            why = " (jtqd was not granted all that it asked for)" if self.refused else ""
            text = f"not kept: {100.0 * self._missed:.0f} % of the slots missed{why}; jtq doctor looks at the machine"
            lines.append(f"real time     {text}")
        if self.stolen_s > 0.0:
            lines.append(f"processors    {self.stolen_s:.2f} s stolen by the hypervisor")
        return lines

    def _recorded(self) -> list[str]:
        account = self.recording
        if account is None:
            return ["log           none"]
        lost, parts = account.get("lost", 0), len(account.get("paths", ()))
        nothing = "no trigger" if account.get("flight_recordings") == 0 else "it could not be written"
        shown = account.get("path") or f"none: {account.get('error') or nothing}"
        shown += f" (the last of {parts} parts)" if parts > 1 else ""
        shown += f", {counted(lost, 'cycle')} lost" if lost else ""
        left = [f"              {each} (left by a killed recorder)" for each in account.get("left", [])]
        return [f"log           {shown}", *left]

    def text(self) -> str:
        """Return the summary as text."""
        view, counters, lines = self.view, self.view.counters, self._timing()
        errors = zip(view.rmse_nm, view.rmse_now_nm, view.joints, strict=False)
        for n, (rmse, now, joint) in enumerate(errors, start=1):
            lines.append(f"RMSE joint {n}  {_against_sensor(rmse, now, joint.age_ms)}")
            for name, shadow in view.shadows[n - 1].items():
                against = _against_sensor(shadow.rmse_nm, shadow.rmse_now_nm, shadow.age_ms)
                lines.append(f"  {name:<12}{against}")
        zeros = enumerate(view.zeros, start=1)
        lines += [f"zeros joint {joint} {each.text}" for joint, each in zeros if each.tracked]
        if self.contacts:
            lines.append(f"contacts      {counters['contacts'] or 'none'}")
        happened = [each for each in self.conditions if CATALOGUE[each.name].severity > INFO]
        for n, each in enumerate(happened):
            times = "once" if each.times == 1 else f"{each.times} times"
            lines.append(
                f"{'' if n else 'conditions':<13} {each.subject}: {each.name.replace('_', ' ')} {times}, "
                f"{each.total_s:.1f} s in all, first after {each.first_s:.1f} s"
            )
        for title, selected in (("no torque", Shown.SUMMARY_TORQUE), ("bus", Shown.SUMMARY_BUS)):
            found = [
                f"{name.removeprefix('fault_').replace('_', ' ')} {counters[name]}"
                for name in shown_in(selected)
                if counters[name]
            ]
            if found:
                lines.append(f"{title:<13} {', '.join(found)}")
        for name, counts in self.inputs.items():
            shown = ", ".join(f"{kind} {count}" for kind, count in counts.items() if count)
            if shown:
                lines.append(f"  {name:<24} {shown}")
        lines += self._recorded()
        if self.no_estimate:
            lines.append(f"no estimate   {self.no_estimate}")
        if self.error:
            lines.append(f"ended by      {self.error}")
        return "\n".join(lines)


def summary_of(
    reader: SnapshotReader,
    result: dict[str, Any],
    refused: list[str],
    recording: dict[str, Any] | None,
    *,
    history: Sequence[Occurrences],
    began_s: float,
    stolen_s: float,
    contacts: bool = False,
    deadline_us: float = inf,
    bench: bool = False,
) -> Summary:
    """Return the summary of a run from the snapshot and last answer of its loop; began_s: CLOCK_MONOTONIC."""
    return Summary(
        view=reader.read(),
        work_us=reader.work_us(0.5, 0.99, 1.0),
        late_us=reader.late_us(0.5, 0.99, 1.0),
        refused=refused,
        recording=recording,
        error=result.get("error") or result.get("failed"),
        inputs=result.get("counters", {}),
        conditions=tuple(each._replace(first_s=max(0.0, each.first_s - began_s)) for each in history),
        stolen_s=stolen_s,
        contacts=contacts,
        deadline_us=deadline_us,
        bench=bench,
    )
