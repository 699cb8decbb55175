"""`jtq check`: a bus and this machine's timing, measured for some seconds and judged item by item."""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Console

from jtqd.daemon.bus.boot import boot_request, bus_load_of
from jtqd.daemon.cli.checks import FAIL, GOOD, SKIP, WARN, CheckResult, as_json, exit_status, share, show
from jtqd.daemon.cli.reading import Daemon, find_daemons, on_bus
from jtqd.daemon.cli.traffic import (
    SYNC,
    NodeCount,
    PdoCount,
    TimeHistogram,
    Timing,
    Traffic,
    described,
    drive,
    leave,
    listen,
    silent,
)
from jtqd.daemon.config import Config, load_config
from jtqd.daemon.loop import realtime
from jtqd.daemon.loop.realtime import stolen_s
from jtqd.daemon.shared.child_process import Child, ChildError
from jtqd.daemon.shared.snapshot import LATE_BIN_NS, NMT_STATES, SnapshotError, SnapshotReader, View
from jtqd.drivers.bus_load import LIMIT
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_SFF_MASK
from jtqd.drivers.frame_socket import BusError, FrameSocket, open_frame_socket
from jtqd.estimator.checked import ConfigError, seconds
from jtqd.estimator.status import NAMES, PUBLISHED

# Judgement of a bus by what was counted on it: one finding for each item. Pure.


SUCCESS_GOOD, SUCCESS_FAIL = 0.99, 0.90
"""Of complete cycles, as libfranka judges its communication test: below 0.95 "many lost", below 0.90 "not sufficient"."""
SUCCESS_MANY = 0.95
JITTER_WARN = 0.1
"""Of the period: the observer's step is then noticeably wrong for drives that sample at SYNC."""
RATE_TOLERANCE = 0.02
_HEARTBEAT_GAP = 1.5
_OPERATIONAL = 5
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
    """Findings of everything that was heard.

    Args:
        traffic: what was counted.
        config: what should have been there.
        lost: frames that this process read too late.
        error_frames: the bus can report errors.
    """
    yield _sync(traffic, config)
    for pdo in traffic.inputs.values():
        yield _input(pdo, traffic, config)
    yield _estimate(traffic, config)
    yield _success(traffic)
    for node in traffic.nodes.values():
        yield _node(node, traffic, config)
    yield _load(traffic, config)
    yield _strangers(traffic)
    yield _errors(traffic) if error_frames else CheckResult("error frames", SKIP, "a unix bus has none")
    if lost:
        yield CheckResult(
            "this check",
            WARN,
            f"read too late and lost {lost} frames: some of what is missing above may be that",
            "run it on an idle machine, or give it real-time priority",
        )


def arrival(tally: TimeHistogram) -> str:
    """Quantiles of a tally."""
    return f"p50 {tally.quantile_us(0.5):.0f}, p99 {tally.quantile_us(0.99):.0f}, max {tally.quantile_us(1.0):.0f} us"


def _sync(traffic: Traffic, config: Config) -> CheckResult:
    if traffic.syncs < 2:
        return CheckResult(
            "SYNC",
            FAIL,
            "none on the bus",
            "start jtqd, or let this check boot the nodes and send SYNC: --drive-sync",
        )
    period_us = config.period_ns / 1000
    text = f"{traffic.sync_rate:.1f} per s, wanted {1e6 / period_us:.0f}; off the period: {arrival(traffic.sync_jitter)}"
    too_many = traffic.cycles - traffic.slots
    if traffic.counter_jumps or too_many > (1 - SUCCESS_GOOD) * traffic.cycles:
        return CheckResult(
            "SYNC",
            FAIL,
            f"{text}; {traffic.counter_jumps} jumps of its counter",
            "is there a second SYNC producer, or has the one been restarted? (candump can0,080:7FF)",
        )
    if too_many < 0:
        level = FAIL if -too_many > (1 - SUCCESS_GOOD) * traffic.slots else WARN
        return CheckResult(
            "SYNC",
            level,
            f"{text}; {-too_many} of {traffic.slots} slots without one",
            "the sender missed slots: see its timing, and `jtq doctor`",
        )
    if traffic.sync_jitter.quantile_us(0.99) > JITTER_WARN * period_us:
        return CheckResult(
            "SYNC", WARN, text, "the sender is woken late: `jtq doctor` says what real time lacks"
        )
    return CheckResult("SYNC", GOOD, text)


