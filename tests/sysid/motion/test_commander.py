"""The commander leads the emulated bench through a motion, in lock-step: its frames, the motion of one to four joints."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.drivers.boot_node import BootError
from jtqd.drivers.drive import CIA_402, DriveObject, DriveProfile, map_of
from jtqd.drivers.pdo import Tpdo
from jtqd.sim_can import devices as cia402
from jtqd.sysid.motion.commander import Phase
from jtqd.sysid.motion.drives import sending_order
from jtqd.sysid.motion.setpoints import (
    HELD_RAD,
    Limits,
    MotionError,
    MotionResult,
    Setpoints,
    Surroundings,
    check_setpoints,
    path_range,
)
from jtqd.sysid.planner.campaigns import approach
from tests.sysid.motion.lock_step import (
    MS,
    WARM,
    WIDE,
    LockStep,
    changed,
    plateau,
    raised_cosine,
    turning,
    without,
)

OFF = (cia402.SWITCH_ON_DISABLED, cia402.SWITCH_ON_DISABLED)
RPDOS = {0x201, 0x202, 0x301, 0x302}


@pytest.fixture
def lock():
    return LockStep()


def test_a_whole_motion_is_played_and_both_joints_are_disabled(lock):
    motion = lock.commander(plateau(1.0, 2.0))
    lock.run()
    assert motion.result == MotionResult("done", "", 1.0)
    assert motion.refusal is None
    assert lock.states == OFF
    assert lock.velocities == (0.0, 0.0)
    before = len(lock.sent)
    lock.run_for(50)
    assert len(lock.sent) == before, "nothing is sent once it is over"


@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_joints_do_what_was_planned(lock, joint, sign):
    """On the plateau the true velocity is the planned one, and the other joint's true current is the planned one."""
    motion = lock.commander(plateau(sign * 1.2, 2.5, joint=joint))
    velocities, currents = [], []
    lock.play_until(400)
    while motion.played_s < 0.7:
        lock.cycle()
        velocities.append(lock.velocities[joint - 1])
        currents.append(lock.source.plant.drives[2 - joint].current_a)
    assert np.mean(velocities) == pytest.approx(sign * 1.2, abs=0.005)
    assert np.ptp(velocities) < 0.1
    assert currents == pytest.approx([2.5] * len(currents), abs=0.005), "1/1000 of 8 A is 8 mA"


def one_encoder_and_torque(node: int) -> DriveProfile:
    """No link position, torque (6077h) for current."""
    objects = replace(CIA_402, link_position=None, current=DriveObject(0x6077, bits=16, by="6076h"))
    store = LockStep().bench.drives[node - 1].store
    return DriveProfile(
        node, objects=objects, torque_constant_nm_per_a=store.number(0x6076) / store.number(0x6075)
    )


def three_tpdos(node: int) -> DriveProfile:
    """Every quantity in another place than usual."""
    words = ((0x60410010, 0x60640020), (0x606C0020,), (0x60780010, 0x60E40120))
    bases = (0x180, 0x380, 0x280)
    layout = [
        map_of(node, Tpdo(number, base + node, each), CIA_402)
        for number, (base, each) in enumerate(zip(bases, words, strict=True), 1)
    ]
    return DriveProfile(node, layout=tuple(layout))


@pytest.mark.parametrize("made", [one_encoder_and_torque, three_tpdos])
def test_drives_with_other_objects_and_layouts_are_moved_as_planned(made):
    lock = LockStep(profiles=(made(1), made(2)))
    motion = lock.commander(plateau(1.2, 2.5))
    seen = []
    lock.play_until(400)
    while motion.played_s < 0.7:
        lock.cycle()
        seen.append(motion.inputs.sample())
        assert lock.velocities[0] == pytest.approx(1.2, abs=0.06)
        assert lock.source.plant.drives[1].current_a == pytest.approx(2.5, abs=0.005)
    assert np.mean([each.joints[0].velocity_rad_s for each in seen]) == pytest.approx(1.2, abs=0.01)
    assert np.mean([each.joints[1].current_a for each in seen]) == pytest.approx(2.5, abs=0.03)
    assert seen[-1].joints[0].travel_rad - seen[0].joints[0].travel_rad == pytest.approx(
        1.2 * 1e-3 * (len(seen) - 1), rel=0.05
    )
    lock.run()
    assert motion.result.status == "done"
    last = motion.inputs.drives[0].units.tpdos[-1]
    again = LockStep(profiles=(made(1), made(2)))
    motion = again.commander(plateau(1.2, 2.5))
    again.play_until(400)
    again.filter = without(last.cob_id)
    again.run()
    text = f"joint 1: TPDO{last.number} ({last.cob_id:03X}h) missing for 6 cycles, limit 5"
    assert motion.result.reason.startswith(text)


