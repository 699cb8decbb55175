"""Whole campaigns on vcan0 in exact time: emulated bench, jtqd, commander and files, interrupted in every way."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.models.files import load_joint, shipped
from jtqd.sysid.planner.plan import expand, load_plan
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.logs import log_to_run
from tests.shipped_bench import shipped_bench

pytestmark = pytest.mark.socketcan

FORWARD, BACK = "forward_1", "back_1"
PLAN = yaml.safe_load("""
schema: jtq.plan/1
name: two
runs:
  - name: forward_1
    velocity_joint: 1
    segments:
      - {kind: plateau, velocity_rad_s: 0.8, current_a: 3.0, hold_s: 0.8, ramp_s: 0.4}
      - &end {kind: rest, hold_s: 0.2, ramp_s: 0.3}
  - name: back_1
    velocity_joint: 2
    segments:
      - {kind: plateau, velocity_rad_s: -0.8, current_a: -3.0, hold_s: 0.8, ramp_s: 0.4}
      - *end
""")


@pytest.fixture
def arguments(tmp_path, monkeypatch):
    """A campaign of two runs in a directory of its own; nothing of it is left on the bus afterwards."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(PLAN))
    config = shipped_bench()
    config["estimator"] |= {"method": "tob", "shadow": []}
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(config))
    options = ["--config", str(tmp_path / "bench.yaml"), "--bus", "sim:vcan0", "--out", str(tmp_path / "out")]
    yield [str(tmp_path / "two.yaml"), *options, "--json"]
    all_gone()


def started(arguments: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "jtqd.daemon.jtq", "campaign", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, dict[str, Any], str]:
    output, errors = process.communicate(timeout=300)
    assert "Traceback" not in errors, errors
    return process.returncode, json.loads(output) if output else {}, errors


def in_motion(out: Path, run: str) -> None:
    """Wait until a run's log is being written, and then until its motion has begun."""
    end = time.monotonic() + 60.0
    while not list((out / f"{run}.part").glob("log/*.active")):
        assert time.monotonic() < end
        time.sleep(0.01)
    time.sleep(1.2)


def all_gone() -> None:
    """Wait until no process of a campaign is left: they end by themselves when it is killed."""
    end = time.monotonic() + 60.0
    while left := [p for p in Path("/proc").glob("[0-9]*/cmdline") if campaign_process(p)]:
        assert time.monotonic() < end, left
        time.sleep(0.05)


def campaign_process(cmdline: Path) -> bool:
    try:
        words = cmdline.read_bytes().split(b"\0")
    except OSError:
        return False
    return any(
        each in words
        for each in (
            b"jtqd.sim_can",
            b"jtqd.daemon.jtqd",
            b"jtqd.daemon.loop.process",
            b"jtqd.daemon.recording.recorder",
        )
    )


def check_done(out: Path, status: int, content: dict[str, Any], runs: list[str]) -> None:
    """The campaign is whole, and nothing is left of its interruption."""
    assert status == 0, content
    assert content["runs"]["done"] == len(runs)
    assert content["missed_cycles"] == content["incomplete_cycles"] == content["findings"] == {}
    left = sorted(file.name for file in out.iterdir())
    files = [f"{name}{end}" for name in runs for end in (".csv.gz", ".json", ".mcap")]
    assert left == sorted([".lock", "campaign.json", "plan.yaml", *files])


def test_ctrl_c_brings_both_joints_to_rest_and_the_same_command_goes_on(arguments, tmp_path):
    out = tmp_path / "out"
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(PLAN | {"runs": PLAN["runs"][1:]}))
    process = started(arguments)
    in_motion(out, BACK)
    process.send_signal(signal.SIGINT)
    status, content, errors = ended(process)
    assert status == 1, errors
    assert content["runs"] == {"done": 0, "stopped": 1, "failed": 0, "pending": 0}
    assert "SIGINT" in content["not_done"][BACK]
    assert "SIGINT" in content["ended"]
    state = {run["name"]: run for run in json.loads((out / "campaign.json").read_text())["runs"]}
    assert 0.1 < state[BACK]["played_s"] < 1.7
    stopped = log_to_run(out / f"{BACK}.stopped.mcap").table.joints[2].motor_velocity_rad_s
    assert stopped is not None
    assert np.abs(stopped).max() > 30.0
    assert np.abs(stopped[-5:]).max() < 2.0, "at rest before the power goes"
    assert not (out / f"{BACK}.csv.gz").exists()
    all_gone()
    status, content, errors = ended(started(arguments))
    check_done(out, status, content, [BACK])
    check_tables(out)


@pytest.mark.campaign
def test_a_campaign_that_was_killed_goes_on(arguments, tmp_path):
    """SIGKILL: nothing tidies up but the next call; what it had started ends by itself."""
    out = tmp_path / "out"
    process = started(arguments)
    in_motion(out, BACK)
    process.kill()
    process.communicate()
    all_gone()
    assert (out / f"{BACK}.part").is_dir()
    first = {end: (out / f"{FORWARD}{end}").read_bytes() for end in (".csv.gz", ".json", ".mcap")}
    status, content, _ = ended(started(arguments))
    check_done(out, status, content, [BACK, FORWARD])
    assert {end: (out / f"{FORWARD}{end}").read_bytes() for end in first} == first, "played once, and kept"
    check_tables(out)