def _input(pdo: PdoCount, traffic: Traffic, config: Config) -> CheckResult:
    if not traffic.cycles:
        level, seen = (
            (SKIP, "no SYNC to answer") if not pdo.frames else (WARN, f"{pdo.frames} without any SYNC")
        )
        return CheckResult(pdo.name, level, seen)
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
    text = f"{rate:.4g} per SYNC, wanted 1; after SYNC: {arrival(pdo.delays)}"
    if not pdo.delays.count:
        hint = "is the node on the bus, and operational? Its TPDO must be bound to SYNC (transmission type 1)"
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


def _hint(pdo: PdoCount, config: Config) -> str:
    if pdo.wrong_length:
        return f"its mapping is not the configured one ({pdo.length} bytes): jtqd configures it when it boots the node"
    if pdo.twice:
        return "two nodes with one number, or a node that sends by itself: transmission type must be 1"
    if pdo.late > pdo.missing:
        return (
            f"after the deadline of {config.input_deadline_ns / 1000:.0f} us: less load (`jtq bus-load`), or a "
            "higher priority (lower COB-ID)"
        )
    return "frames are lost: look at error frames, termination and the interface's txqueuelen"


def _estimate(traffic: Traffic, config: Config) -> CheckResult:
    pdo = traffic.estimate
    if not pdo.frames:
        return CheckResult(pdo.name, SKIP, "no jtqd on the bus")
    per_joint = []
    for number, count in enumerate(traffic.statuses, start=1):
        total = max(1, sum(count.values()))
        known = sum(count[code] for code in PUBLISHED) / total
        others = [(n, code) for code, n in count.items() if code not in PUBLISHED]
        worst = f" ({NAMES.get(max(others)[1], '?')} {max(others)[0]})" if others else ""
        per_joint.append((known, f"joint {number} {share(known)}{worst}"))
    text = f"{pdo.counted / max(1, traffic.cycles):.4g} per SYNC; with a number: " + ", ".join(
        each for _, each in per_joint
    )
    late = pdo.delays.quantile_us(0.99) > config.period_ns / 1000
    if pdo.missing > (1 - SUCCESS_GOOD) * max(1, traffic.cycles) or late:
        return CheckResult(
            pdo.name, WARN, f"{text}; missing in {pdo.missing} of {traffic.cycles} cycles", "see jtq status"
        )
    if min(known for known, _ in per_joint) < SUCCESS_GOOD:
        return CheckResult(pdo.name, WARN, text, "`jtq status` says why there is no number")
    return CheckResult(pdo.name, GOOD, text)


def _success(traffic: Traffic) -> CheckResult:
    if not traffic.cycles:
        return CheckResult("success rate", SKIP, "no SYNC, no cycles")
    rate = traffic.complete / traffic.cycles
    text = f"{rate:.4f}: {traffic.complete} of {traffic.cycles} cycles had every input once and in time"
    if rate >= SUCCESS_GOOD:
        return CheckResult("success rate", GOOD, text)
    word = "many cycles" if rate < SUCCESS_MANY else "some cycles"
    level = FAIL if rate < SUCCESS_FAIL else WARN
    hint = (
        "not sufficient: do not use the estimate for control"
        if level == FAIL
        else f"{word} without all inputs: see above which"
    )
    return CheckResult("success rate", level, text, hint)


def _node(node: NodeCount, traffic: Traffic, config: Config) -> CheckResult:
    item = f"heartbeat {node.name}"
    if not node.heartbeats:
        if node.name == "jtqd":
            return CheckResult(item, SKIP, "no jtqd on the bus")
        if not traffic.syncs:
            hint = "not there, or not booted: a node has none before jtqd has configured it"
            return CheckResult(item, WARN, "none", hint)
        return CheckResult(item, FAIL, "none", "is it powered, wired, and at the right bit rate?")
    state = NMT_STATES.get(node.state if node.state is not None else -1, f"state {node.state}")
    text = f"{state}; longest silence {node.longest_gap_ns / 1e6:.0f} ms, wanted {config.heartbeat_ms} ms"
    if node.emergencies:
        text += f"; {node.emergencies} emergencies, last {node.last_emergency:04X}h"
    hint = ""
    if node.boot_ups:
        text += f"; restarted {node.boot_ups} times"
        hint = "supply voltage? watchdog of the drive?"
    elif node.longest_gap_ns > _HEARTBEAT_GAP * config.heartbeat_ms * 1e6:
        hint = "heartbeats are late or lost"
    elif node.state != _OPERATIONAL:
        hint = "it sends no PDO in this state; jtqd starts it"
    elif node.emergencies:
        hint = "1003h of the node has its history"
    return CheckResult(item, WARN if hint else GOOD, text, hint)