def test_a_drive_that_sends_by_itself_is_not_moved():
    acyclic = map_of(1, Tpdo(2, 0x281, (0x606C0020, 0x60780010, 0x60410010), 255), CIA_402)
    layout = (map_of(1, Tpdo(1, 0x181, (0x60640020, 0x60E40120)), CIA_402), acyclic)
    lock = LockStep(profiles=(DriveProfile(1, layout=layout, acyclic=True), DriveProfile(2)))
    with pytest.raises(BootError, match=r"node 1: 1801h:2 transmission type .*: expected 1, found 255"):
        lock.commander(plateau(1.0, 2.0))


def test_each_drive_gets_every_second_setpoint_and_no_cycle_carries_two(lock):
    plan = plateau(1.0, 2.0, hold_ms=100)
    motion = lock.commander(plan)
    lock.run(lambda: motion.phase is Phase.PLAYING)
    begin_ms = lock.now // MS + 1  # of set-point 0
    lock.run(lambda: motion.phase is Phase.RAMPING)
    sent = {ms: (can_id, target) for ms, can_id, target in lock.setpoints_sent(begin_ms)}
    velocity_units = motion.inputs.drives[0].units.velocity_units
    assert velocity_units(1.0) == round(100 / (2 * math.pi) * 65536)
    for k in range(len(plan)):
        can_id, target = sent[begin_ms + k]
        assert can_id == (0x301, 0x202)[(k + (sent[begin_ms][0] == 0x202)) % 2], "one drive after the other"
        planned = (
            velocity_units(plan.velocity_rad_s[k]) if can_id == 0x301 else round(plan.current_a[k] / 0.008)
        )
        assert target == planned
    by_ms = [ms for ms, can_id, _ in lock.sent if can_id in RPDOS]
    assert len(by_ms) == len(set(by_ms)), "never two RPDOs in one cycle"
    for drive in lock.bench.drives:
        assert (drive.store.number(0x60C2, 1), drive.store.number(0x60C2, 2)) == (2, -3)
        assert drive.store.number(0x1016, 2) == 0x21 << 16 | 300


def test_the_start_word_by_word(lock):
    """After boot-up and standstill: 6, 7, 15 to each drive, each when its statusword has confirmed the last one."""
    motion = lock.commander(plateau(1.0, 2.0))
    lock.run(lambda: motion.phase is Phase.PLAYING)
    assert lock.sent[0][1:] == (0x721, b"\x00"), "boot-up message"
    beats = [ms for ms, can_id, data in lock.sent if (can_id, data) == (0x721, b"\x05")]
    assert np.diff(beats).tolist() == [100] * (len(beats) - 1)
    for can_id in (0x201, 0x202):
        words = [data for _, found, data in lock.sent if found == can_id]
        assert words[:3] == [b"\x06\x00\x00\x00", b"\x07\x00\x00\x00", b"\x0f\x00\x00\x00"]
        assert set(words[3:]) <= {b"\x0f\x00\x00\x00"}
    first = min(ms for ms, can_id, _ in lock.sent if can_id in RPDOS)
    assert first - lock.sent[0][0] >= 150, "standstill was watched before"


def test_the_end_word_by_word(lock):
    """Set-points to zero, quick stop, power off: nothing else, and the current joint never without its velocity joint."""
    motion = lock.commander(plateau(1.0, 2.0))
    lock.run()
    for can_id in (0x201, 0x202):
        words = [data[:2] for _, found, data in lock.sent if found == can_id]
        tail = [word for n, word in enumerate(words) if n == 0 or words[n - 1] != word]
        assert tail[-3:] == [b"\x0f\x00", b"\x02\x00", b"\x00\x00"]
    assert motion.over


def test_joints_that_turn_are_not_enabled(lock):
    """Joint 2 turns by hand: refused after 3 s, nothing was enabled."""
    motion = lock.commander(plateau(1.0, 2.0))
    lock.filter = turning(2, 0.05)
    lock.run()
    assert motion.refusal == "joint 2: velocity 0.050 rad/s before the start, limit 0.02 rad/s"
    assert not [each for each in lock.sent if each[1] in RPDOS]
    assert lock.states == OFF


@pytest.mark.parametrize(
    ("gone", "line"),
    [
        (0x080, "no SYNC: is jtqd running on this bus?"),
        (0x702, "joint 2: no heartbeat 702h"),
        (0x703, "sensor: no heartbeat 703h"),
        (0x181, "joint 1: no TPDO1 or TPDO2; start jtqd, which configures them"),
        (0x282, "joint 2: no TPDO1 or TPDO2; start jtqd, which configures them"),
        (0x183, "sensor: no torque of channel 1"),
    ],
)
def test_nothing_is_begun_without_every_input(lock, gone, line):
    motion = lock.commander(plateau(1.0, 2.0))
    lock.filter = without(gone)
    assert lock.run() == pytest.approx(3000, abs=5)
    assert motion.refusal == line
    assert not [each for each in lock.sent if each[1] in RPDOS]


