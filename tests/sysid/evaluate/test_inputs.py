"""`jtq evaluate`: trained-on runs are refused; broken runs and missing models are left out by name."""

from __future__ import annotations

import gzip
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.run import RunTable
from jtqd.models.files import load_joint
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
    models: Path, one: Path, two: Path, *, tmp_path: Path, capsys: pytest.CaptureFixture[str], copy: str
) -> None:
    unpacked = gzip.decompress(two.read_bytes())
    content, trained_on = {
        "unpacked": (unpacked, two.read_bytes()),
        "packed again": (gzip.compress(unpacked, 1), unpacked),
    }.get(copy, (two.read_bytes(), two.read_bytes()))
    run = tmp_path / {"itself": two.name, "unpacked": "held_out.csv"}.get(copy, "held_out.csv.gz")
    run.write_bytes(content)
    runs = {"variable_2": hashlib.sha256(trained_on).hexdigest()}
    (models / "joint2.fused.onnx").write_bytes(fused_network("joint2", runs=runs))
    assert evaluate(tmp_path, [one, run], models=models) == 1
    error = capsys.readouterr().err
    assert run.name in error
    assert "joint2.fused.onnx" in error
    assert "variable_1" not in error
    assert not (tmp_path / "out" / "evaluation.json").exists()


def test_a_run_that_a_joint_file_was_fitted_to_is_refused_also_outside(
    models: Path, one: Path, two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint, runs = load_joint(models / "joint1.yaml"), {"any": read_run(one).sha256}
    fitted = with_fit(joint, "efficiency", by="a test", runs=runs, date="2026-01-01")
    write_joint(models / "joint1.yaml", fitted, "of a test")
    for arguments in ([one], [two, "--outside", str(one)]):
        assert evaluate(tmp_path, arguments[:1], *arguments[1:], models=models) == 1
        error = capsys.readouterr().err
        assert "variable_1.csv.gz" in error
        assert "joint1.yaml (efficiency)" in error
    assert evaluate(tmp_path, [two], models=models) == 0


def test_a_network_that_names_no_training_runs_is_a_finding(models: Path, one: Path, tmp_path: Path) -> None:
    (models / "joint1.onnx").write_bytes(paper_network("joint1", runs=None))
    assert evaluate(tmp_path, [one], models=models) == 3
    assert [item["kind"] for item in report(tmp_path / "out")["findings"]] == ["training_runs_unknown"]
    # its card beside it names them: no finding, and a leak is seen
    for sha256, status in (("f" * 64, 0), (read_run(one).sha256, 1)):
        (models / "joint1.json").write_text(json.dumps({"runs": {"other.csv": sha256}}))
        assert evaluate(tmp_path, [one], models=models) == status


# Broken runs, missing models -----------------------------------------------------------------------------


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
    bench: Path, one: Path, *, tmp_path: Path, kind: str, changes: dict[str, Any]
) -> None:
    table, broken = read_run(one).table, tmp_path / "broken.csv"
    joint = table.joints[1]
    joint = replace(joint, **{name: change(getattr(joint, name)) for name, change in changes.items()})
    write_run(broken, RunTable(table.time_s, {**table.joints, 1: joint}))
    (run,), findings, _ = read_inputs([broken], load_models(bench / "models"))
    assert {item.kind for item in findings} == {kind}
    assert all("broken.csv" in item.text and "j1" in item.text for item in findings)
    assert sorted(run.columns) == [2]


def test_nan_and_copies_are_left_out_by_name(bench: Path, two: Path, tmp_path: Path) -> None:
    copy, gaps = tmp_path / "copy.csv.gz", tmp_path / "gaps.csv"
    shutil.copy(two, copy)
    lines = gzip.decompress(two.read_bytes()).decode().splitlines()
    lines[7] = lines[7].rsplit(",", 1)[0] + ",nan"
    gaps.write_text("\n".join(lines))
    assert evaluate(bench, [two, copy, gaps], "--out", str(tmp_path / "out")) == 3
    content = report(tmp_path / "out")
    assert sorted(item["kind"] for item in content["findings"]) == ["twice", "unreadable"]
    assert "line 8" in str(content["findings"])
    assert "gaps.csv" in (tmp_path / "out" / "evaluation.html").read_text()
    assert [run["name"] for run in content["runs"]] == ["variable_2.csv.gz"]


def test_nothing_left_is_a_failure(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.csv"
    broken.write_text("time_s,j1.current_a\n0,1\n0.001,nan\n")
    assert evaluate(bench, [broken], "--out", str(tmp_path / "out")) == 1
    assert "line 3, column 'j1.current_a': found 'nan'" in capsys.readouterr().err
    assert evaluate(bench, [tmp_path / "absent.csv"], "--out", str(tmp_path / "out")) == 1
    assert "absent.csv" in capsys.readouterr().err


def test_a_joint_that_never_moves_is_named(bench: Path, one: Path, two: Path, tmp_path: Path) -> None:
    table = read_run(one).table
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
    assert evaluate(bench, [two, tmp_path / "still.csv"], "--out", str(tmp_path / "out")) == 3
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
    models: Path, one: Path, *, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, words: str
) -> None:
    change(models)
    assert evaluate(tmp_path, [one], "--joint", "1", models=models) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_samples_and_plateaus_without_a_value_are_named(bench: Path, models: Path, tmp_path: Path) -> None:
    """A joint rated 10 Nm publishes nothing above 30 Nm: the heavy plateau is in no score, which is a finding."""
    joint = load_joint(models / "joint1.yaml")
    write_joint(models / "joint1.yaml", replace(joint, rated_torque_nm=10.0), "of a test")
    run = bench / "runs" / "constant_1.csv.gz"
    assert evaluate(tmp_path, [run], "--joint", "1", models=models) == 3
    content = report(tmp_path / "out")
    kinds = {item["kind"]: item["text"] for item in content["findings"]}
    assert set(kinds) == {"no_value", "plateau_lost"}
    assert "no value of classical TOB" in kinds["no_value"]
    assert [round(p["velocity_rad_s"], 1) for p in content["constant"]["plateaus"]] == [-1.5]


def test_ours_without_a_network_is_the_physics_of_ours_with_one(models: Path, one: Path) -> None:
    with_network = load_models(models)
    (run,) = read_inputs([one], with_network).runs
    for n in (1, 2):
        (models / f"joint{n}.fused.onnx").unlink()
    without = load_models(models)
    for both, alone in zip(with_network, without, strict=True):
        assert {"physics", "fused"} <= {*both.methods}
        assert {"physics", "fused"} & {*alone.methods} == {"fused"}
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
