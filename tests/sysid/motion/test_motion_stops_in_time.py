"""A motion is stopped because SYNC or the commander is late, or because somebody asks. In lock-step with the bench."""

import re
import struct

import pytest

from jtqd.sim_can import drive_node as cia402
from jtqd.sysid.motion.stopping import Phase
from tests.sysid.motion.motion_helpers import MS, WARM, LockStep, plateau
from tests.sysid.motion.motion_stop_helpers import (
    BRAKE_MS,
    CURRENT,
    RAMP_MS,
    SPEED,
    Frames,
    changed,
    started,
    stopped_with,
    until_stop,
)


@pytest.fixture
def lock() -> LockStep:
    return LockStep()


# SYNC and time ----------------------------------------------------------------------------------------------


def test_sync_that_stops(lock: LockStep) -> None:
    """After 20 ms both drives brake by themselves; what is sent then is quick stop and power off, nothing else."""
    started(lock)
    lock.sync_runs = False
    assert 19 <= until_stop(lock, 100) <= 21
    begin = lock.now // MS
    assert lock.motion.phase is Phase.BRAKING
    stopped_with(lock, r"SYNC missing for 2[01] ms, limit 20 ms", 300)
    words = {data[:2] for ms, can_id, data in lock.sent if ms > begin and can_id in (0x201, 0x202)}
    assert words == {b"\x02\x00", b"\x00\x00"}
    assert not lock.setpoints_sent(begin + 1)


def test_sync_that_was_away_for_longer_than_allowed(lock: LockStep) -> None:
    """The commander did not look while SYNC was away, and still notices by the stamps."""
    started(lock)
    lock.sync_runs = False
    lock.deaf = True
    lock.run_for(24)
    lock.sync_runs = True
    lock.deaf = False
    lock.cycle()
    stopped_with(lock, r"SYNC missing for 2[45] ms, limit 20 ms", BRAKE_MS)


@pytest.mark.parametrize("ms", [25, 200])
def test_a_commander_that_was_held_up(lock: LockStep, ms: int) -> None:
    started(lock)
    held: Frames = []
    lock.deaf = True
    for _ in range(ms):
        lock.cycle()
        held += lock.waiting
        lock.waiting = []
    lock.deaf = False
    lock.waiting = held
    lock.cycle()
    stopped_with(lock, f"commander: late by {ms + 0.7:.0f} ms, limit 20 ms")


def test_a_limit_that_was_exceeded_while_the_commander_did_not_look_is_not_missed(lock: LockStep) -> None:
    """Three cycles come at once, the middle one with 9.6 A."""
    started(lock)
    held: Frames = []
    lock.deaf = True
    for n in range(3):
        lock.filter = changed(0x282, lambda d, n=n: struct.pack("<ihH", 0, 1200, 0x1237) if n == 1 else d)  # type: ignore[misc]
        lock.cycle()
        held += lock.waiting
        lock.waiting = []
    lock.deaf = False
    lock.filter = lambda frames: frames
    lock.waiting = held
    lock.cycle()
    stopped_with(lock, r"joint 2: current 9\.600 A, limit 9 A")


