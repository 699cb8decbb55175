"""Motions of one joint of an arm: whatever the kind and the room, no sample leaves it."""

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import MotionLimits
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.next_experiment import (
    MOTION_FILE,
    NoRangeError,
    each_joint,
    joint_range_of,
    next_experiment,
)
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, joint_signals
from jtqd.sysid.planner.experiments import EXPERIMENTS, RATE_HZ, JointRange, csv_text, joint_motions
from tests.sysid.diagnosis.diagnose_helpers import JOINT, bench_run

GRAVITY_NM = 20.0


def swung(low: float = -0.6, high: float = 1.0, speed: float = 0.7, noise_rad: float = 0.0) -> JointSignals:
    """An arm's joint swung from low to high and back under gravity."""
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    rate = speed / half
    time_s = np.arange(0.0, 12.0, 0.002)
    angle = middle + half * np.sin(rate * time_s)
    torque = GRAVITY_NM * np.sin(angle)
    columns = JointColumns(
        current_a=torque / JOINT.gear_ratio / JOINT.torque_constant_nm_per_a,
        motor_position_rad=JOINT.gear_ratio
        * (angle + noise_rad * np.random.default_rng(1).normal(size=len(angle))),
        torque_nm=torque,
    )
    return joint_signals("r", RunTable(time_s, {1: columns}), 1, JOINT, BaseLoss(JOINT))


@pytest.mark.parametrize("kind", EXPERIMENTS)
@pytest.mark.parametrize(
    "room",
    [
        JointRange(-0.5, 0.9, 0.7, 2.0, 40.0, 18.0),
        JointRange(0.1, 0.13, 0.02, 0.05, 5.0, 1.0),
        JointRange(-6.0, 6.0, 3.0, 0.8, 300.0, 100.0),
        JointRange(-0.01, 0.2, 3.0, 60.0, 5.0, 1.0),
    ],
)
def test_no_motion_leaves_its_room(kind: str, room: JointRange) -> None:
    made = joint_motions([kind], room)
    assert len(made) >= 2  # a run to leave out
    for motion in made:
        assert motion.position_rad.min() >= room.low_rad - 1e-9
        assert motion.position_rad.max() <= room.high_rad + 1e-9
        assert np.abs(motion.velocity_rad_s).max() <= room.velocity_rad_s * (1.0 + 1e-9)
        steps = np.abs(np.diff(motion.velocity_rad_s)) * RATE_HZ
        assert steps.max() <= room.acceleration_rad_s2 * (1.0 + 1e-9)
        assert motion.velocity_rad_s[0] == motion.velocity_rad_s[-1] == 0.0
        turned = np.diff(motion.position_rad) * RATE_HZ
        between = 0.5 * (motion.velocity_rad_s[1:] + motion.velocity_rad_s[:-1])
        assert np.abs(turned - between).max() <= 1e-9
        assert 1.0 < motion.duration_s < 3600.0


def test_the_room_is_where_the_runs_have_been() -> None:
    room = joint_range_of(JOINT, [swung()])
    assert room.low_rad == pytest.approx(-0.6 + 0.05 * 1.6, abs=1e-3)
    assert room.high_rad == pytest.approx(1.0 - 0.05 * 1.6, abs=1e-3)
    assert room.velocity_rad_s == pytest.approx(0.7, rel=0.01)
    assert room.needed_nm == pytest.approx(GRAVITY_NM * np.sin(1.0), rel=0.01)


@pytest.mark.parametrize("noise_rad", [0.0, 2e-4])
def test_noise_of_the_encoder_is_no_acceleration(noise_rad: float) -> None:
    room = joint_range_of(JOINT, [swung(noise_rad=noise_rad)])
    assert room.acceleration_rad_s2 == pytest.approx(0.7**2 / 0.8, rel=0.15)


def test_the_limits_of_the_joint_file_make_it_smaller() -> None:
    limits = MotionLimits((-0.2, 5.0), velocity_rad_s=0.3, acceleration_rad_s2=0.1, torque_nm=10.0)
    room = joint_range_of(replace(JOINT, motion_limits=limits), [swung()])
    assert room.low_rad >= -0.2
    assert GRAVITY_NM * np.sin(room.high_rad) <= 10.0  # nowhere where gravity alone needs more
    assert (room.velocity_rad_s, room.acceleration_rad_s2, room.torque_nm) == (0.3, 0.1, 10.0)


