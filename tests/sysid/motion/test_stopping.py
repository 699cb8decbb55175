"""Each way a motion is stopped: its reason, how fast both joints stand, that no set-point follows.

By limits, by missing or faulty inputs, by SYNC or a commander that is late, by a signal. Lock-step with the emulated bench,
so the true velocities are known.
"""

import re
import struct
from dataclasses import replace

import pytest

from jtqd.sim_can import devices as cia402
from jtqd.sysid.motion.commander import Phase
from jtqd.sysid.motion.setpoints import Limits
from tests.sysid.motion.lock_step import MS, WARM, WIDE, Frames, LockStep, changed, plateau, without

SPEED = 1.5
CURRENT = 3.0
RAMP_MS = round(SPEED / 10.0 * 1e3)
STOP_MS = RAMP_MS + 60
"""Both joints stand: the ramp at 10 rad/s2, and the drives' lag."""
BRAKE_MS = 120
"""Both joints stand after a quick stop."""


def started(lock: LockStep, limits: Limits = WIDE, joint: int = 1, at_ms: int = 500) -> None:
    """At full speed and load."""
    lock.commander(plateau(SPEED, CURRENT, hold_ms=3000, joint=joint), limits)
    lock.play_until(at_ms)


def still_after(lock: LockStep, limit_ms: int) -> int:
    """Cycles until both true velocities are, and stay, below 0.02 rad/s."""
    moved = 0
    for ms in range(1, limit_ms + 101):
        lock.cycle()
        if max(abs(v) for v in lock.velocities) > 0.02:
            moved = ms
    return moved


def stopped_with(lock: LockStep, pattern: str, limit_ms: int = STOP_MS) -> None:
    """Led to a stop in time and disabled, for the reason that matches; only smaller set-points followed, then none."""
    begin = lock.now // MS
    assert lock.motion.phase in (Phase.RAMPING, Phase.BRAKING), lock.motion.phase
    assert still_after(lock, limit_ms) <= limit_ms
    lock.run()
    result = lock.motion.result
    assert result.status == "stopped"
    assert re.fullmatch(pattern, result.reason), result.reason
    assert "\n" not in result.reason
    for state in lock.states:
        assert state in (cia402.SWITCH_ON_DISABLED, cia402.FAULT), state
    for can_id in (0x201, 0x202, 0x301, 0x302):
        targets = [target for _, found, target in lock.setpoints_sent(begin) if found == can_id]
        assert targets == sorted(targets, key=abs, reverse=True), f"{can_id:X}h grew again: {targets}"
    before = len(lock.sent)
    lock.run_for(30)
    assert len(lock.sent) == before


def until_stop(lock: LockStep, limit_ms: int) -> int:
    """Cycles until the commander begins to stop."""
    return lock.run(lambda: lock.motion.phase in (Phase.RAMPING, Phase.BRAKING), limit_ms)


@pytest.fixture
def lock():
    return LockStep()


# Limits, reached by the true plant --------------------------------------------------------------------------


DRIVEN, DRIVING = (lambda lock, k=k: lock.source.plant.drives[k].current_a for k in (0, 1))


@pytest.mark.parametrize(
    ("speed", "limit", "measured", "tolerance", "reason"),
    [
        (-0.5, {"current_a": 2.5}, DRIVING, 0.06, r"joint 2: current 2\.5\d\d A, limit 2\.5 A"),
        (0.5, {"current_a": 3.4}, DRIVEN, 0.1, r"joint 1: current 3\.4\d\d A, limit 3\.4 A"),
        (
            SPEED,
            {"velocity_rad_s": 1.0},
            lambda lock: lock.velocities[0],
            0.05,
            r"joint [12]: velocity -?1\.0\d+ rad/s, limit 1 rad/s",
        ),
        (
            SPEED,
            {"torque_nm": 10.0},
            lambda lock: lock.source.channels[0].torque_nm,
            1.0,
            r"joints 1 and 2: torque at the sensor -?1\d\.\d\d Nm, limit 10 Nm",
        ),
    ],
    ids=["current of the driving joint", "current of the velocity joint, driving both", "velocity", "torque"],
)
def test_a_limit_stops_the_motion_when_the_true_value_reaches_it(  # noqa: PLR0917
    lock, speed, limit, measured, tolerance, reason
):
    lock.commander(plateau(speed, CURRENT, ramp_ms=300 if speed == SPEED else 1000), replace(WIDE, **limit))
    until_stop(lock, 2000)
    (value,) = limit.values()
    assert abs(measured(lock)) == pytest.approx(value, abs=tolerance)
    stopped_with(lock, reason)