def test_an_emcy_or_a_fault_that_is_there_already_refuses_the_start(lock):
    motion = lock.commander(plateau(1.0, 2.0))
    lock.with_extra(0x081, bytes.fromhex("1023020000000000"))
    lock.run()
    assert motion.refusal == "joint 1: EMCY 2310h (error register 02h)"
    lock = LockStep()
    motion = lock.commander(plateau(1.0, 2.0))
    lock.bench.drives[1].machine.fault()
    lock.run()
    assert motion.refusal == "joint 2: fault (statusword 0218h)"


@pytest.mark.parametrize("content", [None, (-0x8000).to_bytes(2, "little", signed=True)])
def test_a_temperature_limit_needs_a_temperature(lock, content):
    """TPDO3 of drive 2 does not come, or is "not measured" (8000h)."""
    motion = lock.commander(plateau(1.0, 2.0), WARM)
    lock.filter = without(0x382) if content is None else changed(0x382, lambda _: content)
    lock.run()
    assert motion.refusal == "joint 2: no temperature (382h), which is required by its limit"


def test_a_drive_that_does_not_come_on_stops_the_other(lock):
    """Drive 2 stays in "ready to switch on": nothing is played, both are off again."""
    motion = lock.commander(plateau(1.0, 2.0))
    machine = lock.bench.drives[1].machine
    obey = type(machine).controlword
    words: list[int] = []

    class Stuck(type(machine)):  # type: ignore[misc]
        __slots__ = ()

        def controlword(self, word: int) -> bool:
            words.append(word)
            return obey(self, 0x06 if word in (0x07, 0x0F) else word)

    machine.__class__ = Stuck
    lock.run()
    expected = "joint 2: ready to switch on (statusword 0231h) after 1 s, expected operation enabled"
    assert motion.result == MotionResult("stopped", expected, 0.0)
    assert 0x07 in words
    assert lock.states == OFF


def test_lost_cycles_make_the_motion_longer_and_never_jump(lock):
    """Up to 12 SYNCs are missing now and then: the motion continues at most four set-points further."""
    ramp = plateau(1.5, 3.0, hold_ms=300)
    motion = lock.commander(ramp)
    lock.play_until(100)
    rng = np.random.default_rng(3)
    for _ in range(20):
        lock.sync_runs = False
        lock.run_for(int(rng.integers(1, 13)))
        lock.sync_runs = True
        lock.run_for(int(rng.integers(5, 25)))
    lock.run()
    assert motion.result == MotionResult("done", "", 0.9)
    targets = [target for _, can_id, target in lock.setpoints_sent() if can_id == 0x301]
    units = lock.motion.inputs.drives[0].units.velocity_units(1.0)
    steepest = np.abs(np.diff(ramp.velocity_rad_s)).max()
    assert np.abs(np.diff(targets)).max() <= 8.01 * steepest * units


def test_a_commander_that_is_held_up_briefly_sends_no_burst(lock):
    motion = lock.commander(plateau(1.0, 2.0))
    lock.play_until(300)
    lock.held_up(15)
    before = len(lock.sent)
    lock.cycle()
    assert len([each for each in lock.sent[before:] if each[1] in RPDOS]) == 1
    lock.run()
    assert motion.result.status == "done"


def test_the_travel_begins_where_the_motion_begins_and_counters_roll_over(lock):
    """The motor's counter starts 0.2 rad of the motor below its upper end: 0.4 rad of the joint are 0.4 rad."""
    plant = lock.source.plant
    turns = (2**31 / 65536) * 2 * math.pi - 0.2
    plant.motor_position[0] = turns
    plant.motor_position[1] = -turns
    plant.link_position = turns / 100
    motion = lock.commander(plateau(1.0, 0.5, hold_ms=100), replace(WIDE, travel_rad=1.0))
    lock.run_for(20)
    plant.motor_position[0] += 300.0  # turned by 3 rad before the start: no travel of the motion
    plant.motor_position[1] -= 300.0
    plant.link_position += 3.0
    lock.run(lambda: motion.phase is Phase.BRAKING)
    one, two = motion.inputs.drives
    true = (plant.motor_position[0] - turns - 300.0) / 100
    assert true == pytest.approx(0.4, abs=0.01)
    assert one.travel_rad == pytest.approx(true, abs=1e-3)
    assert two.travel_rad == pytest.approx(-true, abs=1e-3)
    assert motion.result.status == "done"


def test_setpoints_beyond_the_range_of_an_rpdo_are_refused(lock):
    """300 A of an 8 A drive are 37500 in 1/1000 of rated torque; 16 bits end at 32767."""
    with pytest.raises(
        MotionError, match="plan: current of joint 2 is -37500 in units of the drive, limit 32767"
    ):
        lock.commander(plateau(1.0, -300.0))


def test_setpoints_that_end_in_motion_are_led_to_rest(lock):
    whole = plateau(1.0, 2.0)
    cut = Setpoints(1, whole.velocity_rad_s[:500], whole.current_a[:500])
    motion = lock.commander(cut)
    lock.run()
    assert motion.result == MotionResult("done", "", 0.5)
    assert lock.velocities == (0.0, 0.0)


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
