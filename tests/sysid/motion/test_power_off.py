"""Drives switched off and on again within a motion: what is sent and measured, that nothing jumps, what stops it."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import shipped
from jtqd.sim_can import devices as cia402
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.motion.commander import Phase
from jtqd.sysid.motion.setpoints import Mark, Setpoints
from jtqd.sysid.planner.plan import Off, Plateau, Rest, Run, check_run, expand
from tests.sysid.motion.lock_step import MS, PLANT, WIDE, LockStep, changed, plateau, turning

BOTH_OFF = (cia402.SWITCH_ON_DISABLED, cia402.SWITCH_ON_DISABLED)
BOTH_ON = (cia402.OPERATION_ENABLED, cia402.OPERATION_ENABLED)
OFFSET_A = 0.07
OFF_S = 1.5
RUN = Run(
    "a",
    1,
    (Plateau(0.5, 1.0, 0.1, 0.3), Rest(0.2, 0.3), Off(OFF_S), Plateau(-0.5, -1.0, 0.4, 0.3), Rest(0.1, 0.3)),
)
"""Off from 0.9 to 2.4 s; 2.7 to 3.1 s the plateau after it."""


def with_offset() -> LockStep:
    one = PLANT.joints[0]
    measured = replace(one.measurement, current_offset_a=OFFSET_A)
    return LockStep(replace(PLANT, joints=(replace(one, measurement=measured), PLANT.joints[1])))


def until_off(lock: LockStep) -> None:
    lock.commander(check_run(RUN, WIDE))
    lock.run(lambda: lock.states == BOTH_OFF and lock.motion.played_s > 0.5)
    assert lock.motion.phase is Phase.POWERLESS


def stopped(lock: LockStep, pattern: str) -> None:
    """At once, both off in the end, for this reason; no drive is enabled on the way."""
    enabled = {k for k in (0, 1) if lock.states[k] == cia402.OPERATION_ENABLED}
    lock.run(lambda: lock.motion.phase is not Phase.POWERLESS, limit_ms=1500)
    began = lock.now
    while not lock.motion.over:
        lock.cycle()
        now = {k for k in (0, 1) if lock.states[k] == cia402.OPERATION_ENABLED}
        assert now <= enabled
        enabled = now
    assert lock.now - began < 1700 * MS, "quick_stop_s, disable_s"
    assert lock.motion.result.status == "stopped"
    assert re.fullmatch(pattern, lock.motion.result.reason), lock.motion.result.reason
    assert lock.states == BOTH_OFF


def test_the_motion_continues_after_a_window_without_power_in_which_only_the_offset_is_read():
    lock = with_offset()
    motion = lock.commander(check_run(RUN, WIDE))
    rows = []
    while not motion.over:
        lock.cycle()
        true = [drive.current_a for drive in lock.source.plant.drives]
        read = [drive.current_a for drive in lock.source.drives]
        rows.append((motion.played_s, lock.states == BOTH_OFF, *lock.velocities, *true, *read))
    assert motion.result == ("done", "", pytest.approx(RUN.duration_s)), "off for as long as planned"
    played, off, v1, v2, i1, i2, r1, r2 = np.array(rows).T
    inside = (off > 0) & (played > 0.0) & (played < RUN.duration_s)
    assert inside.sum() * 1e-3 == pytest.approx(OFF_S - 0.4, abs=0.02), "standing before, 0.25 s to come back"
    assert played[inside].min() > 0.9
    late = inside & (played > played[inside].min() + 0.1)
    assert np.abs(np.array([i1, i2])[:, late]).max() < 1e-6, "no current, so no torque of a motor"
    assert np.abs([v1[late], v2[late]]).max() < 1e-6
    noise = 4.0 * 0.01 / math.sqrt(late.sum())
    assert r1[late].mean() == pytest.approx(OFFSET_A, abs=noise)
    assert r2[late].mean() == pytest.approx(0.0, abs=noise)
    plateau_after = (played > 2.85) & (played < 3.1)
    assert v1[plateau_after].mean() == pytest.approx(-0.5, abs=0.005)
    assert i2[plateau_after] == pytest.approx(-1.0, abs=0.005)
    back = (played > played[inside].max()) & (played < 2.4)
    assert np.abs([v1[back], v2[back]]).max() < 0.02, "enabled again without a jump"


def test_the_controlwords_of_switching_off_and_on_and_no_target_meanwhile():
    lock = LockStep()
    lock.commander(check_run(RUN, WIDE))
    lock.run(lambda: lock.motion.phase is Phase.POWERLESS)
    begin = lock.now // MS
    lock.run(lambda: lock.motion.phase is Phase.PLAYING)
    for can_id in (0x201, 0x202):
        sent = [data for ms, found, data in lock.sent if found == can_id and ms >= begin]
        words = [int.from_bytes(data[:2], "little") for data in sent]
        changes = [word for n, word in enumerate(words) if n == 0 or words[n - 1] != word]
        assert changes[-4:] == [0, 6, 7, 15]
        assert changes[:-4] in ([], [15])
        assert all(data[2:] == b"\x00\x00" for data in sent), "no torque is asked for"
    assert {t for ms, can_id, t in lock.setpoints_sent(begin) if ms < lock.now // MS} == {0}
    assert lock.states == BOTH_ON


def test_a_window_without_power_is_no_new_day_of_the_emulated_bench():
    lock = LockStep(load_plant(shipped("campaign_plant.yaml")))
    days = set()
    lock.commander(check_run(RUN, WIDE))
    while not lock.motion.over:
        lock.cycle()
        days.add(lock.source.day_number)
    assert lock.motion.result.status == "done"
    assert days == {0}
    lock.commander(plateau(0.2, 0.0))
    lock.run()
    assert lock.source.day_number == 1, "the next run is"


def test_a_signal_while_the_power_is_off_ends_the_motion_without_enabling_again():
    lock = LockStep()
    until_off(lock)
    lock.run_for(200)
    before = len(lock.sent)
    lock.motion.stop("SIGINT")
    stopped(lock, "SIGINT")
    words = {data[:2] for _, can_id, data in lock.sent[before:] if can_id in (0x201, 0x202)}
    assert words <= {b"\x02\x00", b"\x00\x00"}, "quick stop and disable voltage, never enable operation"


@pytest.mark.parametrize(
    ("can_id", "data", "pattern"),
    [
        (0x081, "1023020000000000", r"joint 1: EMCY 2310h .*"),
        (0x702, "7f", r"joint 2: NMT pre-operational, expected operational"),
        (0x183, "400d030000", r"joints 1 and 2: torque at the sensor 200.00 Nm, .*"),
    ],
)
def test_limits_and_supervision_continue_without_power(can_id, data, pattern):
    lock = LockStep()
    until_off(lock)
    lock.run_for(300)
    lock.with_extra(can_id, bytes.fromhex(data))
    stopped(lock, pattern)


def test_a_joint_that_turns_without_power_ends_the_motion():
    lock = LockStep()
    until_off(lock)
    lock.run_for(300)
    lock.filter = turning(2, 0.3)
    stopped(lock, r"joint 2: velocity 0\.300 rad/s without power, limit 0\.2 rad/s")


@pytest.mark.parametrize(
    ("word", "pattern"),
    [
        (0x1237, r"joint 2: operation enabled \(statusword 1237h\) after 0\.5 s, expected no power"),
        (0x0231, r"joint 2: ready to switch on \(statusword 0231h\) after 1 s, expected operation enabled"),
    ],
    ids=["stays on", "stays off"],
)
def test_a_drive_that_does_not_obey_ends_the_motion(word, pattern):
    lock = LockStep()
    lock.commander(check_run(RUN, WIDE))
    lock.run(lambda: lock.motion.phase is Phase.POWERLESS)

    same_word = changed(0x282, lambda data: data[:6] + word.to_bytes(2, "little"))
    if word == 0x0231:
        lock.run(lambda: lock.states == BOTH_OFF)
    lock.filter = lambda frames: same_word(frames) if lock.motion.phase is Phase.POWERLESS else frames
    lock.run(lambda: lock.motion.phase is not Phase.POWERLESS, limit_ms=4000)
    lock.run()
    assert lock.motion.result.status == "stopped"
    assert re.fullmatch(pattern, lock.motion.result.reason), lock.motion.result.reason
    assert lock.states == BOTH_OFF


def test_the_power_does_not_go_while_a_joint_moves():
    """Both drives stay enabled until both joints have stood for 150 ms, and are then off for half of the window."""
    lock = LockStep()
    lock.commander(check_run(RUN, WIDE))
    lock.run(lambda: lock.motion.phase is Phase.POWERLESS)
    lock.filter = turning(1, 0.1)
    lock.run_for(1500)
    assert lock.states == BOTH_ON
    lock.filter = lambda frames: frames
    lock.run_for(100)
    assert lock.states == BOTH_ON
    lock.run_for(100)
    assert lock.states == BOTH_OFF
    off = lock.run(lambda: lock.states != BOTH_OFF)
    assert off == pytest.approx(700, abs=60)


def test_lost_cycles_do_not_skip_a_window_without_power():
    lock = LockStep()
    lock.commander(check_run(RUN, WIDE))
    lock.run(lambda: lock.motion.played_s >= 0.899)
    lock.now += 3 * MS
    lock.run(lambda: lock.states == BOTH_OFF, limit_ms=400)


def test_segments_without_power():
    points = expand(RUN)
    assert points.off == ((900, 2400),)
    assert Mark("power_off", 0.9, 2.4) in points.marks
    assert not points.velocity_rad_s[900:2400].any()


@pytest.mark.parametrize(
    ("off", "text"),
    [
        (((0, 2),), "off at 0.000 s with a target other than 0, expected rest"),
        (((3, 6),), "off from 3 to 6, expected rising numbers up to 5"),
        (((2, 4), (3, 5)), "off from 3 to 5, expected rising numbers up to 5"),
    ],
)
def test_setpoints_refuse_power_off_in_motion(off, text):
    with pytest.raises(ValueError, match=text):
        Setpoints(1, np.array([0.0, 0.01, 0.0, 0.0, 0.0]), np.zeros(5), (), off)
