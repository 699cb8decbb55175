"""Judgement of a bus by what was counted on it: one finding for each item. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.config import Config
from daemon.master.bus_load import bus_load_of
from daemon.tools.figures import share
from daemon.tools.finding import FAIL, GOOD, SKIP, WARN, Finding
from daemon.tools.reasons import NMT_STATES
from daemon.tools.tally import Tally
from daemon.tools.traffic import SYNC, NodeCount, PdoCount, Traffic, described
from drivers.bus_load import LIMIT
from drivers.frame import CAN_EFF_FLAG, CAN_EFF_MASK, CAN_SFF_MASK
from estimator.status import NAMES, PUBLISHED

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


def check_bus(traffic: Traffic, config: Config, *, lost: int, error_frames: bool = True) -> Iterator[Finding]:
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
    yield _errors(traffic) if error_frames else Finding("error frames", SKIP, "a unix bus has none")
    if lost:
        yield Finding(
            "this check",
            WARN,
            f"read too late and lost {lost} frames: some of what is missing above may be that",
            "run it on an idle machine, or give it real-time priority",
        )


def arrival(tally: Tally) -> str:
    """Quantiles of a tally."""
    return f"p50 {tally.quantile_us(0.5):.0f}, p99 {tally.quantile_us(0.99):.0f}, max {tally.quantile_us(1.0):.0f} us"


def _sync(traffic: Traffic, config: Config) -> Finding:
    if traffic.syncs < 2:
        return Finding(
            "SYNC",
            FAIL,
            "none on the bus",
            "start jtqd, or let this check boot the nodes and send SYNC: --drive-sync",
        )
    period_us = config.period_ns / 1000
    text = f"{traffic.sync_rate:.1f} per s, wanted {1e6 / period_us:.0f}; off the period: {arrival(traffic.sync_jitter)}"
    too_many = traffic.cycles - traffic.slots
    if traffic.counter_jumps or too_many > (1 - SUCCESS_GOOD) * traffic.cycles:
        return Finding(
            "SYNC",
            FAIL,
            f"{text}; {traffic.counter_jumps} jumps of its counter",
            "is there a second SYNC producer, or has the one been restarted? (candump can0,080:7FF)",
        )
    if too_many < 0:
        level = FAIL if -too_many > (1 - SUCCESS_GOOD) * traffic.slots else WARN
        return Finding(
            "SYNC",
            level,
            f"{text}; {-too_many} of {traffic.slots} slots without one",
            "the sender missed slots: see its timing, and `jtq doctor`",
        )
    if traffic.sync_jitter.quantile_us(0.99) > JITTER_WARN * period_us:
        return Finding("SYNC", WARN, text, "the sender is woken late: `jtq doctor` says what real time lacks")
    return Finding("SYNC", GOOD, text)


def _input(pdo: PdoCount, traffic: Traffic, config: Config) -> Finding:
    if not traffic.cycles:
        level, seen = (
            (SKIP, "no SYNC to answer") if not pdo.frames else (WARN, f"{pdo.frames} without any SYNC")
        )
        return Finding(pdo.name, level, seen)
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
        return Finding(pdo.name, FAIL, f"none{length}", hint)
    if faults:
        text += f"; {', '.join(faults)} of {traffic.cycles} cycles"
    bad = (pdo.missing + pdo.late + pdo.twice) / traffic.cycles
    if not pdo.missing + pdo.twice + pdo.wrong_length and bad <= 1 - SUCCESS_GOOD:
        return Finding(
            pdo.name, GOOD, text
        )  # a few that are late are within the success rate; none may be lost
    level = FAIL if bad > 1 - SUCCESS_FAIL or pdo.wrong_length else WARN
    return Finding(pdo.name, level, text, _hint(pdo, config))


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


def _estimate(traffic: Traffic, config: Config) -> Finding:
    pdo = traffic.estimate
    if not pdo.frames:
        return Finding(pdo.name, SKIP, "no jtqd on the bus")
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
        return Finding(
            pdo.name, WARN, f"{text}; missing in {pdo.missing} of {traffic.cycles} cycles", "see jtq status"
        )
    if min(known for known, _ in per_joint) < SUCCESS_GOOD:
        return Finding(pdo.name, WARN, text, "`jtq status` says why there is no number")
    return Finding(pdo.name, GOOD, text)


def _success(traffic: Traffic) -> Finding:
    if not traffic.cycles:
        return Finding("success rate", SKIP, "no SYNC, no cycles")
    rate = traffic.complete / traffic.cycles
    text = f"{rate:.4f}: {traffic.complete} of {traffic.cycles} cycles had every input once and in time"
    if rate >= SUCCESS_GOOD:
        return Finding("success rate", GOOD, text)
    word = "many cycles" if rate < SUCCESS_MANY else "some cycles"
    level = FAIL if rate < SUCCESS_FAIL else WARN
    hint = (
        "not sufficient: do not use the estimate for control"
        if level == FAIL
        else f"{word} without all inputs: see above which"
    )
    return Finding("success rate", level, text, hint)


def _node(node: NodeCount, traffic: Traffic, config: Config) -> Finding:
    item = f"heartbeat {node.name}"
    if not node.heartbeats:
        if node.name == "jtqd":
            return Finding(item, SKIP, "no jtqd on the bus")
        if not traffic.syncs:
            hint = "not there, or not booted: a node has none before jtqd has configured it"
            return Finding(item, WARN, "none", hint)
        return Finding(item, FAIL, "none", "is it powered, wired, and at the right bit rate?")
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
    return Finding(item, WARN if hint else GOOD, text, hint)


def _load(traffic: Traffic, config: Config) -> Finding:
    configured = bus_load_of(config)
    if traffic.seconds <= 0:
        return Finding("bus load", SKIP, "nothing on the bus")
    seen = traffic.bits / traffic.seconds / config.bitrate
    bounds = f"{share(configured.unstuffed)} to {share(configured.worst)}"
    text = f"{share(seen)} by the bits of every frame; by configuration {bounds}"
    if seen > LIMIT:
        return Finding("bus load", FAIL, text, f"above {LIMIT:.0%} there is no room for a retransmission")
    if seen > configured.worst * (1 + RATE_TOLERANCE):
        return Finding(
            "bus load", WARN, text, "more is on the bus than the configuration knows: see foreign frames"
        )
    return Finding("bus load", GOOD, text)


def _strangers(traffic: Traffic) -> Finding:
    if not traffic.strangers:
        return Finding("foreign frames", GOOD, "none")
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
        return Finding(
            "foreign frames", FAIL, text, "remote or 29-bit frames under our identifiers: jtqd refuses them"
        )
    return Finding(
        "foreign frames", WARN, text, "not in the configuration, and not in its bus load: who sends them?"
    )


def _errors(traffic: Traffic) -> Finding:
    if not traffic.errors:
        return Finding("error frames", GOOD, "none")
    text = ", ".join(
        f"{_ERROR_CLASSES.get(bit, f'{bit:X}h')} {count}" for bit, count in sorted(traffic.errors.items())
    )
    if _BUS_OFF in traffic.errors:
        return Finding(
            "error frames",
            FAIL,
            text,
            "bus-off: bit rate, wiring, termination; restart-ms brings the interface back",
        )
    if _NO_ACKNOWLEDGE in traffic.errors:
        return Finding(
            "error frames", FAIL, text, "nobody acknowledges: is any other node on the bus and powered?"
        )
    return Finding(
        "error frames", WARN, text, "wiring, termination (60 ohm between the lines), bit rate, sample point"
    )