def _load(traffic: Traffic, config: Config) -> CheckResult:
    configured = bus_load_of(config)
    if traffic.seconds <= 0:
        return CheckResult("bus load", SKIP, "nothing on the bus")
    seen = traffic.bits / traffic.seconds / config.bitrate
    bounds = f"{share(configured.unstuffed)} to {share(configured.worst)}"
    text = f"{share(seen)} by the bits of every frame; by configuration {bounds}"
    if seen > LIMIT:
        return CheckResult("bus load", FAIL, text, f"above {LIMIT:.0%} there is no room for a retransmission")
    if seen > configured.worst * (1 + RATE_TOLERANCE):
        return CheckResult(
            "bus load", WARN, text, "more is on the bus than the configuration knows: see foreign frames"
        )
    return CheckResult("bus load", GOOD, text)


def _strangers(traffic: Traffic) -> CheckResult:
    if not traffic.strangers:
        return CheckResult("foreign frames", GOOD, "none")
    seconds = max(traffic.seconds, 1e-9)
    most = traffic.strangers.most_common(5)
    text = ", ".join(f"{described(can_id)} {count / seconds:.3g} per s" for can_id, count in most)
    left = len(traffic.strangers) - len(most)
    text += f" and {left} more identifiers" if left else ""
    ours = traffic.inputs.keys() | {SYNC}
    mocking = [
        each
        for each in traffic.strangers
        if each & (CAN_EFF_MASK if each & CAN_EFF_FLAG else CAN_SFF_MASK) in ours
    ]
    if mocking:
        return CheckResult(
            "foreign frames", FAIL, text, "remote or 29-bit frames under our identifiers: jtqd refuses them"
        )
    return CheckResult(
        "foreign frames", WARN, text, "not in the configuration, and not in its bus load: who sends them?"
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
            "error frames", FAIL, text, "nobody acknowledges: is any other node on the bus and powered?"
        )
    return CheckResult(
        "error frames", WARN, text, "wiring, termination (60 ohm between the lines), bit rate, sample point"
    )


# Judgement of timing: this process's wake-ups, SYNC's echo, or the loop of a daemon that runs. Pure.


LATE_WARN, LATE_FAIL = 0.1, 0.5
"""Of the period, p99: noticeable, and as much as makes the loop skip a slot."""
MISSED_FAIL = 0.01
ECHO_WARN = 0.3
"""Of the period, p99: at 1 Mbit/s SYNC and a frame that is just being sent take up to 200 us."""
STOLEN_WARN = 0.001
_STOLEN_HINT = (
    "no setting in this machine helps: give it processors of its own, or a machine without a hypervisor"
)
_HINT = "`jtq doctor` says what real time lacks on this machine"


def own_timing(
    timing: Timing, period_ns: int, refused: Sequence[str], *, driven: bool
) -> Iterator[CheckResult]:
    """Findings of this process's own loop; `refused`: what real-time means it did not get."""
    granted = (
        "without real-time scheduling" if any("SCHED_FIFO" in line for line in refused) else "SCHED_FIFO"
    )
    yield _judged("timer wake-up", timing.lateness, timing.missed, period_ns, granted)
    if driven:
        text = f"from send to echo: {arrival(timing.echo)}"
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
                "SYNC waits in the transmit queue: who else sends on this machine?" if level == WARN else ""
            )
            yield CheckResult("SYNC echo", level, text, hint)


def loop_timing(before: tuple[int, ...], after: tuple[int, ...], first: View, last: View) -> CheckResult:
    """Finding of the running loop, from its histogram of SYNC's lateness before and after."""
    tally = TimeHistogram()
    for n, (old, new) in enumerate(zip(before, after, strict=True)):
        for _ in range(new - old):
            tally.add((n + 1) * LATE_BIN_NS)
    missed = last.counters["missed"] - first.counters["missed"]
    return _judged("jtqd's timing", tally, missed, round(last.period_s * 1e9), "SYNC's lateness in the loop")


