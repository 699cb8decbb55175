"""Contacts on arrays: a known push with its size and sign, none where the joint moves, unknown where inputs are missing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from jtqd.estimator.arrays import CodeArray, FloatArray
from jtqd.estimator.detection import detect_contacts
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import recommended
from jtqd.estimator.status import CONTACT_NONE, CONTACT_PRESENT, CONTACT_UNKNOWN
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, Push, emulate
from jtqd.sim_can.plant_source import load_any_plant

SETTINGS = replace(recommended("fused"), track_zeros=False)
THRESHOLD_NM = 0.6
JOINTS = tuple(load_joint(shipped(f"trained/joint{n}.yaml")) for n in (1, 2))
SINGLE, BLANK = 0.8, 6
"""Weight of one residual; samples without a result after a contact."""


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
        dt_s = np.diff(time_s, prepend=time_s[0])
        found.append(FusedEstimator(joint, SETTINGS).run(dt_s, *inputs).load_nm)
    return found


def angle_of(made: EmulatedRun) -> FloatArray:
    angle = made.table.joints[1].motor_position_rad
    assert angle is not None
    return angle


def opposed(made: EmulatedRun, threshold_nm: float = THRESHOLD_NM) -> tuple[FloatArray, CodeArray]:
    """Residual and code, in the frame of joint 1."""
    one, two = loads_of(made)
    return detect_contacts(two - one, angle_of(made), threshold_nm)


def alone(x: FloatArray, threshold_nm: float) -> tuple[FloatArray, CodeArray]:
    """Residual and code of a motor at rest."""
    return detect_contacts(x, np.zeros(len(x)), threshold_nm)


def reversals(made: EmulatedRun) -> int:
    velocity = made.table.joints[1].motor_velocity_rad_s
    assert velocity is not None
    return np.count_nonzero(np.diff(np.sign(velocity[104:])))


@cache
def run(pushes: tuple[Push, ...] = (), seconds: float = 2.0) -> EmulatedRun:
    """Accelerations, reversals at up to 25 rad/s^2 and a reversing load, on day 3."""
    moved = JointCommand.velocity(lambda t: 1.2 * math.sin(9.0 * t))
    loaded = JointCommand.current(lambda t: 4.0 * math.sin(5.0 * t + 1.0))
    plant = load_any_plant(shipped("campaign_plant.yaml"))
    return emulate(plant, (moved, loaded), seconds, 41, day=3, pushes=pushes)


@pytest.mark.parametrize("phase_ms", [0.0, 0.3, 0.7, 0.95])
@pytest.mark.parametrize("torque_nm", [3.0, -3.0])
def test_a_push_is_found_within_two_samples_with_its_size_and_sign(torque_nm: float, phase_ms: float) -> None:
    begin_s = 1.0 + 1e-3 * phase_ms
    residual, code = opposed(run((Push(begin_s, torque_nm), Push(1.2, 0.0))))
    first = int(np.flatnonzero(code == CONTACT_PRESENT)[0])
    assert 1000 < first <= 1002
    assert residual[first] * torque_nm > 0.0
    # the link swings at some 200 Hz for a few milliseconds, then carries the push
    assert np.mean(residual[1006:1040]) == pytest.approx(torque_nm, abs=0.5)
    assert (code[first:1200] == CONTACT_PRESENT).all()
    assert (code[200:1000] == CONTACT_NONE).all()
    end = 1100 + int(np.argmax(code[1100:] == CONTACT_NONE))
    assert 1201 <= end - BLANK <= 1203
    assert (code[end - BLANK : end] == CONTACT_UNKNOWN).all()
    assert (code[end:1400] == CONTACT_NONE).all()


@pytest.mark.parametrize("drift_nm", [2.5, -2.5])
def test_a_load_that_changes_under_a_push_neither_ends_nor_outlasts_it(drift_nm: float) -> None:
    """Its error moves by almost the push itself in 0.2 s; the step back is the end, and no contact of the other sign."""
    t = np.arange(2400) * 1e-3
    moved = drift_nm * np.clip((t - 1.0) / 0.2, 0.0, 1.0)
    pushes = np.where((t >= 1.0) & (t < 1.2), 3.0, 0.0) - np.where((t >= 1.5) & (t < 1.7), 3.0, 0.0)
    residual, code = alone(moved + pushes, 2.0)
    present = code == CONTACT_PRESENT
    pushed = (t > 1.0005) & (t < 1.1995) | (t > 1.5005) & (t < 1.6995)
    assert present[pushed].all()
    pushed[[1000, 1200, 1500, 1700]] = True
    assert not present[~pushed].any()
    assert residual[1001] > 0.0 > residual[1501]


def test_an_outlier_is_no_contact_and_two_of_them_are_a_brief_one() -> None:
    x = np.zeros(1000)
    x[500] = 1.9
    residual, code = alone(x, 1.6)
    assert not (code == CONTACT_PRESENT).any()
    assert residual[500] == pytest.approx(SINGLE * 1.9)
    assert residual[501] == pytest.approx(0.95, abs=0.1), "the mean with the next"
    assert np.flatnonzero(alone(x, 1.5)[1] == CONTACT_PRESENT)[0] == 500, "large enough for one sample"
    x[500], x[501] = 1.8, 1.3
    x[502:] = 0.7  # less than a step of the threshold back
    found = np.flatnonzero(alone(x, 1.5)[1] == CONTACT_PRESENT)
    assert found[0] == 501
    assert len(found) < 20
    x = np.zeros(1000)
    x[500:503] = 1.9, np.nan, 1.5
    residual, code = alone(x, 1.6)
    assert residual[502] == pytest.approx(SINGLE * 1.5, abs=0.1), "no mean across a missing sample"
    assert not (code == CONTACT_PRESENT).any()


def test_motion_reversal_and_load_are_no_contact() -> None:
    made = run(seconds=8.0)
    residual, code = opposed(made)
    assert (code[:103] == CONTACT_UNKNOWN).all()
    assert (code[104:] == CONTACT_NONE).all()
    assert reversals(made) > 20
    assert np.nanmax(np.abs(residual)) < THRESHOLD_NM / 1.1


def test_stick_slip_is_no_contact() -> None:
    """At a crawl against the breakaway of a bristle friction: a bench with equations of its own, and the nominal spring."""
    crawl = JointCommand.velocity(lambda t: 0.012 * math.sin(2.0 * t))
    loaded = JointCommand.current(lambda t: 1.5 * math.sin(7.0 * t))
    made = emulate(load_any_plant(shipped("plants/typical.yaml")), (crawl, loaded), 6.0, 5, day=1)
    velocity = made.table.joints[1].motor_velocity_rad_s
    assert velocity is not None
    assert np.count_nonzero(np.diff((np.abs(velocity) < 1e-3).astype(int))) > 20, "it sticks and slips"
    assert (opposed(made, 1.0)[1][110:] == CONTACT_NONE).all()


def test_the_momentum_is_earlier_than_the_torsion() -> None:
    """Without the link's inertia in it the residual of the first sample after a push is smaller."""
    made = run((Push(1.0, 3.0), Push(1.2, 0.0)))

    def first_step(joints: tuple[Joint, ...]) -> float:
        one, two = loads_of(made, joints)
        return float((two - one)[1001] - (two - one)[1000])

    assert first_step(JOINTS) > 0.8
    assert abs(first_step(tuple(replace(each, link_inertia_kgm2=1e-9) for each in JOINTS))) < 0.4


