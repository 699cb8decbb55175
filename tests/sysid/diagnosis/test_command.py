"""`jtq diagnose`: files in, files out, exit status; and what it refuses, each in one line."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd import __version__
from jtqd.estimator.arrays import BoolArray
from jtqd.estimator.run import RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.diagnosis.command import main
from jtqd.sysid.diagnosis.next_experiment import MOTION_FILE, PLAN_FILE
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.planner.plan import load_plan
from jtqd.sysid.runs.tables import write_run
from tests.sysid.diagnosis.diagnose_helpers import (
    COULOMB,
    JOINT,
    JOINT_FILE,
    OFFSET,
    Core,
    bench_run,
    cause,
    findings,
    run,
    said,
    stand_in,
    value,
    write_runs,
)

PLAN = {
    "schema": "jtq.plan/1",
    "name": "more",
    "limits": {"current_a": 5.0, "velocity_rad_s": 2.0},
    "runs": [{"name": "r1", "velocity_joint": 1, "segments": [{"kind": "rest", "hold_s": 1.0}]}],
}


def made_in(folder: Path) -> dict[str, Any]:
    made: dict[str, Any] = json.loads((folder / "findings.json").read_text())
    return made


def diagnosed(folder: Path, *more: object) -> tuple[int, dict[str, Any]]:
    """Exit status and findings of the runs of a folder with one joint file, written beside it."""
    out = folder.parent / "out"
    status = run(folder, "--joint", JOINT_FILE, "--out", out, *more)
    return status, made_in(out)


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Core:
    return stand_in(monkeypatch)


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run("--help")
    assert caught.value.code == 0
    assert "jtq diagnose campaigns/validate --joint" in capsys.readouterr().out


@pytest.mark.parametrize("verdict", ["no_gap", "cause", "ambiguous", "unexplained", "insufficient_data"])
def test_status_and_files_by_verdict(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str], verdict: str
) -> None:
    core.answer = findings(verdict, causes=(COULOMB, OFFSET) if verdict == "cause" else ())
    write_runs(tmp_path)
    out = tmp_path / "new" / "out"
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", out) == (0 if verdict == "no_gap" else 3)
    text, _ = capsys.readouterr()
    assert text.startswith(f"{verdict}: ")
    row = "joint 2        Coulomb friction  3.00 -> 4.40 Nm  [4.30, 4.50]"
    assert (row in text) == (verdict == "cause")
    last = text.splitlines()[-1]
    assert f"sha256 of a.csv {made_in(out)['runs'][0]['sha256'][:12]}, b.csv.gz" in last
    assert last.endswith(f": jtq diagnose {tmp_path} --joint {JOINT_FILE} --out {out}")
    made = made_in(out)
    assert made["verdict"] == verdict
    assert [each["name"] for each in made["runs"]] == ["a.csv", "b.csv.gz", "c.csv"]
    assert all(len(each["sha256"]) == 64 for each in made["runs"])
    names = ["extended.joint.yaml", "extended.joint1.yaml", "extended.joint2.yaml", "report.html"]
    assert sorted(made["files"]) == names
    assert sorted(path.name for path in out.iterdir()) == sorted([*names, "findings.json"])
    assert (out / "report.html").read_text() == f"<html>{verdict}</html>"
    effects = [effect.name for effect in load_joint(out / "extended.joint.yaml").effects]
    assert effects == (["coulomb_friction", "sensor_offset"] if verdict == "cause" else [])


def test_the_findings_hold_what_they_were_made_of(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path, numbers=(1,))
    columns = ("time_s", "j1.current_a", "j1.motor_position_rad", "j1.link_position_rad", "j1.torque_nm")
    (tmp_path / "map.yaml").write_text(yaml.safe_dump({name: name for name in columns}))
    (tmp_path / "j.yaml").write_text(joint_text())
    files = ("--columns", tmp_path / "map.yaml", "--joint", tmp_path / "j.yaml")
    trust = ("--trust", "sensor_gain=5%", "--relevance", "2")
    run(tmp_path / "a.csv", *files, "--out", tmp_path / "o", *trust)
    made = made_in(tmp_path / "o")
    origin = made["provenance"]
    assert list(origin["inputs"]) == ["a.csv", str(tmp_path / "j.yaml"), str(tmp_path / "map.yaml")]
    for path in (tmp_path / "j.yaml", tmp_path / "map.yaml"):
        assert origin["inputs"][str(path)] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert origin["inputs"]["a.csv"] == made["runs"][0]["sha256"]
    assert origin["version"] == __version__
    assert origin["command"].startswith(f"jtq diagnose {tmp_path / 'a.csv'} --columns")
    assert made["relevance"] == 0.02
    assert [each["name"] for each in made["priors"] if each["set_by_user"]] == ["sensor_gain"]
    assert core.options == [{"relevance": 0.02, "trust": {"sensor_gain": 5.0}}]


def test_json_on_standard_output_is_the_file(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]
) -> None:
    write_runs(tmp_path)
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o", "--json") == 3
    out = capsys.readouterr().out
    assert out == (tmp_path / "o" / "findings.json").read_text()
    assert json.loads(out)["causes"][0]["name"] == "coulomb_friction"


def test_one_file_serves_both_joints_and_one_each_its_own(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path)
    other = tmp_path / "other.yaml"
    write_joint(other, replace(JOINT, name="other"), "t")
    run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o")
    run(tmp_path, "--joint", f"2={other}", "--joint", f"1={JOINT_FILE}", "--out", tmp_path / "p")
    run(tmp_path, "--joint", f"2={other}", "--out", tmp_path / "q")
    names = [{number: joint.name for number, joint in joints.items()} for _, joints in core.asked]
    assert names == [{1: "joint1", 2: "joint1"}, {1: "joint1", 2: "other"}, {2: "other"}]
    assert all(list(table.joints) == [2] for _, table in core.asked[2][0])
    assert not (tmp_path / "q" / "extended.joint2.yaml").exists()  # the only joint


def test_runs_of_one_joint(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path, numbers=(2,))
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    assert list(core.asked[0][1]) == [2]
    assert not list((tmp_path / "o").glob("extended.joint?.yaml"))


def test_a_map_of_columns_brings_names_units_and_joint_files(tmp_path: Path, core: Core) -> None:
    table = bench_run(numbers=(1,))
    columns = table.joints[1]
    rows = np.column_stack(
        (table.time_s, columns.current_a, np.degrees(columns.link_position_rad), columns.torque_nm)
    )
    np.savetxt(tmp_path / "rig.csv", rows, delimiter=",", header="t,amps,deg,torque", comments="")
    mapping = {
        "time_s": "t",
        "j1.current_a": "amps",
        "j1.link_position_rad": {"column": "deg", "scale": float(np.pi / 180)},
        "j1.torque_nm": "torque",
        "j1.joint_file": "arm.yaml",
    }
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(mapping))
    write_joint(tmp_path / "arm.yaml", replace(JOINT, name="arm"), "t")
    assert run(tmp_path / "rig.csv", "--columns", tmp_path / "map.yaml", "--out", tmp_path / "o") == 3
    runs, joints = core.asked[0]
    assert joints[1].name == "arm"
    link = runs[0][1].joints[1].link_position_rad
    assert link is not None
    assert columns.link_position_rad is not None
    assert np.allclose(link, columns.link_position_rad, atol=1e-9)


def test_a_usage_error_is_said_before_a_missing_package(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "scipy" else real(name, *rest)
    )
    write_runs(tmp_path)
    assert run(tmp_path, "--out", tmp_path / "o") == 2
    assert "--joint: missing" in said(capsys)
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 1
    assert said(capsys) == "jtq diagnose: scipy is not installed: pip install 'jtqd[analysis]'\n"
    assert not (tmp_path / "o").exists()


def test_parquet_without_pyarrow_is_one_line(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "pyarrow" else real(name, *rest)
    )
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    assert run(tmp_path / "a.parquet", "--joint", JOINT_FILE, "--out", tmp_path / "o") == 1
    assert "pip install pyarrow" in said(capsys)


def test_parquet_is_the_same_run(tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]) -> None:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = bench_run(numbers=(1,))
    columns = table.joints[1]
    cells = {
        "t": table.time_s,
        "time_s": table.time_s,
        "j1.current_a": columns.current_a,
        "j1.link_position_rad": columns.link_position_rad,
        "j1.torque_nm": columns.torque_nm,
        "note": ["x"] * len(table.time_s),
    }
    path = tmp_path / "a.parquet"
    parquet.write_table(arrow.table(cells), path)
    assert run(path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    read = core.asked[0][0][0][1]
    assert np.array_equal(read.time_s, table.time_s)
    assert read.joints[1].torque_nm is not None
    assert np.array_equal(read.joints[1].torque_nm, cells["j1.torque_nm"])
    capsys.readouterr()
    spoilt = columns.current_a.copy() if columns.current_a is not None else None
    assert spoilt is not None
    spoilt[4] = np.inf
    parquet.write_table(arrow.table({name: cell[:1] for name, cell in cells.items()}), path)
    assert run(path, "--joint", JOINT_FILE, "--out", tmp_path / "p") == 1
    assert "found 1 sample, expected at least 2" in said(capsys)
    for content, wanted in ((spoilt, "row 5, column 'j1.current_a'"), (["x"] * len(spoilt), "found 'x'")):
        parquet.write_table(arrow.table({**cells, "j1.current_a": content}), path)
        assert run(path, "--joint", JOINT_FILE, "--out", tmp_path / "p") == 1
        assert wanted in said(capsys)


def test_the_next_experiment_is_a_plan_that_the_campaign_reads(tmp_path: Path, core: Core) -> None:
    core.answer = findings("ambiguous", next_experiment={"why": "load both ways", "plan": PLAN})
    write_runs(tmp_path)
    out = tmp_path / "o"
    both = [text for n in (1, 2) for text in ("--joint", f"{n}={shipped(f'joint{n}.yaml')}")]
    assert run(tmp_path, *both, "--out", out) == 3
    assert load_plan(out / "next_experiment.plan.yaml").name == "more"
    made = made_in(out)
    plan = out / "next_experiment.plan.yaml"
    command = f"jtq campaign {plan} --bus can0 --config CONFIG --out RUNS"
    assert made["next_experiment"] == {"why": "load both ways", "plan": PLAN, "command": command}
    assert "next_experiment.plan.yaml" in made["files"]


def test_the_motion_of_an_arm_is_a_file_beside(tmp_path: Path, core: Core) -> None:
    motion = {"joint": 1, "runs": [{"name": "a", "what": "empty", "duration_s": 3.0}]}
    files = {"motions": {"next_experiment.motion.csv": motion}}
    tables = {"next_experiment.motion.csv": "run,time_s\na,0\n"}
    made = {"why": "w", "plan": None, **files, "tables": tables}
    core.answer = findings("ambiguous", next_experiment=made)
    write_runs(tmp_path)
    out = tmp_path / "o"
    run(tmp_path, "--joint", JOINT_FILE, "--out", out)
    assert (out / "next_experiment.motion.csv").read_text() == "run,time_s\na,0\n"
    found = made_in(out)
    assert found["next_experiment"] == {"why": "w", "plan": None, **files}
    assert "next_experiment.motion.csv" in found["files"]
    core.answer = findings("no_gap")
    run(tmp_path, "--joint", JOINT_FILE, "--out", out, "--force")
    assert not (out / "next_experiment.motion.csv").exists()


def test_options_reach_the_diagnosis(tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]) -> None:
    write_runs(tmp_path, numbers=(1,))
    limits = "travel_rad=-0.5:0.5, velocity_rad_s=1"
    asked = ("--without", "sensor_drift", "--given", "1=coulomb_friction", "--limits", limits)
    run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o", *asked)
    assert core.scopes[0].out == {(None, "sensor_drift"), (1, "coulomb_friction")}
    asked_limits = core.asked[0][1][1].motion_limits
    assert asked_limits is not None
    assert (asked_limits.travel_rad, asked_limits.velocity_rad_s) == ((-0.5, 0.5), 1.0)
    assert load_joint(tmp_path / "o" / "extended.joint.yaml").motion_limits is None  # not of the joint
    wrong = {
        "--without": ("gravity",),
        "--given": ("4=gravity",),
        "--trust": ("sensor_gain", "sensor_gain=5Nm", "gravity=5%"),
        "--limits": ("speed=1", "travel_rad=1", "travel_rad=1:-1", "velocity_rad_s=fast", "torque_nm=0"),
    }
    for option, text in ((option, text) for option, texts in wrong.items() for text in texts):
        with pytest.raises(SystemExit) as caught:
            run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "p", option, text)
        assert caught.value.code == 2
        assert f"argument {option}: " in capsys.readouterr().err


def test_limits_beyond_those_of_the_file_are_said(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path, numbers=(1,))
    core.answer = findings("insufficient_data", next_experiment={"why": "w.", "plan": None})
    limits = {"travel_rad": [-0.5, 0.5], "velocity_rad_s": 1.0}
    (tmp_path / "j.yaml").write_text(joint_text(motion_limits=limits))
    for asked, sentence in (
        ("travel_rad=-0.4:0.5,velocity_rad_s=0.5,torque_nm=5", ""),
        (
            "travel_rad=-0.4:0.6,velocity_rad_s=2,torque_nm=5",
            " --limits allows more than motion_limits of joint 1: travel_rad -0.4:0.6, the file -0.5:0.5; "
            "velocity_rad_s 2, the file 1.",
        ),
    ):
        options = ("--joint", tmp_path / "j.yaml", "--out", tmp_path / "o", "--limits", asked, "--force")
        run(tmp_path / "a.csv", *options)
        made = made_in(tmp_path / "o")
        assert made["next_experiment"]["why"] == f"w.{sentence}"


def test_a_towing_plan_says_that_it_does_not_keep_the_travel(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path)
    core.answer = findings("insufficient_data", next_experiment={"why": "w.", "plan": PLAN})
    for asked, told in (("velocity_rad_s=0.5", False), ("travel_rad=-1:1", True)):
        run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o", "--force", "--limits", asked)
        why = made_in(tmp_path / "o")["next_experiment"]["why"]
        assert ("travel_rad of --limits is not kept" in why) == told


def test_a_known_load_of_the_map_is_no_sensor(tmp_path: Path, core: Core) -> None:
    paths = write_runs(tmp_path, numbers=(1,))
    names = ("current_a", "motor_position_rad", "link_position_rad")
    mapping: dict[str, object] = {"time_s": "time_s"} | {f"j1.{name}": f"j1.{name}" for name in names}
    mapping["j1.load"] = {"torque_nm": "j1.torque_nm + 0"}
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(mapping))
    options = ("--columns", tmp_path / "map.yaml", "--joint", JOINT_FILE, "--out", tmp_path / "o")
    assert run(*paths, *options) == 3
    assert core.scopes[0].known_references == {1}


def test_nothing_is_overwritten_without_force(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]
) -> None:
    core.answer = findings("ambiguous", next_experiment={"why": "x", "plan": PLAN})
    write_runs(tmp_path)
    out = tmp_path / "o"
    call = (tmp_path / "a.csv", tmp_path / "b.csv.gz", "--joint", JOINT_FILE, "--out", out)
    run(*call)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    (out / "mine.txt").write_text("kept")
    capsys.readouterr()
    core.answer = findings("no_gap")
    assert run(*call) == 1
    assert "--force" in said(capsys)
    assert len(core.asked) == 1  # refused before the work, not after it
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.name != "mine.txt"} == before
    assert run(*call, "--force") == 0
    assert made_in(out)["verdict"] == "no_gap"
    assert not (out / "next_experiment.plan.yaml").exists()  # of the earlier diagnosis
    assert (out / "mine.txt").read_text() == "kept"


def test_an_input_is_not_overwritten(tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]) -> None:
    write_runs(tmp_path)
    mine = tmp_path / "o" / "extended.joint.yaml"
    mine.parent.mkdir()
    mine.write_bytes(JOINT_FILE.read_bytes())
    link = tmp_path / "link"
    link.symlink_to(mine.parent)
    for out in (mine.parent, link):
        assert run(tmp_path, "--joint", mine, "--out", out, "--force") == 1
        assert "found the input" in said(capsys)
    assert not core.asked
    assert mine.read_bytes() == JOINT_FILE.read_bytes()


def test_a_name_of_a_file_that_is_no_utf_8_costs_no_result(
    tmp_path: Path, core: Core, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_runs(tmp_path)
    odd = tmp_path / "j\udcff.yaml"
    odd.write_bytes(JOINT_FILE.read_bytes())
    runs, out = (tmp_path / "a.csv", tmp_path / "b.csv.gz"), tmp_path / "o"
    page = sys.modules["jtqd.sysid.diagnosis.report"]
    monkeypatch.setattr(page, "render", lambda findings: findings.provenance.command)
    assert run(*runs, "--joint", odd, "--out", out) == 3
    assert str(tmp_path / "j\\udcff.yaml") in made_in(out)["provenance"]["inputs"]
    assert "j\\udcff.yaml" in (out / "report.html").read_text()
    (tmp_path / "a.csv").rename(tmp_path / "a\udcff.csv")
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "p") == 1
    assert "a\\udcff.csv': found a name that is not UTF-8" in capsys.readouterr().err


def test_a_failure_on_the_way_leaves_the_earlier_results(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]
) -> None:
    write_runs(tmp_path)
    out = tmp_path / "o"
    call = (tmp_path / "a.csv", "--joint", JOINT_FILE, "--out", out, "--force")
    run(*call)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    core.answer = findings(causes=(cause("warp_core", 1, {"amplitude_nm": value(1.0)}),))
    capsys.readouterr()
    assert run(*call) == 1
    assert "warp_core" in said(capsys)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        ((), "--joint: missing"),
        (("--joint", "a.yaml", "--joint", "b.yaml"), "two files for all joints"),
        (("--joint", "1=a.yaml", "--joint", "1=b.yaml"), "two files of joint 1"),
        (("--joint", "1=a.yaml", "--joint", "b.yaml"), "expected either"),
    ],
)
def test_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], wanted: str
) -> None:
    write_runs(tmp_path, 1)
    assert run(tmp_path, "--out", tmp_path / "o", *arguments) == 2
    assert wanted in said(capsys)
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("arguments", [["--out", "o"], ["a.csv", "--joint", "j.yaml"], ["a.csv", "--what"]])
def test_usage_of_argparse(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    capsys.readouterr()


def test_the_help_names_the_files_of_the_next_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    """Written out there: the module that has the names needs scipy."""
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    assert PLAN_FILE in out
    assert MOTION_FILE in out


def joint_text(**changes: object) -> str:
    mapping = JOINT.to_mapping() | changes
    return yaml.safe_dump({key: item for key, item in mapping.items() if item is not None})


def test_joint_files_are_checked_before_runs_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def read(*_: object) -> None:
        raise AssertionError("read before the joint files were checked")

    monkeypatch.setattr("jtqd.sysid.diagnosis.command.read_runs", read)
    for joint, status in (("x=a.yaml", 2), (f"9={JOINT_FILE}", 2), ("1=none.yaml", 1), ("none.yaml", 1)):
        assert run("a.csv", "--joint", joint, "--out", tmp_path / "o") == status
        assert joint.rpartition("=")[2] in said(capsys)


def test_other_failures_are_one_line(tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]) -> None:
    paths = write_runs(tmp_path, 2)
    (tmp_path / "void").mkdir()
    (tmp_path / "file").write_text("x")
    (tmp_path / "run.txt").write_text("x")
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP nonsense")
    (tmp_path / "twin.csv").write_bytes(paths[0].read_bytes())
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "wrong.yaml").write_text(joint_text(effects=[{"name": "warp_core", "parameters": {}}]))
    ready = ("--joint", JOINT_FILE, "--out", tmp_path / "o")
    for arguments, wanted in (
        ((tmp_path / "absent.csv", *ready), "found no such file or directory"),
        ((tmp_path / "void", *ready), "no run file in it"),
        ((tmp_path / "run.txt", *ready), "ending in '.txt'"),
        ((tmp_path / "bad.mcap", *ready), "not a readable MCAP file"),
        ((paths[0], tmp_path / "twin.csv", *ready), "same data as in a.csv"),
        ((tmp_path / "empty.csv", *ready), "empty file"),
        ((paths[0], "--joint", tmp_path / "wrong.yaml", "--out", tmp_path / "o"), "warp_core"),
        ((paths[0], "--joint", tmp_path / "absent.yaml", "--out", tmp_path / "o"), "cannot be read"),
        ((paths[0], "--joint", f"3={JOINT_FILE}", "--out", tmp_path / "o"), "no columns of j3"),
        ((paths[0], "--joint", JOINT_FILE, "--out", tmp_path / "file"), "it is a file"),
        ((paths[0], "--columns", tmp_path / "absent.yaml", *ready), "cannot be read"),
    ):
        assert run(*arguments) == 1
        assert wanted in said(capsys)
    assert core.asked == []


def only(folder: Path, change: Callable[[RunTable], RunTable]) -> Path:
    folder.mkdir()
    for k in range(2):
        write_run(folder / f"{k}.csv", change(bench_run(phase=0.7 * k)))
    return folder


def without_sensor(table: RunTable) -> RunTable:
    return RunTable(table.time_s, {n: replace(c, torque_nm=None) for n, c in table.joints.items()})


def in_millinewtonmetres(table: RunTable) -> RunTable:
    made = {}
    for number, columns in table.joints.items():
        assert columns.torque_nm is not None
        made[number] = replace(columns, torque_nm=1000.0 * columns.torque_nm)
    return RunTable(table.time_s, made)


def in_milliseconds(table: RunTable) -> RunTable:
    return RunTable(1000.0 * table.time_s, table.joints)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (without_sensor, "no valid torque sensor channel"),
        (in_millinewtonmetres, "mNm suspected"),
        (in_milliseconds, "milliseconds"),
    ],
)
def test_runs_that_cannot_be_used_are_insufficient_data_with_the_reason(
    tmp_path: Path, core: Core, change: Callable[[RunTable], RunTable], wanted: str
) -> None:
    status, made = diagnosed(only(tmp_path / "runs", change))
    assert (status, made["verdict"]) == (3, "insufficient_data")
    assert any(wanted in reason for reason in made["reasons"])
    assert made["causes"] == []
    assert core.asked == []
    assert load_joint(tmp_path / "out" / "extended.joint1.yaml").effects == ()


def test_a_joint_file_of_another_joint_is_insufficient_data(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path)
    write_joint(tmp_path / "j.yaml", replace(JOINT, gear_ratio=160.0), "t")
    assert run(tmp_path, "--joint", tmp_path / "j.yaml", "--out", tmp_path / "o") == 3
    made = made_in(tmp_path / "o")
    assert made["verdict"] == "insufficient_data"
    assert "wrong gear ratio" in made["reasons"][0]


def test_no_gap_is_not_said_of_a_joint_that_could_not_be_judged(tmp_path: Path, core: Core) -> None:
    def one_bad(table: RunTable) -> RunTable:
        return RunTable(table.time_s, {**table.joints, 1: in_millinewtonmetres(table).joints[1]})

    core.answer = findings("no_gap")
    status, made = diagnosed(only(tmp_path / "runs", one_bad))
    assert list(core.asked[0][1]) == [2]
    assert (status, made["verdict"]) == (3, "insufficient_data")
    assert "joint 1" in made["reasons"][0]
    assert any("mNm" in note for note in made["channel_notes"])


def test_one_bad_run_is_left_out_and_noted(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path, 2)
    write_run(tmp_path / "z.csv", in_millinewtonmetres(bench_run(phase=2.0)))
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    assert [name for name, _ in core.asked[0][0]] == ["a.csv", "b.csv.gz"]
    made = made_in(tmp_path / "o")
    assert made["verdict"] == "cause"
    assert any(note.startswith("z.csv: j1.torque_nm") for note in made["channel_notes"])


@pytest.mark.parametrize(("bad", "good"), [(2, 3), (2, 2), (3, 2)])
def test_fewer_than_half_of_the_recordings_may_be_left_out(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str], bad: int, good: int
) -> None:
    """A load or a joint file that most runs contradict is not judged by the others; one line for the runs alike."""
    judged = bad < good
    write_runs(tmp_path, good)
    for k in range(bad):
        write_run(tmp_path / f"z{k}.csv", in_millinewtonmetres(bench_run(phase=2.0 + k)))
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    out, err = capsys.readouterr()
    made = made_in(tmp_path / "o")
    assert made["verdict"] == ("cause" if judged else "insufficient_data")
    assert len(core.asked) == judged
    text = out + err
    assert text.count("mNm suspected") == 2  # joints 1 and 2
    assert text.count(f"the same in {bad} runs: z0.csv, z1.csv") == 2
    if not judged:
        assert made["reasons"][0].startswith(
            f"joint 1: found {bad} of {bad + good} recordings that cannot be used"
        )
        assert "mNm" not in err


def segment(table: RunTable, keep: BoolArray) -> RunTable:
    joints = {number: columns.map(lambda _, x: x[keep]) for number, columns in table.joints.items()}
    return RunTable(table.time_s[keep], joints)


def test_a_piece_that_cannot_be_used_is_no_recording(tmp_path: Path, core: Core) -> None:
    """Of a recording with a gap one piece may be without the sensor's torque; the other one is used."""
    for k in range(2):
        table = bench_run(phase=0.7 * k, seconds=6.0)
        keep = (table.time_s < 2.5) | (table.time_s > 3.0)
        joints = {}
        for number, columns in table.joints.items():
            assert columns.torque_nm is not None
            held = np.where(table.time_s > 3.0, 5.0, columns.torque_nm)
            joints[number] = replace(columns, torque_nm=held)
        write_run(tmp_path / f"{k}.csv", segment(RunTable(table.time_s, joints), keep))
    run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o")
    assert [name for name, _ in core.asked[0][0]] == ["0.csv (1 of 2)", "1.csv (1 of 2)"]