def test_a_commander_that_dies_is_noticed_by_both_drives(lock: LockStep) -> None:
    """1016h:2: 300 ms after its last heartbeat both drives brake, say EMCY 8130h and keep the fault."""
    started(lock)
    last = max(ms for ms, can_id, _ in lock.sent if can_id == 0x721)
    emergencies = []
    lock.deaf = True
    while lock.now // MS < last + 300 + BRAKE_MS:
        lock.cycle()
        emergencies += [
            (lock.now // MS - last, can_id, data[:2])
            for can_id, data, _ in lock.waiting
            if can_id in (0x81, 0x82)
        ]
        lock.waiting = []
        if lock.now // MS < last + 299:
            assert abs(lock.velocities[0]) > 1.0
    assert [each[1:] for each in emergencies] == [(0x81, b"\x30\x81"), (0x82, b"\x30\x81")]
    assert all(300 <= ms <= 302 for ms, _, _ in emergencies)
    assert max(abs(v) for v in lock.velocities) < 0.02
    assert lock.states == (cia402.FAULT, cia402.FAULT)


def test_a_bus_that_takes_no_frames(lock: LockStep) -> None:
    started(lock)
    for _ in range(5):
        lock.motion.frame_refused(True)
    stopped_with(lock, "bus: transmit queue full for 5 frames in a row", BRAKE_MS)


def test_single_refused_frames_are_no_reason(lock: LockStep) -> None:
    started(lock)
    for refused in (True, True, True, True, False) * 5:
        lock.motion.frame_refused(refused)
    assert lock.motion.phase is Phase.PLAYING


def test_a_second_commander(lock: LockStep) -> None:
    started(lock)
    lock.filter = lambda frames: [*frames, (0x721, b"\x05", lock.now)]
    lock.cycle()
    stopped_with(lock, r"another commander is on the bus .*", BRAKE_MS)


# Asked for --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", [1, 2])
def test_a_signal_leads_both_joints_to_a_stop(lock: LockStep, joint: int) -> None:
    started(lock, joint=joint)
    lock.motion.stop("SIGINT")
    velocities = []
    for _ in range(RAMP_MS):
        lock.cycle()
        velocities.append(abs(lock.velocities[joint - 1]))
    assert velocities[RAMP_MS // 2] == pytest.approx(SPEED / 2, abs=0.1), "along the ramp"
    stopped_with(lock, "SIGINT", 60)
    assert lock.motion.result.played_s == pytest.approx(0.5)


def test_asked_twice_they_brake_at_once_and_the_first_reason_stays(lock: LockStep) -> None:
    started(lock)
    lock.motion.stop("SIGINT")
    lock.run_for(30)
    assert lock.motion.phase is Phase.RAMPING
    lock.motion.stop("SIGTERM")
    assert lock.motion.phase is Phase.BRAKING
    lock.motion.stop("SIGINT again")
    stopped_with(lock, "SIGINT", BRAKE_MS)


def test_a_stop_while_stopping_for_a_limit_does_not_begin_the_ramp_anew(lock: LockStep) -> None:
    """The temperature stays beyond its limit all along the ramp: one ramp, one reason."""
    started(lock, WARM)
    lock.filter = changed(0x381, lambda _: struct.pack("<h", 800))
    until_stop(lock, 600)
    stopped_with(lock, re.escape("joint 1: temperature 80.0 °C, limit 70 °C"))


def test_a_fault_on_the_ramp_goes_over_to_braking(lock: LockStep) -> None:
    started(lock)
    lock.motion.stop("SIGINT")
    lock.run_for(30)
    lock.bench.drives[0].machine.fault()
    lock.run_for(2)
    assert lock.motion.phase is Phase.BRAKING
    stopped_with(lock, "SIGINT", BRAKE_MS)


@pytest.mark.parametrize("phase", [Phase.WAITING, Phase.ENABLING])
def test_a_signal_before_the_first_setpoint(lock: LockStep, phase: Phase) -> None:
    motion = lock.commander(plateau(SPEED, CURRENT))
    lock.run(lambda: motion.phase is phase and lock.now > 1100 * MS)
    motion.stop("SIGINT")
    lock.run()
    assert (motion.result.status, motion.result.reason, motion.result.played_s) == ("stopped", "SIGINT", 0.0)
    assert lock.states == (cia402.SWITCH_ON_DISABLED, cia402.SWITCH_ON_DISABLED)
    assert lock.velocities == (0.0, 0.0)


def test_an_exceeded_limit_before_the_start_refuses_it(lock: LockStep) -> None:
    motion = lock.commander(plateau(SPEED, CURRENT), WARM)
    lock.filter = changed(0x382, lambda _: struct.pack("<h", 701))
    lock.run()
    assert motion.refusal == "joint 2: temperature 70.1 °C, limit 70 °C"