@pytest.mark.parametrize(
    "limits",
    [
        MotionLimits((2.0, 3.0)),
        MotionLimits(velocity_rad_s=1e-4),
        MotionLimits(travel_rad=(0.5, 0.9), torque_nm=1.0),
    ],
)
def test_without_room_there_is_no_motion(limits: MotionLimits) -> None:
    with pytest.raises(NoRangeError, match="the joint stood in these runs"):
        joint_range_of(replace(JOINT, motion_limits=limits), [swung()])
    made = next_experiment([("hysteresis",)], {3: replace(JOINT, motion_limits=limits)}, signals=[swung()])
    assert made["plan"] is None
    assert "motions" not in made
    assert "No motion is planned" in made["why"]


def test_without_runs_the_limits_of_the_file_are_the_room() -> None:
    limits = MotionLimits((-0.2, 0.4), velocity_rad_s=0.3, acceleration_rad_s2=1.0, torque_nm=10.0)
    made = next_experiment([], {1: replace(JOINT, motion_limits=limits)})
    assert made["motions"][MOTION_FILE]["travel_rad"] == [-0.2, 0.4]
    assert "no run shows what torque that needs" in made["why"]
    assert "motions" not in next_experiment([], {1: JOINT})
    without = next_experiment([], {1: replace(JOINT, motion_limits=MotionLimits((-0.2, 0.4), torque_nm=1.0))})
    assert "motions" not in without
    assert without["why"].endswith("(or --limits) lacks velocity_rad_s, acceleration_rad_s2.")


def test_one_run_is_too_few_and_shows_where_the_joint_may_go_all_the_same() -> None:
    """Limits wider than the run's motion do not widen the experiment."""
    table = bench_run(seconds=6.0, numbers=(1,))
    position = table.joints[1].link_position_rad
    assert position is not None
    wide = MotionLimits((-50.0, 50.0), velocity_rad_s=90.0, acceleration_rad_s2=900.0)
    found = diagnose([("a", table)], {1: replace(JOINT, motion_limits=wide)})
    assert found.verdict == "insufficient_data"
    assert "found 1 usable run, expected at least 2" in found.reasons[-1]
    assert found.next_experiment is not None
    motion = found.next_experiment["motions"][MOTION_FILE]
    low, high = motion["travel_rad"]
    assert float(position.min()) < low < high < float(position.max())
    assert motion["velocity_rad_s"] < 5.0


def test_one_joint_gets_a_motion_and_no_towing_plan() -> None:
    made = next_experiment([("torque_constant", "sensor_gain")], {3: JOINT}, "Why.", signals=[swung()])
    assert made["plan"] is None
    motion = made["motions"][MOTION_FILE]
    assert motion["joint"] == 3
    assert "with a payload" in {run["what"] for run in motion["runs"]}
    rows = made["tables"][MOTION_FILE].splitlines()
    assert rows[0] == "run,time_s,position_rad,velocity_rad_s"
    positions = [float(row.split(",")[2]) for row in rows[1:]]
    assert min(positions) >= motion["travel_rad"][0] - 1e-6
    assert max(positions) <= motion["travel_rad"][1] + 1e-6
    assert made["why"].startswith(
        "Why. Proposed to distinguish torque_constant from sensor_gain: load_at_both"
    )
    assert "a payload may add no more than the rest" in made["why"]


def test_every_joint_of_an_arm_gets_a_motion_of_its_own() -> None:
    """Three joints, one of them without a room; no towing plan."""
    limits = MotionLimits((-0.2, 0.4), velocity_rad_s=0.3, acceleration_rad_s2=1.0, torque_nm=10.0)
    free = replace(JOINT, motion_limits=limits)
    made = next_experiment([("hysteresis",)], {2: free, 3: JOINT, 4: free}, "Why.")
    assert made["plan"] is None
    assert [each["joint"] for each in made["motions"].values()] == [2, 4]
    assert set(made["tables"]) == {f"next_experiment.joint{n}.motion.csv" for n in (2, 4)}
    alone = next_experiment([("hysteresis",)], {4: free}, "Why.")["tables"][MOTION_FILE]
    assert made["tables"]["next_experiment.joint4.motion.csv"] == alone
    assert all(f"Joint {n}: Why." in made["why"] for n in (2, 3, 4))
    assert "towing" not in made["why"]
    assert each_joint({2: {"why": "one"}}) == {"why": "one"}


def test_the_same_room_gives_the_same_table() -> None:
    room = JointRange(-0.5, 0.9, 0.7, 2.0, 40.0, 18.0)
    assert csv_text(joint_motions(["excitation"], room)) == csv_text(joint_motions(["excitation"], room))
