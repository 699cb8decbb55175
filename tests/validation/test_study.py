"""What all studies share: the list, one form of tables with seeds and commit, JSON; docs name studies that exist."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.paths import ROOT
from validation import study
from validation.__main__ import STUDIES, USAGE, main
from validation.study import Report, Table, json_of, lines_of, share, text_of, wilson


def test_the_list_has_every_study(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = capsys.readouterr().out
    for name, (module, line) in STUDIES.items():
        assert re.search(rf"^  {name} +{re.escape(line)}$", printed, re.MULTILINE)
        made = importlib.import_module(module)
        assert callable(made.options)
        assert callable(made.run)
    assert main(["nonsense"]) == USAGE
    assert "found 'nonsense', expected one of goals" in capsys.readouterr().err


def test_the_pages_name_studies_that_are_there() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), ROOT / "validation" / "README.md"]
    named = {name for page in pages for name in re.findall(r"python -m validation (\w+)", page.read_text())}
    assert named - {"STUDY"} <= set(STUDIES)
    assert len(named) > 5


def test_a_report_has_one_form(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    table = Table(("a", "long head"), [("1", "x"), ("22", "yy")], "title")
    assert lines_of(table) == [
        *("title", ""),
        "| a  | long head |",
        "|----|-----------|",
        "| 1  | x         |",
        "| 22 | yy        |",
    ]
    report = Report(
        [table], {"judge": 3, "fit": 1}, ["a note"], {"rms": np.float64(0.5), "none": float("nan")}
    )
    monkeypatch.setattr(study, "ROOT", tmp_path)  # outside of git
    assert text_of(report).splitlines()[-3:] == ["a note", "", "judge 3, fit 1; commit unknown"]
    made = json.loads(json_of("goals", report))
    assert (made["study"], made["commit"], made["seeds"]) == ("goals", "unknown", {"judge": 3, "fit": 1})
    assert made["values"] == {"rms": 0.5, "none": None}
    assert made["tables"][0]["rows"] == [["1", "x"], ["22", "yy"]]


@pytest.mark.parametrize(
    ("good", "target", "text", "reached"),
    [(19, 0.95, "at least 95 %", True), (18, 0.95, "at least 95 %", False), (1, -0.0, "at most 0 %", False)],
)
def test_shares_have_targets(good: int, target: float, text: str, reached: bool) -> None:
    row = share("what", [True] * good + [False] * (20 - good), target)
    assert row is not None
    assert (row.target, row.reached, row.trials) == (text, reached, 20)
    assert row.low < row.value == good / 20 < row.high
    assert share("none", [], target) is None


def test_intervals_of_shares_are_wilsons() -> None:
    assert wilson(95, 100) == pytest.approx((0.888, 0.978), abs=2e-3)
