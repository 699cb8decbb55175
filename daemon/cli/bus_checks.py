"""Checks of a bus and of timing: what was counted and measured, judged item by item. Pure.

`check_bus` compares the traffic with the configuration, `check_own_timing` judges this process's wake-ups and SYNC's echo,
`check_loop_timing` the loop of a running daemon, `check_stolen_time` what a hypervisor took.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from jtqd.daemon.bus.boot import bus_load_of
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult
from jtqd.daemon.cli.traffic import NodeCount, PdoCount, TimeHistogram, Timing, Traffic, described
from jtqd.daemon.config import Config
from jtqd.daemon.shared.conditions import Condition
from jtqd.daemon.shared.notices import ERROR
from jtqd.daemon.shared.snapshot import LATE_BIN_NS, View
from jtqd.drivers import nmt
from jtqd.drivers.bus_load import LIMIT
from jtqd.drivers.devices import SYNC_COB_ID
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_SFF_MASK
from jtqd.estimator.status import NAMES, PUBLISHED
from jtqd.estimator.text import counted, percent

SUCCESS_GOOD, SUCCESS_FAIL = 0.99, 0.90
"""Of complete cycles, as libfranka judges its communication test: below 0.95 "many lost", below 0.90 "not sufficient"."""
SUCCESS_MANY = 0.95
JITTER_WARN = 0.1
"""Of the period: the observer's step is then noticeably wrong for drives that sample at SYNC."""
RATE_TOLERANCE = 0.02
LATE_WARN, LATE_FAIL = 0.1, 0.5
"""Of the period, p99: noticeable, and as much as makes the loop skip a slot."""
MISSED_FAIL = 0.01
ECHO_WARN = 0.3
"""Of the period, p99: at 1 Mbit/s SYNC and a frame that is just being sent take up to 200 us."""
STOLEN_WARN = 0.001
_STOLEN_HINT = "no setting on this machine helps: use dedicated processors or a machine without a hypervisor"
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
    """Evaluate everything that was received.

    Args:
        traffic: what was counted.
        config: what should have been there.
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
        yield _node(node, traffic, config)
    yield _load(traffic, config)
    yield _foreign(traffic)
    yield (
        _errors(traffic)
        if error_frames
        else CheckResult("error frames", SKIP, "a unix bus has no error frames")
    )
    if lost:
        yield CheckResult(
            "this check",
            WARN,
            f"read too late and lost {counted(lost, 'frame')}: this may explain missing frames above",
            "run it on an idle machine, or give it real-time priority",
        )


def _quantiles(times: TimeHistogram) -> str:
    return f"p50 {times.quantile_us(0.5):.0f}, p99 {times.quantile_us(0.99):.0f}, max {times.quantile_us(1.0):.0f} us"


def _sync(traffic: Traffic, config: Config) -> CheckResult:
    if traffic.syncs < 2:
        return CheckResult(
            "SYNC",
            FAIL,
            "none on the bus",
            "start jtqd, or let this check boot the nodes and send SYNC: --drive-sync",
        )
    period_us = config.period_ns / 1000
    jitter = _quantiles(traffic.sync_jitter)
    text = f"{traffic.sync_rate:.1f} per s, expected {1e6 / period_us:.0f}; off the period: {jitter}"
    too_many = traffic.cycles - traffic.slots
    if traffic.counter_jumps or too_many > (1 - SUCCESS_GOOD) * traffic.cycles:
        return CheckResult(
            "SYNC",
            FAIL,
            f"{text}; {counted(traffic.counter_jumps, 'jump')} of its counter",
            "possibly a second SYNC producer, or a restarted one (candump can0,080:7FF)",
        )
    if too_many < 0:
        level = FAIL if -too_many > (1 - SUCCESS_GOOD) * traffic.slots else WARN
        return CheckResult(
            "SYNC",
            level,
            f"{text}; {-too_many} of {traffic.slots} slots without one",
            "the sender missed slots: check its timing and `jtq doctor`",
        )
    if traffic.sync_jitter.quantile_us(0.99) > JITTER_WARN * period_us:
        return CheckResult(
            "SYNC", WARN, text, "the sender wakes up late: `jtq doctor` shows the missing real-time settings"
        )
    return CheckResult("SYNC", GOOD, text)


def _input(pdo: PdoCount, traffic: Traffic, config: Config) -> CheckResult:
    if not traffic.cycles:
        level, seen = (
            (SKIP, "no SYNC on the bus") if not pdo.frames else (WARN, f"{pdo.frames} without any SYNC")
        )
        return CheckResult(pdo.name, level, seen)
    if pdo.age_ns:
        return _by_itself(pdo, traffic)
    rate = pdo.counted / traffic.cycles
    faults = [
        f"{kind} {count}"
        for kind, count in (
            ("missing", pdo.missing),
            ("late", pdo.late),
            ("twice", pdo.twice),
            ("wrong length", pdo.wrong_length),
        )
        if count
    ]
    text = f"{rate:.4g} per SYNC, expected 1; after SYNC: {_quantiles(pdo.delays)}"
    if not pdo.delays.count:
        hint = "check that the node is on the bus and operational, and that its TPDO has transmission type 1 (SYNC)"
        length = f", {pdo.wrong_length} of a wrong length" if pdo.wrong_length else ""
        return CheckResult(pdo.name, FAIL, f"none{length}", hint)
    if faults:
        text += f"; {', '.join(faults)} of {traffic.cycles} cycles"
    bad = (pdo.missing + pdo.late + pdo.twice) / traffic.cycles
    if not pdo.missing + pdo.twice + pdo.wrong_length and bad <= 1 - SUCCESS_GOOD:
        return CheckResult(
            pdo.name, GOOD, text
        )  # a few that are late are within the success rate; none may be lost
    level = FAIL if bad > 1 - SUCCESS_FAIL or pdo.wrong_length else WARN
    return CheckResult(pdo.name, level, text, _hint(pdo, config))


def _by_itself(pdo: PdoCount, traffic: Traffic) -> CheckResult:
    """Judge a PDO of transmission type 0, 254 or 255 by its age at SYNC: it belongs to no cycle."""
    if not pdo.delays.count:
        return CheckResult(pdo.name, FAIL, "none", "check that the node is on the bus and operational")
    per_s = pdo.counted / max(traffic.cycles, 1) * traffic.sync_rate
    limit = f"{pdo.age_ns / 1e6:g} ms"
    text = f"{per_s:.4g} per s, sent by the drive itself; age at SYNC: {_quantiles(pdo.delays)}"
    length = f"; wrong length {pdo.wrong_length}" * bool(pdo.wrong_length)
    if not pdo.missing and not pdo.wrong_length:
        return CheckResult(pdo.name, GOOD, f"{text}, at most {limit}")
    share_of = pdo.missing / traffic.cycles
    level = FAIL if share_of > 1 - SUCCESS_FAIL or pdo.wrong_length else WARN
    hint = (
        "joint_N.max_age_ms is below the longest time between two frames: its event timer (180xh:5) must be shorter, or "
        "max_age_ms longer"
    )
    return CheckResult(
        pdo.name,
        level,
        f"{text}, older than {limit} in {pdo.missing} of {traffic.cycles} cycles{length}",
        hint,
    )


def _hint(pdo: PdoCount, config: Config) -> str:
    if pdo.wrong_length:
        return f"its mapping differs from the configuration ({pdo.length} bytes): jtqd configures it when it boots the node"
    if pdo.twice:
        return "two nodes with one node-ID, or an event-driven TPDO: transmission type must be 1"
    if pdo.late > pdo.missing:
        return (
            f"after the deadline of {config.input_deadline_ns / 1000:.0f} us: less load (`jtq bus-load`), or a "
            "higher priority (lower COB-ID)"
        )
    return "frames are lost: check error frames, termination and the interface's txqueuelen"


def _estimate(traffic: Traffic, config: Config, cob_id: int) -> CheckResult:
    pdo = traffic.estimates[cob_id]
    if not pdo.frames:
        return CheckResult(pdo.name, SKIP, "no jtqd on the bus")
    per_joint = []
    for number, count in traffic.statuses_in(cob_id).items():
        total = max(1, sum(count.values()))
        known = sum(count[code] for code in PUBLISHED) / total
        others = [(n, code) for code, n in count.items() if code not in PUBLISHED]
        worst = f" ({NAMES.get(max(others)[1], '?')} {max(others)[0]})" if others else ""
        per_joint.append((known, f"joint {number} {percent(known)}{worst}"))
    text = f"{pdo.counted / max(1, traffic.cycles):.4g} per SYNC; with a torque: " + ", ".join(
        each for _, each in per_joint
    )
    late = pdo.delays.quantile_us(0.99) > config.period_ns / 1000
    if pdo.missing > (1 - SUCCESS_GOOD) * max(1, traffic.cycles) or late:
        return CheckResult(
            pdo.name, WARN, f"{text}; missing in {pdo.missing} of {traffic.cycles} cycles", "see `jtq status`"
        )
    if min(known for known, _ in per_joint) < SUCCESS_GOOD:
        return CheckResult(pdo.name, WARN, text, "`jtq status` gives the reason for the missing torque")
    return CheckResult(pdo.name, GOOD, text)


def _success(traffic: Traffic) -> CheckResult:
    if not traffic.cycles:
        return CheckResult("success rate", SKIP, "no SYNC, no cycles")
    rate = traffic.complete / traffic.cycles
    text = (
        f"{rate:.4f}: {traffic.complete} of {traffic.cycles} cycles had every input exactly once and in time"
    )
    if rate >= SUCCESS_GOOD:
        return CheckResult("success rate", GOOD, text)
    word = "many cycles" if rate < SUCCESS_MANY else "some cycles"
    level = FAIL if rate < SUCCESS_FAIL else WARN
    hint = (
        "not sufficient: do not use the estimate for control"
        if level == FAIL
        else f"{word} without all inputs: see above"
    )
    return CheckResult("success rate", level, text, hint)


def _node(node: NodeCount, traffic: Traffic, config: Config) -> CheckResult:
    item = f"heartbeat {node.name}"
    if not node.heartbeats:
        if node.name == "jtqd":
            return CheckResult(item, SKIP, "no jtqd on the bus")
        if not traffic.syncs:
            hint = "absent or not booted: a node has no heartbeat before jtqd has configured it"
            return CheckResult(item, WARN, "none", hint)
        return CheckResult(item, FAIL, "none", "check power, wiring and bit rate")
    state = nmt.STATES.get(node.state if node.state is not None else -1, f"state {node.state}")
    text = f"{state}; longest silence {node.longest_gap_ns / 1e6:.0f} ms, expected {config.heartbeat_ms} ms"
    if node.emergencies:
        text += f"; {node.emergencies} EMCY, last {node.last_emergency:04X}h"
    hint = ""
    if node.boot_ups:
        text += f"; {counted(node.boot_ups, 'restart')}"
        hint = "check the supply voltage and the drive's watchdog"
    elif node.longest_gap_ns > _HEARTBEAT_GAP * config.heartbeat_ms * 1e6:
        hint = "heartbeats are late or lost"
    elif node.state != nmt.OPERATIONAL:
        hint = "it sends no PDO in this state until jtqd starts it"
    elif node.emergencies:
        hint = "1003h of the node has its history"
    return CheckResult(item, WARN if hint else GOOD, text, hint)


def _load(traffic: Traffic, config: Config) -> CheckResult:
    configured = bus_load_of(config)
    if traffic.seconds <= 0:
        return CheckResult("bus load", SKIP, "nothing on the bus")
    seen = traffic.bits / traffic.seconds / config.bitrate
    bounds = f"{percent(configured.unstuffed)} to {percent(configured.worst)}"
    text = f"{percent(seen)} by the bits of every frame; by configuration {bounds}"
    if seen > LIMIT:
        return CheckResult("bus load", FAIL, text, f"above {LIMIT:.0%} no time remains for a retransmission")
    if seen > configured.worst * (1 + RATE_TOLERANCE):
        return CheckResult(
            "bus load",
            WARN,
            text,
            "the bus carries frames that are not in the configuration: see foreign frames",
        )
    return CheckResult("bus load", GOOD, text)


def _foreign(traffic: Traffic) -> CheckResult:
    if not traffic.strangers:
        return CheckResult("foreign frames", GOOD, "none")
    seconds = max(traffic.seconds, 1e-9)
    most = traffic.strangers.most_common(5)
    text = ", ".join(f"{described(can_id)} {count / seconds:.3g} per s" for can_id, count in most)
    left = len(traffic.strangers) - len(most)
    text += f" and {counted(left, 'more identifier')}" if left else ""
    ours = traffic.inputs.keys() | {SYNC_COB_ID}
    disguised = [
        each
        for each in traffic.strangers
        if each & (CAN_EFF_MASK if each & CAN_EFF_FLAG else CAN_SFF_MASK) in ours
    ]
    if disguised:
        return CheckResult(
            "foreign frames", FAIL, text, "remote or 29-bit frames with jtqd's identifiers: jtqd refuses them"
        )
    return CheckResult(
        "foreign frames", WARN, text, "not in the configuration and not in its bus load: find the sender"
    )


def _errors(traffic: Traffic) -> CheckResult:
    if not traffic.errors:
        return CheckResult("error frames", GOOD, "none")
    text = ", ".join(
        f"{_ERROR_CLASSES.get(bit, f'{bit:X}h')} {count}" for bit, count in sorted(traffic.errors.items())
    )
    if _BUS_OFF in traffic.errors:
        return CheckResult(
            "error frames",
            FAIL,
            text,
            "bus-off: bit rate, wiring, termination; restart-ms brings the interface back",
        )
    if _NO_ACKNOWLEDGE in traffic.errors:
        return CheckResult(
            "error frames",
            FAIL,
            text,
            "no node acknowledges: check that another node is on the bus and powered",
        )
    return CheckResult(
        "error frames", WARN, text, "wiring, termination (60 ohm between the lines), bit rate, sample point"
    )


def check_own_timing(
    timing: Timing, period_ns: int, refused: Sequence[str], *, driven: bool
) -> Iterator[CheckResult]:
    """Evaluate this process's own loop; `refused`: real-time settings that the system did not grant."""
    granted = (
        "without real-time scheduling" if any("SCHED_FIFO" in line for line in refused) else "SCHED_FIFO"
    )
    yield _check_timing("timer wake-up", timing.lateness, timing.missed, period_ns, granted)
    if driven:
        text = f"from send to echo: {_quantiles(timing.echo)}"
        if timing.unsent:
            yield CheckResult(
                "SYNC echo",
                FAIL,
                f"{text}; {timing.unsent} not sent",
                "transmit queue full: txqueuelen, bus load",
            )
        elif timing.echo.count < timing.lateness.count - 1:
            lost = timing.lateness.count - timing.echo.count
            yield CheckResult(
                "SYNC echo",
                FAIL,
                f"{text}; {lost} without an echo",
                "the interface sends late, or not at all",
            )
        else:
            level = WARN if timing.echo.quantile_us(0.99) > ECHO_WARN * period_ns / 1000 else GOOD
            hint = (
                "SYNC waits in the transmit queue: check which other programs send on this machine"
                if level == WARN
                else ""
            )
            yield CheckResult("SYNC echo", level, text, hint)


