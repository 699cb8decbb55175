"""`jtq campaign` from the outside, without a bus: usage, dry run, refusals; each one line, none a traceback."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from jtqd.daemon.jtq import main as jtq
from jtqd.models.files import shipped
from jtqd.sysid.campaign.bench import BenchConfig
from jtqd.sysid.campaign.command import main, parser, recipe, wanted_plan
from jtqd.sysid.campaign.state import DONE, CampaignDirectory, RunState
from jtqd.sysid.planner.campaigns import units_of
from tests.drivers.hub_helpers import until_it_listens

SMALL = yaml.safe_load("""
schema: jtq.plan/1
name: small
runs:
  - name: a
    velocity_joint: 1
    segments: &both [{kind: plateau, velocity_rad_s: 0.5, current_a: 1.0, hold_s: 1.0}, {kind: rest, hold_s: 0.5}]
  - {name: b, velocity_joint: 1, segments: *both}
""")


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return str(path)


@pytest.mark.parametrize("more", [[], ["--dry-run"], ["--bus", "sim", "--out", "x"]])
def test_a_missing_plan_comes_before_a_missing_option(more, capsys):
    assert main(["nothere.yaml", *more]) == 1
    assert (
        capsys.readouterr().err == "jtq campaign: nothere.yaml: cannot be read: No such file or directory\n"
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["efficiency"], ["--bus is missing"]),
        (["efficiency", "--bus", "sim"], ["--out is missing"]),
        (["eficiency", "--dry-run"], ["'eficiency'", "efficiency, excitation, quick, validate"]),
        (["p.yaml", "--dry-run", "--runs", "3"], ["--runs belongs to"]),
        (["p.yaml", "--dry-run", "--hold", "3"], ["--hold belongs to"]),
        (["p.yaml", "--dry-run", "--quick"], ["--quick belongs to"]),
        (["efficiency", "--bus", "can0", "--out", "x", "--plant", "p"], ["--plant requires --bus sim"]),
    ],
)
def test_misuse_is_status_2_and_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    for word in words:
        assert word in captured.err


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--runs", "0"], ["found '0'"]),
        (["--limit", "curent_a=3"], ["'curent_a'", "current_a"]),
        (["--limit", "current_a=-3"], ["current_a=-3", "> 0"]),
        (["--limit", "current_a=none"], ["current_a=none"]),
    ],
)
def test_wrong_values_of_options(option, words, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["efficiency", "--dry-run", *option])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    for word in words:
        assert word in error


def test_a_dry_run_prints_every_run_and_moves_nothing(capsys):
    assert main(["efficiency", "--dry-run"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert len(lines) == 1 + 32 + 3
    row = next(line for line in lines if line.startswith("back_1_n2.2")).split()
    assert row[1:3] == ["2", "7"]
    assert row[4:6] == ["2.20", "4.00"]
    assert "32 runs, 8:" in lines[-3]
    assert "93.4% in the worst case, 934 of 1000 bits" in lines[-1]


def test_a_dry_run_as_json_adds_up(plan, capsys):
    assert main([plan, "--dry-run", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [run["run"] for run in content["runs"]] == ["a", "b"]
    assert content["motion_s"] == pytest.approx(sum(run["seconds"] for run in content["runs"]))
    assert content["motion_s"] == pytest.approx(5.0)
    assert content["expected_s"] > content["motion_s"]
    assert content["runs"][0]["travel_rad"] == pytest.approx(0.75, abs=1e-3)
    assert content["bus_load_worst"] == pytest.approx(0.934, abs=0.002)


def bench_config(folder: Path, **changes: object) -> Path:
    """The shipped configuration with copies of its models, and changes of top-level keys."""
    content = yaml.safe_load(shipped("bench.yaml").read_text()) | changes
    shutil.copytree(shipped("trained/joint1.yaml").parent, folder / "trained")
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bitrate": 800_000}, ["bench.yaml", "commander", "bus load", "95%"]),
        ({"sensor": {"node": 3, "channels": 2}}, ["bus load"]),
        ({"contact": {"opposed": True}}, ["commander", "bus load"]),
        ({"sync": {"period_us": 1500}}, ["sync.period_us", "1500", "whole milliseconds"]),
        ({"sensor": {"node": 2, "channels": 1}}, ["bench.yaml", "sensor.node", "not used by joint_2.node"]),
        ({"joint_1": {"node": 1, "file": "none.yaml"}}, ["none.yaml"]),
        ({"joint_4": {"node": 5, "file": "none.yaml"}}, ["joint_3", "without a gap"]),
    ],
)
def test_a_bench_that_cannot_carry_it_is_refused(tmp_path, changes, words, capsys):
    path = bench_config(tmp_path, **changes)
    assert main(["efficiency", "--dry-run", "--config", str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    for word in words:
        assert word in captured.err


def drives_with(folder: Path, **section: object) -> Path:
    """The bench with both drives so."""
    joints = {
        f"joint_{n}": {"node": n, "file": f"trained/joint{n}.yaml", "sensor_channel": 1, **section}
        for n in (1, 2)
    }
    return bench_config(folder, estimator={"method": "efficiency"}, **joints)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"max_age_ms": 5}, "key 'joint_1.max_age_ms': found 5, expected none for a campaign"),
        ({"objects": {"motor_velocity": False}}, "key 'joint_1.objects.motor_velocity': found false, expected 606Ch"),
        (
            {"objects": {"motor_velocity": {"index": 0x2031, "type": "I16", "factor": 0.1}}},
            "key 'joint_1.objects.motor_velocity': found 2031h:0, sign 1, expected 606Ch with sign 1",
        ),
        (
            {"objects": {"current": {"sign": -1}}},
            "key 'joint_1.objects.current': found 6078h:0, sign -1, expected 6078h or 6077h with sign 1",
        ),
        (
            {"temperature": True, "objects": {"temperature": {"index": 0x2040, "factor": 0.01}}},
            "key 'joint_1.objects.temperature': found another one, expected 3001h",
        ),
    ],
)  # fmt: skip
def test_a_drive_that_would_be_moved_otherwise_than_planned_is_refused(section, words, tmp_path, capsys):
    assert main(["efficiency", "--dry-run", "--config", str(drives_with(tmp_path, **section))]) == 1
    error = capsys.readouterr().err
    assert words in error
    assert len(error.splitlines()) == 1


def test_the_bus_load_of_a_campaign_is_that_of_the_layout(tmp_path):
    """Four bytes less of each drive, and torque instead of current, are no reason against it."""
    less = {"link_position": False, "current": {"index": 0x6077}}
    config = BenchConfig.load(drives_with(tmp_path, objects=less))
    assert config.drives[0].objects.link_position is None
    assert config.drives[0].torque_constant_nm_per_a == config.joints[0].torque_constant_nm_per_a
    whole = BenchConfig.load(None).load_with_commander()
    assert whole.worst - config.load_with_commander().worst == pytest.approx(0.08)


def test_a_plan_beyond_its_limits_is_refused(plan, capsys):
    assert main([plan, "--dry-run", "--limit", "velocity_rad_s=0.4"]) == 1
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    for word in ("small.yaml", "run 'a'", "velocity", "limit 0.4 rad/s"):
        assert word in error
    assert main([plan, "--dry-run", "--limit", "temperature_c=none"]) == 0
    assert "temperature not supervised" in capsys.readouterr().out


def done_directory(path: Path, arguments: list[str]) -> None:
    """A campaign that is done, as it would be left."""
    options = parser().parse_args([*arguments, "--bus", "x", "--out", str(path)])
    config = BenchConfig.load(None)
    joints = config.joints
    wanted = wanted_plan(options, joints, units_of(config.channels, sensor=True))
    directory = CampaignDirectory(path)
    directory.begin(wanted, recipe(options, joints))
    for run in wanted.runs:
        for ending in (".csv.gz", ".json", ".mcap"):
            (path / (run.name + ending)).write_text("x")
        directory.put(run.name, RunState(DONE, attempts=1, rows=10))
    directory.close()


def test_a_campaign_that_is_done_needs_no_bus(plan, tmp_path, capsys):
    done_directory(tmp_path / "out", [plan])
    assert main([plan, "--bus", "unix:/nonexistent/bus", "--out", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"]["done"] == 2


def test_the_same_directory_takes_no_other_plan(plan, tmp_path, capsys):
    where = ["--bus", "unix:/nonexistent/bus", "--out", str(tmp_path / "out")]
    same = ["validate", "--quick", "--seed", "3", "--runs", "1", "--seconds", "4"]
    done_directory(tmp_path / "out", same)
    for other in ([plan], [*same, "--seed", "4"], [*same, "--runs", "2"], [*same, "--limit", "torque_nm=9"]):
        assert main([*other, *where]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert "of another plan" in line
    assert main([*same, *where]) == 0


def test_a_plan_that_was_designed_once_is_not_designed_again(tmp_path, monkeypatch, capsys):
    arguments = ["excitation", "--quick", "--evaluations", "1"]
    done_directory(tmp_path / "out", arguments)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("designed again")

    monkeypatch.setattr("jtqd.sysid.planner.campaigns.design", never)
    assert main([*arguments, "--bus", "x", "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()


@pytest.mark.parametrize("bus", ["can77", "unix:/nonexistent/bus"])
def test_a_bus_that_is_not_there_ends_the_campaign_in_one_line(plan, tmp_path, bus, capsys):
    assert main([plan, "--bus", bus, "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert bus.removeprefix("unix:") in captured.out
    assert "Traceback" not in captured.err
    left = sorted(file.name for file in (tmp_path / "out").iterdir())
    assert left == [".lock", "campaign.json", "plan.yaml"]


def test_the_error_of_a_jtqd_that_does_not_start_is_passed_on(plan, tmp_path, monkeypatch, capsys):
    """A bench with nothing on it: jtqd's boot names the node that is missing, and the campaign passes it on."""
    (tmp_path / "run").mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    hub = subprocess.Popen([sys.executable, "-m", "jtqd.drivers.hub", f"unix:{tmp_path}/bus"])
    try:
        bus = f"unix:{tmp_path}/bus"
        until_it_listens(bus, hub)
        assert main([plan, "--bus", bus, "--out", str(tmp_path / "out"), "--json"]) == 1
        content = json.loads(capsys.readouterr().out)
        assert "node 1" in content["not_done"]["a"]
        assert content["runs"] == {"done": 0, "stopped": 0, "failed": 1, "pending": 1}
        assert (tmp_path / "out" / "a.jtqd.log").exists()
    finally:
        hub.terminate()
        hub.wait(10)


def test_help_has_an_example_and_jtq_knows_the_command(capsys):
    with pytest.raises(SystemExit) as left:
        jtq(["campaign", "--help"])
    assert left.value.code == 0
    assert "jtq campaign efficiency --dry-run" in capsys.readouterr().out
