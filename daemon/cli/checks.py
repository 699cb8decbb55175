"""Results of checks, and the checks of a bus and of timing: counts and measurements judged item by item. Pure."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.cli.traffic import NodeCount, PdoCount, TimeHistogram, Timing, Traffic, identifier_text
from jtqd.daemon.config import Config
from jtqd.daemon.shared.conditions import Condition
from jtqd.daemon.shared.events import ERROR
from jtqd.daemon.shared.snapshot import LATE_BIN_NS, View
from jtqd.daemon.supervisor.display import PrintableView
from jtqd.drivers import nmt
from jtqd.drivers.bus_load import LIMIT
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_SFF_MASK
from jtqd.drivers.pdo import SYNC_COB_ID
from jtqd.estimator.status import NAMES, PUBLISHED
from jtqd.estimator.text import counted, percent

GOOD, WARN, FAIL, SKIP = "GOOD", "WARN", "FAIL", "-"
"""SKIP: does not apply here; the text has the reason."""
_STYLES = {GOOD: "green", WARN: "yellow", FAIL: "bold red", SKIP: "dim"}
_EXIT_STATUS = {GOOD: 0, WARN: 3, FAIL: 1}


@dataclass(frozen=True)
class CheckResult:
    """Result of one item. hint: the remedy, empty if none is needed."""

    item: str
    level: str
    text: str
    hint: str = ""


def judge(item: str, text: str, *rules: tuple[object, str, str]) -> CheckResult:
    """Return the result by the first rule (condition, level, hint) whose condition is true, else GOOD."""
    for condition, level, hint in rules:
        if condition:
            return CheckResult(item, level, text, hint)
    return CheckResult(item, GOOD, text)


def worst(results: Iterable[CheckResult]) -> str:
    """Return the worst level: FAIL, WARN or GOOD."""
    levels = {each.level for each in results}
    return next((level for level in (FAIL, WARN) if level in levels), GOOD)


def report(results: Sequence[CheckResult], schema: str | None, **more: Any) -> int:
    """Print the results on standard output; return the exit status: 0 all good, 3 warnings, 1 failures.

    Args:
        results: in the order of the report.
        schema: print JSON of this schema; None prints a table.
        more: further keys of the JSON.
    """
    level = worst(results)
    if schema is None:
        show(Console(markup=False), results)
    else:
        items = [asdict(each) for each in results]
        print(json.dumps({"schema": schema, "result": level, **more, "items": items}))
    return _EXIT_STATUS[level]


def show(console: Console, results: Sequence[CheckResult]) -> None:
    """Print the table and a last line with the counts."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="bold")
    table.add_column(overflow="fold")
    for each, following in zip(results, (*results[1:], None), strict=True):
        text = Text(each.text)
        if each.hint and (following is None or following.hint != each.hint):  # one hint for a row of them
            text.append(f"\n> {each.hint}", style="italic")
        table.add_row(Text(each.level, style=_STYLES[each.level]), each.item, text)
    console.print(PrintableView(table))
    count = {level: sum(each.level == level for each in results) for level in (GOOD, WARN, FAIL)}
    level = worst(results)
    counts = f": {count[GOOD]} good, {counted(count[WARN], 'warning')}, {counted(count[FAIL], 'failure')}"
    console.print(Text.assemble((level, _STYLES[level]), counts))


