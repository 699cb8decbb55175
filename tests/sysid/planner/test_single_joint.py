"""Runs of one joint that is moved alone: within its range, back to the start, and as informative as they can be."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import MotionLimits
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.motion.setpoints import path, path_range
from jtqd.sysid.planner.campaigns import (
    Scale,
    joint_plateau_run,
    make_plan_of,
    parsed_limits,
    range_of,
    tightest,
    units_of,
)
from jtqd.sysid.planner.design import SHARE, SingleJoint, log_det, trajectories
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Plan, Plateau, Rest, Run, check_plan, load_plan

LIMITS = MotionLimits((-1.0, 2.0), 1.5, 6.0, 25.0)
JOINT = replace(load_joint(shipped("joint1.yaml")), motion_limits=LIMITS)
RANGE = range_of(1, JOINT, DEFAULT_LIMITS)


def arm_plan(kind: str = "excitation", **scale: Any) -> Plan:
    sized = Scale(quick=True, evaluations=1, **scale)
    return make_plan_of(kind, units_of([1], True), [JOINT], sized)


@pytest.mark.parametrize("kind", ["excitation", "validate"])
def test_a_joint_alone_stays_in_its_range_and_comes_back(kind):
    plan = arm_plan(kind)
    for run, points in zip(plan.runs, check_plan(plan).values(), strict=True):
        assert (run.joints, run.current_joint) == ((1,), None)
        assert not points.current_a.any()
        low, high = path_range(points)
        assert -1.5 * SHARE - 1e-3 <= low < high <= 1.5 * SHARE + 1e-3, run.name
        assert float(np.abs(points.velocity_rad_s).max()) <= SHARE * LIMITS.velocity_rad_s + 1e-9
        steepest = float(np.abs(np.diff(points.velocity_rad_s, prepend=0.0)).max()) * 1e3
        assert steepest <= LIMITS.acceleration_rad_s2 + 1e-6, run.name
        assert path(points)[-1] == pytest.approx(0.0, abs=2e-3), "it ends where it began"
    assert plan.alone[1] == RANGE.limits
    assert RANGE.limits.torque_nm == 25.0, "the file's limit, below its rating"
    assert 4.0 < RANGE.limits.current_a < 8.0
    assert arm_plan(kind) == plan
    assert arm_plan(kind, seed=1) != plan


def test_plateaus_in_both_directions_at_every_velocity():
    run = joint_plateau_run(1, RANGE, "r", (0.2, 0.5))
    held = sorted({each.velocity_rad_s for each in run.segments if isinstance(each, Plateau)})
    fastest = SHARE * LIMITS.velocity_rad_s
    assert held == pytest.approx([share * fastest for share in (-0.5, -0.2, 0.2, 0.5)])
    alone = joint_plateau_run(1, replace(RANGE, acceleration_rad_s2=1.0), "r", (0.2, 1.0))
    assert len(alone.segments) == 2 + 5, "the fast one does not fit at this acceleration"


def test_a_search_gives_more_information_than_one_draw():
    """The velocities of a design cover more than those of a draw: it is the reason to search at all."""

    def information(evaluations: int) -> float:
        task = SingleJoint(RANGE, 1.0, 3.0)
        (segment,) = trajectories(RANGE, [1.0], 3.0, seed=2, evaluations=evaluations)
        amplitudes = np.array([*segment.velocity.a, *segment.velocity.b])
        return float(log_det(task.finish(amplitudes, np.zeros((6, 6)))[1]))

    assert information(400) > information(1) + 1.0


def test_a_plan_of_a_joint_alone_survives_a_file(tmp_path):
    plan = arm_plan()
    (tmp_path / "plan.yaml").write_text(plan.to_yaml())
    again = load_plan(tmp_path / "plan.yaml")
    assert again.sha256 == plan.sha256
    assert again.alone == plan.alone
    assert "current" not in plan.to_yaml().split("runs:")[1]
    pair = replace(plan, runs=(Run("p", 4, (Rest(1.0),), 3),), alone={})
    (tmp_path / "plan.yaml").write_text(pair.to_yaml())
    assert load_plan(tmp_path / "plan.yaml").runs == pair.runs


def test_motion_limits_of_a_command_line():
    assert parsed_limits("travel_rad=-1:1, torque_nm=5") == {"travel_rad": (-1.0, 1.0), "torque_nm": 5.0}


def test_the_tighter_limit_holds():
    given = replace(RANGE.limits, current_a=1.0, velocity_rad_s=9.0, position_rad=(-5.0, 1.0), travel_rad=6.0)
    both = tightest(given, RANGE.limits)
    assert (both.current_a, both.velocity_rad_s, both.position_rad) == (1.0, 1.5, (-1.0, 1.0))
    with pytest.raises(ConfigError, match=r"alone\.travel_rad"):
        tightest(replace(given, position_rad=(3.0, 4.0)), RANGE.limits)
