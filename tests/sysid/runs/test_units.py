"""Columns in other units than the run table's are named by their size."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from jtqd.estimator.run import RunTable
from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import emulate_run
from jtqd.sim_can.plant_file import load_plant
from tests.sysid.runs.spoiled_runs import (
    ANGLES,
    DEGREES,
    Change,
    bench,
    changed,
    checked,
    motion,
    times,
)


@pytest.fixture(scope="module")
def run() -> RunTable:
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
        (
            times("motor_position_rad motor_velocity_rad_s", DEGREES),
            "motor_position_rad",
            "degrees suspected",
        ),
        (times("motor_position_rad motor_velocity_rad_s", 0.01), "motor_position_rad", "joint side"),
        (times("link_position_rad", DEGREES), "link_position_rad", "degrees suspected"),
        (times("link_position_rad", 524288 / (2 * math.pi)), "link_position_rad", "counts (524288"),
        (times(ANGLES, DEGREES), "j1", "degrees suspected"),
        (times("torque_nm", 1000.0), "torque_nm", "mNm suspected"),
        (times("torque_nm", 0.01), "torque_nm", "motor side"),
        (times("current_a", 1000.0), "current_a", "mA"),
        (times("current_a torque_nm", 1000.0), "j1", "mNm and mA"),
    ],
)
def test_other_units_are_named_by_size_and_the_other_joint_stays(
    run: RunTable, change: Change, channel: str, unit: str
) -> None:
    result = checked(changed(run, change))
    assert len(result.refused) == 1
    assert f"r.csv: j1.{channel}: " in result.refused[0] or channel == "j1"
    assert unit in result.refused[0]
    assert "expected" in result.refused[0]
    assert list(result.runs[0][1].joints) == [2]
    assert result.lost == (1,)


def test_slow_motion_in_degrees_is_seen_by_the_spring() -> None:
    """57 times 0.1 rad/s is a speed that joints have: the torsion against the sensor is what gives it away."""
    table = emulate_run(load_plant(shipped("plant.yaml")), motion(0.12), 20.0, 6)
    assert checked(table).refused == ()
    found = checked(changed(table, times(ANGLES, DEGREES))).refused
    assert len(found) == 1
    assert "stiffness" in found[0]
    assert "degrees suspected" in found[0]


def test_one_encoder_in_degrees_is_seen_by_its_speed(run: RunTable) -> None:
    table = changed(run, lambda c: replace(c, motor_position_rad=None, motor_velocity_rad_s=None))
    assert checked(table).refused == ()
    found = checked(changed(table, times("link_position_rad", DEGREES))).refused
    assert len(found) == 1
    assert "motor speed" in found[0]
    assert "degrees suspected" in found[0]
