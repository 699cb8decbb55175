"""`jtq evaluate`: trained-on runs are refused; broken runs and missing models are left out by name."""

from __future__ import annotations

import gzip
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.run import RunTable
from jtqd.models.files import load_joint
from jtqd.sysid.evaluate.command import main
from jtqd.sysid.evaluate.inputs import by_marks, load_models, read_inputs
from jtqd.sysid.fit.joint_writer import with_fit, write_joint
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.tables import write_run
from tests.sysid.evaluate.evaluate_helpers import (
    NO_PICTURES,
    evaluate,
    fused_network,
    paper_network,
    report,
)

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jtqd.sysid.evaluate.report.pictures", lambda result: NO_PICTURES)


# Leaks ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copy", ["itself", "renamed", "unpacked", "packed again"])
def test_a_run_that_a_network_was_trained_on_is_refused(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], copy: str
) -> None:
    models = tmp_path / "models"
    shutil.copytree(bench / "models", models)
    seen = bench / "runs" / "variable_2.csv.gz"
    sha256 = read_run(seen).sha256
    run = tmp_path / {"itself": seen.name, "renamed": "held_out.csv.gz"}.get(copy, "held_out.csv")
    if copy in ("unpacked", "packed again"):
        run.write_bytes(gzip.decompress(seen.read_bytes()))
    else:
        shutil.copy(seen, run)
    if copy == "packed again":
        sha256 = read_run(run).sha256  # the network saw the unpacked one
        packed = run.with_name("again.csv.gz")
        packed.write_bytes(gzip.compress(run.read_bytes(), 1))
        run = packed
    (models / "joint2.fused.onnx").write_bytes(fused_network("joint2", runs={"variable_2": sha256}))
    assert evaluate(tmp_path, [bench / "runs" / "variable_1.csv.gz", run], models=models) == 1
    error = capsys.readouterr().err
    assert run.name in error
    assert "joint2.fused.onnx" in error
    assert "variable_1" not in error
    assert not (tmp_path / "out" / "evaluation.json").exists()


def test_a_run_that_a_joint_file_was_fitted_to_is_refused_also_outside(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = tmp_path / "models"
    shutil.copytree(bench / "models", models)
    runs = [bench / "runs" / f"variable_{n}.csv.gz" for n in (1, 2)]
    fitted = with_fit(
        load_joint(models / "joint1.yaml"),
        "efficiency",
        by="a test",
        runs={"any": read_run(runs[0]).sha256},
        date="2026-01-01",
    )
    write_joint(models / "joint1.yaml", fitted, "of a test")
    for arguments in ([str(runs[0])], [str(runs[1]), "--outside", str(runs[0])]):
        assert main([*arguments, "--models", str(models), "--out", str(tmp_path / "out")]) == 1
        error = capsys.readouterr().err
        assert "variable_1.csv.gz" in error
        assert "joint1.yaml (efficiency)" in error
    assert main([str(runs[1]), "--models", str(models), "--out", str(tmp_path / "out")]) == 0


def test_a_network_that_names_no_training_runs_is_a_finding(bench: Path, tmp_path: Path) -> None:
    models = tmp_path / "models"
    shutil.copytree(bench / "models", models)
    (models / "joint1.onnx").write_bytes(paper_network("joint1", runs=None))
    run = bench / "runs" / "variable_1.csv.gz"
    assert evaluate(tmp_path, [run], models=models) == 3
    assert [item["kind"] for item in report(tmp_path / "out")["findings"]] == ["training_runs_unknown"]
    # its card beside it names them: no finding, and a leak is seen
    (models / "joint1.json").write_text(json.dumps({"runs": {"other.csv": "f" * 64}}))
    assert evaluate(tmp_path, [run], models=models) == 0
    (models / "joint1.json").write_text(json.dumps({"runs": {"this.csv": read_run(run).sha256}}))
    assert evaluate(tmp_path, [run], models=models) == 1


# Broken runs, missing models -----------------------------------------------------------------------------


def _changed(bench: Path, **changes: Any) -> RunTable:
    """variable_1 with columns of joint 1 changed."""
    table = read_run(bench / "runs" / "variable_1.csv.gz").table
    joints = dict(table.joints)
    joints[1] = replace(
        joints[1], **{name: change(getattr(joints[1], name)) for name, change in changes.items()}
    )
    return RunTable(table.time_s, joints)


def _stuck(column: np.ndarray) -> np.ndarray:
    column = column.copy()
    column[1500:3000] = column[1500]
    return column


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("dead_channel", {"torque_nm": np.zeros_like}),
        ("torque_nm_stuck", {"torque_nm": _stuck}),
        ("torque_nm_sign", {"torque_nm": np.negative}),
        ("current_a_sign", {"current_a": np.negative}),
        ("motor_velocity_rad_s_sign", {"motor_velocity_rad_s": np.negative}),
        ("missing_columns", {"link_position_rad": lambda column: None}),
        ("gear_ratio", {"link_position_rad": lambda column: 1.1 * column}),
    ],
)
def test_a_broken_channel_is_named_and_its_joint_left_out(
    bench: Path, tmp_path: Path, kind: str, changes: dict[str, Any]
) -> None:
    good = bench / "runs" / "variable_2.csv.gz"
    broken = tmp_path / "broken.csv"
    write_run(broken, _changed(bench, **changes))
    assert evaluate(bench, [good, broken], "--out", str(tmp_path / "out")) == 3
    content = report(tmp_path / "out")
    assert {item["kind"] for item in content["findings"]} == {kind}
    assert all("broken.csv" in item["text"] and "j1" in item["text"] for item in content["findings"])
    joints = {run["name"]: sorted(run["joints"]) for run in content["runs"]}
    assert joints == {"variable_2.csv.gz": ["1", "2"], "broken.csv": ["2"]}
    assert "broken.csv" in (tmp_path / "out" / "evaluation.html").read_text()