SUCCESS_GOOD, SUCCESS_MANY, SUCCESS_FAIL = 0.99, 0.95, 0.90
"""Of complete cycles, as libfranka judges its communication test: below 0.95 "many lost", below 0.90 "not sufficient"."""
JITTER_WARN = 0.1
"""Of the period: the observer's step is then noticeably wrong for drives that sample at SYNC."""
RATE_TOLERANCE = 0.02
LATE_WARN, LATE_FAIL = 0.1, 0.5
"""Of the period, p99: noticeable, and as much as makes the loop skip a slot."""
MISSED_FAIL = 0.01
ECHO_WARN = 0.3
"""Of the period, p99: at 1 Mbit/s SYNC and a frame that is just being sent take up to 200 us."""
STOLEN_WARN = 0.001
_TIMING_HINT = "`jtq doctor` shows the missing real-time settings of this machine"
_HEARTBEAT_GAP = 1.5
_ERROR_CLASSES = {
    0x001: "transmit timeout",
    0x002: "arbitration lost",
    0x004: "controller warning or passive",
    0x008: "protocol violation",
    0x010: "transceiver",
    0x020: "no acknowledge",
    0x040: "bus-off",
    0x080: "bus error",
    0x100: "restarted after bus-off",
    0x200: "error counters",
}
"""Bits of an error message's identifier (linux/can/error.h)."""
_BUS_OFF, _NO_ACKNOWLEDGE = 0x040, 0x020


def check_bus(
    traffic: Traffic, config: Config, *, lost: int, error_frames: bool = True
) -> Iterator[CheckResult]:
    """Compare the traffic with the configuration.

    Args:
        traffic: counts of all frames received.
        config: configuration of the bus.
        lost: frames that this process read too late.
        error_frames: the bus can report errors.
    """
    yield _sync(traffic, config)
    for pdo in traffic.inputs.values():
        yield _input(pdo, traffic, config)
    for cob_id in traffic.estimates:
        yield _estimate(traffic, config, cob_id)
    yield _success(traffic)
    for node in traffic.nodes.values():
        yield _heartbeat(node, traffic, config)
    yield _load(traffic, config)
    yield _foreign(traffic)
    yield (
        _errors(traffic)
        if error_frames
        else CheckResult("error frames", SKIP, "a unix bus has no error frames")
    )
    if lost:
        text = f"read too late and lost {counted(lost, 'frame')}: this may explain missing frames above"
        hint = "run it on an idle machine, or give it real-time priority"
        yield CheckResult("this check", WARN, text, hint)


def _sync(traffic: Traffic, config: Config) -> CheckResult:
    if traffic.syncs < 2:
        hint = "start jtqd, or let this check boot the nodes and send SYNC: --drive-sync"
        return CheckResult("SYNC", FAIL, "none on the bus", hint)
    period_us, jitter = config.period_ns / 1000, traffic.sync_jitter
    text = f"{traffic.sync_rate:.1f} per s, expected {1e6 / period_us:.0f}; off the period: {jitter}"
    too_many, jumps = traffic.cycles - traffic.slots, traffic.counter_jumps
    second = jumps or too_many > (1 - SUCCESS_GOOD) * traffic.cycles
    many = -too_many > (1 - SUCCESS_GOOD) * traffic.slots
    if second:
        text += f"; {counted(jumps, 'jump')} of its counter"
    elif too_many < 0:
        text += f"; {-too_many} of {traffic.slots} slots without one"
    return judge(
        "SYNC",
        text,
        (second, FAIL, "possibly a second SYNC producer, or a restarted one (candump can0,080:7FF)"),
        (too_many < 0, FAIL if many else WARN, "the sender missed slots: check its timing and `jtq doctor`"),
        (
            jitter.quantile_us(0.99) > JITTER_WARN * period_us,
            WARN,
            "the sender wakes up late: `jtq doctor` shows the missing real-time settings",
        ),
    )


