"""Channels of one joint that cannot be right, by their fault; units by size; columns that two joints have exchanged."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import emulate_run
from jtqd.sim_can.plant_file import load_plant, plant_of_joint
from jtqd.sysid.runs.channels import Channels, check_channels
from jtqd.sysid.runs.checks import check_runs
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run, read_runs
from tests.estimator.estimator_helpers import joint1
from tests.paths import ROOT
from tests.sysid.campaign_helpers import plateau_run
from tests.sysid.diagnosis.diagnose_core_helpers import rich_run
from tests.sysid.runs.spoiled_runs import (
    ANGLES,
    DEGREES,
    bench,
    changed,
    checked,
    column,
    drawn,
    motion,
    times,
)

JOINT = joint1()
POINTS = [(v, i) for v in (0.4, 2.0, -1.0) for i in (0.0, 3.0, 5.0, -4.0)]


@pytest.fixture(scope="module")
def noisy():
    return plateau_run(load_plant(shipped("plant.yaml")), POINTS, hold_s=0.6)


@pytest.fixture(scope="module")
def ideal():
    """Without noise beyond rounding: constant values are normal here, and no sign of a stuck channel."""
    return plateau_run(plant_of_joint(JOINT), POINTS, hold_s=0.6)


def kinds(table: RunTable, joint: Joint = JOINT, number: int = 1, **changes: FloatArray | None) -> list[str]:
    run = replace(table.joints[number], **changes)
    found = check_channels(Channels(table.time_s, run, joint, f"run.csv: j{number}"))
    assert all(item.text.startswith("run.csv: j1") or number == 2 for item in found)
    assert all("\n" not in item.text for item in found)
    return [item.kind for item in found]


@pytest.mark.parametrize("number", [1, 2])
def test_good_runs_have_no_finding(noisy, ideal, number):
    assert kinds(noisy, number=number) == []
    assert kinds(ideal, number=number) == []


@pytest.mark.parametrize("seed", [3, 4])
def test_random_motion_through_all_quadrants_has_no_finding(seed):
    for plant in (load_plant(shipped("plant.yaml")), plant_of_joint(JOINT)):
        table = emulate_run(plant, drawn(seed, 12.0), 12.0, seed)
        assert kinds(table) == []
        assert kinds(table, number=2) == []


@pytest.mark.parametrize("run", ["opti_traj_testing1", "RunTrajectory1"])
def test_measured_runs_of_a_real_arm_have_no_finding(run):
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    table = read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns).table
    for number, path in columns.joint_files.items():
        joint = load_joint(path)
        assert check_channels(Channels(table.time_s, table.joints[number], joint, "run")) == []


def test_dead_channels(noisy):
    zero = np.zeros(len(noisy.time_s))
    assert kinds(noisy, torque_nm=zero)[0] == "torque_nm_dead"
    assert kinds(noisy, current_a=zero)[0] == "current_a_dead"
    assert kinds(noisy, motor_velocity_rad_s=zero) == ["motor_velocity_rad_s_dead"]
    assert kinds(noisy, motor_velocity_rad_s=zero, motor_position_rad=None) == ["motor_velocity_rad_s_dead"]


@pytest.mark.parametrize("span", [slice(1200, None), slice(1300, 2300)])
def test_a_stuck_sensor(noisy, span):
    """To the end of the run, or for a while in which the current changes."""
    torque = column(noisy, "torque_nm")
    torque[span] = torque[span.start]
    run = replace(noisy.joints[1], torque_nm=torque)
    [issue] = check_channels(Channels(noisy.time_s, run, JOINT, "r: j1"))
    assert issue.kind == "torque_nm_stuck"
    assert f"found exactly {torque[span.start]:g} Nm for" in issue.text


def test_a_saturated_sensor(noisy, ideal):
    for table in (noisy, ideal):
        torque = np.clip(column(table, "torque_nm"), -22.0, 22.0)
        assert kinds(table, torque_nm=torque) == ["torque_nm_saturated"]


def test_a_stuck_current(noisy):
    current = column(noisy, "current_a")
    current[1100:] = current[1100]
    assert "current_a_stuck" in kinds(noisy, current_a=current)


def test_stuck_positions(noisy):
    motor, link = column(noisy, "motor_position_rad"), column(noisy, "link_position_rad")
    assert kinds(noisy, link_position_rad=np.full_like(link, 0.3)) == ["link_position_rad_stuck"]
    assert kinds(noisy, motor_position_rad=np.full_like(motor, 7.0))[0] == "motor_position_rad_stuck"


def test_swapped_signs_are_distinguished(noisy, ideal):
    for table in (noisy, ideal):
        for name in ("torque_nm", "current_a", "motor_velocity_rad_s", "link_position_rad"):
            assert kinds(table, **{name: -column(table, name)}) == [f"{name}_sign"], name


def test_swapped_torque_and_current_are_distinguished_without_positions(noisy):
    none = {"motor_position_rad": None, "link_position_rad": None}
    for name in ("torque_nm", "current_a"):
        assert kinds(noisy, **none, **{name: -column(noisy, name)}) == [f"{name}_sign"]


@pytest.mark.parametrize("ratio", [50.0, 98.0, 102.0, 160.0])
def test_wrong_gear_ratio(noisy, ratio):
    assert kinds(noisy, replace(JOINT, gear_ratio=ratio)) == ["gear_ratio"]
    assert Channels(noisy.time_s, noisy.joints[1], JOINT, "r").gear_ratio == pytest.approx(100.0, rel=2e-3)


@pytest.mark.parametrize(
    ("swing_rad", "ratio", "found"),
    [(0.08, 100.0, []), (0.08, 110.0, ["gear_ratio"]), (0.5, 102.0, ["gear_ratio"])],
)
def test_in_a_small_swing_a_twisting_gear_is_no_wrong_gear_ratio(swing_rad, ratio, found):
    """The load of a swing is in phase with it: 0.8 mrad of twist in 80 mrad look like a ratio that is 2 % off."""
    time = 1e-3 * np.arange(20_000)
    link = 0.5 * swing_rad * np.sin(2.0 * np.pi * 0.7 * time)
    motor = 100.0 * (link + 0.8e-3 * np.sin(2.0 * np.pi * 0.7 * time))
    run = JointColumns(motor_position_rad=motor, link_position_rad=link)
    assert kinds(RunTable(time, {1: run}), replace(JOINT, gear_ratio=ratio)) == found


def test_a_velocity_of_the_joint_side_or_in_other_units(noisy):
    velocity = column(noisy, "motor_velocity_rad_s")
    for scale in (0.01, 9.549, 0.5):
        assert kinds(noisy, motor_velocity_rad_s=scale * velocity) == ["motor_velocity_rad_s_scale"]


def test_positions_that_roll_over_are_no_finding(noisy):
    turn = 2.0 * np.pi
    wrapped = np.mod(column(noisy, "motor_position_rad"), 40.0 * turn)
    assert np.ptp(np.diff(wrapped)) > 100.0  # it does roll over
    link = np.mod(column(noisy, "link_position_rad") + 0.3, turn)
    assert kinds(noisy, motor_position_rad=wrapped, link_position_rad=link) == []


def test_missing_channels_have_no_finding(noisy):
    assert check_channels(Channels(noisy.time_s, JointColumns(), JOINT, "r")) == []
    only = JointColumns(current_a=noisy.joints[1].current_a, torque_nm=noisy.joints[1].torque_nm)
    assert check_channels(Channels(noisy.time_s, only, JOINT, "r")) == []


def test_a_torque_held_by_stiction_at_standstill_is_not_stuck(ideal):
    """Stiction: a constant torque in a standing joint while the current changes."""
    n = 2000
    time_s = 0.001 * np.arange(n)
    run = JointColumns(
        current_a=np.linspace(0.0, 1.5, n), motor_velocity_rad_s=np.zeros(n), torque_nm=np.full(n, 6.0)
    )
    assert check_channels(Channels(time_s, run, JOINT, "r")) == []
    moving = replace(run, motor_velocity_rad_s=np.full(n, 50.0))
    assert [f.kind for f in check_channels(Channels(time_s, moving, JOINT, "r"))] == ["torque_nm_stuck"]


# Units ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def day():
    return bench()


@pytest.mark.parametrize(
    ("change", "channel", "unit"),
    [
        (times("motor_velocity_rad_s", 30.0 / math.pi), "motor_velocity_rad_s", "rpm"),
        (times("motor_velocity_rad_s", DEGREES), "motor_velocity_rad_s", "degrees per second"),
        (times("motor_velocity_rad_s", 0.01), "motor_velocity_rad_s", "joint side's velocity"),
        (times("motor_velocity_rad_s", 65536 / (2 * math.pi)), "motor_velocity_rad_s", "counts per second"),
        (times("motor_position_rad", DEGREES), "motor_position_rad", "degrees suspected"),
        (times("motor_position_rad", 65536 / (2 * math.pi)), "motor_position_rad", "counts (65536"),
        (times("motor_position_rad motor_velocity_rad_s", DEGREES), "motor_position_rad", "degrees suspected"),
        (times("motor_position_rad motor_velocity_rad_s", 0.01), "motor_position_rad", "joint side"),
        (times("link_position_rad", DEGREES), "link_position_rad", "degrees suspected"),
        (times("link_position_rad", 524288 / (2 * math.pi)), "link_position_rad", "counts (524288"),
        (times(ANGLES, DEGREES), "j1", "degrees suspected"),
        (times("torque_nm", 1000.0), "torque_nm", "mNm suspected"),
        (times("torque_nm", 0.01), "torque_nm", "motor side"),
        (times("current_a", 1000.0), "current_a", "mA"),
        (times("current_a torque_nm", 1000.0), "j1", "mNm and mA"),
    ],
)  # fmt: skip
def test_other_units_by_size_and_the_other_joint_stays(day, change, channel, unit):
    result = checked(changed(day, change))
    assert len(result.refused) == 1
    assert f"r.csv: j1.{channel}: " in result.refused[0] or channel == "j1"
    assert unit in result.refused[0]
    assert "expected" in result.refused[0]
    assert list(result.runs[0][1].joints) == [2]
    assert result.lost == (1,)


def test_slow_motion_in_degrees_is_seen_by_the_spring():
    """57 times 0.1 rad/s is a speed that joints have; the torsion against the sensor shows the unit."""
    table = emulate_run(load_plant(shipped("plant.yaml")), motion(0.12), 20.0, 6)
    assert checked(table).refused == ()
    found = checked(changed(table, times(ANGLES, DEGREES))).refused
    assert len(found) == 1
    assert "stiffness" in found[0]
    assert "degrees suspected" in found[0]


def test_one_encoder_in_degrees_is_seen_by_its_speed(day):
    table = changed(day, lambda c: replace(c, motor_position_rad=None, motor_velocity_rad_s=None))
    assert checked(table).refused == ()
    found = checked(changed(table, times("link_position_rad", DEGREES))).refused
    assert len(found) == 1
    assert "motor speed" in found[0]
    assert "degrees suspected" in found[0]


# Exchanged columns ----------------------------------------------------------------------------------------------

NOMINAL = load_joint(shipped("joint1.yaml"))
ONE = replace(NOMINAL, efficiency=None, friction=replace(NOMINAL.friction, stribeck_nm=0.0))
TWO = replace(
    ONE,
    name="two",
    gear_ratio=50.0,
    torque_constant_nm_per_a=0.03,
    friction=replace(ONE.friction, coulomb_nm=0.6, viscous_nms_per_rad=0.4),
)
PAIR = {3: ONE, 4: TWO}
MOTION = ("motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "link_velocity_rad_s")
KINOVA = ROOT / "models" / "kinova_gen3"


def rich(seed: int) -> RunTable:
    one, two = (rich_run(j, seed + k, noise=2e-3) for k, j in enumerate((ONE, TWO)))
    return RunTable(one.time_s, {3: one.joints[1], 4: two.joints[1]})


def exchanged(table: RunTable, names: tuple[str, ...], a: int = 3, b: int = 4) -> RunTable:
    one, two = table.joints[a], table.joints[b]
    joints = {
        a: replace(one, **{n: getattr(two, n) for n in names}),
        b: replace(two, **{n: getattr(one, n) for n in names}),
    }
    return RunTable(table.time_s, {**table.joints, **joints})


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("torque_nm",), "good: j3.torque_nm and j4.torque_nm: found the other joint's"),
        (("current_a",), "good: j3.current_a and j4.current_a: found the other joint's"),
        (("current_a", *MOTION, "torque_nm"), "good: j3 and j4: found that each fits the other's joint file"),
    ],
    ids=["torque", "current", "all"],
)
def test_exchanged_columns(names, expected):
    checked = check_runs([("good", exchanged(rich(5), names))], PAIR)
    assert checked.runs == ()
    (line,) = checked.refused
    assert line.startswith(expected)
    assert "swapped columns" in line
    assert checked.lost == (3, 4)


def test_a_run_with_exchanged_columns_is_left_out_and_the_others_are_used():
    bad = exchanged(rich(5), ("torque_nm",))
    checked = check_runs([("a", rich(7)), ("b", bad), ("c", rich(9))], PAIR)
    assert [name for name, _ in checked.runs] == ["a", "c"]
    assert [line.split(":")[0] for line in checked.refused] == ["b"]


def test_a_wrong_joint_file_is_no_exchange():
    wrong = replace(ONE, torque_constant_nm_per_a=0.7 * ONE.torque_constant_nm_per_a, rotor_inertia_kgm2=1e-6)
    assert not [
        line for line in check_runs([("a", rich(5))], {3: wrong, 4: TWO}).refused if "swapped" in line
    ]


@cache
def kinova() -> tuple[list[tuple[str, RunTable]], dict[int, Joint]]:
    columns = ColumnMap.load(KINOVA / "columns.yaml")
    read = read_runs(sorted(KINOVA.glob("*.csv.gz")), columns)
    joints = {n: load_joint(KINOVA / f"joint{n}.yaml") for n in range(2, 8)}
    return [(run.name, run.table) for run in read], joints


def test_columns_of_a_real_arm_are_where_they_belong():
    runs, joints = kinova()
    assert not [line for line in check_runs(runs, joints).refused if "swapped" in line]


@pytest.mark.parametrize("names", [("torque_nm",), ("current_a",)])
def test_exchanged_columns_of_a_real_arm(names):
    runs, joints = kinova()
    bad = [(name, exchanged(table, names)) for name, table in runs]
    refused = check_runs(bad, {3: joints[3], 4: joints[4]}).refused
    swapped = [line for line in refused if "swapped columns" in line]
    assert len(swapped) == len(runs)
    assert all(f"j3.{names[0]} and j4.{names[0]}" in line for line in swapped)
