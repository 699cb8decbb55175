"""`jtq evaluate` on small emulated runs: numbers against an independent computation, and the report."""

from __future__ import annotations

import html.parser
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.network import load_network
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import RunTable
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import DEGRADED, VALID
from jtqd.models.files import load_joint
from jtqd.sysid.evaluate.command import main
from jtqd.sysid.evaluate.evaluation import Target
from jtqd.sysid.evaluate.report import as_mapping, report_html
from jtqd.sysid.runs.files import read_run
from jtqd.sysid.runs.tables import write_run
from tests.sysid.evaluate.evaluate_helpers import NO_PICTURES, evaluate, report
from tests.sysid.evaluate.test_evaluation import EMPTY

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def judged(bench: Path) -> tuple[dict[str, Any], str]:
    """The evaluation of all runs: JSON and HTML."""
    out = bench / "report"
    assert main([str(bench / "runs"), "--models", str(bench / "models"), "--out", str(out)]) == 0
    return report(out), (out / "evaluation.html").read_text()


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only `judged`, which is made before this, draws."""
    monkeypatch.setattr("jtqd.sysid.evaluate.report.pictures", lambda result: NO_PICTURES)


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ((None, None), "These runs decide no target of the paper's bench</strong>:"),
        ((None, False), "0 of 1 targets of the paper's bench reached</strong>, 1 not known from these runs:"),
        ((True, False), "1 of 2 targets of the paper's bench reached</strong>:"),
    ],
)
def test_a_target_that_runs_do_not_decide_is_not_missed(states: tuple[bool | None, ...], words: str) -> None:
    """Those of one's own joint: the targets have the torques of another."""
    rows = tuple(Target(f"k{n}", "figure", "-", "at most 1", "2", each) for n, each in enumerate(states))
    result = replace(EMPTY, targets=rows)
    text = report_html(result, as_mapping(result), "made by a test")
    assert words in text.replace("&#39;", "'")
    assert 'class="box warn"' not in text


def by_hand(bench: Path, name: str, number: int) -> dict[str, tuple[float, int]]:
    """MSE and samples of every method in one run, from the estimators and another filter than the evaluation's."""
    table = read_run(bench / "runs" / name).table
    joint = load_joint(bench / "models" / f"joint{number}.yaml")
    columns = table.joint(number, joint.gear_ratio)
    assert columns.torque_nm is not None
    runs, sensors = {}, {}
    for method in ("tob", "efficiency", "network", "physics", "fused"):
        own = "fused" if method == "physics" else method
        file = {"network": f"joint{number}.onnx", "fused": f"joint{number}.fused.onnx"}.get(method)
        network = None if file is None else load_network(own, str(bench / "models" / file))
        tracked = own == "fused"
        settings = EstimatorSettings(method=own, track_torsion=tracked, track_zeros=tracked)
        runs[method] = estimate_columns(joint, settings, network, table.time_s, columns)
        sensors[method] = columns.torque_nm if tracked else low_pass(columns.torque_nm, table.dt_s, 200.0)
    keep = table.time_s >= 0.1
    for run in runs.values():
        keep &= np.isfinite(run.torque_nm) & ((run.status == VALID) | (run.status == DEGRADED))
    return {
        method: (float(np.mean((run.torque_nm - sensors[method])[keep] ** 2)), int(keep.sum()))
        for method, run in runs.items()
    }


def test_scores_are_those_of_the_estimators_on_the_samples_all_of_them_have(
    bench: Path, judged: tuple[dict[str, Any], str]
) -> None:
    content, _ = judged
    expected = {(n, j): by_hand(bench, f"variable_{n}.csv.gz", j) for n in (1, 2) for j in (1, 2)}
    for (n, j), methods in expected.items():
        (record,) = [run for run in content["runs"] if run["name"] == f"variable_{n}.csv.gz"]
        for method, (mse, count) in methods.items():
            found = record["joints"][str(j)]["errors"][method]
            assert found["mse_nm2"] == pytest.approx(mse, rel=1e-6), (n, j, method)
            assert found["samples"] == count

    def pooled(method: str, keys: list[tuple[int, int]]) -> float:
        parts = [expected[key][method] for key in keys]
        return sum(mse * count for mse, count in parts) / sum(count for _, count in parts)

    for method in content["methods"]:
        tested = content["variable"]["tested"][method]["mse_nm2"]
        assert tested == pytest.approx(pooled(method, [(1, 1), (2, 2)]), rel=1e-6)
        assert content["variable"]["both"][method]["mse_nm2"] == pytest.approx(
            pooled(method, list(expected)), rel=1e-6
        )
    ratio = pooled("tob", [(1, 1), (2, 2)]) / pooled("network", [(1, 1), (2, 2)])
    assert content["variable"]["ratios"]["tested"]["tob_to_paper"] == pytest.approx(ratio, rel=1e-6)