@pytest.mark.parametrize("direction", [1, -1])
def test_travel(lock, direction):
    lock.commander(plateau(direction * SPEED, CURRENT, hold_ms=3000), replace(WIDE, travel_rad=1.2))
    until_stop(lock, 3000)
    plant = lock.source.plant
    assert plant.motor_position[0] / 100 == pytest.approx(direction * 1.2, abs=0.01)
    minus_1, minus_2 = ("-", "") if direction < 0 else ("", "-")
    reason = rf"joint (1: travel {minus_1}|2: travel {minus_2})1\.20\d rad, limit 1\.2 rad"
    stopped_with(lock, reason)
    assert abs(plant.motor_position[0] / 100) < 1.2 + SPEED**2 / 20 + 0.05, "stopping distance v^2 / 2a"


# Limits of each joint, by frames on the bus ------------------------------------------------------------------


# COB-ID, layout, place
VELOCITY_FIELD = (0x280, "<ihH", 0)
CURRENT_FIELD = (0x280, "<ihH", 1)
TEMPERATURE_FIELD = (0x380, "<h", 0)


@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize(
    ("field", "value", "line"),
    [
        (CURRENT_FIELD, 1200, "current 9.600 A, limit 9 A"),
        (CURRENT_FIELD, -1200, "current -9.600 A, limit 9 A"),
        (VELOCITY_FIELD, 3650633, "velocity 3.500 rad/s, limit 3.3 rad/s"),
        (VELOCITY_FIELD, -3650633, "velocity -3.500 rad/s, limit 3.3 rad/s"),
        (TEMPERATURE_FIELD, 703, "temperature 70.3 °C, limit 70 °C"),
    ],
)
def test_one_sample_beyond_a_limit_names_its_joint(lock, joint, field, value, line):
    base, layout, place = field
    started(lock, WARM)
    pending = [True]

    def once(data: bytes) -> bytes:
        if not pending:
            return data
        pending.clear()
        fields = list(struct.unpack(layout, data))
        fields[place] = value
        return struct.pack(layout, *fields)

    lock.filter = changed(base + joint, once)
    assert until_stop(lock, 600) <= (500 if base == 0x380 else 1) + 1
    stopped_with(lock, re.escape(f"joint {joint}: {line}"))


@pytest.mark.parametrize("encoder", ["motor", "link"])
def test_a_dead_encoder_does_not_hide_the_travel(lock, encoder):
    """One encoder of each joint stays at its value; the other one still counts."""
    started(lock, replace(WIDE, travel_rad=2.0))
    frozen: dict[int, bytes] = {}

    def freeze(frames: Frames) -> Frames:
        out = []
        for can_id, data, t_ns in frames:
            content = data
            if can_id in (0x181, 0x182):
                old = frozen.setdefault(can_id, data)
                content = old[:4] + data[4:] if encoder == "motor" else data[:4] + old[4:]
            out.append((can_id, content, t_ns))
        return out

    lock.filter = freeze
    until_stop(lock, 3000)
    stopped_with(lock, r"joint [12]: travel -?2\.00\d rad, limit 2 rad")


# Inputs, drives, nodes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gone", "line"),
    [
        (0x181, "joint 1: TPDO1 (181h) missing for 6 cycles, limit 5"),
        (0x281, "joint 1: TPDO2 (281h) missing for 6 cycles, limit 5"),
        (0x182, "joint 2: TPDO1 (182h) missing for 6 cycles, limit 5"),
        (0x282, "joint 2: TPDO2 (282h) missing for 6 cycles, limit 5"),
        (0x183, "sensor: torque of channel 1 missing for 6 cycles, limit 5"),
    ],
)
def test_a_pdo_that_is_missing_or_has_another_length(lock, gone, line):
    started(lock)
    lock.filter = changed(gone, lambda data: data[:7]) if gone == 0x281 else without(gone)
    assert until_stop(lock, 100) == 6
    stopped_with(lock, re.escape(line))
    assert lock.states == (cia402.SWITCH_ON_DISABLED, cia402.SWITCH_ON_DISABLED)


def test_five_missing_pdos_are_no_reason(lock):
    started(lock)
    lock.filter = without(0x282)
    lock.run_for(5)
    lock.filter = lambda frames: frames
    lock.run_for(50)
    assert lock.motion.phase is Phase.PLAYING