def check_conditions(conditions: Sequence[Condition]) -> Iterator[CheckResult]:
    """Return one result per condition of the daemon on this bus, or one that says there is none."""
    for each in conditions:
        level = FAIL if each.severity >= ERROR else WARN
        yield CheckResult(
            each.name.replace("_", " "), level, f"jtqd reports: {each.line}", "see `jtq status`"
        )
    if not conditions:
        yield CheckResult("conditions", GOOD, "jtqd reports no condition")


def check_loop_timing(
    before: tuple[int, ...], after: tuple[int, ...], first: View, last: View
) -> CheckResult:
    """Evaluate the running loop by its histogram of the lateness of SYNC before and after."""
    times = TimeHistogram()
    for n, (old, new) in enumerate(zip(before, after, strict=True)):
        for _ in range(new - old):
            times.add((n + 1) * LATE_BIN_NS)
    missed = last.counters["missed"] - first.counters["missed"]
    return _check_timing(
        "jtqd's timing", times, missed, round(last.period_s * 1e9), "lateness of SYNC in the loop"
    )


def check_stolen_time(stolen_s: float, seconds: float) -> CheckResult:
    """Evaluate the processor time that a hypervisor used in `seconds` (`daemon/loop/realtime.py`)."""
    stolen = stolen_s / max(seconds, 1e-3)
    text = f"{percent(stolen)} of a processor used by the hypervisor (stolen time)"
    return (
        CheckResult("processors", WARN, text, _STOLEN_HINT)
        if stolen >= STOLEN_WARN
        else CheckResult("processors", GOOD, text)
    )


def _check_timing(item: str, times: TimeHistogram, missed: int, period_ns: int, how: str) -> CheckResult:
    slots = times.count + missed
    text = f"{how}: late {_quantiles(times)}; {missed} of {slots} slots missed"
    p99_us, period_us = times.quantile_us(0.99), period_ns / 1000
    if not times.count or missed > MISSED_FAIL * slots or p99_us > LATE_FAIL * period_us:
        return CheckResult(item, FAIL, text, _TIMING_HINT)
    if missed or p99_us > LATE_WARN * period_us:
        return CheckResult(item, WARN, text, _TIMING_HINT)
    return CheckResult(item, GOOD, text)
