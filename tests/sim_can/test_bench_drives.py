"""The bench's drives by CiA 402 on the bus: targets, quick stop, faults, and the loss of the master's heartbeat."""

import math

import pytest

from jtqd.sim_can.source import OFF, VELOCITY
from tests.sim_can.bench_player import enabled, mapped_player, quiet


@pytest.fixture
def mapped():
    return mapped_player()


def test_velocity_mode_target_is_in_increments_per_second_motor_side(mapped):
    enabled(mapped)
    mapped.put(1, 0x60FF, 0, -65536 * 10, 4)
    drive, mode, target = mapped.source.commands[-1]
    assert (drive, mode) == (0, VELOCITY)
    assert target == pytest.approx(-20 * math.pi)
    assert mapped.read(1, 0x6061) == 9
    mapped.put(1, 0x6040, 0, 0x10F, 2)  # halt
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)


def test_quick_stop_brakes_then_switches_off(mapped):
    enabled(mapped)
    mapped.source.drives[0].motor_velocity_rad_s = 50.0
    mapped.put(1, 0x6040, 0, 0x02, 2)
    assert mapped.status() == 0x07
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)
    mapped.sync()
    assert mapped.status() == 0x07  # still turning
    mapped.source.drives[0].motor_velocity_rad_s = 0.5
    mapped.sync()
    assert mapped.status() == 0x40
    assert mapped.source.commands[-1] == (0, OFF, 0.0)


def test_overcurrent_is_a_latched_fault_with_emcy(mapped):
    enabled(mapped)
    mapped.source.drives[0].current_a = -12.5
    texts = mapped.sync()
    assert texts[0] == "081#1023030000000000"  # 2310h, register: generic + current
    assert mapped.status() & 0x4F == 0x08
    assert mapped.read(1, 0x603F) == 0x2310
    assert mapped.source.commands[-1] == (0, OFF, 0.0)
    mapped.source.drives[0].current_a = 0.0
    mapped.put(1, 0x6040, 0, 0x0F, 2)
    assert mapped.status() & 0x4F == 0x08
    assert mapped.put(1, 0x6040, 0, 0x80, 2) == ["081#0000000000000000"]
    assert mapped.status() == 0x40
    assert mapped.read(1, 0x603F) == 0


def test_lost_master_heartbeat_stops_a_commanded_drive(mapped):
    """1016h: node 20h, 200 ms. Watched from the first heartbeat on; EMCY 8130h, fault, pre-operational (1029h
    = 0).
    """
    quiet(mapped).put(1, 0x1016, 1, 0x0020_00C8, 4)
    enabled(mapped)
    mapped.now = 0
    assert mapped.tick(1000) == []  # no heartbeat seen yet
    mapped.send(0x720, b"\x05")
    mapped.send(0x721, b"\x05", after_ms=100)  # another node
    mapped.send(0x720, b"\x05\x05", after_ms=50)  # not a heartbeat
    assert mapped.tick(1199) == []
    mapped.source.drives[0].motor_velocity_rad_s = 50.0
    assert mapped.tick(1200) == ["081#3081110000000000"]
    assert mapped.read(1, 0x6041) & 0x4F == 0x0F  # fault reaction: braking
    assert mapped.source.commands[-1] == (0, VELOCITY, 0.0)
    assert mapped.bench.drives[0].state == 0x7F
    mapped.source.drives[0].motor_velocity_rad_s = 0.0
    mapped.sync()
    assert mapped.read(1, 0x6041) & 0x4F == 0x08
    assert mapped.tick(5000) == []  # told once
    assert mapped.send(0x720, b"\x05") == ["081#0000000000000000"]
    assert mapped.read(1, 0x6041) & 0x4F == 0x08  # the fault stays until it is reset


def test_heartbeats_in_time_are_no_error(mapped):
    quiet(mapped).put(1, 0x1016, 1, 0x0020_00C8, 4)
    for k in range(1, 30):
        assert mapped.tick(100 * k) == []
        assert mapped.send(0x720, b"\x05") == []
