"""One to four joints on a bus: what goes out, what is recorded and shown of each of them."""

import math
from pathlib import Path

import pytest

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.input_pdos import InputPdo, JointInputs, drive_places
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.own_objects import estimate_tpdos
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.settings import EstimatorSettings
from jtqd.models.files import load_joint, shipped
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import (
    ENABLED,
    I32,
    MOTION,
    SCALE,
    SENSOR,
    ExactTime,
    ScriptedSocket,
    build,
    frame,
)

SENSOR_NODE = 9
CYCLES = 40


class Bus:
    """A cycle with so many joints; joint n has current 100 n, and a sensor channel where `sensor`."""

    def __init__(self, directory: Path, joints: int, *, sensor: bool = True, without: int = 0) -> None:
        self.numbers = range(1, joints + 1)
        self.sensor, self.without = sensor, without
        pdos = []
        for node in self.numbers:
            pdos.append(InputPdo(0x180 + node, 8, I32, node, f"position {node}"))
            pdos.append(InputPdo(0x280 + node, 8, MOTION, node, f"motion {node}"))
        if sensor:
            pdos.append(InputPdo(0x180 + SENSOR_NODE, 5, SENSOR, SENSOR_NODE, "sensor"))
        self.socket = ScriptedSocket(self.answers)
        self.snapshot_path = directory / "snapshot"
        settings = EstimatorSettings(method="efficiency")
        estimators = [JointEstimator(load_joint(shipped("joint1.yaml")), settings) for _ in self.numbers]
        inputs = [
            JointInputs(drive_places(2 * n), 2 * joints if sensor else None, **SCALE) for n in range(joints)
        ]
        pairs = list(zip(inputs, estimators, strict=True))
        self.cycle, self.ring = build(directory, self.socket, Intake(pdos), pairs, Grid(0, 1_000_000))

    def answers(self, sync: int) -> list[bytes]:
        found = []
        for node in self.numbers:
            if node == self.without and sync > CYCLES // 2:
                continue
            found.append(frame(0x180 + node, I32.pack(500 * sync, 50 * sync)))
            found.append(frame(0x280 + node, MOTION.pack(50_000, 100 * node, ENABLED)))
        if self.sensor:
            found.append(frame(0x180 + SENSOR_NODE, SENSOR.pack(9000, 0)))
        return found

    def estimates(self) -> list[dict[int, bytes]]:
        """Estimate PDOs of each cycle by their identifiers."""
        found: list[dict[int, bytes]] = []
        for data in self.socket.sent:
            can_id = int.from_bytes(data[:4], "little")
            if can_id == 0x080:
                found.append({})
            elif can_id in (0x1A0, 0x2A0):
                assert data[4] == 8
                found[-1][can_id] = data[8:16]
        return found


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> ExactTime:
    return ExactTime().install(monkeypatch)


@pytest.mark.parametrize("sensor", [True, False])
@pytest.mark.parametrize("joints", [1, 2, 3, 4])
def test_every_joint_is_sent_recorded_and_shown(
    tmp_path: Path, exact: ExactTime, joints: int, sensor: bool
) -> None:
    bus = Bus(tmp_path, joints, sensor=sensor)
    exact.turn(bus.cycle, CYCLES)
    sent = bus.estimates()
    ids = [pdo.cob_id for pdo in estimate_tpdos(joints)]
    assert ids == ([0x1A0] if joints <= 2 else [0x1A0, 0x2A0])
    assert [list(each) for each in sent] == [ids] * CYCLES
    records = bus.ring.read(limit=256).records
    assert {len(record) for record in records} == {cr.layout_of(joints).size}
    for number, (pdos, record) in enumerate(zip(sent, records, strict=True), start=1):
        for joint in bus.numbers:
            logged = cr.joint_of(record, joint)
            estimate = decode(pdos[ids[(joint - 1) // 2]])
            half = (joint - 1) % 2
            assert estimate.sequence == cr.header_of(record).sync_counter == number
            assert estimate.status[half] == logged.status
            torque = estimate.torque_nm[half]
            assert (torque is None) == math.isnan(logged.torque_nm)
            if torque is not None:
                assert torque == pytest.approx(logged.torque_nm, abs=0.0051)
            assert logged.current_a == pytest.approx(joint)
            assert logged.sensor_torque_nm == 9.0 if sensor else math.isnan(logged.sensor_torque_nm)
        frames = [int.from_bytes(data[:4], "little") for data, _ in rr.frames_of(record)]
        assert frames.count(0x080) == 1
        assert set(ids) <= set(frames)
        assert cr.header_of(record).frames_left_out == 0
        assert cr.header_of(record).stale_inputs == 0
    last = {joint: cr.joint_of(records[-1], joint) for joint in bus.numbers}
    assert [each.status for each in last.values()] == [2] * joints
    assert len({each.torque_nm for each in last.values()}) == joints
    bus.cycle.leave()
    view = SnapshotReader(bus.snapshot_path).read()
    assert len(view.joints) == len(view.rmse_nm) == len(view.measured) == len(view.status_cycles) == joints
    assert [sum(each) for each in view.status_cycles] == [CYCLES] * joints
    assert [each.status for each in view.joints] == [0] * joints
    assert [math.isfinite(each) for each in view.rmse_nm] == [sensor] * joints


@pytest.mark.parametrize("joints", [1, 3])
def test_the_second_half_of_an_odd_joint_s_pdo_is_off(tmp_path: Path, exact: ExactTime, joints: int) -> None:
    bus = Bus(tmp_path, joints)
    exact.turn(bus.cycle, CYCLES)
    for pdos in bus.estimates():
        data = list(pdos.values())[-1]
        assert data[2:4] == b"\x00\x80"
        assert data[5] == 255
        assert data[6] >> 4 == 0


@pytest.mark.parametrize("without", [1, 2, 3, 4])
def test_a_joint_without_inputs_is_stale_and_no_other_one(
    tmp_path: Path, exact: ExactTime, without: int
) -> None:
    bus = Bus(tmp_path, 4, without=without)
    exact.turn(bus.cycle, CYCLES)
    record = bus.ring.read(limit=256).records[-1]
    assert [cr.joint_of(record, joint).status for joint in bus.numbers] == [
        4 if joint == without else 2 for joint in bus.numbers
    ]


def test_joints_are_the_same_beside_others(tmp_path: Path, exact: ExactTime) -> None:
    """What joints 1 and 2 get does not depend on how many there are."""
    found = []
    for joints in (2, 4):
        directory = tmp_path / str(joints)
        directory.mkdir()
        bus = Bus(directory, joints)
        exact.turn(bus.cycle, CYCLES)
        found.append([each[0x1A0] for each in bus.estimates()])
    assert found[0] == found[1]


def test_a_bus_has_one_to_four_joints() -> None:
    for joints in (0, 5):
        with pytest.raises(ValueError, match=f"found {joints} joints"):
            cr.layout_of(joints)