def _input(pdo: PdoCount, traffic: Traffic, config: Config) -> CheckResult:
    cycles, name = traffic.cycles, pdo.name
    if not cycles:
        if pdo.frames:
            return CheckResult(name, WARN, f"{pdo.frames} without any SYNC")
        return CheckResult(name, SKIP, "no SYNC on the bus")
    hint = "check that the node is on the bus and operational"
    if pdo.age_ns:
        return _acyclic(pdo, traffic) if pdo.delays.count else CheckResult(name, FAIL, "none", hint)
    if not pdo.delays.count:
        length = f", {pdo.wrong_length} of a wrong length" if pdo.wrong_length else ""
        hint += ", and that its TPDO has transmission type 1 (SYNC)"
        return CheckResult(name, FAIL, f"none{length}", hint)
    faults = {"missing": pdo.missing, "late": pdo.late, "twice": pdo.twice, "wrong length": pdo.wrong_length}
    found = ", ".join(f"{kind} {count}" for kind, count in faults.items() if count)
    bad = (pdo.missing + pdo.late + pdo.twice) / cycles
    only_late = not pdo.missing + pdo.twice + pdo.wrong_length
    level = FAIL if bad > 1 - SUCCESS_FAIL or pdo.wrong_length else WARN
    mapping = f"its mapping differs from the configuration ({pdo.length} bytes): jtqd configures it when it boots the node"
    deadline = (
        f"after the deadline of {config.input_deadline_ns / 1000:.0f} us: less load (`jtq bus-load`), or a higher priority "
        "(lower COB-ID)"
    )
    return judge(
        name,
        f"{pdo.counted / cycles:.4g} per SYNC, expected 1; after SYNC: {pdo.delays}"
        + (f"; {found} of {cycles} cycles" if found else ""),
        (only_late and bad <= 1 - SUCCESS_GOOD, GOOD, ""),  # a few late frames are within the success rate
        (pdo.wrong_length, level, mapping),
        (
            pdo.twice,
            level,
            "two nodes with one node-ID, or an event-driven TPDO: transmission type must be 1",
        ),
        (pdo.late > pdo.missing, level, deadline),
        (True, level, "frames are lost: check error frames, termination and the interface's txqueuelen"),
    )


def _acyclic(pdo: PdoCount, traffic: Traffic) -> CheckResult:
    """Judge a PDO of transmission type 0, 254 or 255 by its age at SYNC: it belongs to no cycle."""
    cycles, limit = traffic.cycles, f"{pdo.age_ns / 1e6:g} ms"
    text = f"{pdo.counted / cycles * traffic.sync_rate:.4g} per s, sent by the drive itself; age at SYNC: {pdo.delays}"
    if not pdo.missing and not pdo.wrong_length:
        return CheckResult(pdo.name, GOOD, f"{text}, at most {limit}")
    text += f", older than {limit} in {pdo.missing} of {cycles} cycles"
    text += f"; wrong length {pdo.wrong_length}" if pdo.wrong_length else ""
    level = FAIL if pdo.missing / cycles > 1 - SUCCESS_FAIL or pdo.wrong_length else WARN
    hint = (
        "joint_N.max_age_ms is below the longest time between two frames: its event timer (180xh:5) must be shorter, or "
        "max_age_ms longer"
    )
    return CheckResult(pdo.name, level, text, hint)


def _estimate(traffic: Traffic, config: Config, cob_id: int) -> CheckResult:
    pdo, cycles = traffic.estimates[cob_id], max(1, traffic.cycles)
    if not pdo.frames:
        return CheckResult(pdo.name, SKIP, "no jtqd on the bus")
    shares, shown = [], []
    for number, count in traffic.statuses_in(cob_id).items():
        shares.append(sum(count[code] for code in PUBLISHED) / max(1, sum(count.values())))
        others = [(n, code) for code, n in count.items() if code not in PUBLISHED]
        most = f" ({NAMES.get(max(others)[1], '?')} {max(others)[0]})" if others else ""
        shown.append(f"joint {number} {percent(shares[-1])}{most}")
    text = f"{pdo.counted / cycles:.4g} per SYNC; with a torque: {', '.join(shown)}"
    late = pdo.delays.quantile_us(0.99) > config.period_ns / 1000
    if pdo.missing > (1 - SUCCESS_GOOD) * cycles or late:
        missing = f"{text}; missing in {pdo.missing} of {traffic.cycles} cycles"
        return CheckResult(pdo.name, WARN, missing, "see `jtq status`")
    hint = "`jtq status` gives the reason for the missing torque"
    return judge(pdo.name, text, (min(shares) < SUCCESS_GOOD, WARN, hint))