def stolen_time(stolen_s: float, seconds: float) -> CheckResult:
    """Finding of the processor time that a hypervisor took (`daemon/loop/realtime.py`) in `seconds`."""
    share = stolen_s / max(seconds, 1e-3)
    text = f"{share:.1%} of a processor taken away by a hypervisor (stolen time)"
    return (
        CheckResult("processors", WARN, text, _STOLEN_HINT)
        if share >= STOLEN_WARN
        else CheckResult("processors", GOOD, text)
    )


def _judged(item: str, tally: TimeHistogram, missed: int, period_ns: int, how: str) -> CheckResult:
    slots = tally.count + missed
    text = f"{how}: late {arrival(tally)}; {missed} of {slots} slots missed"
    p99_us, period_us = tally.quantile_us(0.99), period_ns / 1000
    if not tally.count or missed > MISSED_FAIL * slots or p99_us > LATE_FAIL * period_us:
        return CheckResult(item, FAIL, text, _HINT)
    if missed or p99_us > LATE_WARN * period_us:
        return CheckResult(item, WARN, text, _HINT)
    return CheckResult(item, GOOD, text)


SCHEMA = "jtq.check/1"
_EXAMPLES = """examples:
  jtq check --bus can0                   listen for 10 s beside a running jtqd, or to whatever is there
  jtq check 60 --bus can0 --config /etc/jtqd/can0.yaml
  jtq check --bus vcan0 --drive-sync     without jtqd: boot the nodes as it does, send SYNC, measure the answers
  jtq check 5 --bus sim                  this machine's timing, against the emulated bench
  jtq check --json | jq '.items[] | select(.level != "GOOD")'

Without --drive-sync nothing is sent. With it the nodes are configured and started, and set to pre-operational at the
end, exactly as by jtqd; no drive is commanded. It is refused where jtqd runs, or anybody else sends SYNC.

exit status: 0 all good, 3 warnings, 1 failures, 2 usage"""
_CAPACITY = 256
_QUIET_S = 0.5
_BENCH_WAIT_S = 60.0
_BENCH_PRIORITY = 40


class CheckError(Exception):
    """The check cannot be made; the message is one line for the operator."""


def parser() -> argparse.ArgumentParser:
    """Options of `jtq check`."""
    made = argparse.ArgumentParser(
        prog="jtq check",
        description="Self-test of a bus and of this machine's timing: GOOD, WARN or FAIL for each item, and what to do.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "seconds", type=seconds, nargs="?", default=10.0, metavar="S", help="how long (default 10)"
    )
    made.add_argument("--bus", default="can0", help="SocketCAN interface, unix:PATH, or sim (default can0)")
    made.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="what should be on the bus (default: the running jtqd's configuration, else the bench that ships)",
    )
    made.add_argument("--drive-sync", action="store_true", help="boot the nodes and send SYNC")
    made.add_argument("--json", action="store_true", help="print as JSON")
    return made


def main(argv: list[str]) -> int:
    """Measure and judge; returns the exit status."""
    arguments = parser().parse_args(argv)
    try:
        daemon = None if arguments.bus == "sim" else on_bus(find_daemons(), arguments.bus)
        path = arguments.config or (Path(daemon.about.configuration) if daemon else None)
        config = load_config(path)
        before_s, began_s = stolen_s(), time.monotonic()
        with _bus(arguments.bus, config, daemon) as bus:
            findings = list(
                _driven(bus, config, arguments.seconds, daemon)
                if arguments.drive_sync or arguments.bus == "sim"
                else _heard(bus, config, arguments.seconds, daemon)
            )
        findings.append(stolen_time(stolen_s() - before_s, time.monotonic() - began_s))
    except (CheckError, ConfigError, BusError, ChildError) as error:
        print(f"jtq check: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 1
    if arguments.json:
        more = {"bus": arguments.bus, "seconds": arguments.seconds, "configuration": str(config.path)}
        print(json.dumps(as_json(SCHEMA, findings, **more)))
    else:
        show(Console(), findings)
    return exit_status(findings)


def _say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"jtq check: {text}", file=sys.stderr)


def _open(bus: str, *, receive_own: bool = False) -> FrameSocket:
    errors = not bus.startswith("unix:")
    return open_frame_socket(bus, None, receive_own=receive_own, error_frames=errors, capacity=_CAPACITY)


