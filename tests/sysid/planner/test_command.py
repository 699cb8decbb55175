"""The command `jtq excitation`, and its runs as segments of a plan."""

import json
import sys

import pytest
import yaml

from jtqd.sysid.planner import command as excitation_command
from jtqd.sysid.planner.design import ExcitationLimits, design
from jtqd.sysid.planner.plan import FourierSeries, FourierTrajectory, Plan, load_plan, segment_mapping


def test_segment_mapping_is_what_a_plan_reads(tmp_path):
    (one,) = design(ExcitationLimits(), count=1, duration_s=10.0, seed=2, evaluations=1)
    mapping = segment_mapping(one.segment)
    assert mapping["kind"] == "fourier"
    assert mapping["duration_s"] == 10.0
    run = {"name": "one", "velocity_joint": 2, "segments": [yaml.safe_load(yaml.safe_dump(mapping))]}
    plan = Plan.from_mapping({"schema": "jtq.plan/1", "name": "test", "runs": [run]}, "test")
    assert plan.runs[0].segments == (one.segment,)


def test_command_writes_a_plan_of_what_it_prints(tmp_path, capsys):
    out = tmp_path / "new" / "excitation.plan.yaml"
    arguments = ["--count", "2", "--duration", "8", "--evaluations", "60", "--velocity-joint", "2"]
    assert excitation_command.main([*arguments, "--json", "--out", str(out)]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert captured.err == f"jtq excitation: wrote {out}\n"
    plan = load_plan(out)
    assert [run.velocity_joint for run in plan.runs] == [2, 2]
    for run, printed in zip(plan.runs, result["runs"], strict=True):
        rest, motion, again = run.segments
        assert rest == again
        assert rest.hold_s == 1.0
        segment = printed["segment"]
        velocity, current = segment["velocity"], segment["current"]
        assert motion.velocity == FourierTrajectory(
            velocity["omega_rad_s"], tuple(velocity["a"]), tuple(velocity["b"]), 8.0
        )
        assert motion.current == FourierSeries(
            current["omega_rad_s"], tuple(current["a"]), tuple(current["b"]), 8.0, current["offset_a"]
        )
        assert printed["peaks"]["velocity_rad_s"] == pytest.approx(3.0)
    assert excitation_command.main(arguments) == 0
    assert len(capsys.readouterr().out.splitlines()) == 4


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--duration", "0.5"], 1, "duration_s: found 0.5, expected 1 to 600"),
        (["--velocity", "99", "--out", "plan.yaml"], 1, "--velocity: found 99, expected at most"),
        (["--joint-current", "99", "--out", "plan.yaml"], 1, "--joint-current: found 99, expected at most"),
        (["--joints", "none1.yaml", "none2.yaml"], 1, "none1.yaml: cannot be read"),
    ],
)
def test_command_refuses_in_one_line(arguments, status, message, capsys, tmp_path):
    arguments = [str(tmp_path / word) if word == "plan.yaml" else word for word in arguments]
    assert excitation_command.main(arguments) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"jtq excitation: {message}")
    assert captured.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_command_without_scipy_refuses_in_one_line(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert excitation_command.main(["--count", "1", "--evaluations", "100"]) == 1
    assert capsys.readouterr().err == "jtq excitation: scipy is not installed: pip install 'jtqd[analysis]'\n"


@pytest.mark.parametrize("value", ["nan", "0", "-1", "many", "1e23"])
def test_numbers_without_sense_are_usage_errors(value, capsys):
    with pytest.raises(SystemExit) as refused:
        excitation_command.main([f"--torque={value}"])
    assert refused.value.code == 2
    assert f"argument --torque: found {value!r}, expected a number > 0" in capsys.readouterr().err
