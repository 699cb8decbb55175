"""Channels that cannot be right are named, each by what is wrong with it; runs that are right raise no finding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant, plant_of_joint
from jtqd.sysid.runs.channels import Channels, check_channels
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import read_run
from tests.estimator.estimator_helpers import joint1
from tests.sysid.campaign_helpers import plateau_run
from tests.sysid.runs.random_motion import Excitation, random_current, random_velocity

JOINT = joint1()
POINTS = [(v, i) for v in (0.4, 2.0, -1.0) for i in (0.0, 3.0, 5.0, -4.0)]


@pytest.fixture(scope="module")
def noisy() -> RunTable:
    return plateau_run(load_plant(shipped("plant.yaml")), POINTS, hold_s=0.6)


@pytest.fixture(scope="module")
def ideal() -> RunTable:
    """Without noise beyond rounding: constant values are normal here, and no sign of a stuck channel."""
    return plateau_run(plant_of_joint(JOINT), POINTS, hold_s=0.6)


def kinds(table: RunTable, joint: Joint = JOINT, number: int = 1, **changes: FloatArray | None) -> list[str]:
    run = replace(table.joints[number], **changes)
    found = check_channels(Channels(table.time_s, run, joint, f"run.csv: j{number}"))
    assert all(item.text.startswith("run.csv: j1") or number == 2 for item in found)
    assert all("\n" not in item.text for item in found)
    return [item.kind for item in found]


def column(table: RunTable, name: str) -> FloatArray:
    values: FloatArray = getattr(table.joints[1], name)
    return values.copy()


@pytest.mark.parametrize("number", [1, 2])
def test_good_runs_have_no_finding(noisy: RunTable, ideal: RunTable, number: int) -> None:
    assert kinds(noisy, number=number) == []
    assert kinds(ideal, number=number) == []


@pytest.mark.parametrize("seed", [3, 4])
def test_random_motion_through_all_quadrants_has_no_finding(seed: int) -> None:
    print("seed", seed)
    rng = np.random.default_rng(seed)
    commands = (
        JointCommand.velocity(random_velocity(Excitation(), 12.0, rng)),
        JointCommand.current(random_current(Excitation(), rng)),
    )
    for plant in (load_plant(shipped("plant.yaml")), plant_of_joint(JOINT)):
        table = emulate_run(plant, commands, 12.0, seed)
        assert kinds(table) == []
        assert kinds(table, number=2) == []


@pytest.mark.parametrize("run", ["opti_traj_testing1", "RunTrajectory1"])
def test_measured_runs_of_a_real_arm_have_no_finding(run: str) -> None:
    columns = ColumnMap.load(shipped("kinova_gen3/columns.yaml"))
    table = read_run(shipped(f"kinova_gen3/{run}.csv.gz"), columns).table
    for number, path in columns.joint_files.items():
        joint = load_joint(path)
        assert check_channels(Channels(table.time_s, table.joints[number], joint, "run")) == []


def test_dead_channels(noisy: RunTable) -> None:
    zero = np.zeros(len(noisy.time_s))
    assert kinds(noisy, torque_nm=zero)[0] == "torque_nm_dead"
    assert kinds(noisy, current_a=zero)[0] == "current_a_dead"
    assert kinds(noisy, motor_velocity_rad_s=zero) == ["motor_velocity_rad_s_dead"]
    assert kinds(noisy, motor_velocity_rad_s=zero, motor_position_rad=None) == ["motor_velocity_rad_s_dead"]


def test_a_sensor_that_stays_where_it_was(noisy: RunTable) -> None:
    torque = column(noisy, "torque_nm")
    torque[1200:] = torque[1200]
    assert kinds(noisy, torque_nm=torque) == ["torque_nm_stuck"]
    text = check_channels(Channels(noisy.time_s, replace(noisy.joints[1], torque_nm=torque), JOINT, "r: j1"))[
        0
    ].text
    assert f"found exactly {torque[1200]:g} Nm for" in text
    # a stretch in the middle is enough, when the current moved in it
    torque = column(noisy, "torque_nm")
    torque[1300:2300] = torque[1300]
    assert kinds(noisy, torque_nm=torque) == ["torque_nm_stuck"]


def test_a_saturated_sensor(noisy: RunTable, ideal: RunTable) -> None:
    for table in (noisy, ideal):
        torque = np.clip(column(table, "torque_nm"), -22.0, 22.0)
        assert kinds(table, torque_nm=torque) == ["torque_nm_saturated"]


def test_a_current_that_stays_where_it_was(noisy: RunTable) -> None:
    current = column(noisy, "current_a")
    current[1100:] = current[1100]
    assert "current_a_stuck" in kinds(noisy, current_a=current)


def test_stuck_positions(noisy: RunTable) -> None:
    motor, link = column(noisy, "motor_position_rad"), column(noisy, "link_position_rad")
    assert kinds(noisy, link_position_rad=np.full_like(link, 0.3)) == ["link_position_rad_stuck"]
    assert kinds(noisy, motor_position_rad=np.full_like(motor, 7.0))[0] == "motor_position_rad_stuck"


def test_swapped_signs_are_told_apart(noisy: RunTable, ideal: RunTable) -> None:
    for table in (noisy, ideal):
        for name in ("torque_nm", "current_a", "motor_velocity_rad_s", "link_position_rad"):
            assert kinds(table, **{name: -column(table, name)}) == [f"{name}_sign"], name


def test_swapped_torque_and_current_are_told_apart_without_positions(noisy: RunTable) -> None:
    none = {"motor_position_rad": None, "link_position_rad": None}
    for name in ("torque_nm", "current_a"):
        assert kinds(noisy, **none, **{name: -column(noisy, name)}) == [f"{name}_sign"]


@pytest.mark.parametrize("ratio", [50.0, 98.0, 102.0, 160.0])
def test_wrong_gear_ratio(noisy: RunTable, ratio: float) -> None:
    assert kinds(noisy, replace(JOINT, gear_ratio=ratio)) == ["gear_ratio"]
    assert Channels(noisy.time_s, noisy.joints[1], JOINT, "r").gear_ratio == pytest.approx(100.0, rel=2e-3)


@pytest.mark.parametrize(
    ("swing_rad", "ratio", "found"),
    [(0.08, 100.0, []), (0.08, 110.0, ["gear_ratio"]), (0.5, 102.0, ["gear_ratio"])],
)
def test_in_a_small_swing_a_twisting_gear_is_no_wrong_gear_ratio(
    swing_rad: float, ratio: float, found: list[str]
) -> None:
    """The load of a swing is in phase with it: 0.8 mrad of twist in 80 mrad look like a ratio that is 2 % off."""
    time = 1e-3 * np.arange(20_000)
    link = 0.5 * swing_rad * np.sin(2.0 * np.pi * 0.7 * time)
    motor = 100.0 * (link + 0.8e-3 * np.sin(2.0 * np.pi * 0.7 * time))
    run = JointColumns(motor_position_rad=motor, link_position_rad=link)
    assert kinds(RunTable(time, {1: run}), replace(JOINT, gear_ratio=ratio)) == found


def test_a_velocity_of_the_joint_side_or_in_other_units(noisy: RunTable) -> None:
    velocity = column(noisy, "motor_velocity_rad_s")
    for scale in (0.01, 9.549, 0.5):
        assert kinds(noisy, motor_velocity_rad_s=scale * velocity) == ["motor_velocity_rad_s_scale"]


def test_positions_that_roll_over_are_no_finding(noisy: RunTable) -> None:
    turn = 2.0 * np.pi
    wrapped = np.mod(column(noisy, "motor_position_rad"), 40.0 * turn)
    assert np.ptp(np.diff(wrapped)) > 100.0  # it does roll over
    link = np.mod(column(noisy, "link_position_rad") + 0.3, turn)
    assert kinds(noisy, motor_position_rad=wrapped, link_position_rad=link) == []


def test_channels_that_are_not_there_are_not_asked(noisy: RunTable) -> None:
    assert check_channels(Channels(noisy.time_s, JointColumns(), JOINT, "r")) == []
    only = JointColumns(current_a=noisy.joints[1].current_a, torque_nm=noisy.joints[1].torque_nm)
    assert check_channels(Channels(noisy.time_s, only, JOINT, "r")) == []


def test_a_torque_held_by_stiction_at_standstill_is_not_stuck(ideal: RunTable) -> None:
    """In a standing joint a constant torque beside a moving current is what stiction does."""
    n = 2000
    time_s = 0.001 * np.arange(n)
    run = JointColumns(
        current_a=np.linspace(0.0, 1.5, n), motor_velocity_rad_s=np.zeros(n), torque_nm=np.full(n, 6.0)
    )
    assert check_channels(Channels(time_s, run, JOINT, "r")) == []
    moving = replace(run, motor_velocity_rad_s=np.full(n, 50.0))
    assert [f.kind for f in check_channels(Channels(time_s, moving, JOINT, "r"))] == ["torque_nm_stuck"]
