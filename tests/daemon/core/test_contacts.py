"""Contacts in the loop: what goes out, what is recorded and counted, and that a replay gives the same bits."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.bus.own_node import OwnNode
from jtqd.daemon.config import ContactSettings, load_config
from jtqd.daemon.core.estimate_pdo import NO_RATE, ContactPdo, decode_contact
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import ContactWatch, JointCycle
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.replay.logged import SAMPLE
from jtqd.daemon.replay.rows import CycleRows
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.drivers.object_dictionary import ObjectStore, read_eds
from jtqd.estimator.detection import detect_contacts
from jtqd.estimator.estimator import Estimator, FusedEstimator, make_estimator
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import CONTACT_NONE, CONTACT_PRESENT, INVALID
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, Push, emulate
from jtqd.sim_can.plant_source import load_any_plant
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import ENABLED, I32, MOTION, ExactTime, ScriptedSocket, build, frame
from tests.paths import JTQD_EDS

CYCLES = 400
PUSHED, MISSING = 300, 200
THRESHOLD_NM = 0.8
SETTINGS = replace(recommended("fused"), track_zeros=False)
UNITS = (2.0 * math.pi / 65536, 2.0 * math.pi / 65536, 2.0 * math.pi / 524288, 0.008)
SCALE = dict(
    zip(
        ("motor_rad_per_count", "motor_rad_s_per_unit", "link_rad_per_count", "ampere_per_unit"),
        UNITS,
        strict=True,
    ),
    sensor_nm_per_unit=0.0,
)
PDOS = [
    InputPdo(base + n, 8, layout, n, f"{base + n:X}h")
    for n in (1, 2)
    for base, layout in ((0x180, I32), (0x280, MOTION))
]


@cache
def counts(moves: bool = True) -> tuple[tuple[tuple[int, int, int, int], ...], ...]:
    """Of each cycle and joint: motor position, velocity, link position, current, as a drive sends them."""
    size = 1.0 if moves else 0.0
    moved = JointCommand.velocity(lambda t: 0.8 * size * math.sin(12.0 * t))
    loaded = JointCommand.current(lambda t: 2.0 * size * math.sin(9.0 * t))
    plant = load_any_plant(shipped("campaign_plant.yaml"))
    push = [Push(1e-3 * (PUSHED - 0.4), 3.0)]
    made = emulate(plant, (moved, loaded), 1e-3 * CYCLES, 7, day=1, pushes=push).table
    found = []
    for n in (1, 2):
        c = made.joint(n, 100.0)
        columns = c.motor_position_rad, c.motor_velocity_rad_s, c.link_position_rad, c.current_a
        found.append(
            np.column_stack([np.rint(each / unit) for each, unit in zip(columns, UNITS, strict=True)]).astype(
                int
            )  # type: ignore[operator]
        )
    return tuple(tuple(tuple(each[k].tolist()) for each in found) for k in range(CYCLES))  # type: ignore[misc]


def joints() -> list[tuple[JointInputs, Estimator]]:
    return [
        (
            JointInputs(drive_places(2 * n), None, **SCALE),
            make_estimator(load_joint(shipped(f"trained/joint{n + 1}.yaml")), SETTINGS),
        )
        for n in (0, 1)
    ]


class Loop:
    """A loop whose bus answers the emulated run; in cycle MISSING the motion of joint 1 does not come.

    In three cycles from `jumps_at` on its motor is a turn further: a fault that stays latched.
    """

    def __init__(self, directory: Path, contacts: ContactWatch | None, moves: bool = True) -> None:
        self.moves = moves
        self.jumps_at = CYCLES
        self.socket = ScriptedSocket(self.answers)
        self.path = directory / "snapshot"
        self.cycle, self.ring = build(
            directory, self.socket, Intake(PDOS), joints(), Grid(0, 1_000_000), slots=512, contacts=contacts
        )
        self.sync = 0

    def answers(self, sync: int) -> list[bytes]:
        row, self.sync = self.sync, self.sync + 1
        found = []
        for n, (motor, speed, link, current) in enumerate(counts(self.moves)[row], start=1):
            jumped = 65536 * (n == 1 and 0 <= row - self.jumps_at < 3)
            found.append(frame(0x180 + n, I32.pack(motor + jumped, link)))
            if row != MISSING or n != 1:
                found.append(frame(0x280 + n, MOTION.pack(speed, current, ENABLED)))
        return found

    def sent(self) -> list[ContactPdo]:
        frames = [each for each in self.socket.sent if int.from_bytes(each[:4], "little") == 0x3A0]
        assert all(each[4] == 4 for each in frames)
        return [decode_contact(each[8:12]) for each in frames]

    def records(self) -> list[bytes]:
        return [bytes(each) for each in self.ring.read(limit=512).records]


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    return ExactTime().install(monkeypatch)


def test_a_push_goes_out_is_recorded_and_counted(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM, 5.0], opposed=True))
    exact.turn(loop.cycle, CYCLES)
    sent, records = loop.sent(), loop.records()
    assert len(sent) == len(records) == CYCLES
    codes = [each.contact for each in sent]
    assert set(codes[:100]) == {(1, 1)}, "not known before it has settled"
    assert codes[MISSING : MISSING + 5] == [(1, 1)] * 5, (
        "nor where an input is missing, until three steps are even again"
    )
    assert set(codes[110:MISSING] + codes[MISSING + 5 : PUSHED]) == {(2, 2)}
    assert codes[PUSHED + 2 : PUSHED + 90] == [(3, 4)] * 88, (
        "joint 1 along, joint 2 against its own direction"
    )
    for record, pdo in zip(records, sent, strict=True):
        one, two = cr.joint_of(record, 1), cr.joint_of(record, 2)
        known = pdo.contact[0] != 1
        assert (
            bool(one.input_flags & cr.FLAG_CONTACT_KNOWN)
            == bool(two.input_flags & cr.FLAG_CONTACT_KNOWN)
            == known
        )
        assert bool(one.input_flags & cr.FLAG_CONTACT) == (pdo.contact[0] == 3)
        assert math.isnan(one.contact_nm) == (not known)
        if known:
            assert one.contact_nm == -two.contact_nm
            rate = pdo.torque_rate_nm_s[0]
            assert rate == pytest.approx(max(min(one.torque_rate_nm_s, 4064.0), -4064.0), abs=16.01)
        assert pdo.sequence == cr.header_of(record).sync_counter
        assert 0x3A0 in [int.from_bytes(data[:4], "little") for data, _ in rr.frames_of(record)]
    settled = [cr.joint_of(record, 1).contact_nm for record in records[PUSHED + 8 : PUSHED + 60]]
    assert np.mean(settled) == pytest.approx(3.0, abs=0.5)
    loop.cycle.leave()
    assert SnapshotReader(loop.path).read().counters["contacts"] == 1


def test_the_loop_agrees_with_the_arrays(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2, opposed=True))
    exact.turn(loop.cycle, CYCLES)
    records = loop.records()
    joints = [[cr.joint_of(record, n) for record in records] for n in (1, 2)]
    loads = np.full((2, CYCLES), np.nan)
    for n, states in enumerate(joints):
        used = [k for k, each in enumerate(states) if not math.isnan(each.current_a)]
        names = "dt_s", "current_a", "motor_position_rad", "motor_velocity_rad_s", "link_position_rad"
        columns = [np.array([getattr(states[k], name) for k in used]) for name in names]
        joint = load_joint(shipped(f"trained/joint{n + 1}.yaml"))
        loads[n, used] = FusedEstimator(joint, SETTINGS).run(*columns).load_nm
    angle = np.array([each.motor_position_rad for each in joints[0]])
    residual, codes = detect_contacts(loads[1] - loads[0], angle, THRESHOLD_NM)
    np.testing.assert_array_equal([each.contact_nm for each in joints[0]], residual)
    assert {CONTACT_NONE, CONTACT_PRESENT} < set(codes.tolist())


def test_alone_at_rest_each_joint_sees_its_half_of_the_push(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2), moves=False)
    exact.turn(loop.cycle, CYCLES)
    assert {each.contact for each in loop.sent()[110:PUSHED]} <= {(2, 2), (1, 2), (1, 1)}
    record = loop.records()[PUSHED + 10]
    after = [cr.joint_of(record, n).contact_nm for n in (1, 2)]
    assert loop.sent()[PUSHED + 10].contact == (3, 4)
    assert after == pytest.approx([1.5, -1.5], abs=0.5)


def test_the_objects_of_the_node_are_what_was_sent(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2, opposed=True))
    config = load_config(None)
    for contact, expected in (
        (ContactSettings(opposed=True), (0x4000_03A0, 0x43)),
        (ContactSettings(pdo=False), (0xC000_03A0, 0x43)),
        (None, (0xC000_03A0, 0)),
    ):
        if contact is not None and contact.pdo:
            exact.turn(loop.cycle, PUSHED + 20)
        store = ObjectStore(read_eds(JTQD_EDS, 0x20).entries, 0x20)
        OwnNode(store, replace(config, contact=contact), SnapshotReader(loop.path, supervisor=True))
        assert (store.number(0x1802, 1), int.from_bytes(store.read(0x2107, 0), "little")) == expected
        rate = int.from_bytes(store.read(0x2106, 1), "little", signed=True)
        assert (rate == NO_RATE) == (contact is None)


@pytest.mark.parametrize("watched", [False, True])
def test_nothing_goes_out_where_it_is_in_the_log_only_or_not_watched(
    tmp_path: Path, exact: ExactTime, watched: bool
) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2, opposed=True, sends=False) if watched else None)
    exact.turn(loop.cycle, CYCLES)
    assert loop.sent() == []
    first = [cr.joint_of(record, 1) for record in loop.records()]
    assert any(each.input_flags & cr.FLAG_CONTACT for each in first) == watched
    assert any(each.input_flags & cr.FLAG_CONTACT_KNOWN for each in first) == watched
    assert all(math.isnan(each.contact_nm) for each in first) != watched


def test_an_answer_that_comes_too_late_knows_of_no_contact(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2, opposed=True))
    exact.turn(loop.cycle, PUSHED + 10)

    def late() -> None:
        exact.now_ns += 2_000_000

    exact.turn(loop.cycle, 1, {"publish": late})
    record, last = loop.records()[-1], loop.sent()[-1]
    assert cr.header_of(record).flags & cr.FLAG_WITHDRAWN
    assert last.contact == (1, 1)
    assert last.torque_rate_nm_s == (None, None)
    assert math.isnan(cr.joint_of(record, 1).contact_nm)


def test_an_invalid_encoder_gives_no_contacts(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2))
    loop.jumps_at = PUSHED - 50
    exact.turn(loop.cycle, CYCLES)
    records, sent = loop.records(), loop.sent()
    assert cr.joint_of(records[loop.jumps_at - 1], 1).input_flags & cr.FLAG_CONTACT_KNOWN
    invalid = [row for row, record in enumerate(records) if cr.joint_of(record, 1).status == INVALID]
    assert len(invalid) > 20, "longer than the jump itself"
    for row in invalid:
        joint = cr.joint_of(records[row], 1)
        assert not joint.input_flags & (cr.FLAG_CONTACT | cr.FLAG_CONTACT_KNOWN)
        assert math.isnan(joint.contact_nm)
        assert (sent[row].contact[0], sent[row].torque_rate_nm_s[0]) == (1, None)
    goes_on = [sent[row].contact[1] != 1 for row in invalid]
    assert sum(goes_on) > 0.8 * len(invalid), "joint 2 goes on"


def test_rows_of_a_log_give_the_same_bits(tmp_path: Path, exact: ExactTime) -> None:
    loop = Loop(tmp_path, ContactWatch([THRESHOLD_NM] * 2, opposed=True))
    exact.turn(loop.cycle, CYCLES)
    records = loop.records()
    logged = [np.array([cr.joint_of(record, n) for record in records], SAMPLE) for n in (1, 2)]
    headers = [cr.header_of(record) for record in records]
    intake = Intake(PDOS)
    snapshot = Snapshot(tmp_path / "again", 1e-3, 0.8, 2)
    cycles = [
        JointCycle(n, *each, intake=intake, snapshot=snapshot, period_ns=1_000_000)
        for n, each in enumerate(joints())
    ]
    table = np.array(counts())
    flags = [each["input_flags"] for each in logged]
    fresh = np.array([(flags[n] & bit) != 0 for n in (0, 1) for bit in (cr.FLAG_POSITION, cr.FLAG_MOTION)])
    assert not fresh[1, MISSING]
    word = np.full(CYCLES, ENABLED)
    rows = CycleRows(
        intake,
        cycles,
        fresh=fresh,
        values=[
            part
            for n in (0, 1)
            for part in ((table[:, n, 0], table[:, n, 2]), (table[:, n, 1], table[:, n, 3], word))
        ],
        celsius=np.empty((0, CYCLES)),
        cycle=np.array([each.cycle for each in headers]),
        counter=np.array([each.sync_counter for each in headers]),
        sync_ns=np.array([[each.sync_realtime_ns for each in headers]] * 2),
        wanted=np.ones((2, CYCLES), bool),
        flags=np.zeros((2, CYCLES), np.uint8),
        contacts=ContactWatch([THRESHOLD_NM] * 2, opposed=True),
    )
    rows.go_on(0, CYCLES)
    for n in (0, 1):
        again = rows.samples[n].view(SAMPLE)[:, 0]
        for name in ("torque_rate_nm_s", "contact_nm", "input_flags", "torque_nm", "status"):
            np.testing.assert_array_equal(again[name], logged[n][name], err_msg=name)


def test_what_cannot_be_watched_is_refused(tmp_path: Path) -> None:
    for thresholds, opposed in (([1.0], True), ([1.0] * 3, True), ([], False), ([1.0] * 5, False)):
        with pytest.raises(ValueError, match=r"found [0-5] joints, expected 1 to 4, and 2 or 4 that"):
            ContactWatch(thresholds, opposed=opposed)
    with pytest.raises(ValueError, match="found a threshold of"):
        ContactWatch([1.0, -1.0])
    with pytest.raises(ValueError, match="found contacts of 1 joints, expected 2"):
        Loop(tmp_path, ContactWatch([1.0]))