@pytest.mark.parametrize("joint", [1, 2])
def test_a_fault_of_one_drive_brakes_both(lock, joint):
    """Also that of the velocity joint: the other one's current must not accelerate the pair."""
    started(lock)
    lock.bench.drives[joint - 1].machine.fault()
    assert until_stop(lock, 10) <= 2
    assert lock.motion.phase is Phase.BRAKING
    reason = (
        rf"joint {joint}: fault( reaction active)? \(statusword [0-9A-F]{{4}}h\), expected operation enabled"
    )
    stopped_with(lock, reason, BRAKE_MS)
    assert not lock.setpoints_sent(lock.now // MS - 20)


def test_a_drive_that_trips_on_current_names_its_fault(lock):
    """The true drive 2 measures 13 A for a moment: EMCY 2310h or its state, whichever comes first."""
    started(lock)
    drive = lock.bench.drives[1]
    drive._ratings = replace(drive._ratings, trip_current_a=2.0)
    until_stop(lock, 10)
    stopped_with(lock, r"joint 2: EMCY 2310h \(error register 03h\)|joint 2: fault.*", BRAKE_MS)


@pytest.mark.parametrize("joint", [1, 2])
def test_an_emcy(lock, joint):
    started(lock)
    lock.with_extra(0x080 + joint, bytes.fromhex("1042 08 0000000000"))
    assert until_stop(lock, 10) == 1
    assert lock.motion.phase is Phase.BRAKING
    stopped_with(lock, rf"joint {joint}: EMCY 4210h \(error register 08h\)", BRAKE_MS)


@pytest.mark.parametrize(("node", "name"), [(1, "joint 1"), (2, "joint 2"), (3, "sensor")])
def test_a_node_whose_heartbeat_stops(lock, node, name):
    started(lock)
    lock.filter = without(0x700 + node)
    assert 200 <= until_stop(lock, 1000) <= 302
    stopped_with(lock, rf"{name}: no heartbeat for 30\d ms, limit 300 ms")


def test_a_sensor_that_is_not_valid(lock):
    started(lock)
    lock.source.channels[0].valid = False
    until_stop(lock, 10)
    stopped_with(lock, "sensor: status of channel 1 is 01h, expected 00h")


@pytest.mark.parametrize("node", [1, 2])
def test_a_node_that_receives_no_rpdo_is_stopped_by_sdo(lock, node):
    """Pre-operational with its power on: an SDO brakes it 10 ms later."""
    started(lock)
    lock.to_bench(0, bytes([0x80, node]))
    assert until_stop(lock, 10) <= 7
    assert lock.motion.phase is Phase.BRAKING
    reason = rf"joint {node}: (NMT pre-operational, expected operational|TPDO2 \(28{node}h\) missing for 6 cycles, limit 5)"
    stopped_with(lock, reason, BRAKE_MS + 20)
    by_sdo = [each for each in lock.sent if each[1] == 0x600 + node]
    assert [data.hex() for _, _, data in by_sdo] == ["2b40600002000000"]


def test_a_drive_that_obeys_nothing_gets_no_heartbeat_and_stops_by_itself(lock):
    """Neither RPDO nor SDO reach drive 1: after 0.2 s our heartbeat ends, 0.3 s later it brakes with 8130h."""
    started(lock)
    reach = lock.bench.drives[0].on_frame
    lock.bench.drives[0].on_frame = lambda i, d, t: [] if i in (0x201, 0x301, 0x601) else reach(i, d, t)  # type: ignore[method-assign]
    lock.motion.stop("SIGTERM")
    lock.cycle()
    lock.run_for(RAMP_MS + 300 + 10)
    assert lock.motion.phase is Phase.BRAKING
    assert abs(lock.velocities[0]) > 1.0, "it still turns"
    lock.run_for(230)
    assert lock.motion.silent
    lock.run_for(300 + BRAKE_MS)
    assert max(abs(v) for v in lock.velocities) < 0.02
    assert lock.bench.drives[0].store.number(0x1003, 1) & 0xFFFF == 0x8130
    lock.run()
    assert lock.motion.result.reason == "SIGTERM"


# SYNC and time ----------------------------------------------------------------------------------------------


def test_sync_that_stops(lock):
    """After 20 ms both drives brake by themselves; only quick stop and power off are sent then."""
    started(lock)
    lock.sync_runs = False
    assert 19 <= until_stop(lock, 100) <= 21
    begin = lock.now // MS
    assert lock.motion.phase is Phase.BRAKING
    stopped_with(lock, r"SYNC missing for 2[01] ms, limit 20 ms", 300)
    words = {data[:2] for ms, can_id, data in lock.sent if ms > begin and can_id in (0x201, 0x202)}
    assert words == {b"\x02\x00", b"\x00\x00"}
    assert not lock.setpoints_sent(begin + 1)


def test_sync_that_was_away_for_longer_than_allowed(lock):
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
def test_a_commander_that_was_held_up(lock, ms):
    started(lock)
    lock.held_up(ms)
    lock.cycle()
    stopped_with(lock, f"commander: late by {ms + 0.7:.0f} ms, limit 20 ms")


def test_a_limit_that_was_exceeded_while_the_commander_did_not_look_is_not_missed(lock):
    """Three cycles come at once, the middle one with 9.6 A."""
    started(lock)
    cycle = iter(range(3))
    lock.filter = changed(0x282, lambda d: struct.pack("<ihH", 0, 1200, 0x1237) if next(cycle) == 1 else d)
    lock.held_up(3)
    lock.filter = lambda frames: frames
    lock.cycle()
    stopped_with(lock, r"joint 2: current 9\.600 A, limit 9 A")


def test_a_commander_that_dies_is_noticed_by_both_drives(lock):
    """1016h:2: 300 ms after its last heartbeat both drives brake with EMCY 8130h and keep the fault."""
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


def test_a_bus_that_takes_no_frames(lock):
    started(lock)
    for _ in range(5):
        lock.motion.frame_refused(True)
    stopped_with(lock, "bus: transmit queue full for 5 frames in a row", BRAKE_MS)


def test_single_refused_frames_are_no_reason(lock):
    started(lock)
    for refused in (True, True, True, True, False) * 5:
        lock.motion.frame_refused(refused)
    assert lock.motion.phase is Phase.PLAYING


def test_a_second_commander(lock):
    started(lock)
    lock.with_extra(0x721, b"\x05")
    lock.cycle()
    stopped_with(lock, r"another commander is on the bus .*", BRAKE_MS)


# Asked for --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("joint", [1, 2])
def test_a_signal_leads_both_joints_to_a_stop(lock, joint):
    started(lock, joint=joint)
    lock.motion.stop("SIGINT")
    velocities = []
    for _ in range(RAMP_MS):
        lock.cycle()
        velocities.append(abs(lock.velocities[joint - 1]))
    assert velocities[RAMP_MS // 2] == pytest.approx(SPEED / 2, abs=0.1), "along the ramp"
    stopped_with(lock, "SIGINT", 60)
    assert lock.motion.result.played_s == pytest.approx(0.5)


def test_asked_twice_they_brake_at_once_and_the_first_reason_stays(lock):
    started(lock)
    lock.motion.stop("SIGINT")
    lock.run_for(30)
    assert lock.motion.phase is Phase.RAMPING
    lock.motion.stop("SIGTERM")
    assert lock.motion.phase is Phase.BRAKING
    lock.motion.stop("SIGINT again")
    stopped_with(lock, "SIGINT", BRAKE_MS)


def test_a_stop_while_stopping_for_a_limit_does_not_begin_the_ramp_again(lock):
    """The temperature stays beyond its limit all along the ramp: one ramp, one reason."""
    started(lock, WARM)
    lock.filter = changed(0x381, lambda _: struct.pack("<h", 800))
    until_stop(lock, 600)
    stopped_with(lock, re.escape("joint 1: temperature 80.0 °C, limit 70 °C"))


def test_a_fault_on_the_ramp_goes_over_to_braking(lock):
    started(lock)
    lock.motion.stop("SIGINT")
    lock.run_for(30)
    lock.bench.drives[0].machine.fault()
    lock.run_for(2)
    assert lock.motion.phase is Phase.BRAKING
    stopped_with(lock, "SIGINT", BRAKE_MS)


@pytest.mark.parametrize("phase", [Phase.WAITING, Phase.ENABLING])
def test_a_signal_before_the_first_setpoint(lock, phase):
    motion = lock.commander(plateau(SPEED, CURRENT))
    lock.run(lambda: motion.phase is phase and lock.now > 1100 * MS)
    motion.stop("SIGINT")
    lock.run()
    assert (motion.result.status, motion.result.reason, motion.result.played_s) == ("stopped", "SIGINT", 0.0)
    assert lock.states == (cia402.SWITCH_ON_DISABLED, cia402.SWITCH_ON_DISABLED)
    assert lock.velocities == (0.0, 0.0)


def test_an_exceeded_limit_before_the_start_refuses_it(lock):
    motion = lock.commander(plateau(SPEED, CURRENT), WARM)
    lock.filter = changed(0x382, lambda _: struct.pack("<h", 701))
    lock.run()
    assert motion.refusal == "joint 2: temperature 70.1 °C, limit 70 °C"
