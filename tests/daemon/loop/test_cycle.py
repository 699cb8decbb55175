"""Stages of a cycle against a scripted socket: what goes out is what came in, scaled, dated and in time. The grid."""

import gc
import itertools
import math
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.core.schedule import Grid, WakeUp
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.status import VALID, Estimate
from tests.daemon import ring_records as rr
from tests.daemon.loop.cycle_helpers import (
    I32,
    SCALE,
    SENSOR,
    ExactTime,
    estimates,
    frame,
    inputs,
    make,
    turn,
)


@pytest.fixture(autouse=True)
def _exact_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cycle is late only where a test wants it to be."""
    ExactTime().install(monkeypatch)


def test_each_sync_gets_one_estimate_with_its_counter(tmp_path: Path) -> None:
    cycle, socket, _ = make(tmp_path, lambda n: inputs())
    turn(cycle, 250)
    counters = [data[8] for data in socket.sent if struct.unpack_from("<I", data)[0] == 0x080]
    assert counters == [n % 240 + 1 for n in range(250)]
    assert [decode(data).sequence for data in estimates(socket)] == counters


def test_a_sync_without_counter_is_empty_and_the_estimate_still_counts(tmp_path: Path) -> None:
    cycle, socket, reader = make(tmp_path, lambda n: inputs(), counter_overflow=0)
    turn(cycle, 250)
    syncs = [data for data in socket.sent if struct.unpack_from("<I", data)[0] == 0x080]
    assert {data[4] for data in syncs} == {0}
    assert [decode(data).sequence for data in estimates(socket)] == [n % 240 + 1 for n in range(250)]
    flags = {cr.header_of(record).flags & cr.FLAG_SYNC_CONFIRMED for record in reader.read().records}
    assert flags == {cr.FLAG_SYNC_CONFIRMED}


def test_the_first_cycles_are_published_as_starting(tmp_path: Path) -> None:
    cycle, socket, _ = make(tmp_path, lambda n: inputs())
    turn(cycle, 30)
    statuses = [decode(data).status for data in estimates(socket)]
    assert statuses[:20] == [(1, 1)] * 20
    assert statuses[20:] == [(2, 2)] * 10
    assert decode(estimates(socket)[0]).torque_nm == (None, None)


def test_inputs_are_scaled_and_recorded(tmp_path: Path) -> None:
    cycle, _, reader = make(tmp_path, lambda n: inputs())
    turn(cycle, 3)
    record = reader.read().records[2]
    joint = cr.joint_of(record, 1)
    assert joint.motor_position_rad == pytest.approx(0.1)
    assert joint.link_position_rad == pytest.approx(0.02)
    assert joint.motor_velocity_rad_s == pytest.approx(5.0)
    assert joint.current_a == pytest.approx(2.0)
    assert joint.sensor_torque_nm == pytest.approx(9.0)
    assert cr.joint_of(record, 2).motor_position_rad == pytest.approx(-0.1)
    assert joint.input_flags == 7
    header = cr.header_of(record)
    assert header.flags & (cr.FLAG_COMPLETE | cr.FLAG_PUBLISHED | cr.FLAG_SYNC_CONFIRMED) == 0x0B
    ids = [struct.unpack_from("<I", data)[0] for data, _ in rr.frames_of(record)]
    assert ids == [0x080, 0x181, 0x281, 0x182, 0x282, 0x183, 0x1A0]


def test_a_missing_input_is_stale_for_its_joint_only(tmp_path: Path) -> None:
    cycle, socket, reader = make(tmp_path, lambda n: inputs() if n != 40 else inputs()[1:])
    turn(cycle, 45)
    pdo = decode(estimates(socket)[39])
    assert pdo.status == (4, 2)
    assert pdo.torque_nm[0] is None
    assert pdo.torque_nm[1] is not None
    joint = cr.joint_of(reader.read(limit=64).records[39], 1)
    assert math.isnan(joint.torque_nm)
    assert joint.input_flags == 2 | 4


@pytest.mark.parametrize(
    ("missing", "flags"), [(0, (6, 7)), (1, (5, 7)), (3, (7, 5)), (4, (3, 3)), (5, (7, 7))]
)
def test_the_snapshot_says_which_inputs_a_joint_has(
    tmp_path: Path, missing: int, flags: tuple[int, int]
) -> None:
    cycle, _, _ = make(tmp_path, lambda n: [*inputs()[:missing], *inputs()[missing + 1 :]])
    turn(cycle)
    one, two = SnapshotReader(tmp_path / "snapshot").read().joints
    assert (one.input_flags, two.input_flags) == flags


def test_a_missing_sensor_does_not_touch_the_estimate(tmp_path: Path) -> None:
    cycle, socket, _ = make(tmp_path, lambda n: inputs() if n < 30 else inputs()[:4])
    turn(cycle, 40)
    assert decode(estimates(socket)[35]).status == (2, 2)


@pytest.mark.parametrize(
    ("word", "status"), [(0x08, 5), (0x0F, 5), (0x40, 0), (0x21, 0), (0x23, 0), (0x07, 2)]
)
def test_the_drive_state_decides(tmp_path: Path, word: int, status: int) -> None:
    cycle, socket, _ = make(tmp_path, lambda n: inputs(status=word))
    turn(cycle, 25)
    pdo = decode(estimates(socket)[-1])
    assert pdo.status[0] == status
    assert (pdo.torque_nm[0] is None) == (status != 2)


def test_an_invalid_sensor_is_no_reference(tmp_path: Path) -> None:
    script = [*inputs()[:4], frame(0x183, SENSOR.pack(9000, 1))]
    cycle, _, reader = make(tmp_path, lambda n: script)
    turn(cycle, 30)
    assert math.isnan(cr.joint_of(reader.read().records[-1], 1).sensor_torque_nm)
    assert math.isnan(SnapshotReader(tmp_path / "snapshot").read().rmse_nm[0])


def test_a_bus_that_is_down_is_stale_and_counted_and_comes_back(tmp_path: Path) -> None:
    cycle, socket, reader = make(tmp_path, lambda n: inputs())
    turn(cycle, 30)
    socket.down = True
    turn(cycle, 2)
    socket.down = False
    turn(cycle, 15)
    records = reader.read(limit=64).records
    # Two cycles without a bus, one in which the first answers could be old ones, then good again with the fifth good one.
    assert [cr.joint_of(record, 1).status for record in records[29:38]] == [2, *[4] * (2 + 1 + 4), 2]
    assert not cr.header_of(records[31]).flags & cr.FLAG_PUBLISHED


def test_the_heartbeat_is_the_loops_own(tmp_path: Path) -> None:
    cycle, socket, _ = make(tmp_path, lambda n: inputs())
    turn(cycle, 201)
    heartbeats = [data for data in socket.sent if struct.unpack_from("<I", data)[0] == 0x720]
    assert heartbeats == [frame(0x720, b"\x05")] * 3


def test_more_frames_than_a_record_holds_are_counted(tmp_path: Path) -> None:
    flood = [frame(0x701, b"\x05")] * 20
    cycle, _, reader = make(tmp_path, lambda n: inputs() + flood)
    turn(cycle, 2)
    header = cr.header_of(reader.read().records[1])
    assert header.frame_count == rr.FRAME_CAPACITY
    assert header.frames_left_out == 1 + 5 + 20 + 1 - rr.FRAME_CAPACITY


def test_leaving_says_off(tmp_path: Path) -> None:
    cycle, socket, _ = make(tmp_path, lambda n: inputs())
    turn(cycle, 30)
    cycle.leave()
    pdo = decode(estimates(socket)[-1])
    assert pdo.status == (0, 0)
    assert pdo.torque_nm == (None, None)


def test_the_wake_up_follows_the_arrival_of_the_inputs() -> None:
    wake_up = WakeUp(0, 100_000)
    for _ in range(3000):
        wake_up.follow(60_000)
    assert wake_up.wait_ns == pytest.approx(70_000, abs=20_000)
    for _ in range(30):
        wake_up.follow(90_000)
    assert wake_up.wait_ns <= 90_000, "never beyond the deadline"


def test_a_position_that_rolls_over_goes_on(tmp_path: Path) -> None:
    counts = [0, 2**31 - 5, 2**31 + 5, 2**32 - 7, 2**31 + 5, 2**31 - 5, 0, -(2**31) + 3, -(2**31) - 3, -5]
    wire = [(value + 2**31) % 2**32 - 2**31 for value in counts]
    cycle, _, reader = make(tmp_path, lambda n: [frame(0x181, I32.pack(wire[n - 1], 0)), *inputs()[1:]])
    turn(cycle, len(counts))
    recorded = [cr.joint_of(record, 1).motor_position_rad for record in reader.read().records]
    assert recorded == [value * SCALE["motor_rad_per_count"] for value in counts]


def test_the_estimate_does_not_see_the_roll_over(tmp_path: Path) -> None:
    def script(n: int) -> list[bytes]:
        counts = (2**31 - 2000 + 40 * n + 2**31) % 2**32 - 2**31
        return [frame(0x181, I32.pack(counts, 10 * n)), *inputs()[1:]]

    cycle, socket, reader = make(tmp_path, script)
    turn(cycle, 60)
    assert {decode(data).status[0] for data in estimates(socket)[20:]} == {2}
    positions = [cr.joint_of(record, 1).motor_position_rad for record in reader.read().records]
    steps = [b - a for a, b in itertools.pairwise(positions)]
    assert steps == pytest.approx([40e-4] * 59)


def test_an_estimate_that_is_too_late_is_withdrawn(tmp_path: Path) -> None:
    cycle, socket, reader = make(tmp_path, lambda n: inputs())
    turn(cycle, 30)

    def late() -> None:
        cycle.grid.slot_ns -= 20_000_000  # the next SYNC was due 10 ms ago

    turn(cycle, publish=late)
    pdo = decode(estimates(socket)[-1])
    assert pdo.status == (4, 4)
    assert pdo.torque_nm == (None, None)
    record = reader.read().records[-1]
    assert cr.header_of(record).flags & cr.FLAG_WITHDRAWN
    joint = cr.joint_of(record, 1)
    assert joint.status == 4
    assert math.isnan(joint.torque_nm)
    turn(cycle, 5)
    assert [decode(data).status for data in estimates(socket)[-5:]] == [(4, 4)] * 4 + [(2, 2)]


def test_a_stall_of_minutes_is_recorded_and_not_fatal(tmp_path: Path) -> None:
    cycle, _, reader = make(tmp_path, lambda n: inputs())
    turn(cycle, 3)

    def stall() -> None:
        cycle.late_ns = 600_000_000_000
        cycle.work_start_ns -= 600_000_000_000

    turn(cycle, record=stall)
    header = cr.header_of(reader.read().records[-1])
    assert header.work_ns == 0xFFFF_FFFF
    assert header.late_ns == 0x7FFF_FFFF


def test_log_and_bus_agree_on_a_torque_that_does_not_fit_the_field(tmp_path: Path) -> None:
    class Huge:
        with_network = False

        def step(self, *_: float) -> Estimate:
            return Estimate(400.0, 1.0, VALID, 1.0, 1.0, math.nan)

    cycle, socket, reader = make(tmp_path, lambda n: inputs(), estimators=[Huge(), Huge()])
    turn(cycle, 25)
    assert decode(estimates(socket)[-1]).status[0] == 15
    joint = cr.joint_of(reader.read().records[-1], 1)
    assert joint.status == 15
    assert math.isnan(joint.torque_nm)


MS = 1_000_000


def test_on_time_cycles_stay_on_the_grid() -> None:
    grid = Grid(10 * MS, MS)
    for n in range(1, 5):
        assert grid.advance(10 * MS + (n - 1) * MS + 300_000) == 0
        assert grid.slot_ns == (10 + n) * MS
    assert grid.missed == 0


def test_a_stall_is_skipped_counted_and_not_made_up() -> None:
    grid = Grid(0, MS)
    assert grid.advance(200 * MS + 100_000) == 199
    assert grid.slot_ns == 200 * MS  # 0.1 ms ago: can still be begun
    assert grid.missed == 199
    assert grid.advance(200 * MS + 200_000) == 0
    assert grid.slot_ns == 201 * MS


def test_half_a_period_decides() -> None:
    late = Grid(0, MS)
    assert late.advance(MS + MS // 2) == 0
    assert late.slot_ns == MS
    too_late = Grid(0, MS)
    assert too_late.advance(MS + MS // 2 + 1) == 1
    assert too_late.slot_ns == 2 * MS
    assert not too_late.too_late(2 * MS + MS // 2)
    assert too_late.too_late(2 * MS + MS // 2 + 1)


HEALTHY, LOST, STRANGE = inputs(), inputs()[1:], [*inputs(), inputs()[0]]


def test_no_cycle_leaves_anything_to_a_collector(tmp_path: Path) -> None:
    """Whole ones, ones without an input, ones with a frame twice."""
    cycle, _, _ = make(tmp_path, lambda n: (HEALTHY, LOST, STRANGE)[n % 3])
    turn(cycle, 100)
    gc.collect()
    gc.disable()
    try:
        turn(cycle, 300)
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_the_collector_is_off_once_the_loop_is_ready() -> None:
    code = (
        "import gc; from jtqd.daemon.loop import realtime; realtime.freeze(); "
        "print(gc.isenabled(), gc.get_freeze_count() > 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