def test_kinds_of_runs_and_their_velocity_joints_are_found(judged: tuple[dict[str, Any], str]) -> None:
    content, _ = judged
    found = {
        run["name"]: (run["kind"], run["velocity_joint"], run["velocity_joint_by"]) for run in content["runs"]
    }
    assert found["variable_1.csv.gz"] == ("variable", 1, "data")
    assert found["variable_2.csv.gz"] == ("variable", 2, "data")
    assert found["constant_1.csv.gz"][:2] == ("constant", 1)


def test_both_plateaus_are_scored_for_both_joints(judged: tuple[dict[str, Any], str]) -> None:
    content, _ = judged
    plateaus = content["constant"]["plateaus"]
    drives = {(p["number"], round(p["velocity_rad_s"], 1)): p["drive"] for p in plateaus}
    assert drives == {(1, 2.5): "forward", (2, -2.5): "back", (1, -1.5): "forward", (2, 1.5): "back"}
    for p in plateaus:
        assert p["rated_percent"]["tob"] == pytest.approx(100 * abs(p["errors_nm"]["tob"]) / 40.0)
        assert p["percent"]["tob"] == pytest.approx(100 * abs(p["errors_nm"]["tob"] / p["torque_nm"]))
    # the classical TOB knows nothing of the load: many percent; the efficiency, of which the bench is made, few
    (hard,) = [
        p for p in plateaus if p["number"] == 2 and p["drive"] == "back" and abs(p["velocity_rad_s"]) > 2
    ]
    assert hard["percent"]["tob"] > 10.0
    assert hard["percent"]["efficiency"] < 3.0
    target = {t["key"]: t for t in content["figures_to_reach"]}["back_drive"]
    assert target["ours"] == f"{hard['rated_percent']['fused']:.2f} % of rated"
    assert target["reached"] == (hard["rated_percent"]["fused"] <= 2.0)


def test_the_figures_to_reach_follow_from_the_tables(judged: tuple[dict[str, Any], str]) -> None:
    content, _ = judged
    found = {t["key"]: t for t in content["figures_to_reach"]}
    ratios = content["variable"]["ratios"]
    assert found["tob_to_paper"]["ours"] == f"{ratios['tested']['tob_to_paper']:.1f}"
    assert found["tob_to_paper"]["reached"] is None
    assert found["ours_to_paper"]["reached"] == (
        max(ratios[k]["ours_to_paper"] for k in ("tested", "both")) <= 0.5
    )
    worse = [r for r in content["runs"] for j in r["joints"].values()
             if j["errors"]["fused"]["mse_nm2"] > j["errors"]["physics"]["mse_nm2"]]  # fmt: skip
    assert found["every_run"]["ours"] == f"{len(worse)} of 6"
    assert len(content["worse_than_physics"]) == len(worse)
    samples = {kind: table["overall"]["samples"] for kind, table in content["intervals"].items()}
    assert samples["all"] == samples["variable"] + samples["constant"]
    assert samples["variable"] == content["variable"]["both"]["fused"]["samples"]
    shares = [
        q["share"] for joint in content["intervals"]["variable"]["quadrants"].values() for q in joint.values()
    ]
    assert found["coverage"]["reached"] == all(0.87 <= share <= 0.93 for share in shares)
    assert found["jump_fused"]["reached"] == (content["jumps"]["at"]["fused"]["nm"] <= 0.2)
    assert found["outside_rmse"]["reached"] is None
    assert found["loop_time"]["reached"] is not None
    assert "2 joints together, median of" in found["loop_time"]["details"][0]


