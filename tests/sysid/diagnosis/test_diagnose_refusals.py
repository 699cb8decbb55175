"""`jtq diagnose` and what it cannot use: one clear line, or insufficient_data with the reason; nothing written by halves."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from jtqd.estimator.run import RunTable
from jtqd.models.files import load_joint
from jtqd.sysid.diagnosis.command import main
from jtqd.sysid.fit.joint_writer import write_joint
from jtqd.sysid.runs.files import write_run
from tests.sysid.diagnosis.diagnose_helpers import (
    JOINT,
    JOINT_FILE,
    Core,
    bench_run,
    findings,
    run,
    said,
    stand_in,
    write_runs,
)


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Core:
    return stand_in(monkeypatch)


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


def cell(text: str, row: int, column: int, content: str) -> str:
    lines = text.splitlines()
    cells = lines[row].split(",")
    cells[column] = content
    lines[row] = ",".join(cells)
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [
        (lambda text: "", "empty file"),
        (lambda text: text.splitlines()[0] + "\n", "0 samples"),
        (lambda text: cell(text, 5, 1, "nan"), "line 6, column 'j1.current_a': found 'nan'"),
        (lambda text: cell(text, 7, 2, "12,5"), "line 8: found"),
        (lambda text: cell(text, 9, 1, "1.5 A"), "line 10, column 'j1.current_a': found '1.5 A'"),
        (lambda text: cell(text, 9, 0, "0.001"), "expected rising time"),
        (lambda text: text.replace("time_s", "Time"), "no column 'time_s'"),
        (lambda text: "\n".join([*text.splitlines()[:800], *text.splitlines()[1500:]]) + "\n", "found a gap"),
    ],
)
def test_bad_run_files(
    tmp_path: Path,
    core: Core,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[str], str],
    wanted: str,
) -> None:
    path = write_runs(tmp_path, 1)[0]
    path.write_text(spoil(path.read_text()))
    assert run(path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 1
    err = said(capsys)
    assert wanted in err
    assert str(path) in err
    assert list((tmp_path / "o").iterdir()) == []
    assert core.asked == []


def joint_text(**changes: object) -> str:
    mapping = JOINT.to_mapping() | changes
    return yaml.safe_dump({key: item for key, item in mapping.items() if item is not None})


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (joint_text(gear_ration=100.0), "did you mean 'gear_ratio'"),
        (joint_text(gear_ratio="hundred"), "gear_ratio"),
        (joint_text(effects=[{"name": "warp_core", "parameters": {}}]), "warp_core"),
        ("- 1\n", "expected a mapping"),
        ("a: [", "not YAML"),
    ],
)
def test_bad_joint_files(
    tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str], text: str, wanted: str
) -> None:
    write_runs(tmp_path, 1)
    path = tmp_path / "j.yaml"
    path.write_text(text)
    assert run(tmp_path, "--joint", path, "--out", tmp_path / "o") == 1
    err = said(capsys)
    assert wanted in err
    assert str(path) in err


def test_other_failures_are_one_line(tmp_path: Path, core: Core, capsys: pytest.CaptureFixture[str]) -> None:
    paths = write_runs(tmp_path, 2)
    (tmp_path / "void").mkdir()
    (tmp_path / "file").write_text("x")
    (tmp_path / "run.txt").write_text("x")
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP nonsense")
    (tmp_path / "twin.csv").write_bytes(paths[0].read_bytes())
    ready = ("--joint", JOINT_FILE, "--out", tmp_path / "o")
    for arguments, wanted in (
        ((tmp_path / "absent.csv", *ready), "found nothing there"),
        ((tmp_path / "void", *ready), "no run file in it"),
        ((tmp_path / "run.txt", *ready), "ending in '.txt'"),
        ((tmp_path / "bad.mcap", *ready), "not a readable MCAP file"),
        ((paths[0], tmp_path / "twin.csv", *ready), "same data as in a.csv"),
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
        (without_sensor, "no torque sensor channel"),
        (in_millinewtonmetres, "mNm suspected"),
        (in_milliseconds, "milliseconds"),
    ],
)
def test_runs_that_cannot_be_used_are_insufficient_data_with_the_reason(
    tmp_path: Path, core: Core, change: Callable[[RunTable], RunTable], wanted: str
) -> None:
    folder = only(tmp_path / "runs", change)
    assert run(folder, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    made = json.loads((tmp_path / "o" / "findings.json").read_text())
    assert made["verdict"] == "insufficient_data"
    assert any(wanted in reason for reason in made["reasons"])
    assert made["causes"] == []
    assert core.asked == []
    assert load_joint(tmp_path / "o" / "extended.joint.yaml").effects == ()


def test_a_joint_file_of_another_joint_is_insufficient_data(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path)
    write_joint(tmp_path / "j.yaml", replace(JOINT, gear_ratio=160.0), "t")
    assert run(tmp_path, "--joint", tmp_path / "j.yaml", "--out", tmp_path / "o") == 3
    made = json.loads((tmp_path / "o" / "findings.json").read_text())
    assert made["verdict"] == "insufficient_data"
    assert "wrong gear ratio" in made["reasons"][0]


def test_no_gap_is_not_said_of_a_joint_that_could_not_be_judged(tmp_path: Path, core: Core) -> None:
    def one_bad(table: RunTable) -> RunTable:
        return RunTable(table.time_s, {**table.joints, 1: in_millinewtonmetres(table).joints[1]})

    folder = only(tmp_path / "runs", one_bad)
    core.answer = findings("no_gap")
    assert run(folder, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    made = json.loads((tmp_path / "o" / "findings.json").read_text())
    assert list(core.asked[0][1]) == [2]
    assert made["verdict"] == "insufficient_data"
    assert "joint 1" in made["reasons"][0]
    assert any("mNm" in note for note in made["channel_notes"])


def test_one_bad_run_is_left_out_and_noted(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path, 2)
    write_run(tmp_path / "z.csv", in_millinewtonmetres(bench_run(phase=2.0)))
    assert run(tmp_path, "--joint", JOINT_FILE, "--out", tmp_path / "o") == 3
    assert [name for name, _ in core.asked[0][0]] == ["a.csv", "b.csv.gz"]
    made = json.loads((tmp_path / "o" / "findings.json").read_text())
    assert made["verdict"] == "cause"
    assert any(note.startswith("z.csv: j1.torque_nm") for note in made["channel_notes"])
