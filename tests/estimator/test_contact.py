"""Contacts on arrays: a known push with its size and sign, none where the joint moves, unknown where inputs are missing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.contact import ALONE, BLIND, CONTACT, NONE, UNKNOWN, ContactDetector, link_loads
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import recommended
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, Push, emulate
from jtqd.sim_can.plants import load_any_plant

SETTINGS = recommended("fused")
THRESHOLD_NM = 0.6
JOINTS = tuple(load_joint(shipped(f"trained/joint{n}.yaml")) for n in (1, 2))


def loads_of(
    made: EmulatedRun, joints: tuple[Joint, ...] = JOINTS, keep: CodeArray | None = None
) -> list[FloatArray]:
    """Loads of both joints at the rows that are kept."""
    rows = slice(None) if keep is None else np.flatnonzero(keep)
    time_s, found = made.table.time_s[rows], []
    for number, joint in enumerate(joints, start=1):
        c = made.table.joint(number, joint.gear_ratio)
        columns = c.current_a, c.motor_position_rad, c.motor_velocity_rad_s, c.link_position_rad
        inputs = [each[rows] for each in columns if each is not None]
        found.append(link_loads(joint, SETTINGS, np.diff(time_s, prepend=time_s[0]), *inputs)[1])
    return found


def opposed(made: EmulatedRun, threshold_nm: float = THRESHOLD_NM) -> tuple[FloatArray, CodeArray]:
    """Residual and what is told, in the frame of joint 1."""
    one, two = loads_of(made)
    angle = made.table.joints[1].motor_position_rad
    assert angle is not None
    return ContactDetector(threshold_nm).run(two - one, angle)


@cache
def run(
    pushes: tuple[Push, ...] = (), seconds: float = 2.0, plant: str = "campaign_plant.yaml"
) -> EmulatedRun:
    """Accelerations, reversals at up to 25 rad/s^2 and a reversing load, on day 3."""
    moved = JointCommand.velocity(lambda t: 1.2 * math.sin(9.0 * t))
    loaded = JointCommand.current(lambda t: 4.0 * math.sin(5.0 * t + 1.0))
    return emulate(load_any_plant(shipped(plant)), (moved, loaded), seconds, 41, day=3, pushes=pushes)


@pytest.mark.parametrize("phase_ms", [0.0, 0.3, 0.7, 0.95])
@pytest.mark.parametrize("torque_nm", [3.0, -3.0])
def test_a_push_is_told_within_two_samples_with_its_size_and_sign(torque_nm: float, phase_ms: float) -> None:
    begin_s = 1.0 + 1e-3 * phase_ms
    residual, told = opposed(run((Push(begin_s, torque_nm), Push(1.2, 0.0))))
    first = int(np.flatnonzero(told == CONTACT)[0])
    assert 1000 < first <= 1002
    assert residual[first] * torque_nm > 0.0
    # the link swings at some 200 Hz for a few milliseconds, then carries the push
    assert np.mean(residual[1006:1040]) == pytest.approx(torque_nm, abs=0.5)
    assert (told[first:1200] == CONTACT).all()
    assert (told[200:1000] == NONE).all()


def test_the_end_of_a_push_is_the_end_of_the_contact() -> None:
    _, told = opposed(run((Push(1.0, 3.0), Push(1.2, 0.0))))
    ended = 1100 + int(np.argmax(told[1100:] == NONE))
    assert 1201 <= ended - BLIND <= 1203
    assert (told[ended - BLIND : ended] == UNKNOWN).all(), "the load is learned anew"
    assert (told[ended:1400] == NONE).all()


@pytest.mark.parametrize("drift_nm", [2.5, -2.5])
def test_a_load_that_goes_on_under_a_push_neither_ends_nor_outlasts_it(drift_nm: float) -> None:
    """Its error moves by almost the push itself in 0.2 s; what steps back is the end, and no contact of the other sign."""
    t = np.arange(2400) * 1e-3
    moved = drift_nm * np.clip((t - 1.0) / 0.2, 0.0, 1.0)
    pushes = np.where((t >= 1.0) & (t < 1.2), 3.0, 0.0) - np.where((t >= 1.5) & (t < 1.7), 3.0, 0.0)
    residual, told = ContactDetector(2.0).run(moved + pushes, np.zeros(len(t)))
    there = told == CONTACT
    assert there[1001:1200].all()
    assert there[1501:1700].all()
    assert not there[:1000].any()
    assert not there[1201:1500].any()
    assert not there[1701:].any()
    assert residual[1001] > 0.0 > residual[1501]


def test_a_wild_sample_is_no_contact_and_two_of_them_are_a_brief_one() -> None:
    x = np.zeros(1000)
    x[500] = 1.9
    residual, told = ContactDetector(1.6).run(x, np.zeros(len(x)))
    assert not (told == CONTACT).any()
    assert residual[500] == pytest.approx(ALONE * 1.9)
    assert residual[501] == pytest.approx(0.95, abs=0.1), "the mean with the one after"
    assert np.flatnonzero(ContactDetector(1.5).run(x, np.zeros(len(x)))[1] == CONTACT)[0] == 500, (
        "large at once"
    )
    x[500], x[501] = 1.8, 1.3
    x[502:] = 0.7  # less than a step of the threshold back
    _, told = ContactDetector(1.5).run(x, np.zeros(len(x)))
    there = np.flatnonzero(told == CONTACT)
    assert there[0] == 501
    assert len(there) < 20


def test_motion_reversal_and_load_are_no_contact() -> None:
    made = run(seconds=8.0)
    residual, told = opposed(made)
    assert (told[:103] == UNKNOWN).all()
    assert (told[104:] == NONE).all()
    velocity = made.table.joints[1].motor_velocity_rad_s
    assert velocity is not None
    assert np.count_nonzero(np.diff(np.sign(velocity[104:]))) > 20, "it does reverse"
    assert np.nanmax(np.abs(residual)) < THRESHOLD_NM / 1.1


def test_stick_slip_is_no_contact() -> None:
    """At a crawl against the breakaway of a bristle friction: a bench with laws of its own, and the nominal spring."""
    crawl = JointCommand.velocity(lambda t: 0.012 * math.sin(2.0 * t))
    loaded = JointCommand.current(lambda t: 1.5 * math.sin(7.0 * t))
    made = emulate(load_any_plant(shipped("plants/typical.yaml")), (crawl, loaded), 6.0, 5, day=1)
    velocity = made.table.joints[1].motor_velocity_rad_s
    assert velocity is not None
    stopped = np.abs(velocity) < 1e-3
    assert np.count_nonzero(np.diff(stopped.astype(int))) > 20, "it sticks and slips"
    _, told = opposed(made, 1.0)
    assert (told[110:] == NONE).all()


def test_the_momentum_is_earlier_than_the_torsion() -> None:
    """Without the link's inertia in it the residual of the first sample after a push is smaller."""
    made = run((Push(1.0, 3.0), Push(1.2, 0.0)))
    light = tuple(replace(each, link_inertia_kgm2=1e-9) for each in JOINTS)
    (one, two), (light_one, light_two) = loads_of(made), loads_of(made, light)
    whole, without = (
        (two - one)[1001] - (two - one)[1000],
        (light_two - light_one)[1001] - (light_two - light_one)[1000],
    )
    assert whole > 0.8
    assert abs(without) < 0.4