def _success(traffic: Traffic) -> CheckResult:
    if not traffic.cycles:
        return CheckResult("success rate", SKIP, "no SYNC, no cycles")
    rate = traffic.complete / traffic.cycles
    complete = f"{traffic.complete} of {traffic.cycles} cycles"
    return judge(
        "success rate",
        f"{rate:.4f}: {complete} had every input exactly once and in time",
        (rate < SUCCESS_FAIL, FAIL, "not sufficient: do not use the estimate for control"),
        (rate < SUCCESS_MANY, WARN, "many cycles without all inputs: see above"),
        (rate < SUCCESS_GOOD, WARN, "some cycles without all inputs: see above"),
    )


def _heartbeat(node: NodeCount, traffic: Traffic, config: Config) -> CheckResult:
    item = f"heartbeat {node.name}"
    if not node.heartbeats:
        if node.name == "jtqd":
            return CheckResult(item, SKIP, "no jtqd on the bus")
        if traffic.syncs:
            return CheckResult(item, FAIL, "none", "check power, wiring and bit rate")
        hint = "absent or not booted: a node has no heartbeat before jtqd has configured it"
        return CheckResult(item, WARN, "none", hint)
    state = nmt.STATES.get(node.state if node.state is not None else -1, f"state {node.state}")
    text = f"{state}; longest silence {node.longest_gap_ns / 1e6:.0f} ms, expected {config.heartbeat_ms} ms"
    text += f"; {node.emergencies} EMCY, last {node.last_emergency:04X}h" if node.emergencies else ""
    text += f"; {counted(node.boot_ups, 'restart')}" if node.boot_ups else ""
    silent = node.longest_gap_ns > _HEARTBEAT_GAP * config.heartbeat_ms * 1e6
    return judge(
        item,
        text,
        (node.boot_ups, WARN, "check the supply voltage and the drive's watchdog"),
        (silent, WARN, "heartbeats are late or lost"),
        (node.state != nmt.OPERATIONAL, WARN, "it sends no PDO in this state until jtqd starts it"),
        (node.emergencies, WARN, "1003h of the node has its history"),
    )


def _load(traffic: Traffic, config: Config) -> CheckResult:
    if traffic.seconds <= 0:
        return CheckResult("bus load", SKIP, "nothing on the bus")
    configured = bus_load_of(config)
    load = traffic.bits / traffic.seconds / config.bitrate
    bounds = f"{percent(configured.unstuffed)} to {percent(configured.worst)}"
    foreign = "the bus carries frames that are not in the configuration: see foreign frames"
    return judge(
        "bus load",
        f"{percent(load)} by the bits of every frame; by configuration {bounds}",
        (load > LIMIT, FAIL, f"above {LIMIT:.0%} no time remains for a retransmission"),
        (load > configured.worst * (1 + RATE_TOLERANCE), WARN, foreign),
    )


def _foreign(traffic: Traffic) -> CheckResult:
    foreign = traffic.foreign
    if not foreign:
        return CheckResult("foreign frames", GOOD, "none")
    seconds = max(traffic.seconds, 1e-9)
    most = foreign.most_common(5)
    text = ", ".join(f"{identifier_text(can_id)} {count / seconds:.3g} per s" for can_id, count in most)
    others = len(foreign) - len(most)
    text += f" and {counted(others, 'more identifier')}" if others else ""
    ours = traffic.inputs.keys() | {SYNC_COB_ID}
    disguised = any(
        can_id & (CAN_EFF_MASK if can_id & CAN_EFF_FLAG else CAN_SFF_MASK) in ours for can_id in foreign
    )
    return judge(
        "foreign frames",
        text,
        (disguised, FAIL, "remote or 29-bit frames with jtqd's identifiers: jtqd refuses them"),
        (True, WARN, "not in the configuration and not in its bus load: find the sender"),
    )


