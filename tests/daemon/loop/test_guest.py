"""jtqd beside another master, in exact time: estimates of role master, no frame but its own, no wrong torque."""

from __future__ import annotations

import random
import struct
from bisect import bisect
from itertools import pairwise
from math import isnan
from pathlib import Path

import pytest

from jtqd.daemon.recording.messages import CycleMessages
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import FLAG_PUBLISHED, HEADER, JOINT, Header, JointRecord
from jtqd.estimator.status import DEGRADED, PUBLISHED, STALE, VALID
from tests.daemon.loop.cycle_helpers import ExactTime, frame, moving
from tests.daemon.loop.foreign_master import (
    OWN,
    PERIOD_NS,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Loop,
    Wire,
    clock,
    nmt,
    regular,
)

__all__ = ["clock"]


def joints_of(record: bytes) -> bytes:
    return record[HEADER.size : HEADER.size + 2 * JOINT.size]


def header_of(record: bytes) -> Header:
    return Header(*HEADER.unpack_from(record))


def started(directory: Path, clock: ExactTime, role: str = "guest", **options: int) -> Loop:
    """A guest that its master has started just before the first SYNC, 10 ms from now."""
    wire = Wire(clock)
    begin_ns = clock.now_ns + 10_000_000
    if role == "master":
        loop = Loop(directory, clock, wire, role)
        loop.cycle.grid.slot_ns = begin_ns
        return loop
    wire.put(begin_ns - PERIOD_NS, nmt(START))
    return Loop(directory, clock, wire.follow(regular(begin_ns, **options)), role)


@pytest.mark.parametrize("cycles", [3000, pytest.param(1_000_000, marks=pytest.mark.campaign)])
def test_estimates_are_bit_equal_to_those_of_a_master(tmp_path: Path, clock: ExactTime, cycles: int) -> None:
    """On the same inputs; each before the next SYNC, and nothing is sent beside them, heartbeats and one boot-up message."""
    start_ns = clock.now_ns
    found = {}
    for role in ("master", "guest", "listener"):
        clock.now_ns = start_ns
        loop = started(tmp_path / role, clock, role).run(start_ns + 10_000_000 + cycles * PERIOD_NS)
        records = loop.read()
        index = [header_of(each).cycle for each in records]
        assert index == list(range(index[-1] - len(index) + 1, index[-1] + 1))
        assert len(index) >= min(cycles, (1 << 15) - 1)
        found[role] = [joints_of(each) for each in records], [data for _, data in loop.wire.own_frames(0x180)]
        if role == "guest":
            sent = loop.wire.own_frames(0x180)
            assert all(
                0 < at - start_ns - 10_000_000 - n * PERIOD_NS < PERIOD_NS for n, (at, _) in enumerate(sent)
            )
            beats = [data for _, data in loop.wire.own_frames(0x700)]
            assert len(loop.wire.sent) == cycles + len(beats)
            assert beats.count(b"\0") == 1
            assert len(beats) == pytest.approx(cycles / 100 + 2, abs=1)
    assert found["guest"] == found["master"]
    assert found["listener"] == (found["master"][0], [])
    assert len(found["guest"][1]) == cycles
    assert sum(data[6] == 0x22 for data in found["guest"][1]) > 0.4 * cycles