def _heard(bus: str, config: Config, for_s: float, daemon: Daemon | None) -> Iterator[CheckResult]:
    """Listen only."""
    traffic, socket = Traffic(config), _open(bus)
    reader = _reader(daemon)
    refused = [] if reader else _punctual(config)
    _say(
        f"listening on {bus} for {for_s:g} s"
        + (f" beside jtqd, process {daemon.about.pid}" if daemon else "")
    )
    before = (reader.late_bins(), reader.read()) if reader else None
    timing = listen(socket, traffic, for_s, config.period_ns, timed=reader is None)
    if reader is not None and before is not None:
        yield loop_timing(before[0], reader.late_bins(), before[1], reader.read())
    elif timing is not None:
        yield from own_timing(timing, config.period_ns, refused, driven=False)
    yield from _all_judged(traffic, config, bus, socket)


def _driven(bus: str, config: Config, for_s: float, daemon: Daemon | None) -> Iterator[CheckResult]:
    """Boot the nodes, send SYNC, and put them back."""
    if daemon is not None:
        raise CheckError(
            f"jtqd runs on {bus} (process {daemon.about.pid}): without --drive-sync this check listens"
        )
    socket = _open(bus, receive_own=True)
    if not silent(socket, _QUIET_S):
        raise CheckError(f"somebody sends SYNC on {bus}: without --drive-sync this check listens")
    _say(f"booting the nodes on {bus}")
    booted = _boot(bus, config)
    yield booted
    if booted.level != GOOD:
        return
    refused = _punctual(config)
    traffic = Traffic(config)
    while socket.receive():
        pass  # what was said during the boot
    _say(f"sending SYNC on {bus} for {for_s:g} s")
    try:
        timing = drive(socket, traffic, for_s, config)
    finally:
        leave(socket, config)
    yield from own_timing(timing, config.period_ns, refused, driven=True)
    yield from (each for each in _all_judged(traffic, config, bus, socket) if "jtqd" not in each.item)


def _all_judged(traffic: Traffic, config: Config, bus: str, socket: FrameSocket) -> Iterator[CheckResult]:
    return check_bus(traffic, config, lost=socket.rx_dropped, error_frames=not bus.startswith("unix:"))


def _reader(daemon: Daemon | None) -> SnapshotReader | None:
    if daemon is None:
        return None
    try:
        return SnapshotReader(daemon.directory / "snapshot")
    except SnapshotError as error:
        raise CheckError(f"jtqd on {daemon.about.instance} is still starting ({error})") from None


def _punctual(config: Config) -> list[str]:
    """Run as jtqd's loop does. Returns what was refused."""
    wanted = config.realtime
    refused = realtime.prepare(wanted.priority, wanted.cpu, wanted.lock_memory)
    gc.disable()
    return refused


def _boot(bus: str, config: Config) -> CheckResult:
    child = Child("jtqd.drivers.boot", name="the boot")
    try:
        child.tell(boot_request(config, bus))
        child.end_of_input()
        report = child.answer(60.0)
    finally:
        child.end()
    if not report["ok"]:
        hint = (
            "identity, mapping or scaling of a node is not what the configuration says, or the node is silent"
        )
        return CheckResult("boot", FAIL, str(report["error"]["message"]), hint)
    nodes = ", ".join(sorted(report["nodes"]))
    return CheckResult(
        "boot", GOOD, f"nodes {nodes}: identity, mapping and scaling as configured, operational"
    )


@contextmanager
def _bus(name: str, config: Config, daemon: Daemon | None) -> Iterator[str]:
    """The name under which it can be opened; for "sim" the emulated bench is started for as long as it is used."""
    if name != "sim":
        yield daemon.about.bus if daemon else name
        return
    with tempfile.TemporaryDirectory(prefix="jtq-check-") as directory:
        path = Path(directory) / "bus"
        bench = Child("jtqd.sim_can", ["--bus", f"unix:{path}"], name="the emulated bench")
        try:
            until = time.monotonic() + _BENCH_WAIT_S
            while not path.exists():
                if not bench.alive() or time.monotonic() > until:
                    raise CheckError("the emulated bench did not open its bus")
                time.sleep(0.01)
            if config.realtime.priority > _BENCH_PRIORITY:
                with suppress(PermissionError):  # the emulated nodes stand for hardware
                    os.sched_setscheduler(bench.pid, os.SCHED_FIFO, os.sched_param(_BENCH_PRIORITY))
            yield f"unix:{path}"
        finally:
            bench.end()
