"""Campaigns on a bus with one to four joints: plans, refusals, and runs of a joint that is moved alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from jtqd.estimator.joint import Joint, MotionLimits
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.campaign import bench as campaign_bench
from jtqd.sysid.campaign.bench import Bench, BenchConfig
from jtqd.sysid.campaign.command import main
from jtqd.sysid.campaign.emulated import PLANT, emulated_run
from jtqd.sysid.campaign.runner import findings
from jtqd.sysid.motion.setpoints import Limits, MotionResult, OutOfPlaceError, Setpoints, Timing, path
from jtqd.sysid.planner.campaigns import Scale, make_plan_of, range_of, units_of
from jtqd.sysid.planner.plan import DEFAULT_LIMITS, Plateau, Rest, Run, expand
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.logs import LoggedRun
from jtqd.sysid.runs.options import with_joint
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
def test_runs_of_all_units_that_can_be_driven(tmp_path, capsys, channels, sensor, more, kind, status, words):  # noqa: PLR0917
    file = config_file(tmp_path, channels, sensor=sensor, **more)
    assert main([kind, "--quick", "--evaluations", "1", "--dry-run", "--config", str(file)]) == status
    printed = capsys.readouterr()
    for word in words:
        assert word in (printed.err if status else printed.out)
    if status:
        assert (printed.out, len(printed.err.splitlines())) == ("", 1)


def test_a_joint_without_limits_is_not_moved_until_they_are_given(tmp_path, capsys):
    file = str(config_file(tmp_path, [None, None], sensor=False, limits=False))
    arguments = ["excitation", "--quick", "--evaluations", "1", "--dry-run", "--config", file]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "joint 1 (joint1): found no travel_rad and no velocity_rad_s" in line
    assert "--limits 1:travel_rad=LOW:HIGH" in line
    given = ["--limits", "travel_rad=-1:1,velocity_rad_s=1", "--limits", "2:travel_rad=0:1"]
    assert main([*arguments, *given]) == 0
    printed = capsys.readouterr().out
    assert "joint 1 alone: -1 to 1 rad, 1 rad/s" in printed
    assert "joint 2 alone: 0 to 1 rad, 1 rad/s" in printed
    assert main([*arguments, "--limits", "3:velocity_rad_s=1"]) == 1
    assert "no joint 3" in capsys.readouterr().err
    for wrong in ("speed=1", "1:travel_rad=1", "velocity_rad_s=0", "0:velocity_rad_s=1"):
        with pytest.raises(SystemExit) as caught:
            main([*arguments, "--limits", wrong])
        assert caught.value.code == 2


ALONE = yaml.safe_load("""
schema: jtq.plan/1
name: alone
runs:
  - name: a
    joint: 1
    segments: [{kind: plateau, velocity_rad_s: 0.5, hold_s: 1.0}, {kind: rest, hold_s: 0.5}]
""")


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
def test_errors_in_a_plan_of_a_joint_alone(tmp_path, capsys, change, words):
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


def test_a_run_of_a_joint_alone_holds_its_own_columns_and_is_checked(tmp_path):
    """Joint 3 of a bus: a reader of joint 3 leaves the runs of joints 1 and 2 out."""
    plan = make_plan_of("validate", units_of([1, 1, 2], True), [JOINT] * 3, Scale(quick=True, runs=1))
    files: tuple[Joint, ...] = (JOINT, JOINT, JOINT)
    bench = load_plant(shipped(PLANT))
    for run in (plan.runs[-1], next(run for run in plan.runs if run.name.startswith("joints_1_2_var"))):
        table = emulated_run(bench, 1, 0, run)
        assert tuple(table.joints) == run.joints
        log = LoggedRun(table, 0, 0, {}, 1e-3)
        assert findings(log, expand(run), files, measured=run.joints) == ()
        still = replace(expand(run), velocity_rad_s=0.0 * expand(run).velocity_rad_s, off=())
        (line, *_) = findings(log, still, files, measured=run.joints)
        assert line.startswith(f"j{run.velocity_joint}.motor_velocity_rad_s")
        write_run(tmp_path / f"{run.name}.csv.gz", table)
    runs = read_runs([tmp_path])
    assert [run.name for run in with_joint(runs, 3)] == [f"{plan.runs[-1].name}.csv.gz"]
    assert len(with_joint(runs, 4)) == 2, "no run has it: all of them are returned"


def test_a_limit_of_the_temperature_needs_that_of_every_joint(tmp_path, capsys):
    """jtqd leaves TPDO3 of the others off, and drops the inputs of a drive on which it is switched on."""
    file = config_file(tmp_path, [None, None], sensor=False)
    content = yaml.safe_load(file.read_text())
    del content["joint_2"]["temperature"]
    file.write_text(yaml.safe_dump(content))
    arguments = ["excitation", "--quick", "--evaluations", "1", "--dry-run", "--config", str(file)]
    assert main(arguments) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "joint_2: found no 'temperature: true', expected it for the limit of 70 degC" in line
    assert main([*arguments, "--limit", "temperature_c=none"]) == 0


def test_a_joint_that_stands_elsewhere_is_brought_to_the_middle_first(tmp_path, monkeypatch):
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