def link_on_its_spring(x_nm: FloatArray) -> FloatArray:
    """Link position at 1 kHz, motor at rest, pushed by x [n] at 20 kHz."""
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
    return np.array(found)


def test_of_one_joint_the_residual_is_the_push_itself() -> None:
    x = np.zeros(20 * 600)
    x[20 * 300 + 7 :] = 2.0
    zero, dt = np.zeros(600), np.full(600, 1e-3)
    run = FusedEstimator(JOINTS[0], SETTINGS).run(dt, zero, zero, zero, link_on_its_spring(x))
    rate = run.torque_rate_nm_s
    residual, code = alone(-run.load_nm, 0.5)
    assert np.flatnonzero(code == CONTACT_PRESENT)[0] <= 302
    assert residual[310:320] == pytest.approx(2.0, abs=0.4)  # the joint's slip carries 0.35 Nm
    assert np.nanmin(rate[300:306]) < -300.0  # the joint's torque opposes the push
    assert np.nansum(rate[300:340]) * 1e-3 == pytest.approx(-2.0, abs=0.2)


def test_a_slow_load_is_load_and_a_long_contact_becomes_one() -> None:
    t = np.arange(3000) * 1e-3
    assert (alone(20.0 * np.sin(2.0 * t), 1.0)[1][100:] == CONTACT_NONE).all()
    residual, code = alone(np.where(t < 1.0, 0.0, 3.0), 1.0)
    found = np.flatnonzero(code == CONTACT_PRESENT)
    assert found[0] == 1000
    assert 498 <= len(found) <= 502
    assert abs(residual[2000]) < 1e-9


def test_an_error_over_the_motor_s_turn_is_no_contact() -> None:
    """1.5 Nm at one per turn, more than the threshold; a push on top of it is found."""
    t = np.arange(4000) * 1e-3
    angle = 150.0 * t
    wave = 1.5 * np.cos(angle + 0.4) + 0.5 * np.cos(2.0 * angle)
    push = np.where((t >= 3.0) & (t < 3.2), 3.0, 0.0)
    residual, code = detect_contacts(wave * np.minimum(t, 1.0) + push, angle, 1.0)
    assert (code[100:3000] == CONTACT_NONE).all()
    assert (code[3000:3200] == CONTACT_PRESENT).all()
    assert residual[3050] == pytest.approx(3.0, abs=0.2)


def test_a_gap_in_the_inputs_is_unknown_and_no_contact() -> None:
    made = run()
    keep = np.ones(2000, bool)
    keep[1000] = False
    one, two = loads_of(made, keep=keep)
    _, code = detect_contacts(two - one, angle_of(made)[keep], THRESHOLD_NM)
    assert (code[1000:1003] == CONTACT_UNKNOWN).all(), "three equal steps give an acceleration"
    assert (code[104:1000] == CONTACT_NONE).all()
    assert (code[1003:] == CONTACT_NONE).all()


def test_after_a_long_gap_it_settles_again() -> None:
    x = np.zeros(1000)
    x[300:360] = np.nan
    x[360:] = 8.0
    _, code = alone(x, 1.0)
    assert (code[99:300] == CONTACT_NONE).all()
    assert (code[300:459] == CONTACT_UNKNOWN).all(), "a load that changed in the gap is no contact"
    assert (code[459:] == CONTACT_NONE).all()


@pytest.mark.parametrize(
    ("threshold_nm", "period_s"), [(0.0, 1e-3), (math.nan, 1e-3), (1.0, 0.0), (1.0, 0.02)]
)
def test_a_threshold_or_period_out_of_range_is_refused(threshold_nm: float, period_s: float) -> None:
    with pytest.raises(ValueError, match="found a threshold of"):
        detect_contacts(np.zeros(3), np.zeros(3), threshold_nm, period_s)


def test_inputs_that_do_not_fit_are_refused() -> None:
    zero = np.zeros(3)
    with pytest.raises(ValueError, match="found 2 angles, expected 3"):
        detect_contacts(zero, np.zeros(2), 1.0)
