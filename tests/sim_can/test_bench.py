"""The bench as a whole: its time from SYNC to SYNC, the demo, idling, the end of a played run, random frames."""

import random
import struct

import pytest

from jtqd.drivers.frame import FRAME
from jtqd.models.files import shipped
from jtqd.sim_can.bench import bench_filters
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import CURRENT, VELOCITY
from tests.sim_can.bench_player import MS, RESET_NODE, FakeSource, Player, enabled, mapped_player

PLANT = load_plant(shipped("plant.yaml"))


def test_first_sync_is_time_zero_and_then_measured_time_counts():
    player = Player()
    player.sync(after_ms=123.0)
    player.sync(after_ms=1.0)
    player.sync(after_ms=1.7)
    player.sync(after_ms=400.0)  # clipped
    player.stamp -= 10_000 * MS  # the clock was set back
    player.sync(after_ms=1.0)
    player.stamp += 7_200_000 * MS  # ... and on
    player.sync(after_ms=1.0)
    player.sync(after_ms=1.7)
    assert player.source.steps == pytest.approx([0.0, 0.001, 0.0017, 0.05, 0.001, 0.001, 0.0017])


def test_equal_stamps_give_equal_frames():
    def run():
        player = mapped_player(PlantSource(PLANT, 4), "demo")
        return [player.sync(1 + k % 240, 1.0 + 0.03 * (k % 3)) for k in range(1500)]

    first = run()
    assert first == run()
    assert len(set(map(tuple, first))) > 1400


def test_demo_enables_both_drives_at_the_first_sync_and_moves():
    player = mapped_player(PlantSource(PLANT, 1), "demo")
    assert player.status(1) == player.status(2) == 0x40
    player.sync()
    assert player.status(1) == player.status(2) == 0x27
    assert (player.read(1, 0x6061), player.read(2, 0x6061)) == (VELOCITY, CURRENT)
    for k in range(4000):
        player.sync(1 + k % 240)
    assert abs(player.source.drives[0].motor_velocity_rad_s) > 5.0
    assert abs(player.source.channels[0].torque_nm) > 1.0


@pytest.mark.parametrize(("index", "value", "size"), [(0x6060, 9, 1), (0x6040, 0, 2)])
def test_a_master_ends_the_demo_on_both_drives(index, value, size):
    player = Player(PlantSource(PLANT, 1), "demo")
    for _ in range(5):
        player.sync()
    player.put(1, index, 0, value, size)
    assert player.status(1) == player.status(2) == 0x40
    for _ in range(5):
        player.sync()
    assert player.status(1) == player.status(2) == 0x40


def test_demo_is_released_without_the_master_and_begins_again_from_rest():
    player = Player(PlantSource(PLANT, 1), "demo")
    for drive in (1, 2):
        player.put(drive, 0x1016, 1, 0x0020_00C8, 4)
    for _ in range(3000):
        player.sync()
    player.send(0x720, b"\x05")
    lost = player.tick(player.now // MS + 300)
    assert [text[:8] for text in lost] == ["081#3081", "082#3081"]
    assert player.status(1) == 0x40  # no fault: nobody commands it
    assert player.bench._profile_s > 2.9
    player.sync()
    assert player.status(1) == 0x27
    assert player.bench._profile_s == 0.0


def test_powered_drives_go_on_slowly_without_sync():
    player = Player()
    enabled(player)
    player.sync()
    start = player.now
    player.tick(start // MS)
    assert player.bench.due_ns == start + 50 * MS
    player.tick(start // MS + 50)
    assert player.source.steps[-1] == pytest.approx(0.05)
    assert player.bench.due_ns == player.now + 10 * MS
    player.tick(player.now // MS + 10)
    assert player.source.steps[-1] == pytest.approx(0.01)
    player.stamp += 60 * MS
    player.sync(after_ms=1.0)
    assert player.source.steps[-1] == pytest.approx(0.001)  # what idle steps covered does not count twice


def test_standing_bench_sleeps_without_sync():
    player = Player()
    player.sync()
    assert player.bench.due_ns > player.now + 10**12


def test_played_run_reports_operation_enabled_and_ends():
    player = mapped_player(FakeSource(channels=2, enabled=True, rows=3))
    assert [len(player.sync()) for _ in range(4)] == [5, 5, 5, 0]
    assert player.bench.over
    assert player.status(1) == player.status(2) == 0x27


@pytest.mark.parametrize("seed", range(4))
def test_random_frames_never_raise_and_never_enable_a_drive_outside_its_states(seed):
    rng = random.Random(seed)
    player = mapped_player(FakeSource(channels=2))
    ids = [each.can_id for each in bench_filters()]
    for _ in range(6000):
        can_id = rng.choice(ids)
        length = rng.choice((0, 1, 2, 3, 4, 5, 7, 8, 8, 8))
        data = rng.randbytes(length)
        if can_id > 0x600 and rng.random() < 0.7:  # plausible SDO requests
            index = rng.choice((0x1016, 0x1017, 0x1800, 0x1A00, 0x1600, 0x6040, 0x6060, 0x6132, 0x60FF))
            data = bytes([rng.choice((0x2F, 0x2B, 0x23, 0x40, 0x60, 0x21))]) + struct.pack(
                "<HBI",
                index,
                rng.randrange(9),
                rng.choice((0, 1, 2, 9, 0x4000_0181, 0x6064_0020, rng.getrandbits(32))),
            )
        for frame in player.bench.on_frame(can_id, data, player.stamp, player.now):
            assert len(frame) == 16
            assert FRAME.unpack(frame)[1] <= 8
        if rng.random() < 0.2:
            player.now += rng.randrange(50 * MS)
            player.stamp += MS
            player.bench.tick(player.now)
    for node, state in ((1, 0x7F), (2, 0x7F), (3, 0x7F)):
        player.nmt(RESET_NODE, node)
        assert player.bench.nodes[node - 1].state == state
        assert isinstance(player.read(node, 0x1018, 1), int)