def check_tables(out: Path) -> None:
    """The measurement follows the plan, in the quadrants of its name, with no cycle missing."""
    plan = load_plan(out / "plan.yaml")
    for run in plan.runs:
        read = read_run(out / f"{run.name}.csv.gz")
        assert read.notes == ()
        table, points = read.table, expand(run)
        assert len(points) <= len(table.time_s) <= len(points) + 60  # and the ramp to nothing at the end
        assert np.abs(np.diff(table.time_s) - 1e-3).max() < 1e-5
        mover, driver = table.joints[points.velocity_joint], table.joints[points.current_joint]
        marks = json.loads((out / f"{run.name}.json").read_text())["segments"]
        plateau = next(mark for mark in marks if mark["kind"] == "plateau")
        held = (table.time_s > plateau["start_s"] + 0.2) & (table.time_s < plateau["end_s"])
        gear = load_joint(shipped("joint1.yaml")).gear_ratio
        assert mover.motor_velocity_rad_s is not None
        assert np.mean(mover.motor_velocity_rad_s[held]) / gear == pytest.approx(
            plateau["velocity_rad_s"], abs=0.005
        )
        assert driver.current_a is not None
        assert np.mean(driver.current_a[held]) == pytest.approx(plateau["current_a"], abs=0.01)
        for joint, sign in ((mover, 1.0), (driver, -1.0)):
            assert joint.current_a is not None
            assert joint.motor_velocity_rad_s is not None
            power = float(np.mean(joint.current_a[held] * joint.motor_velocity_rad_s[held])) / gear
            assert power * sign > 0.5, run.name
        # the set-points in the table's own time: 2 to 6 ms of transport, interpolation and control
        lagging = np.interp(table.time_s - 0.004, points.time_s, points.velocity_rad_s, left=0.0, right=0.0)
        assert np.sqrt(np.mean((mover.motor_velocity_rad_s / gear - lagging) ** 2)) < 0.01


@pytest.mark.campaign
def test_a_limit_stops_the_joints_and_the_campaign_unless_keep_going(arguments, tmp_path):
    out = tmp_path / "out"
    status, content, errors = ended(started([*arguments, "--limit", "torque_nm=8", "--keep-going"]))
    assert status == 3, errors
    assert content["runs"] == {"done": 0, "stopped": 2, "failed": 0, "pending": 0}
    for name in (FORWARD, BACK):
        assert "torque at the sensor" in content["not_done"][name]
        assert "limit 8 Nm" in content["not_done"][name]
        assert (out / f"{name}.stopped.mcap").exists()
    assert not list(out.glob("*.csv.gz"))


@pytest.mark.campaign
def test_a_joint_is_moved_alone_beside_a_towing_bench(tmp_path, monkeypatch):
    """Three joints at 500 Hz: joint 3 is brought to the middle of its travel, moved, and read; 1 and 2 are held."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    config: dict[str, Any] = {
        "node_id": 32,
        "sync": {"period_us": 2000},
        "estimator": {"method": "tob"},
        "sensor": {"node": 5, "channels": 2},
    }
    for number, channel in ((1, 1), (2, 1), (3, 2)):
        file = str(shipped(f"trained/joint{2 - number % 2}.yaml"))
        config[f"joint_{number}"] = {
            "node": number,
            "file": file,
            "sensor_channel": channel,
            "temperature": True,
        }
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(config))
    held = {"kind": "plateau", "hold_s": 1.0}
    segments = [held | {"velocity_rad_s": speed} for speed in (0.5, -0.5)] + [{"kind": "rest", "hold_s": 0.5}]
    plan = PLAN | {"runs": [{"name": "third", "joint": 3, "segments": segments}]}
    (tmp_path / "third.yaml").write_text(yaml.safe_dump(plan))
    out = tmp_path / "out"
    status, content, errors = ended(
        started(
            [
                str(tmp_path / "third.yaml"),
                *(
                    "--config",
                    str(tmp_path / "three.yaml"),
                    "--bus",
                    "sim:vcan0",
                    "--out",
                    str(out),
                    "--json",
                ),
                *("--limits", "3:travel_rad=-1.4:0.6,velocity_rad_s=1"),
            ]
        )
    )
    check_done(out, status, content, ["third"])
    assert "joint 3: moved alone" in errors
    table = read_run(out / "third.csv.gz").table
    assert list(table.joints) == [3]
    columns = table.joints[3]
    assert columns.link_position_rad is not None
    assert columns.torque_nm is not None
    assert columns.link_position_rad[0] == pytest.approx(-0.4, abs=0.02), "the way there is not in the table"
    assert np.ptp(columns.link_position_rad) == pytest.approx(0.72, abs=0.05)
    assert abs(np.median(np.diff(table.time_s)) - 2e-3) < 1e-5
    both = log_to_run(out / "third.mcap", joints=[1, 2]).table
    for number in (1, 2):
        position = both.joints[number].link_position_rad
        assert position is not None
        assert np.ptp(position) < 0.01, "held"
    all_gone()