def test_nan_and_copies_are_left_out_by_name(bench: Path, tmp_path: Path) -> None:
    good = bench / "runs" / "variable_2.csv.gz"
    copy, gaps = tmp_path / "copy.csv.gz", tmp_path / "gaps.csv"
    shutil.copy(good, copy)
    lines = gzip.decompress(good.read_bytes()).decode().splitlines()
    lines[7] = lines[7].rsplit(",", 1)[0] + ",nan"
    gaps.write_text("\n".join(lines))
    assert evaluate(bench, [good, copy, gaps], "--out", str(tmp_path / "out")) == 3
    content = report(tmp_path / "out")
    assert sorted(item["kind"] for item in content["findings"]) == ["twice", "unreadable"]
    assert "line 8" in str(content["findings"])
    assert [run["name"] for run in content["runs"]] == ["variable_2.csv.gz"]


def test_nothing_left_is_a_failure(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.csv"
    broken.write_text("time_s,j1.current_a\n0,1\n0.001,nan\n")
    assert evaluate(bench, [broken], "--out", str(tmp_path / "out")) == 1
    assert "line 3, column 'j1.current_a': found 'nan'" in capsys.readouterr().err
    assert evaluate(bench, [tmp_path / "absent.csv"], "--out", str(tmp_path / "out")) == 1
    assert "absent.csv" in capsys.readouterr().err


def test_a_joint_that_never_moves_is_named(bench: Path, tmp_path: Path) -> None:
    table = read_run(bench / "runs" / "variable_1.csv.gz").table
    seed = 3
    rng = np.random.default_rng(seed)
    still = {
        number: replace(
            columns,
            current_a=rng.normal(0.0, 0.01, len(table.time_s)),
            motor_position_rad=np.full(len(table.time_s), 1.0),
            motor_velocity_rad_s=np.zeros(len(table.time_s)),
            link_position_rad=np.full(len(table.time_s), 0.01),
            torque_nm=rng.normal(0.0, 0.02, len(table.time_s)),
        )
        for number, columns in table.joints.items()
    }
    write_run(tmp_path / "still.csv", RunTable(table.time_s, still))
    good = bench / "runs" / "variable_2.csv.gz"
    assert evaluate(bench, [good, tmp_path / "still.csv"], "--out", str(tmp_path / "out")) == 3
    found = report(tmp_path / "out")["findings"]
    assert [item["kind"] for item in found] == ["nothing_to_score"] * 2, seed
    assert "standstill" in found[0]["text"]


def test_methods_without_their_files_are_left_out_and_named(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = tmp_path / "models"
    models.mkdir()
    joint = load_joint(bench / "models" / "joint1.yaml")
    write_joint(models / "joint1.yaml", replace(joint, fused=None), "of a test")
    runs = [bench / "runs" / "variable_1.csv.gz", bench / "runs" / "constant_1.csv.gz"]
    assert evaluate(tmp_path, runs, models=models) == 0
    content = report(tmp_path / "out")
    assert list(content["methods"]) == ["tob", "efficiency"]
    assert set(content["models"][0]["missing"]) == {"network", "physics", "fused"}
    text = capsys.readouterr().out
    assert "without the paper's chain: no joint1.onnx" in text
    assert "without ours" in text
    targets = {target["key"]: target["reached"] for target in content["figures_to_reach"]}
    unknown = {key for key, reached in targets.items() if reached is None}
    assert unknown == set(targets) - {"tob_mse"}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (shutil.rmtree, "found no directory"),
        (lambda d: (d / "joint1.yaml").unlink(), "expected joint1.yaml"),
        (lambda d: (d / "joint1.onnx").write_bytes(b"no network"), "not a usable ONNX model"),
        (
            lambda d: (d / "joint1.onnx").write_bytes(paper_network("joint2")),
            "joint1.onnx: found a network of joint 'joint2'",
        ),
        (lambda d: (d / "joint1.yaml").write_text("name: 3"), "joint1.yaml"),
    ],
)
def test_models_that_cannot_be_used_are_a_failure_in_one_line(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, words: str
) -> None:
    models = tmp_path / "models"
    shutil.copytree(bench / "models", models)
    change(models)
    run = bench / "runs" / "variable_1.csv.gz"
    assert evaluate(tmp_path, [run], "--joint", "1", models=models) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_samples_and_plateaus_without_a_value_are_named(bench: Path, tmp_path: Path) -> None:
    """A joint rated 10 Nm publishes nothing above 30 Nm: the heavy plateau is in no score, which is a finding."""
    models = tmp_path / "models"
    shutil.copytree(bench / "models", models)
    joint = load_joint(models / "joint1.yaml")
    write_joint(models / "joint1.yaml", replace(joint, rated_torque_nm=10.0), "of a test")
    run = bench / "runs" / "constant_1.csv.gz"
    assert evaluate(tmp_path, [run], "--joint", "1", models=models) == 3
    content = report(tmp_path / "out")
    kinds = {item["kind"]: item["text"] for item in content["findings"]}
    assert set(kinds) == {"no_value", "plateau_lost"}
    assert "no value of classical TOB" in kinds["no_value"]
    assert [round(p["velocity_rad_s"], 1) for p in content["constant"]["plateaus"]] == [-1.5]


