"""Campaigns on a bus with one to four joints: what is coupled, what is refused, the runs of a joint that is moved alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.campaign import bench as campaign_bench
from jtqd.sysid.campaign.bench import Bench, BenchConfig
from jtqd.sysid.campaign.command import main
from jtqd.sysid.campaign.emulated import PLANT, emulated_run
from jtqd.sysid.campaign.runner import findings, partial_runs
from jtqd.sysid.motion.setpoints import (
    Limits,
    MotionResult,
    OutOfPlaceError,
    Setpoints,
    Timing,
    path,
    path_range,
)
from jtqd.sysid.planner.campaigns import Scale, check_joints, efficiency_runs, make_plan_of, units_of
from jtqd.sysid.planner.plan import (
    DEFAULT_LIMITS,
    Plan,
    Plateau,
    Rest,
    Run,
    check_plan,
    check_run,
    expand,
    load_plan,
    travel_rad,
)
from jtqd.sysid.planner.single_joint import SHARE, parsed_limits, plateau_run, range_of, tightest
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.joints import with_joint
from jtqd.sysid.runs.logs import LoggedRun
from jtqd.sysid.runs.tables import write_run

LIMITS = MotionLimits((-1.0, 2.0), 1.5, 6.0, 25.0)
JOINT = replace(load_joint(shipped("joint1.yaml")), motion_limits=LIMITS)
ROOM = range_of(1, JOINT, DEFAULT_LIMITS)


def config_file(
    folder: Path, channels: Sequence[int | None], *, sensor: bool, limits: bool = True, **more: Any
) -> Path:
    """A configuration with so many joints; their files have motion_limits, or not."""
    content = yaml.safe_load(shipped("joint1.yaml").read_text())
    if limits:
        content["motion_limits"] = {"travel_rad": [-1.0, 2.0], "velocity_rad_s": 1.5}
    (folder / "joint.yaml").write_text(yaml.safe_dump(content))
    made: dict[str, Any] = {"node_id": 32, "estimator": {"method": "tob"}, **more}
    for number, channel in enumerate(channels, 1):
        made[f"joint_{number}"] = {"node": number, "file": "joint.yaml", "temperature": True}
        if channel is not None:
            made[f"joint_{number}"]["sensor_channel"] = channel
    if sensor:
        count = max(channel or 1 for channel in channels)
        made["sensor"] = {"node": 3 if len(channels) < 3 else 5, "channels": count}
    (folder / "arm.yaml").write_text(yaml.safe_dump(made))
    return folder / "arm.yaml"


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
def test_who_is_coupled_is_what_the_sensor_or_the_operator_says(
    channels: list[int | None],
    sensor: bool,
    towing: list[tuple[int, int]],
    expected: list[tuple[tuple[int, ...], bool]],
) -> None:
    assert [(unit.joints, unit.measured) for unit in units_of(channels, sensor, towing)] == expected


@pytest.mark.parametrize(
    ("channels", "towing", "words"),
    [
        ([1, 1, 1], [], "one sensor_channel for joints 1, 2, 3"),
        ([1, 1, None], [(2, 3)], "joint 2 coupled with joints"),
        ([None, None], [(1, 3)], "found joint 3, expected joints of the bus, 1 to 2"),
    ],
)
def test_what_cannot_be_coupled_is_refused(
    channels: list[int | None], towing: list[tuple[int, int]], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        units_of(channels, True, towing)


TWO_MS = {"sync": {"period_us": 2000}}


@pytest.mark.parametrize(
    ("channels", "sensor", "more", "kind", "status", "words"),
    [
        ([1], True, {}, "excitation", 0, ["1 alone", "-1 to 2 rad", "begins at 0.5 rad"]),
        ([1], True, {}, "validate", 0, ["joint_1_variable_01", "1 alone"]),
        ([1], True, {}, "efficiency", 1, ["joint 1: no efficiency", "jtq campaign excitation"]),
        ([None], False, {}, "excitation", 0, ["1 alone", "no torque sensor"]),
        ([None], False, {}, "validate", 1, ["joint 1: no validation without"]),
        ([1, 1, 2], True, TWO_MS, "efficiency", 0, ["joints_1_2_forward_1_p0.4", "joint 3: no efficiency"]),
        ([1, 1, 2], True, TWO_MS, "excitation", 0, ["joints_1_2_excitation_01", "joint_3_plateaus"]),
        ([1, 1, 2, 2], True, TWO_MS, "validate", 0, ["joints_3_4_constant_back_3_0.5"]),
        ([None] * 4, False, TWO_MS, "efficiency", 1, ["joint 1; joint 2; joint 3; joint 4: no efficiency"]),
        ([1, 1, 2], True, {}, "excitation", 1, ["bus load", "95%"]),
    ],
)
def test_what_can_be_driven_is_planned_and_the_rest_refused_in_one_line(  # noqa: PLR0917
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    channels: list[int | None],
    sensor: bool,
    more: dict[str, Any],
    kind: str,
    status: int,
    words: list[str],
) -> None:
    file = config_file(tmp_path, channels, sensor=sensor, **more)
    assert main([kind, "--quick", "--evaluations", "1", "--dry-run", "--config", str(file)]) == status
    said = capsys.readouterr()
    for word in words:
        assert word in (said.err if status else said.out)
    if status:
        assert (said.out, len(said.err.splitlines())) == ("", 1)


def test_a_joint_without_limits_is_not_moved_until_they_are_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(config_file(tmp_path, [None, None], sensor=False, limits=False))
    arguments = ["excitation", "--quick", "--evaluations", "1", "--dry-run", "--config", file]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "joint 1 (joint1): found no travel_rad and no velocity_rad_s" in line
    assert "--limits 1:travel_rad=LOW:HIGH" in line
    given = ["--limits", "travel_rad=-1:1,velocity_rad_s=1", "--limits", "2:travel_rad=0:1"]
    assert main([*arguments, *given]) == 0
    said = capsys.readouterr().out
    assert "joint 1 alone: -1 to 1 rad, 1 rad/s" in said
    assert "joint 2 alone: 0 to 1 rad, 1 rad/s" in said
    assert main([*arguments, "--limits", "3:velocity_rad_s=1"]) == 1
    assert "no joint 3" in capsys.readouterr().err
    for wrong in ("speed=1", "1:travel_rad=1", "velocity_rad_s=0", "0:velocity_rad_s=1"):
        with pytest.raises(SystemExit) as caught:
            main([*arguments, "--limits", wrong])
        assert caught.value.code == 2
    assert parsed_limits("travel_rad=-1:1, torque_nm=5") == {"travel_rad": (-1.0, 1.0), "torque_nm": 5.0}


def arm_plan(kind: str = "excitation", **scale: Any) -> Plan:
    sized = Scale(quick=True, evaluations=1, **scale)
    return make_plan_of(kind, units_of([1], True), [JOINT], sized)


@pytest.mark.parametrize("kind", ["excitation", "validate"])
def test_a_joint_alone_stays_where_it_may_be_and_comes_back(kind: str) -> None:
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
    assert plan.alone[1] == ROOM.limits
    assert ROOM.limits.torque_nm == 25.0, "the file's limit, below its rating"
    assert 4.0 < ROOM.limits.current_a < 8.0
    assert arm_plan(kind) == plan
    assert arm_plan(kind, seed=1) != plan


def test_plateaus_are_there_in_both_directions_at_every_velocity() -> None:
    run = plateau_run(1, ROOM, "r", (0.2, 0.5))
    held = sorted({each.velocity_rad_s for each in run.segments if isinstance(each, Plateau)})
    fastest = SHARE * LIMITS.velocity_rad_s
    assert held == pytest.approx([share * fastest for share in (-0.5, -0.2, 0.2, 0.5)])
    alone = plateau_run(1, replace(ROOM, acceleration_rad_s2=1.0), "r", (0.2, 1.0))
    assert len(alone.segments) == 2 + 5, "no room for the fast one at this acceleration"


def test_searching_pays_more_information_than_drawing() -> None:
    """The velocities of a design cover more than those of a draw: it is the reason to search at all."""
    from jtqd.sysid.planner.design import log_det
    from jtqd.sysid.planner.single_joint import _Trajectories, trajectories

    def information(evaluations: int) -> float:
        task = _Trajectories(ROOM, 1.0, 3.0)
        (segment,) = trajectories(ROOM, [1.0], 3.0, seed=2, evaluations=evaluations)
        amplitudes = np.array([*segment.velocity.a, *segment.velocity.b])
        return float(log_det(task.finish(amplitudes, np.zeros((6, 6)))[1]))

    assert information(400) > information(1) + 1.0


def test_a_plan_of_a_joint_alone_is_the_same_when_it_is_read_again(tmp_path: Path) -> None:
    plan = arm_plan()
    (tmp_path / "plan.yaml").write_text(plan.to_yaml())
    again = load_plan(tmp_path / "plan.yaml")
    assert again.sha256 == plan.sha256
    assert again.alone == plan.alone
    assert "current" not in plan.to_yaml().split("runs:")[1]
    pair = replace(plan, runs=(Run("p", 4, (Rest(1.0),), 3),), alone={})
    (tmp_path / "plan.yaml").write_text(pair.to_yaml())
    assert load_plan(tmp_path / "plan.yaml").runs == pair.runs


ALONE = {
    "schema": "jtq.plan/1",
    "name": "alone",
    "runs": [
        {
            "name": "a",
            "joint": 1,
            "segments": [
                {"kind": "plateau", "velocity_rad_s": 0.5, "hold_s": 1.0},
                {"kind": "rest", "hold_s": 0.5},
            ],
        }
    ],
}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r["segments"][0].update(current_a=1.0), "segments[0].current_a"),
        (lambda r: r["segments"].insert(0, {"kind": "power_off", "hold_s": 2.0}), "segments[0].kind"),
        (lambda r: r.update(joint=5), "runs[0].joint"),
        (lambda r: r.update(velocity_joint=1), "runs[0].velocity_joint"),
        (lambda r: r.update(joint=2), "expected joints of the bus, 1 to 1"),
        (lambda r: r["segments"][0].update(hold_s=9.0), "travel of joint 1"),
    ],
)
def test_what_is_wrong_in_a_plan_of_a_joint_alone_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Callable[[Any], Any], words: str
) -> None:
    content = json.loads(json.dumps(ALONE))
    file = config_file(tmp_path, [None], sensor=False)
    plan = tmp_path / "p.yaml"
    plan.write_text(yaml.safe_dump(content))
    assert main([str(plan), "--dry-run", "--config", str(file)]) == 0
    capsys.readouterr()
    change(content["runs"][0])
    plan.write_text(yaml.safe_dump(content))
    assert main([str(plan), "--dry-run", "--config", str(file)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert "p.yaml" in line


def test_a_plan_moves_joints_only_as_they_are_coupled() -> None:
    bench, arm = units_of([1, 1], True), units_of([None, None], False)
    pair = Plan("p", DEFAULT_LIMITS, (Run("r", 1, (Rest(1.0),)),))
    single = Plan("p", DEFAULT_LIMITS, (Run("r", 1, (Rest(1.0),), None),))
    check_joints(pair, bench)
    check_joints(single, arm)
    with pytest.raises(ConfigError, match="--towing 1,2 says that they are coupled"):
        check_joints(pair, arm)
    with pytest.raises(ConfigError, match="moved alone, expected a run of joints 1 and 2"):
        check_joints(single, bench)


def test_the_tighter_limit_holds() -> None:
    given = replace(ROOM.limits, current_a=1.0, velocity_rad_s=9.0, position_rad=(-5.0, 1.0), travel_rad=6.0)
    both = tightest(given, ROOM.limits)
    assert (both.current_a, both.velocity_rad_s, both.position_rad) == (1.0, 1.5, (-1.0, 1.0))
    with pytest.raises(ConfigError, match=r"alone\.travel_rad"):
        tightest(replace(given, position_rad=(3.0, 4.0)), ROOM.limits)


def test_plateaus_of_a_joint_alone_are_driven_again_one_velocity_at_a_time() -> None:
    run = plateau_run(1, ROOM, "r", (0.1, 0.2, 0.5))
    pieces = partial_runs(run)
    assert [piece.name for piece in pieces] == ["r~1", "r~2", "r~3"]
    assert sum(piece.duration_s for piece in pieces) == pytest.approx(run.duration_s, abs=0.01)
    for piece in pieces:
        points = check_run(piece, ROOM.limits)
        assert path(points)[-1] == pytest.approx(0.0, abs=2e-3)


def test_a_run_of_one_direction_is_driven_again_plateau_by_plateau() -> None:
    (run, *_) = efficiency_runs((1.4,), 2.1, (1.0, 2.5, 4.0))
    pieces = partial_runs(run)
    assert len(pieces) == 3
    wanted = [each for each in run.segments if isinstance(each, Plateau)]
    for piece, plateau in zip(pieces, wanted, strict=True):
        (own,) = [each for each in piece.segments if isinstance(each, Plateau)]
        assert (own.velocity_rad_s, own.current_a, own.hold_s) == (
            plateau.velocity_rad_s,
            plateau.current_a,
            plateau.hold_s,
        )
        assert own.ramp_s == wanted[0].ramp_s, "from rest, as the run's own first one"
        assert travel_rad(check_run(piece, DEFAULT_LIMITS)) < travel_rad(expand(run))


def test_a_run_of_a_joint_alone_holds_its_own_columns_and_is_checked(tmp_path: Path) -> None:
    """Joint 3 of a bus beside runs of joints 1 and 2: whoever reads joint 3 leaves the others out."""
    plan = make_plan_of("validate", units_of([1, 1, 2], True), [JOINT] * 3, Scale(quick=True, runs=1))
    files: tuple[Joint, ...] = (JOINT, JOINT, JOINT)
    bench = load_plant(shipped(PLANT))
    for run in (plan.runs[-1], next(run for run in plan.runs if run.name.startswith("joints_1_2_var"))):
        table = emulated_run(bench, 1, 0, run)
        assert tuple(table.joints) == run.joints
        log = LoggedRun(table, 0, 0, {}, 1e-3)
        assert findings(log, expand(run), files, measured=run.joints) == ()
        still = replace(expand(run), velocity_rad_s=0.0 * expand(run).velocity_rad_s, off=())
        (said, *_) = findings(log, still, files, measured=run.joints)
        assert said.startswith(f"j{run.velocity_joint}.motor_velocity_rad_s")
        write_run(tmp_path / f"{run.name}.csv.gz", table)
    runs = read_runs([tmp_path])
    assert [run.name for run in with_joint(runs, 3)] == [f"{plan.runs[-1].name}.csv.gz"]
    assert len(with_joint(runs, 4)) == 2, "no run has it: the reader says so"


def test_a_limit_of_the_temperature_needs_that_of_every_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """jtqd leaves TPDO3 of the others off, and takes a drive on which it is switched on for one that was changed."""
    file = config_file(tmp_path, [None, None], sensor=False)
    content = yaml.safe_load(file.read_text())
    del content["joint_2"]["temperature"]
    file.write_text(yaml.safe_dump(content))
    arguments = ["excitation", "--quick", "--evaluations", "1", "--dry-run", "--config", str(file)]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "joint_2: found no 'temperature: true', expected it for the limit of 70 degC" in line
    assert main([*arguments, "--limit", "temperature_c=none"]) == 0


def test_a_joint_that_stands_elsewhere_is_brought_to_the_middle_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = BenchConfig.load(config_file(tmp_path, [None, None, None], sensor=False, **TWO_MS))
    run = expand(Run("r", 3, (Rest(0.1), Plateau(0.5, 0.0, 0.2), Rest(0.5)), None))
    played: list[Setpoints] = []
    asked: dict[str, Any] = {}
    answers: list[MotionResult | Exception] = [
        OutOfPlaceError("joint 3: stands at 1.800 rad", 1.8),
        MotionResult("done", "", 2.0),
        MotionResult("done", "", 1.0),
    ]

    def play(bus: str, setpoints: Setpoints, limits: Limits, **more: Any) -> MotionResult:
        played.append(setpoints)
        asked.update(more)
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(campaign_bench, "play", play)
    motion = Bench("x", None, config).play(lambda _: ROOM.limits, lambda *_: None)
    assert motion(run) == ("done", "", 1.0)
    first, there, again = played
    assert first is again is run
    assert 1.8 + path(there)[-1] == pytest.approx(0.5, abs=1e-9)
    assert asked["timing"] == Timing(period_s=2e-3, setpoint_delay_s=1.4e-3)
    assert set(asked["around"].held_current_a) == {1, 2}
    answers[:] = [OutOfPlaceError("joint 3: stands", 1.8), MotionResult("stopped", "joint 1: fault", 0.3)]
    assert motion(run) == ("stopped", "on the way to 0.5 rad: joint 1: fault", 0.0)