def _errors(traffic: Traffic) -> CheckResult:
    classes = (
        f"{_ERROR_CLASSES.get(bit, f'{bit:X}h')} {count}" for bit, count in sorted(traffic.errors.items())
    )
    bus_off = "bus-off: bit rate, wiring, termination; restart-ms brings the interface back"
    alone = "no node acknowledges: check that another node is on the bus and powered"
    wiring = "wiring, termination (60 ohm between the lines), bit rate, sample point"
    return judge(
        "error frames",
        ", ".join(classes) or "none",
        (_BUS_OFF in traffic.errors, FAIL, bus_off),
        (_NO_ACKNOWLEDGE in traffic.errors, FAIL, alone),
        (traffic.errors, WARN, wiring),
    )


def check_own_timing(
    timing: Timing, period_ns: int, refused: Sequence[str], *, driven: bool
) -> Iterator[CheckResult]:
    """Judge the wake-ups of this process and, if it sent SYNC (`driven`), SYNC's echo.

    refused: real-time settings that the system did not grant.
    """
    fifo = not any("SCHED_FIFO" in line for line in refused)
    how = "SCHED_FIFO" if fifo else "without real-time scheduling"
    yield _timing("timer wake-up", timing.lateness, timing.missed, period_ns, how)
    if not driven:
        return
    text = f"from send to echo: {timing.echo}"
    lost = timing.lateness.count - timing.echo.count
    if timing.unsent:
        text += f"; {timing.unsent} not sent"
    elif lost > 1:  # the last one may still be on its way
        text += f"; {lost} without an echo"
    slow = timing.echo.quantile_us(0.99) > ECHO_WARN * period_ns / 1000
    yield judge(
        "SYNC echo",
        text,
        (timing.unsent, FAIL, "transmit queue full: txqueuelen, bus load"),
        (lost > 1, FAIL, "the interface sends late, or not at all"),
        (slow, WARN, "SYNC waits in the transmit queue: check which other programs send on this machine"),
    )


def check_conditions(conditions: Sequence[Condition]) -> Iterator[CheckResult]:
    """Return one result per condition of the running jtqd, or one that there is none."""
    for each in conditions:
        level = FAIL if each.severity >= ERROR else WARN
        name = each.name.replace("_", " ")
        yield CheckResult(name, level, f"jtqd reports: {each.line}", "see `jtq status`")
    if not conditions:
        yield CheckResult("conditions", GOOD, "jtqd reports no condition")


def check_loop_timing(
    before: tuple[int, ...], after: tuple[int, ...], first: View, last: View
) -> CheckResult:
    """Judge the running loop by its histogram of the lateness of SYNC before and after the check."""
    times = TimeHistogram()
    for n, (old, new) in enumerate(zip(before, after, strict=True)):
        times.add((n + 1) * LATE_BIN_NS, new - old)
    missed = last.counters["missed"] - first.counters["missed"]
    how = "lateness of SYNC in the loop"
    return _timing("jtqd's timing", times, missed, round(last.period_s * 1e9), how)


def check_stolen_time(stolen_s: float, seconds: float) -> CheckResult:
    """Judge the processor time that a hypervisor used in `seconds` (`daemon/loop/realtime.py`)."""
    stolen = stolen_s / max(seconds, 1e-3)
    text = f"{percent(stolen)} of a processor used by the hypervisor (stolen time)"
    hint = "no setting on this machine helps: use dedicated processors or a machine without a hypervisor"
    return judge("processors", text, (stolen >= STOLEN_WARN, WARN, hint))


def _timing(item: str, times: TimeHistogram, missed: int, period_ns: int, how: str) -> CheckResult:
    slots = times.count + missed
    p99_us, period_us = times.quantile_us(0.99), period_ns / 1000
    bad = not times.count or missed > MISSED_FAIL * slots or p99_us > LATE_FAIL * period_us
    return judge(
        item,
        f"{how}: late {times}; {missed} of {slots} slots missed",
        (bad, FAIL, _TIMING_HINT),
        (missed or p99_us > LATE_WARN * period_us, WARN, _TIMING_HINT),
    )