class _Page(html.parser.HTMLParser):
    """What a page loads, how its tags nest, and its ids and links."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.ids: list[str] = []
        self.anchors: list[str] = []
        self.figures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = dict(attrs)
        self.loaded += [f"{tag} {names[key]}" for key in ("src", "data", "srcset") if names.get(key)]
        if tag in ("link", "script", "iframe"):
            self.loaded.append(tag)
        self.figures += tag == "figure"
        if tag == "a":
            self.anchors.append(str(names["href"]))
        if names.get("id") and "svg" not in self.open:
            self.ids.append(str(names["id"]))
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_report_is_whole_and_needs_nothing_else(judged: tuple[dict[str, Any], str]) -> None:
    content, text = judged
    page = _Page()
    page.feed(text)
    assert page.open == []
    assert page.loaded == []
    assert "url(http" not in text
    assert all(anchor.removeprefix("#") in page.ids for anchor in page.anchors)
    assert page.figures == 2 + 1 + 1 + 2 + 2 + 1  # Fig. 14, paper's, Fig. 16, runs, velocities, calibration
    assert text.count("<svg") == page.figures
    for value in ("27.6 %", "10.07", f"{content['variable']['tested']['tob']['mse_nm2']:.3f}"):
        assert value in text
    assert not re.search(r"\b(nan|None|inf)\b", re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL))


def test_json_and_table_go_to_standard_output(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(bench / "models", tmp_path / "models")
    run = bench / "runs" / "variable_1.csv.gz"
    assert evaluate(tmp_path, [run], "--json", "--joint", "1") == 0
    content = json.loads(capsys.readouterr().out)
    assert content == report(tmp_path / "out")
    assert [each["number"] for each in content["models"]] == [1]
    assert evaluate(tmp_path, [run], "--joint", "1") == 0
    text = capsys.readouterr().out
    assert "no run at constant velocity" in text
    for method, values in content["variable"]["tested"].items():
        assert f"{values['mse_nm2']:.3f}" in text, method
    assert all(target["figure"] in text for target in content["figures_to_reach"])


def test_usage(bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as usage:
        main(["--models", "models"])
    assert usage.value.code == 2
    with pytest.raises(SystemExit) as done:
        main(["--help"])
    assert done.value.code == 0
    assert "example" in capsys.readouterr().out
    (tmp_path / "file").write_text("")
    run = bench / "runs" / "variable_1.csv.gz"
    assert evaluate(bench, [run], "--out", str(tmp_path / "file")) == 1
    assert "it is a file" in capsys.readouterr().err


def test_outside_is_scored_by_itself(bench: Path, tmp_path: Path) -> None:
    """A run at 35 degC, where joint file and network know 20 to 30: all of it is outside, and all is flagged."""
    table = read_run(bench / "runs" / "variable_1.csv.gz").table
    warm = {n: replace(c, temperature_c=np.full(len(table.time_s), 35.0)) for n, c in table.joints.items()}
    write_run(tmp_path / "warm.csv", RunTable(table.time_s, warm))
    good = bench / "runs" / "variable_2.csv.gz"
    assert (
        evaluate(bench, [good], "--outside", str(tmp_path / "warm.csv"), "--out", str(tmp_path / "out")) == 0
    )
    content = report(tmp_path / "out")
    assert [each["number"] for each in content["outside"]] == [1, 2]
    for each in content["outside"]:
        assert each["samples"] == each["of"] == each["by_temperature"] > 1000
        assert each["by_load"] == 0
        assert each["flagged"] == 1.0
        assert each["ours"]["samples"] == each["physics"]["samples"] == each["of"]
    targets = {target["key"]: target["reached"] for target in content["figures_to_reach"]}
    assert targets["outside_rmse"] is not None
    assert targets["outside_flagged"] is None
    # the run outside is in no other score
    kinds = {run["name"]: run["kind"] for run in content["runs"]}
    assert kinds == {"variable_2.csv.gz": "variable", "warm.csv": "outside"}
    by_run = [run["joints"]["1"]["errors"] for run in content["runs"]]
    assert by_run[0]["tob"]["mse_nm2"] == content["variable"]["joints"]["1"]["tob"]["mse_nm2"]
    assert by_run[1] is None
    # and it cannot be both
    assert evaluate(bench, [good], "--outside", str(good), "--out", str(tmp_path / "out")) == 1


def test_marks_of_the_campaign_come_before_the_data(bench: Path, tmp_path: Path) -> None:
    run = tmp_path / "variable.csv.gz"
    shutil.copy(bench / "runs" / "variable_1.csv.gz", run)
    (tmp_path / "variable.json").write_text(json.dumps({"run": "variable", "velocity_joint": 2}))
    assert evaluate(bench, [run], "--out", str(tmp_path / "out")) == 0
    content = report(tmp_path / "out")
    (record,) = content["runs"]
    assert (record["velocity_joint"], record["velocity_joint_by"]) == (2, "marks")
    assert content["variable"]["tested"] == content["variable"]["joints"]["2"]


def test_the_only_run_that_cannot_be_read_is_an_error_with_its_reason(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.csv").write_bytes(b"\xff\xfe")
    models = ("--models", str(bench / "models"), "--out", str(tmp_path / "report"))
    assert main([str(tmp_path / "bad.csv"), *models]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"jtq evaluate: {tmp_path}/bad.csv: found byte 0 that is not UTF-8")
    assert error.count("\n") == 1


_TWIN = """
import sys
from jtqd.estimator import settings
settings.METHODS["twin"] = settings.Method("twin of the classical TOB", "JointEstimator")
from jtqd.sysid.evaluate.command import main
from jtqd.sysid.evaluate.evaluation import Target
from jtqd.sysid.evaluate.report import as_mapping, report_html
sys.exit(main(sys.argv[1:]))
"""


def test_a_new_entry_of_the_methods_is_evaluated_and_drawn(bench: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    words = [str(bench / "runs"), "--models", str(bench / "models"), "--out", str(out)]
    subprocess.run([sys.executable, "-c", _TWIN, *words], check=True, stdout=subprocess.DEVNULL)
    for run in report(out)["runs"]:
        for joint in run["joints"].values():
            assert joint["errors"]["twin"] == joint["errors"]["tob"]
    assert "twin of the classical TOB" in (out / "evaluation.html").read_text()