def test_ours_without_a_network_is_the_physics_of_ours_with_one(bench: Path, tmp_path: Path) -> None:
    models = tmp_path / "models"
    shutil.copytree(bench / "models", models)
    with_network = load_models(models)
    (run,) = read_inputs([bench / "runs" / "variable_1.csv.gz"], with_network).runs
    for n in (1, 2):
        (models / f"joint{n}.fused.onnx").unlink()
    without = load_models(models)
    for both, alone in zip(with_network, without, strict=True):
        assert {"physics", "fused"} <= {*both.methods}
        assert "fused" in alone.methods
        assert "physics" not in alone.methods
        assert "physics" in alone.missing
        time_s, columns = run.table.time_s, run.columns[both.number]
        expected, found = (each.estimate(time_s, columns)[0] for each in (both, alone))
        assert np.isfinite(found["fused"].torque_nm).mean() > 0.9
        np.testing.assert_array_equal(found["fused"].torque_nm, expected["physics"].torque_nm)


@pytest.mark.parametrize(
    ("text", "number"),
    [('{"velocity_joint": 2}', 2), ('{"velocity_joint": true}', None), ("no JSON", None), (None, None)],
)
def test_the_marks_of_a_campaign_name_the_velocity_joint(
    tmp_path: Path, text: str | None, number: int | None
) -> None:
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    assert by_marks(tmp_path / "run.csv.gz") == number