def synthetic(x_nm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motor at rest, link on its spring, pushed by x [n] at 20 kHz: time, link position and velocity at 1 kHz."""
    torsion = JOINTS[0].fused.torsion  # type: ignore[union-attr]
    assert torsion is not None
    q = w = 0.0
    found = []
    for k, x in enumerate(x_nm):
        if k % 20 == 0:
            found.append(q)
        torque = -torsion.stiffness_nm_per_rad * q - torsion.damping_nms_per_rad * w
        w += 5e-5 * (torque + x) / JOINTS[0].link_inertia_kgm2
        q += 5e-5 * w
    return np.arange(len(found)) * 1e-3, np.array(found), np.zeros(len(found))


def test_alone_the_residual_is_the_push_itself() -> None:
    x = np.zeros(20 * 600)
    x[20 * 300 + 7 :] = 2.0
    time_s, q, zero = synthetic(x)
    dt = np.diff(time_s, prepend=0.0)
    rate, load = link_loads(JOINTS[0], SETTINGS, dt, zero, zero, zero, q)
    residual, told = ContactDetector(0.5).run(-load, zero)
    assert np.flatnonzero(told == CONTACT)[0] <= 302
    assert residual[310:320] == pytest.approx(2.0, abs=0.4)  # the joint's slip holds 0.35 Nm
    steep = np.nanmin(rate[300:306])  # the joint's torque goes against the push
    assert steep < -300.0
    assert np.nansum(rate[300:340]) * 1e-3 == pytest.approx(-2.0, abs=0.2)


def test_a_slow_load_is_load_and_a_long_contact_becomes_one() -> None:
    t = np.arange(3000) * 1e-3
    zero = np.zeros(3000)
    _, told = ContactDetector(1.0).run(20.0 * np.sin(2.0 * t), zero)
    assert (told[100:] == NONE).all()
    residual, told = ContactDetector(1.0).run(np.where(t < 1.0, 0.0, 3.0), zero)
    there = np.flatnonzero(told == CONTACT)
    assert there[0] == 1000
    assert 498 <= len(there) <= 502
    assert abs(residual[2000]) < 1e-9


def test_what_turns_with_the_motor_is_no_contact() -> None:
    """An error of 1.5 Nm at one per turn, more than the threshold, is learned; a push beside it is told."""
    t = np.arange(4000) * 1e-3
    angle = 150.0 * t
    wave = 1.5 * np.cos(angle + 0.4) + 0.5 * np.cos(2.0 * angle)
    grown = wave * np.minimum(t / 1.0, 1.0)
    push = np.where((t >= 3.0) & (t < 3.2), 3.0, 0.0)
    residual, told = ContactDetector(1.0).run(grown + push, angle)
    assert (told[100:3000] == NONE).all()
    assert (told[3000:3200] == CONTACT).all()
    assert residual[3050] == pytest.approx(3.0, abs=0.2)


def test_a_gap_in_the_inputs_is_unknown_and_no_contact() -> None:
    made = run()
    keep = np.ones(2000, bool)
    keep[1000] = False
    one, two = loads_of(made, keep=keep)
    angle = made.table.joints[1].motor_position_rad
    assert angle is not None
    _, told = ContactDetector(THRESHOLD_NM).run(two - one, angle[keep])
    assert (told[1000:1003] == UNKNOWN).all(), "three steps of one length give an acceleration"
    assert (told[104:1000] == NONE).all()
    assert (told[1003:] == NONE).all()


def test_after_a_long_gap_it_settles_again() -> None:
    x = np.zeros(1000)
    x[300:360] = np.nan
    x[360:] = 8.0
    _, told = ContactDetector(1.0).run(x, np.zeros(1000))
    assert (told[99:300] == NONE).all()
    assert (told[300:459] == UNKNOWN).all(), "a load that changed while nobody saw it is no contact"
    assert (told[459:] == NONE).all()


def test_a_threshold_that_is_none_is_refused() -> None:
    for threshold, period in ((0.0, 1e-3), (math.nan, 1e-3), (1.0, 0.0), (1.0, 0.02)):
        with pytest.raises(ValueError, match="found a threshold of"):
            ContactDetector(threshold, period)


def test_a_joint_without_torsion_has_no_load() -> None:
    zero = np.zeros(3)
    with pytest.raises(ValueError, match="joint joint1: found no section fused"):
        link_loads(load_joint(shipped("joint1.yaml")), SETTINGS, zero, zero, zero, zero, zero)


def test_what_was_before_a_missing_sample_is_in_no_mean() -> None:
    x = np.zeros(1000)
    x[500:503] = 1.9, np.nan, 1.5
    residual, told = ContactDetector(1.6).run(x, np.zeros(len(x)))
    assert residual[502] == pytest.approx(ALONE * 1.5, abs=0.1)
    assert not (told == CONTACT).any()
