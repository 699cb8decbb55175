"""Benches with one to four drives: whose plants they are, and which nodes."""

import pytest

from jtqd.drivers.frame import FRAME
from jtqd.models.files import shipped
from jtqd.sim_can.bench import Bench, bench_filters
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import PlantSource, sources_of
from jtqd.sim_can.source import CURRENT, Source

PLANT = load_plant(shipped("campaign_plant.yaml"))


def moved(source: Source) -> list[float]:
    """What the drives and channels read after a torque of joint 1."""
    source.advance(0.0)
    source.command(0, CURRENT, 2.0)
    for _ in range(50):
        source.advance(1e-3)
    drives = [
        value for s in source.drives for value in (s.current_a, s.motor_position_rad, s.link_position_rad)
    ]
    return drives + [channel.torque_nm for channel in source.channels]


@pytest.mark.parametrize(("joints", "drives"), [(1, [1]), (2, [2]), (3, [2, 1]), (4, [2, 2])])
def test_pairs_side_by_side_and_a_last_one_alone(joints: int, drives: list[int]) -> None:
    sources = sources_of(PLANT, 3, joints)
    assert [len(source.drives) for source in sources] == drives
    assert [len(source.ratings) for source in sources] == drives
    assert [len(source.channels) for source in sources] == [1] * len(drives)


def test_two_joints_are_the_bench_that_they_were() -> None:
    assert moved(sources_of(PLANT, 3, 2)[0]) == moved(PlantSource(PLANT, 3))


def test_each_pair_has_its_own_noise_and_moves_alone() -> None:
    first, second = sources_of(PLANT, 3, 4)
    one, other = moved(first), moved(second)
    assert one != other
    assert other == pytest.approx(one, abs=3.0)  # days differ, not the plant
    still = [signals.motor_position_rad for signals in sources_of(PLANT, 3, 4)[1].drives]
    assert still == [0.0, 0.0]


def test_a_joint_alone_turns_its_load() -> None:
    (alone,) = sources_of(PLANT, 3, 1)
    assert moved(alone)[:3] == moved(PlantSource(PLANT, 3))[:3]


@pytest.mark.parametrize("with_sensor", [True, False])
@pytest.mark.parametrize(("joints", "sensor"), [(1, 3), (2, 3), (3, 5), (4, 5)])
def test_the_nodes_of_a_bench(joints: int, sensor: int, with_sensor: bool) -> None:
    sources = sources_of(PLANT, 3, joints)
    bench = Bench(sources[0], "rest", sources[1:], with_sensor=with_sensor)
    nodes = [*range(1, joints + 1), *([sensor] if with_sensor else [])]
    assert [node.node_id for node in bench.nodes] == nodes
    boot_ups = [FRAME.unpack(frame)[0] for frame in bench.tick(0)]
    assert boot_ups == [0x700 + node for node in nodes]
    heard = {each.can_id for each in bench_filters(joints)}
    assert {0x600 + node for node in nodes} | {0x200 + node for node in range(1, joints + 1)} <= heard


@pytest.mark.parametrize("joints", [1, 3, 4])
def test_the_demo_moves_every_drive(joints: int) -> None:
    sources = sources_of(PLANT, 3, joints)
    bench = Bench(sources[0], "demo", sources[1:])
    bench.on_frame(0x000, b"\x01\x00", 0, 0)  # NMT: start all
    for cycle in range(4000):
        stamp = 1_000_000 * cycle
        bench.on_frame(0x080, bytes([cycle % 240 + 1]), stamp, stamp)
    speeds = [abs(signals.motor_velocity_rad_s) for source in sources for signals in source.drives]
    assert min(speeds) > 1.0, speeds
