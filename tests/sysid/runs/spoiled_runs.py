"""Emulated bench runs and ways to spoil them, for the tests of channel checks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.planner.design import ExcitationLimits, design
from jtqd.sysid.runs.checks import CheckedRuns, check_runs

JOINTS = {number: load_joint(shipped(f"joint{number}.yaml")) for number in (1, 2)}
DEGREES = 180.0 / math.pi
ANGLES = "motor_position_rad motor_velocity_rad_s link_position_rad"
Change = Callable[[JointColumns], JointColumns]


def motion(scale: float = 1.0, offset: float = 0.0) -> tuple[JointCommand, JointCommand]:
    """A velocity and a current that fill all four quadrants within 20 s."""
    return (
        JointCommand.velocity(lambda t: scale * 0.9 * math.sin(1.1 * t) * math.sin(0.4 * t + 0.3) + offset),
        JointCommand.current(lambda t: 2.5 * math.sin(1.7 * t + 0.1)),
    )


def drawn(seed: int, seconds: float) -> tuple[JointCommand, JointCommand]:
    """A Fourier motion and load with drawn coefficients."""
    limits = ExcitationLimits(velocity_rad_s=2.6, travel_rad=2.6, current_a=4.5)
    [one] = design(limits, count=1, duration_s=seconds, seed=seed, evaluations=1)
    time_s = 1e-3 * np.arange(round(seconds * 1e3) + 1)
    v, i = one.segment.velocity.motion(time_s)[1].tolist(), one.segment.current.value(time_s).tolist()
    return JointCommand.velocity(lambda t: v[round(t * 1e3)]), JointCommand.current(
        lambda t: i[round(t * 1e3)]
    )


def bench() -> RunTable:
    """20 s of the campaign's bench on another day."""
    return emulate_run(load_plant(shipped("campaign_plant.yaml")), motion(), 20.0, 5, day=3)


def column(table: RunTable, name: str, number: int = 1) -> FloatArray:
    """A copy of a column that is there."""
    values: FloatArray | None = getattr(table.joints[number], name)
    assert values is not None
    return values.copy()


def changed(table: RunTable, change: Change, number: int = 1) -> RunTable:
    return RunTable(table.time_s, {**table.joints, number: change(table.joints[number])})


def having(table: RunTable, **columns: FloatArray | None) -> RunTable:
    """The run with other columns of joint 1."""
    return changed(table, lambda joint: replace(joint, **columns))


def times(names: str, factor: float) -> Change:
    return lambda joint: joint.map(lambda name, values: values * factor if name in names.split() else values)


def each_column(table: RunTable, change: Callable[[FloatArray], FloatArray]) -> RunTable:
    joints = {number: joint.map(lambda _, values: change(values)) for number, joint in table.joints.items()}
    return RunTable(change(table.time_s), joints)


def checked(table: RunTable, joints: dict[int, Joint] | None = None) -> CheckedRuns:
    result = check_runs([("r.csv", table)], joints or JOINTS)
    for line in (*result.refused, *result.notes):
        assert line.startswith("r.csv: ")
        assert "\n" not in line
    return result
