"""Shipped campaigns: the paper's points and quadrants, limits, units of joints that move together, joints moved alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import MotionLimits
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.motion.setpoints import path, path_range
from jtqd.sysid.planner.campaigns import (
    KINDS,
    Scale,
    check_joints,
    currents_of,
    efficiency_runs,
    excitation_runs,
    joint_plateau_run,
    make_plan,
    make_plan_of,
    parsed_limits,
    range_of,
    seed_of,
    slow_and_fast,
    tightest,
    units_of,
    validation_runs,
    variable_runs,
)
from jtqd.sysid.planner.design import SHARE, SingleJoint, log_det, trajectories
from jtqd.sysid.planner.plan import (
    DEFAULT_LIMITS,
    Fourier,
    Plan,
    Plateau,
    Rest,
    Run,
    check_plan,
    expand,
    load_plan,
    travel_rad,
)

SECTION_II = [(v, i) for v in (0.2, 0.6, 1.0, 1.4, 1.8) for i in range(6)] + [
    (v, i) for v in (2.2, 2.6, 3.0) for i in range(5)
]


def points_of(run: Run) -> list[tuple[float, float]]:
    return [(s.velocity_rad_s, s.current_a) for s in run.segments if isinstance(s, Plateau)]


def test_efficiency_has_every_point_of_section_ii_forward_and_back_in_both_directions():
    runs = efficiency_runs()
    assert len(runs) == 32
    assert len({run.name for run in runs}) == 32
    for joint in (1, 2):
        for sign in (1.0, -1.0):
            found = [
                (abs(v), abs(i))
                for run in runs
                for v, i in points_of(run)
                if run.velocity_joint == joint and np.sign(v) == sign
            ]
            assert sorted(found) == sorted((v, float(i)) for v, i in SECTION_II)
    for run in runs:
        velocities = {v for v, _ in points_of(run)}
        assert len(velocities) == 1, "one velocity and direction per run"
        currents = [i for _, i in points_of(run)]
        assert currents == sorted(currents, key=abs)
        assert all(i * velocities.copy().pop() >= 0.0 for i in currents)
        assert run.name.startswith("forward_1" if run.velocity_joint == 1 else "back_1")


def test_section_iv_a_has_its_points_in_both_directions():
    wanted = {0.5: (0.5, 1.5, 2.5), 1.5: (1.5, 2.5, 3.5), 2.5: (2.5, 3.5, 4.5)}
    found: dict[tuple[int, float], list[tuple[float, float]]] = {}
    for run in validation_runs():
        for v, i in points_of(run):
            found.setdefault((run.velocity_joint, abs(v)), []).append((v, i))
    assert set(found) == {(joint, v) for joint in (1, 2) for v in wanted}
    for (_, speed), points in found.items():
        assert sorted(points) == sorted((s * speed, s * i) for i in wanted[speed] for s in (1.0, -1.0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("quick", [False, True])
def test_shipped_campaigns_keep_their_own_limits(kind, quick):
    scale = Scale(quick=quick, evaluations=80 if quick else 1)
    plan = make_plan(kind, scale)
    assert set(check_plan(plan)) == {run.name for run in plan.runs}
    assert not quick or make_plan(kind, scale).sha256 == plan.sha256


def test_the_named_quadrants_are_those_of_the_plant():
    """forward_1: joint 1's current and velocity have the same sign, joint 2's opposite ones; back_1 the other way round.

    Asked of the plant with measured currents, so that neither the plan nor its comments decide.
    """
    plant = load_plant(shipped("plant.yaml"))
    gear = load_joint(shipped("joint1.yaml")).gear_ratio
    for run in efficiency_runs((1.0,), hold_s=0.6, currents_a=(3.0,)):
        points = expand(run)
        velocity = JointCommand.velocity(lambda t, v=points.velocity_rad_s: float(v[round(t * 1e3)]))
        current = JointCommand.current(lambda t, i=points.current_a: float(i[round(t * 1e3)]))
        commands = (velocity, current) if run.velocity_joint == 1 else (current, velocity)
        table = emulate_run(plant, commands, points.duration_s, seed=1)
        plateau = next(mark for mark in points.marks if mark.kind == "plateau")
        rows = slice(round((plateau.start_s + 0.2) * 1e3), round(plateau.end_s * 1e3))
        power = {}
        for number in (1, 2):
            joint = table.joints[number]
            assert joint.current_a is not None
            assert joint.motor_velocity_rad_s is not None
            assert joint.torque_nm is not None
            power[number] = float(np.mean(joint.current_a[rows] * joint.motor_velocity_rad_s[rows] / gear))
            assert abs(float(np.mean(joint.torque_nm[rows]))) > 5.0
        one, two = (1, -1) if run.name.startswith("forward_1") else (-1, 1)
        assert power[1] * one > 1.0, run.name
        assert power[2] * two > 1.0, run.name
        turned = table.joints[run.velocity_joint].link_position_rad
        assert turned is not None
        assert np.sign(turned[-1] - turned[0]) == (1.0 if "_p" in run.name else -1.0)


def test_slow_and_fast_take_turns_and_none_is_lost():
    order = slow_and_fast([0.2, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0])
    assert order == [0.2, 3.0, 0.6, 2.6, 1.0, 2.2, 1.4, 1.8]
    assert slow_and_fast([3.0, 1.0, 2.0]) == [1.0, 3.0, 2.0]


def test_excitation_alternates_and_covers_low_velocity_for_either_joint():
    runs = excitation_runs(DEFAULT_LIMITS, 12, 24.0, seed=3, evaluations=1)
    assert [run.velocity_joint for run in runs] == [1, 2] * 6
    for run in runs:
        kinds = [type(segment).__name__ for segment in run.segments]
        assert kinds == ["Rest", "Fourier", "Rest", "Fourier", "Rest"]
        assert run.segments[2].duration_s == 2.0, "2 s at rest between: section III"
        assert run.duration_s == pytest.approx(24.0)
    for run in runs[:2]:  # already in the smallest campaign
        slow = run.segments[3]
        assert isinstance(slow, Fourier)
        assert np.abs(slow.velocity.motion(np.linspace(0.0, slow.duration_s, 999))[1]).max() < 0.31
    for joint in (1, 2):
        velocity = np.concatenate([expand(run).velocity_rad_s for run in runs if run.velocity_joint == joint])
        moving = np.abs(velocity[np.abs(velocity) > 1e-3])
        assert np.mean(moving < 0.2) > 0.2
        assert np.mean(moving > 1.0) > 0.2
        assert moving.max() == pytest.approx(3.0, abs=0.1)
        current = np.concatenate([expand(run).current_a for run in runs if run.velocity_joint == joint])
        for v_sign in (1.0, -1.0):
            for i_sign in (1.0, -1.0):  # all four quadrants
                assert np.mean((velocity * v_sign > 0.1) & (current * i_sign > 0.3)) > 0.08


def test_no_trajectory_of_validation_is_one_of_training_whatever_the_seeds():
    def series(runs: tuple[Run, ...]) -> set[tuple[float, ...]]:
        return {s.velocity.a for run in runs for s in run.segments if isinstance(s, Fourier)}

    seeds = range(3)
    trained = set().union(
        *(series(excitation_runs(DEFAULT_LIMITS, 2, 8.0, seed=seed, evaluations=1)) for seed in seeds)
    )
    judged = set().union(*(series(variable_runs(DEFAULT_LIMITS, 2, 8.0, seed=seed)) for seed in seeds))
    assert (len(trained), len(judged)) == (12, 6)
    assert not trained & judged
    purposes = [("excitation", v) for v in (3.0, 1.2, 0.3)] + [("variable", 3.0)]
    assert len({seed_of(purpose, level, n) for purpose, level in purposes for n in range(500)}) == 2000


def test_scale_changes_what_it_names_and_nothing_else():
    plan = make_plan("validate", Scale(runs=3, seconds=5.0, hold_s=0.5))
    fourier = [run for run in plan.runs if run.name.startswith("variable")]
    assert [run.duration_s for run in fourier] == pytest.approx([5.0] * 3)
    holds = {s.hold_s for run in plan.runs for s in run.segments if isinstance(s, Plateau)}
    assert holds == {0.5}
    assert len(plan.runs) == 6 + 3
    assert make_plan("excitation", Scale(runs=2, seed=1, evaluations=1)) != make_plan(
        "excitation", Scale(runs=2, seed=2, evaluations=1)
    )


def test_runs_too_short_for_their_trajectories_are_refused():
    with pytest.raises(ConfigError, match=r"--seconds: found 7, expected at least 8"):
        make_plan("excitation", Scale(seconds=7.0))
    with pytest.raises(ConfigError, match=r"--seconds: found 3, expected at least 4"):
        make_plan("validate", Scale(seconds=3.0))


def test_a_run_of_one_direction_turns_back_before_it_goes_too_far():
    """Long holds in a short space: every point is still there, in its direction, and the limit is kept."""
    for travel in (7.0, 12.0, 25.0):
        for run in efficiency_runs((0.6, 2.2), hold_s=2.1, travel_rad=travel):
            points = expand(run)
            assert travel_rad(points) <= travel
            sign = 1.0 if "_p" in run.name else -1.0
            there = [(v, i) for v, i in points_of(run) if v * sign > 0.0]
            back = [(v, i) for v, i in points_of(run) if v * sign < 0.0]
            assert [abs(i) for _, i in there] == list(currents_of(there[0][0]))
            assert all(i == 0.0 for _, i in back)
    free = efficiency_runs((2.2,), hold_s=2.1)
    assert all(len(points_of(run)) == 5 for run in free)
    assert efficiency_runs((2.2,), hold_s=2.1, travel_rad=60.0) == free
    with pytest.raises(ConfigError, match="travel"):  # one point alone is too long
        check_plan(
            Plan("p", replace(DEFAULT_LIMITS, travel_rad=4.0), efficiency_runs((2.2,), travel_rad=4.0))
        )


@pytest.mark.parametrize(
    ("channels", "sensor", "towing", "expected"),
    [
        ([1, 1], True, [], [((1, 2), True)]),
        ([1, 1], False, [], [((1,), False), ((2,), False)]),
        ([None, None], False, [(2, 1)], [((1, 2), False)]),
        ([1, 2], True, [(1, 2)], [((1, 2), True)]),
        ([1, 2], True, [], [((1,), True), ((2,), True)]),
        ([1], True, [], [((1,), True)]),
        ([1, 1, 2], True, [], [((1, 2), True), ((3,), True)]),
        ([1, 1, None], True, [], [((1, 2), True), ((3,), False)]),
        ([1, 2, 2, 1], True, [], [((1, 4), True), ((2, 3), True)]),
        ([None] * 4, False, [(3, 4)], [((1,), False), ((2,), False), ((3, 4), False)]),
    ],
)
def test_joints_at_one_channel_or_given_by_towing_are_coupled(channels, sensor, towing, expected):
    assert [(unit.joints, unit.measured) for unit in units_of(channels, sensor, towing)] == expected


@pytest.mark.parametrize(
    ("channels", "towing", "words"),
    [
        ([1, 1, 1], [], "one sensor_channel for joints 1, 2, 3"),
        ([1, 1, None], [(2, 3)], "joint 2 coupled with joints"),
        ([None, None], [(1, 3)], "found joint 3, expected joints of the bus, 1 to 2"),
    ],
)
def test_wrong_couplings_are_refused(channels, towing, words):
    with pytest.raises(ConfigError, match=words):
        units_of(channels, True, towing)


def test_runs_must_fit_the_coupling_of_the_joints():
    bench, arm = units_of([1, 1], True), units_of([None, None], False)
    pair = Plan("p", DEFAULT_LIMITS, (Run("r", 1, (Rest(1.0),)),))
    single = Plan("p", DEFAULT_LIMITS, (Run("r", 1, (Rest(1.0),), None),))
    check_joints(pair, bench)
    check_joints(single, arm)
    with pytest.raises(ConfigError, match="--towing 1,2 for two that are coupled"):
        check_joints(pair, arm)
    with pytest.raises(ConfigError, match="moved alone, expected a run of joints 1 and 2"):
        check_joints(single, bench)


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


def test_quick_runs_have_squares_steps_at_rest_and_steps_in_motion():
    """What no trajectory has: accelerations and currents near the steepest that a plan may have, in turn in three kinds."""
    plan = make_plan("quick", Scale(runs=6, seconds=8.0, seed=3))
    check_plan(plan)
    assert [run.velocity_joint for run in plan.runs] == [1, 2] * 3
    for k, run in enumerate(plan.runs):
        points = expand(run)
        held = [segment for segment in run.segments if isinstance(segment, Plateau)]
        speeds = np.array([segment.velocity_rad_s for segment in held[:-6]])
        assert 8.0 <= len(points) * 1e-3 <= 20.0
        assert np.abs(np.diff([segment.current_a for segment in held])).max() > 2.0
        assert np.ptp(np.abs(speeds)) < 1e-9
        if k % 3 == 0:
            assert (speeds[1:] == -speeds[:-1]).all()
            assert np.abs(speeds[0]) > 0.8
        if k % 3 == 1:
            assert not speeds.any(), "at rest"
            assert {np.sign(segment.velocity_rad_s) for segment in held[-6:]} == {-1.0, 1.0}
        if k % 3 == 2:
            assert 0.2 < np.abs(speeds[0]) <= 1.5
            assert (speeds[1:] == speeds[:-1]).mean() > 0.4
        steepest = np.abs(np.diff(points.velocity_rad_s)).max() * 1e3
        assert 40.0 < steepest <= 50.0


def test_quick_runs_keep_the_limits_and_are_the_same_with_a_seed():
    tight = replace(DEFAULT_LIMITS, travel_rad=1.0, velocity_rad_s=1.0, current_a=3.0)
    plan = make_plan("quick", Scale(runs=9, limits=tight))
    check_plan(plan)
    assert plan.runs == make_plan("quick", Scale(runs=9, limits=tight)).runs
    assert plan.runs != make_plan("quick", Scale(runs=9, limits=tight, seed=1)).runs
    assert len(make_plan("quick", Scale(quick=True)).runs) == 3
    alone = units_of([None, None], False)
    with pytest.raises(ConfigError, match="no quick motions"):
        make_plan_of("quick", alone, [load_joint(shipped(f"joint{n}.yaml")) for n in (1, 2)], Scale())
