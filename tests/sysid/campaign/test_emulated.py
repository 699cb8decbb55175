"""`python -m jtqd.sysid.campaign.emulated`: a campaign's runs without a bus."""

import json
from pathlib import Path

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.campaign.emulated import PLANT, emulated_run, main
from jtqd.sysid.planner.campaigns import Scale, make_plan
from jtqd.sysid.planner.plan import expand
from jtqd.sysid.runs.files import read_run

ARGUMENTS = ["--runs", "2", "--seconds", "4", "--hold", "0.3", "--seed", "5"]


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    out: Path = tmp_path_factory.mktemp("runs") / "days"
    assert main([*ARGUMENTS, "--out", str(out)]) == 0
    return out


def test_tables_and_marks_are_those_of_the_plan(directory):
    joints = (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))
    runs = make_plan("validate", Scale(2, 4.0, 0.3, 5, joints=joints)).runs
    assert {path.name for path in directory.iterdir()} == {
        "emulated_runs.json",
        *(f"{run.name}.{ending}" for run in runs for ending in ("csv.gz", "json", "truth.npz")),
    }
    day, run = len(runs) - 1, runs[-1]
    table = read_run(directory / f"{run.name}.csv.gz").table
    expected = emulated_run(load_plant(shipped(PLANT)), 5, day, run)
    assert np.allclose(table.joints[1].current_a, expected.joints[1].current_a, atol=1e-6)
    marks = json.loads((directory / f"{run.name}.json").read_text())
    assert marks["velocity_joint"] == run.velocity_joint
    one = table.joints[run.velocity_joint]
    assert one.motor_velocity_rad_s is not None
    planned = expand(run).velocity_rad_s[: len(table.time_s)]
    driven = one.motor_velocity_rad_s / joints[run.velocity_joint - 1].gear_ratio
    assert np.corrcoef(planned, driven)[0, 1] > 0.99


def test_each_run_has_a_day_of_its_own():
    joints = (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))
    run = make_plan("validate", Scale(1, 4.0, 0.3, 5, joints=joints)).runs[-1]
    bench = load_plant(shipped(PLANT))
    rest = []
    for day in (1, 1, 2):
        sensor = emulated_run(bench, 5, day, run).joints[1].torque_nm
        assert sensor is not None
        rest.append(float(sensor[:200].mean()))
    assert rest[0] == rest[1]
    assert abs(rest[2] - rest[0]) > 0.01


def test_what_was_interrupted_goes_on_and_nothing_else_is_written_over(directory, capsys):
    before = {path.name: path.read_bytes() for path in directory.iterdir()}
    (directory / "variable_02.json").unlink()  # interrupted before its end
    (directory / "variable_02.csv.gz").write_bytes(b"half")
    assert main([*ARGUMENTS, "--out", str(directory)]) == 0
    table = read_run(directory / "variable_02.csv.gz").table
    assert len(table.time_s) > 3000
    assert {path.name for path in directory.iterdir()} == set(before)
    assert (directory / "variable_01.csv.gz").read_bytes() == before["variable_01.csv.gz"]
    assert main([*ARGUMENTS[:-1], "6", "--out", str(directory)]) == 1
    assert "runs of another plan, bench or seed" in capsys.readouterr().err
    assert main([*ARGUMENTS, "--out", str(directory.parent)]) == 1
    assert "File exists" in capsys.readouterr().err
    assert main([*ARGUMENTS, "--out", str(directory / "b"), "--plant", "nothing.yaml"]) == 1
    assert "nothing.yaml" in capsys.readouterr().err
    assert not (directory / "b").exists()
