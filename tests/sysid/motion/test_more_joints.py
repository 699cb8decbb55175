"""The commander on a bus with one, three or four joints: one moved alone, pairs, and joints that are held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.sim_can import devices as cia402
from jtqd.sysid.motion.commander import Phase
from jtqd.sysid.motion.drives import sending_order
from jtqd.sysid.motion.setpoints import (
    HELD_RAD,
    Limits,
    MotionError,
    Setpoints,
    Surroundings,
    check_setpoints,
    path_range,
)
from jtqd.sysid.planner.campaigns import approach
from tests.sysid.motion.lock_step import (
    MS,
    LockStep,
    changed,
    plateau,
    raised_cosine,
    turning,
    without,
)

ALONE = Limits(current_a=9.0, velocity_rad_s=2.0, torque_nm=40.0, travel_rad=4.0, position_rad=(-2.0, 2.0))


def alone(joint: int, velocity: float, hold_ms: int = 300, ramp_ms: int = 200) -> Setpoints:
    """Up, hold, down, and nothing for any other joint."""
    ramp = raised_cosine(ramp_ms)
    shape = np.concatenate([ramp, np.ones(hold_ms), 1.0 - ramp])
    return Setpoints(joint, velocity * shape, np.zeros(len(shape)), current_joint=None)


def travels(lock: LockStep) -> list[float]:
    return [drive.travel_rad for drive in lock.motion.inputs.drives]


@pytest.mark.parametrize(
    ("moved", "drives", "order", "cycles"),
    [
        ((1, 2), 2, (0, 1), 2),
        ((1,), 1, (0,), 1),
        ((3,), 3, (2, 0, 2, 1), 2),
        ((3, 4), 4, (2, 3, 0, 2, 3, 1), 3),
    ],
)
def test_one_drive_gets_a_setpoint_in_each_cycle(moved, drives, order, cycles):
    assert sending_order(moved, drives) == (order, cycles)


@pytest.mark.parametrize(
    ("drives", "period_ms", "setpoints"),
    [
        (1, 1, alone(1, 1.0)),
        (1, 2, alone(1, 1.0)),
        (3, 2, alone(3, -1.0)),
        (3, 2, plateau(1.0, 2.0)),
        (4, 2, Setpoints(3, np.full(400, 0.0), np.full(400, 0.0), current_joint=4)),
    ],
    ids=["one", "one at 500 Hz", "third of three", "pair beside a third", "second pair"],
)
def test_joints_are_moved_and_all_others_held(drives, period_ms, setpoints):
    lock = LockStep(drives=drives, period_ms=period_ms)
    lock.commander(setpoints, replace(ALONE, torque_nm=100.0))
    lock.run(lambda: lock.motion.phase is Phase.RAMPING)
    wanted = path_range(setpoints)[1] + path_range(setpoints)[0]
    for number, travel in enumerate(travels(lock), 1):
        if number == setpoints.velocity_joint:
            assert travel == pytest.approx(wanted, abs=0.02)
        elif number != setpoints.current_joint:
            assert abs(travel) < 0.1 * HELD_RAD
    assert lock.states == (cia402.OPERATION_ENABLED,) * drives, "held with power"
    lock.run()
    assert lock.motion.result == ("done", "", setpoints.duration_s)
    assert cia402.OPERATION_ENABLED not in lock.states
    commands = [ms for ms, can_id, _ in lock.sent if can_id & 0x780 in (0x200, 0x300)]
    assert len(commands) == len(set(commands)), "never two in a cycle"
    held = [
        int.from_bytes(data, "little", signed=True)
        for _, can_id, data in lock.sent
        if can_id & 0x780 == 0x300 and can_id & 0x7F not in setpoints.joints
    ]
    assert len(held) > 0 or drives == len(setpoints.joints)
    assert set(held) <= {0}


@pytest.mark.parametrize(
    ("faulty", "reason"),
    [
        (1, "joint 1: EMCY 2310h"),
        (turning(2, 0.383), "joint 2: velocity 0.383 rad/s, limit 0.3 rad/s"),
        (without(0x181, 0x281), "joint 1: TPDO2 (281h) missing"),
        (3, "joint 3: EMCY 2310h"),
    ],
    ids=["fault of a held joint", "held joint turns", "held joint is silent", "fault of the moved one"],
)
def test_a_fault_of_any_drive_stops_all(faulty, reason):
    lock = LockStep(drives=3, period_ms=2)
    lock.commander(alone(3, 1.0, hold_ms=1000), ALONE)
    lock.play_until(300)
    if isinstance(faulty, int):
        lock.with_extra(0x080 + faulty, b"\x10\x23\x03\0\0\0\0\0")
    else:
        lock.filter = faulty
    began = lock.now
    lock.run(lambda: lock.motion.over)
    result = lock.motion.result
    assert result.status == "stopped"
    assert result.reason.startswith(reason)
    assert cia402.OPERATION_ENABLED not in lock.states
    assert (lock.now - began) / MS < 2000


def test_a_joint_that_would_leave_its_travel_is_not_begun():
    lock = LockStep(drives=1)
    lock.commander(alone(1, 1.0), replace(ALONE, position_rad=(-4.0, 0.2)))
    lock.run()
    assert lock.motion.refusal is not None
    assert lock.motion.refusal.startswith("joint 1: stands at 0.0")
    assert "expected -4.000 to -0.300 rad" in lock.motion.refusal
    assert lock.motion.out_of_place == pytest.approx(0.0, abs=0.02)
    assert lock.states == (cia402.SWITCH_ON_DISABLED,)


def test_an_approach_ends_at_its_target_and_within_its_limits():
    for start, target in ((1.5, 0.0), (-1.9, 1.0), (0.3, 0.31)):
        there = approach(1, start, target, ALONE)
        check_setpoints(there, ALONE)
        assert start + float(np.sum(there.velocity_rad_s)) * 1e-3 == pytest.approx(target, abs=1e-9)
        assert float(np.abs(there.velocity_rad_s).max()) <= 0.31 * ALONE.velocity_rad_s
        assert there.velocity_rad_s[-1] == 0.0
    for start, target in ((2.5, 0.0), (0.0, -2.1)):
        with pytest.raises(MotionError, match="travel_rad is -2 to 2"):
            approach(1, start, target, ALONE)


def test_the_travel_of_a_joint_that_is_moved_alone_is_supervised():
    """The encoder is beyond the limit, although the plan is not."""
    lock = LockStep(drives=1)
    lock.commander(alone(1, 1.0, hold_ms=600), replace(ALONE, position_rad=(-1.0, 1.0)))
    lock.play_until(500)
    node = lock.motion.inputs.drives[0]
    beyond = round(1.2 / node.units.scaling.link_rad_per_count)
    lock.filter = changed(0x181, lambda data: data[:4] + beyond.to_bytes(4, "little", signed=True))
    lock.run()
    assert lock.motion.result.reason.startswith("joint 1: position 1.2")
    assert "limits -1 to 1 rad" in lock.motion.result.reason


def test_the_torque_of_another_joint_is_no_reason_to_stop():
    """Joint 3 is measured by channel 2; channel 1 belongs to joints 1 and 2."""
    around = Surroundings({1: 9.0, 2: 9.0}, {2: (3,)})
    lock = LockStep(drives=3, period_ms=2)
    lock.commander(alone(3, 1.0), ALONE, around=around)
    lock.play_until(200)
    lock.filter = changed(0x185, lambda data: b"\xff\xff\xff\x7f" + data[-1:])
    lock.run_for(50)
    assert lock.motion.phase is Phase.PLAYING
    lock.filter = changed(0x285, lambda data: b"\xff\x7f" + data[-1:])
    lock.run()
    assert lock.motion.result.reason.startswith("joint 3: torque at the sensor")


def test_a_moved_drive_interpolates_over_its_sending_period():
    """60C2h of the moved drive is the time between two of its set-points."""
    lock = LockStep(drives=3, period_ms=2)
    lock.commander(alone(3, 1.0), ALONE)
    store = lock.bench.drives[2].store
    assert (store.number(0x60C2, 1), store.number(0x60C2, 2)) == (4, -3)
    lock.run()
    to_third = [ms for ms, can_id, _ in lock.sent if can_id == 0x303]
    assert set(np.diff(to_third[5:-5])) == {4}
