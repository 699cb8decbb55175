"""No time for the network: the cycle is physics only and in time. In exact time, with networks as slow as a test needs."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.input_pdos import JointInputs, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import JointCycle
from jtqd.daemon.core.schedule import RESERVED_NS, NetworkBudget
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import FLAG_NETWORK_SKIPPED, RingReader
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.estimator import FusedEstimator, make_estimator
from jtqd.estimator.joint import Effect
from jtqd.estimator.network import PathNetwork, load_network
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, STALE, VALID
from jtqd.models.files import load_joint, shipped
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import (
    I32,
    MOTION,
    PDOS,
    SCALE,
    ExactTime,
    ScriptedSocket,
    estimates,
    frame,
    inputs,
    make,
)
from tests.estimator.estimator_helpers import small_network
from tests.estimator.fused_configuration import joint_of, network_of

PERIOD_NS = 10_000_000
SETTINGS = EstimatorSettings(method="fused", track_torsion=True)
MS = 1_000_000


class SlowNetwork(PathNetwork):
    """The shipped network; each run takes as long as `spend_ns` says, in exact time."""

    def __init__(self, number: int, clock: ExactTime) -> None:
        super().__init__(network_of(number))
        self.spend_ns = 0
        inner = self.run_one

        def slow(*x: float) -> float:
            clock.now_ns += self.spend_ns
            return inner(*x)

        self.run_one = slow  # type: ignore[misc]
        self.perceptron = None  # type: ignore[misc]  # evaluated by a call, which takes its time


SlowNetwork.__name__ = PathNetwork.__name__  # a network fits a method by the name of its class


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    """Exact time for cycle and bus."""
    return ExactTime().install(monkeypatch)


def moving(n: int) -> list[bytes]:
    """Both joints turn with 0.5 rad/s under little load, as in the network's training; the current has its dither."""
    steps, current = 5000 * n, 150 + n % 3
    return [
        frame(0x181, I32.pack(steps, steps // 10 - 20)),
        frame(0x281, MOTION.pack(50_000, current, 0x27)),
        frame(0x182, I32.pack(-steps, -steps // 10 + 20)),
        frame(0x282, MOTION.pack(-50_000, -current, 0x27)),
        inputs()[4],
    ]


def built(tmp_path: Path, clock: ExactTime) -> Any:
    """Cycle, socket, reader and the networks of both joints; temperatures are unknown, so the trust is not asked here."""
    networks = [SlowNetwork(number, clock) for number in (1, 2)]
    estimators = [
        FusedEstimator(joint_of(number), SETTINGS, network)
        for number, network in zip((1, 2), networks, strict=True)
    ]
    safety = [JointSafety(None, SETTINGS, joint_of(number), PERIOD_NS) for number in (1, 2)]
    made = make(tmp_path, moving, estimators=estimators, safety=safety, slots=1024)
    return (*made, networks)


def skipped(reader: Any) -> list[tuple[bool, bool]]:
    """Of each new record: was the network of joint 1 and 2 left out?"""
    records = reader.read(limit=1024).records
    return [
        tuple(bool(cr.joint_of(record, n).input_flags & FLAG_NETWORK_SKIPPED) for n in (1, 2))  # type: ignore[misc]
        for record in records
    ]


def statuses(socket: ScriptedSocket) -> list[tuple[int, int]]:
    return [decode(data).status for data in estimates(socket)]


def counters(tmp_path: Path) -> dict[str, int]:
    return SnapshotReader(tmp_path / "snapshot").read().counters


def test_a_network_that_takes_its_usual_time_is_used(tmp_path: Path, clock: ExactTime) -> None:
    cycle, _, reader, networks = built(tmp_path, clock)
    for network in networks:
        network.spend_ns = 3 * MS
    clock.turn(cycle, 105)
    assert set(skipped(reader)) == {(False, False)}
    assert (counters(tmp_path)["network_no_time"], counters(tmp_path)["overruns"]) == (0, 0)


def test_late_inputs_leave_no_time_for_the_network_and_the_estimate_is_in_time(
    tmp_path: Path, clock: ExactTime
) -> None:
    cycle, socket, reader, networks = built(tmp_path, clock)
    for network in networks:
        network.spend_ns = 1 * MS
    clock.turn(cycle, 100)
    skipped(reader)

    def late() -> None:
        clock.now_ns = cycle.grid.slot_ns + PERIOD_NS - MS * 11 // 10  # both networks need 2 ms

    clock.turn(cycle, 1, {"observe": late})
    assert skipped(reader) == [(True, False)]
    clock.turn(cycle, 8)
    assert statuses(socket)[100][0] == DEGRADED
    assert decode(estimates(socket)[100]).torque_nm[0] is not None
    assert counters(tmp_path)["overruns"] == 0


def test_too_late_for_either_network_is_physics_for_both(tmp_path: Path, clock: ExactTime) -> None:
    cycle, socket, reader, networks = built(tmp_path, clock)
    for network in networks:
        network.spend_ns = 1 * MS
    clock.turn(cycle, 100)
    skipped(reader)

    def late() -> None:
        clock.now_ns = cycle.grid.slot_ns + PERIOD_NS - MS // 2

    clock.turn(cycle, 1, {"observe": late})
    assert skipped(reader) == [(True, True)]
    assert statuses(socket)[-1] == (DEGRADED, DEGRADED)
    pdo = decode(estimates(socket)[-1])
    assert None not in pdo.torque_nm
    (*_, record) = RingReader(tmp_path / "ring", rr.RECORD_SIZE).read().records
    joint = [cr.joint_of(record, n) for n in (1, 2)]
    assert [math.isnan(each.network_nm) for each in joint] == [True, True]
    assert [each.torque_nm for each in joint] == [each.physics_nm for each in joint]
    clock.turn(cycle, 8)
    assert (counters(tmp_path)["network_no_time"], counters(tmp_path)["overruns"]) == (2, 0)


def test_a_network_that_has_become_slow_costs_two_cycles_and_then_only_itself(
    tmp_path: Path, clock: ExactTime
) -> None:
    cycle, socket, reader, networks = built(tmp_path, clock)
    clock.turn(cycle, 50)
    networks[0].spend_ns = 25 * MS
    clock.turn(cycle, 500)
    late = [bool(cr.header_of(each).flags & cr.FLAG_WITHDRAWN) for each in reader.read(limit=1024).records]
    assert late[50:52] == [True, True], "the first two cannot be foreseen"
    assert not any(late[52:])
    shown = statuses(socket)
    assert shown[50:52] == [(STALE, STALE)] * 2
    assert {one for one, _ in shown[75:]} == {DEGRADED}
    assert {two for _, two in shown[75:]} <= {VALID, DEGRADED}
    networks[0].spend_ns = 0
    clock.turn(cycle, 2008)
    assert not any(skipped(reader)[-1]), "tried again, and it is quick"
    assert counters(tmp_path)["overruns"] == 2


def test_one_stall_of_the_machine_teaches_nothing(tmp_path: Path, clock: ExactTime) -> None:
    cycle, _, reader, networks = built(tmp_path, clock)
    clock.turn(cycle, 50)
    networks[0].spend_ns = 25 * MS
    clock.turn(cycle, 1)
    networks[0].spend_ns = 0
    clock.turn(cycle, 50)
    left_out = skipped(reader)
    assert left_out.pop(50) == (False, True), "in that very cycle nothing was left for joint 2"
    assert set(left_out) == {(False, False)}


def estimators_with_network() -> dict[str, Any]:
    """Of each kind that can have one, two alike."""
    paper = load_joint(shipped("joint1.yaml"))
    extended = replace(joint_of(1), effects=(Effect("current_offset", {"offset_a": 0.05}),))
    network = small_network().with_metadata(joint="joint1").data
    kinds = {
        "network": lambda: make_estimator(
            paper, EstimatorSettings(method="network"), load_network("network", network)
        ),
        "fused": lambda: make_estimator(joint_of(1), SETTINGS, load_network("fused", network_of(1))),
        "extended": lambda: make_estimator(extended, SETTINGS, load_network("fused", network_of(1))),
    }
    return {name: (made(), made()) for name, made in kinds.items()}


@pytest.mark.parametrize("kind", ["network", "fused", "extended"])
def test_a_cycle_without_the_network_is_physics_and_changes_no_later_one(kind: str) -> None:
    one, two = estimators_with_network()[kind]
    assert one.with_network
    for n in range(400):
        sample = (1e-3, 1.0 + 0.1 * (n % 7), 0.1 * n, 100.0, 1e-3 * n - 1e-4, 25.0)
        wanted = n % 5 != 3
        left, full = one.step(*sample, wanted), two.step(*sample)
        if wanted:
            assert np.array_equal(np.array(left), np.array(full), equal_nan=True), f"step {n}"
        elif n > 1:
            assert (left.status, left.torque_nm) == (DEGRADED, left.physics_nm)
            assert left.physics_nm == full.physics_nm
            assert math.isnan(left.network_nm)
            assert not math.isnan(full.network_nm)


def test_the_budget_leaves_time_for_the_second_joint() -> None:
    budget = NetworkBudget()
    now = 0
    for _ in range(3):
        budget.begin(now + MS)
        assert budget.wanted(0, now)
        assert budget.wanted(1, now + 300_000)
        budget.ended(now + 600_000)
        now += MS
    left = MS - RESERVED_NS
    budget.begin(now + MS)
    assert budget.wanted(0, now)
    budget.begin(now + MS)
    assert not budget.wanted(0, now + left - 599_999)
    assert budget.wanted(1, now + left - 300_000)
    budget.begin(now + MS)
    budget.wanted(0, now)
    assert not budget.wanted(1, now + left - 299_999)


@pytest.mark.parametrize("joints", [1, 2, 3, 4])
def test_every_joint_leaves_time_for_those_after_it(joints: int) -> None:
    budget, now = NetworkBudget(joints), 0
    for _ in range(3):
        budget.begin(now + MS)
        for joint in range(joints):
            assert budget.wanted(joint, now + joint * 100_000)
        budget.ended(now + joints * 100_000)
        now += MS
    latest = now + MS - RESERVED_NS
    for joint in range(joints):
        left = (joints - joint) * 100_000
        for start, wanted in ((latest - left, True), (latest - left + 1, False)):
            budget.begin(now + MS)
            for before in range(joint):
                budget.wanted(before, now)
            assert budget.wanted(joint, start) is wanted


def replay(records: list[bytes], clock: ExactTime) -> Iterator[tuple[float, ...]]:
    """Samples of joint 1 from the frames, times and flags of the records alone, through the loop's own code."""
    intake = Intake(PDOS)

    class Tally:
        counters = array("Q", [0] * len(COUNTERS))
        errors = array("d", [0.0] * 4)

    joint = JointCycle(
        0,
        JointInputs(drive_places(0), 4, **SCALE),
        FusedEstimator(joint_of(1), SETTINGS, SlowNetwork(1, clock)),
        intake=intake,
        snapshot=Tally(),
        period_ns=PERIOD_NS,
        safety=JointSafety(None, SETTINGS, joint_of(1), PERIOD_NS),
    )
    time_ns = 1 << 60
    for n, record in enumerate(records):
        header, logged = cr.header_of(record), cr.joint_of(record, 1)
        if header.flags & cr.FLAG_RESET:
            joint.reset_latch()
        data = {int.from_bytes(each[:4], "little"): each[8:16] for each, _ in rr.frames_of(record)}
        for index, bit in ((0, 1), (1, 2), (4, 4)):
            fresh, pdo = bool(logged.input_flags & bit), PDOS[index]
            intake.place(index, pdo.layout.unpack_from(data[pdo.cob_id]) if fresh else None)
        if fresh and not math.isnan(logged.dt_s):
            time_ns += round(logged.dt_s * 1e9)
        joint.observe(time_ns, n < 20, not logged.input_flags & FLAG_NETWORK_SKIPPED)
        if header.flags & cr.FLAG_WITHDRAWN:
            joint.withdraw(STALE)
        yield joint.sample


def test_the_record_is_enough_to_replay_it_bit_for_bit(tmp_path: Path, clock: ExactTime) -> None:
    """Slow networks, late inputs, lost frames, a jump, its latch and its reset: every decision is in the record."""
    cycle, socket, reader, networks = built(tmp_path, clock)
    script = socket.script

    def disturbed(n: int) -> list[bytes]:
        frames = script(n)
        if n in {120, 121, 127, 300}:
            return frames[1:]
        if n > 200:
            steps = 5000 * n + 40_000
            return [frame(0x181, I32.pack(steps, 500 * n - 20)), *frames[1:]]
        return frames

    socket.script = disturbed
    for n in range(500):
        networks[0].spend_ns = 25 * MS if 60 <= n < 80 else 0
        late = {"observe": lambda: setattr(clock, "now_ns", cycle.grid.slot_ns + PERIOD_NS - 1)}
        if n == 400:
            cycle.reset_faults()
        clock.turn(cycle, 1, late if n % 97 == 50 else None)
    records = reader.read(limit=1024).records
    logged = [cr.joint_of(record, 1) for record in records]
    seen = {int(each.status) for each in logged}
    assert {1, 3, 4, 15} <= seen
    assert any(each.input_flags & FLAG_NETWORK_SKIPPED for each in logged)
    for n, (live, again) in enumerate(zip(logged, replay(records, clock), strict=True)):
        assert np.array_equal(np.array(live), np.array(again), equal_nan=True), f"cycle {n}"