def test_it_sends_nothing_before_it_is_started_and_stops_when_it_is_told(
    tmp_path: Path, clock: ExactTime
) -> None:
    wire, ms = Wire(clock), PERIOD_NS
    begin_ns = clock.now_ns + 50 * ms
    wire.follow(regular(begin_ns))
    for after, command, node in (
        (100, START, OWN),
        (200, PRE_OPERATIONAL, 0),
        (300, START, 0),
        (350, STOP, OWN + 1),  # somebody else
        (400, STOP, OWN),
        (500, START, OWN),
        (600, RESET_COMMUNICATION, 0),
        (700, START, OWN),
        (800, RESET_NODE, OWN),
    ):
        wire.put(begin_ns + after * ms - ms // 2, nmt(command, node))
    Loop(tmp_path, clock, wire).run(begin_ns + 900 * ms)
    sent = {(at_ns - begin_ns) // ms for at_ns, _ in wire.own_frames(0x180)}
    assert sent == {*range(100, 200), *range(300, 400), *range(500, 600), *range(700, 800)}
    states = [((at_ns - begin_ns) // ms, data[0]) for at_ns, data in wire.own_frames(0x700)]
    assert [at for at, state in states if state == 0] == [-50, 599, 799], "boot-up messages"
    later = [(at, state) for at, state in states if state]
    expected = {range(-50, 100): 0x7F, range(100, 200): 5, range(200, 300): 0x7F, range(300, 400): 5}
    expected |= {range(400, 500): 4, range(500, 600): 5, range(600, 700): 0x7F, range(700, 800): 5}
    expected[range(800, 901)] = 0x7F
    assert all(state == next(s for span, s in expected.items() if at in span) for at, state in later)
    assert all(b[0] - a[0] <= 110 for a, b in pairwise(states)), "heartbeats go on without SYNC"


@pytest.mark.parametrize(("counter", "overflow"), [(0, 0), (240, 240), (10, 10), (240, 0), (0, 240)])
def test_sequence_is_the_counter_of_sync_or_counts_cycles(
    tmp_path: Path, clock: ExactTime, counter: int, overflow: int
) -> None:
    wire, begin_ns = Wire(clock), clock.now_ns + PERIOD_NS
    wire.put(clock.now_ns, nmt(START))
    wire.follow(regular(begin_ns, counter=counter, first=7))
    Loop(tmp_path, clock, wire, counter_overflow=overflow).run(begin_ns + 500 * PERIOD_NS)
    found = [pdo.sequence for _, pdo in wire.estimates()]
    first = (6 % counter + 1) if counter and counter == overflow else 1
    assert found == [(first - 1 + n) % (overflow or 240) + 1 for n in range(500)]


def truths(records: list[bytes], inputs: dict[int, int]) -> list[tuple[Header, int]]:
    """Header and status of joint 1 of each record; whatever was estimated is of the inputs of its own SYNC, and of its step.

    inputs: time of each SYNC -> number of what the drives send after it.
    """
    found, last_ns = [], 0
    for record in records:
        header = header_of(record)
        joint = JointRecord(*JOINT.unpack_from(record, HEADER.size))
        if not isnan(joint.dt_s):
            (counts,) = struct.unpack_from("<i", moving(inputs[header.sync_realtime_ns])[0], 8)
            assert joint.motor_position_rad == pytest.approx(counts * 1e-4), "inputs of another SYNC"
            step_s = (header.sync_realtime_ns - last_ns) * 1e-9 if last_ns else 0.0
            assert joint.dt_s == pytest.approx(step_s, abs=5e-6)
            last_ns = header.sync_realtime_ns
        found.append((header, joint.status))
    return found


KINDS = ["period", "pause", "restart", "second master", "jitter", "late guest"]


def foreign(kind: str, rng: random.Random, begin_ns: int, at_ns: int) -> list[tuple[int, int]]:
    """(time, number) of the SYNCs of a master that does what `kind` names at `at_ns`."""
    period_ns, pause_ns, extra_ns, jitter_ns = PERIOD_NS, 0, 0, 0
    match kind:
        case "period":
            period_ns = round(PERIOD_NS * rng.choice((0.5, 0.8, 1.25, 2.0, 4.0)))
        case "pause":
            pause_ns = rng.choice((1, 3, 12, 400)) * PERIOD_NS
        case "restart":
            pause_ns = rng.randrange(50, 900) * PERIOD_NS + rng.randrange(PERIOD_NS)
        case "second master":
            extra_ns = rng.randrange(PERIOD_NS // 8, PERIOD_NS)
        case "jitter":
            jitter_ns = PERIOD_NS // 4
    times = [*range(begin_ns, at_ns, PERIOD_NS), *(at_ns + pause_ns + n * period_ns for n in range(600))]
    times += [at + extra_ns for at in times if extra_ns and at >= at_ns]
    return [(at + rng.randrange(jitter_ns or 1), number) for number, at in enumerate(sorted(times), start=1)]


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("kind", KINDS)
def test_no_wrong_torque_and_told_at_once(tmp_path: Path, clock: ExactTime, kind: str, seed: int) -> None:
    """Torques are of the inputs of their own SYNC, are sent in its period, and stop where the master's period does."""
    rng = random.Random(seed)
    begin_ns = clock.now_ns + 10 * PERIOD_NS
    at_ns = begin_ns + rng.randrange(300, 400) * PERIOD_NS
    syncs = foreign(kind, rng, begin_ns, at_ns)
    times = [at for at, _ in syncs]
    wire = Wire(clock)
    wire.put(clock.now_ns, nmt(START))
    wire.follow((at, frame(0x080, b""), number) for at, number in syncs)
    loop = Loop(tmp_path, clock, wire)
    if kind == "restart":
        wire.put(at_ns, nmt(RESET_COMMUNICATION))
        for node in (1, 2, 3):
            wire.put(at_ns + 100_000, frame(0x700 + node, b"\0"))
        wire.put(times[-600] - 1000, nmt(START))
    if kind == "late guest":
        wire.stall(at_ns + rng.randrange(PERIOD_NS), rng.randrange(1, 6 * PERIOD_NS))
    loop.run(times[-1] + 100_000)
    found = truths(loop.read(), dict(syncs))
    good = [header.sync_realtime_ns for header, status in found if status in PUBLISHED]
    assert sum(at < at_ns for at in good) > 100
    later = [at for at in good if at >= at_ns + 50 * PERIOD_NS]
    # Of nodes that restarted nothing is used until the supervisor has seen to it.
    assert bool(later) == (kind in {"pause", "jitter", "late guest"})
    assert {struct.unpack_from("<I", data)[0] - OWN for _, data in wire.sent} <= {0x180, 0x700}
    if kind not in {"period", "second master"}:
        slots = [
            (header.cycle, round((header.sync_realtime_ns - begin_ns) / PERIOD_NS)) for header, _ in found
        ]
        assert {cycle - slot for cycle, slot in slots} == {slots[0][0]}, "the index follows time"
    sent = wire.own_frames(0x180)
    published = [header for header, _ in found if header.flags & FLAG_PUBLISHED]
    assert len(sent) == len(published)
    in_time = [
        times[bisect(times, at) - 1] == header.sync_realtime_ns
        for header, (at, _) in zip(published, sent, strict=True)
    ]
    assert sum(in_time) >= 0.999 * len(in_time)
    assert kind != "late guest" or loop.cycle.grid.missed <= 6


@pytest.mark.parametrize("command", [STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION])
@pytest.mark.parametrize("node", [0, 1])
def test_a_node_that_its_master_stops_is_not_used(
    tmp_path: Path, clock: ExactTime, command: int, node: int
) -> None:
    """Its frames may be those of another mapping: none of them is an input from the command on."""
    wire, begin_ns = Wire(clock), clock.now_ns + PERIOD_NS
    wire.put(clock.now_ns, nmt(START))
    wire.put(begin_ns + 100 * PERIOD_NS - 1000, nmt(command, node))
    loop = Loop(tmp_path, clock, wire.follow(regular(begin_ns))).run(begin_ns + 200 * PERIOD_NS)
    records = loop.read()
    used = [
        [
            not isnan(JointRecord(*JOINT.unpack_from(each, HEADER.size + n * JOINT.size)).dt_s)
            for each in records
        ]
        for n in range(2)
    ]
    assert sum(used[0][:100]) > 90
    assert not any(used[0][100:])
    assert any(used[1][100:]) == (node == 1)


def test_a_command_that_is_none_changes_nothing(tmp_path: Path, clock: ExactTime) -> None:
    """No node obeys it: their PDOs are used, and the own node goes on."""
    wire, begin_ns = Wire(clock), clock.now_ns + PERIOD_NS
    wire.put(clock.now_ns, nmt(START))
    wire.put(begin_ns + 100 * PERIOD_NS - 1000, nmt(0x99))
    loop = Loop(tmp_path, clock, wire.follow(regular(begin_ns))).run(begin_ns + 200 * PERIOD_NS)
    steps = [JointRecord(*JOINT.unpack_from(each, HEADER.size)).dt_s for each in loop.read()]
    assert sum(not isnan(each) for each in steps[100:]) > 80
    assert len(wire.estimates()) == 200


def test_what_bounds_a_guests_status_is_in_the_record(tmp_path: Path, clock: ExactTime) -> None:
    """So that a replay has the same status: the first cycles with SYNC, and joints whose drive nobody has checked."""
    loop = Loop(tmp_path, clock, Wire(clock))
    begin_ns = clock.now_ns + 1000 * PERIOD_NS
    loop.wire.put(begin_ns - PERIOD_NS, nmt(START))
    loop.wire.follow(regular(begin_ns))
    loop.reader.note_checked(2, checked=False)
    loop.cycle.configured_nodes.doubt()
    loop.run(begin_ns + 40 * PERIOD_NS)
    records = loop.read()
    flags = [header_of(each).flags for each in records]
    assert {each & 0xF00 for each in flags} == {cr.FLAG_UNCHECKED << 3}
    assert [each & cr.FLAG_STARTING != 0 for each in flags] == [True] * 20 + [False] * (len(flags) - 20)
    own = [JointRecord(*JOINT.unpack_from(records[-1], HEADER.size + n * JOINT.size)).status for n in (0, 1)]
    assert own == [VALID, DEGRADED]
    block = CycleMessages(2).block(records[-1], 1, 0, flags=flags[-1], sync_counter=1, frames=0)
    ends = [payload[-1] & cr.FLAG_UNCHECKED for _, payload in CycleMessages(2).payloads(block)]
    assert ends[:2] == [0, cr.FLAG_UNCHECKED]


def test_silence_shows_where_the_loop_is_asked(tmp_path: Path, clock: ExactTime) -> None:
    """Without SYNC: status starting before the first, stale after the last, within 0.2 s; the snapshot goes on."""
    loop = Loop(tmp_path, clock, Wire(clock))
    begin_ns = clock.now_ns + 1000 * PERIOD_NS
    loop.wire.put(begin_ns - PERIOD_NS, nmt(START))
    loop.wire.follow(regular(begin_ns, last=400))
    seen = []
    for ms in (500, 990, 1395, 1425, 1600):
        loop.run(begin_ns + (ms - 1000) * PERIOD_NS)
        loop.cycle.write_snapshot()
        view = loop.reader.read()
        seen.append((view.joints[0].status, view.node_states[OWN], view.sync_monotonic_ns > 0))
        assert abs(view.cycle - ms) <= 12
    assert seen == [(1, 0x7F, False), (1, 0x7F, False), (VALID, 5, True), (STALE, 5, True), (STALE, 5, True)]
    assert loop.wire.own_frames(0x180)[-1][0] < begin_ns + 400 * PERIOD_NS
