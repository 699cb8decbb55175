"""`jtqd.diagnose`: runs and joint files in, findings out, as the command makes them; and what a notebook shows of them."""

from __future__ import annotations

import html
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import jtqd
from jtqd.estimator.errors import ConfigError
from jtqd.sysid.diagnosis.findings import to_mapping
from jtqd.sysid.diagnosis.report import render
from jtqd.sysid.diagnosis.run_files import NotebookFindings
from jtqd.sysid.runs import RunFile
from tests.sysid.diagnosis import findings_examples as examples
from tests.sysid.diagnosis.diagnose_helpers import (
    JOINT,
    JOINT_FILE,
    Core,
    bench_run,
    run,
    stand_in,
    write_runs,
)


@pytest.fixture
def core(monkeypatch: pytest.MonkeyPatch) -> Core:
    return stand_in(monkeypatch)


def test_the_findings_are_those_of_the_command(tmp_path: Path) -> None:
    """Verdict no_gap or not: the equations' own runs, with a file whose torque constant is 10 % low."""
    paths = write_runs(tmp_path, 3, numbers=(1,))
    joint = replace(JOINT, torque_constant_nm_per_a=0.9 * JOINT.torque_constant_nm_per_a)
    findings = jtqd.diagnose(jtqd.read_runs(str(tmp_path)), joint)
    text = JOINT_FILE.read_text()
    file = tmp_path / "low.yaml"
    file.write_text(
        re.sub(
            r"torque_constant_nm_per_a: \S+",
            f"torque_constant_nm_per_a: {joint.torque_constant_nm_per_a!r}",
            text,
        )
    )
    run(*paths, "--joint", file, "--out", tmp_path / "out")
    written = json.loads((tmp_path / "out" / "findings.json").read_text())
    mapping = json.loads(json.dumps(to_mapping(findings)))
    for key in ("verdict", "gap", "causes", "gain", "reasons", "joints", "too_small"):
        assert mapping[key] == written[key], key
    assert written["verdict"] != "no_gap"


def test_a_joint_is_a_value_or_a_path_for_all_joints_or_one_for_each(tmp_path: Path, core: Core) -> None:
    write_runs(tmp_path, 2)
    runs = jtqd.read_runs(str(tmp_path))
    for joint in (str(JOINT_FILE), JOINT_FILE, JOINT):
        assert jtqd.diagnose(runs, joint).joint_files == {1: JOINT, 2: JOINT}
    assert jtqd.diagnose(runs, {2: str(JOINT_FILE)}).joint_files == {2: JOINT}
    assert [sorted(joints) for _, joints in core.asked] == [[1, 2], [1, 2], [1, 2], [2]]
    with pytest.raises(ConfigError, match=r"^joint 3: .*j1, j2$"):
        jtqd.diagnose(runs, {3: JOINT})


def test_tables_from_memory_and_known_loads(tmp_path: Path, core: Core) -> None:
    jtqd.diagnose([("a", bench_run(numbers=(1,)))], JOINT)
    [path] = write_runs(tmp_path, 1, numbers=(1,))
    [read] = jtqd.read_runs([path])
    known: RunFile = replace(read, known_loads=(1,))
    jtqd.diagnose([known], JOINT)
    assert [names for (names, _), *_ in (asked[0] for asked in core.asked)] == ["a", path.name]
    assert [scope.known_references for scope in core.scopes] == [frozenset(), {1}]


def test_what_may_not_be_used_is_in_the_findings_and_not_printed(
    core: Core, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = bench_run(numbers=(1,)), bench_run(numbers=(1,), phase=0.3)
    bad = replace(bad, joints={1: replace(bad.joints[1], torque_nm=None)})
    runs = [("a", good), ("b", replace(good, time_s=good.time_s + 1.0)), ("c", bad)]
    findings = jtqd.diagnose(runs, JOINT)
    assert any(note.startswith("c: j1.torque_nm") for note in findings.channel_notes)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("name", examples.EXAMPLES)
def test_a_notebook_shows_the_head_of_the_page(name: str) -> None:
    findings = NotebookFindings(**vars(examples.EXAMPLES[name]()))
    shown = findings._repr_html_()
    assert shown is not None

    def words(text: str) -> str:
        return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())

    head = re.search(r"<header>(.*?)</header>", render(findings), re.DOTALL)
    assert head is not None
    assert words(shown) == words(head[1].replace(': <a href="#next">what to measure</a>', ""))
    assert "href" not in shown


def test_without_jinja2_a_notebook_shows_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert NotebookFindings(**vars(examples.one_cause()))._repr_html_() is None


def test_importing_jtqd_imports_nothing_of_it() -> None:
    code = "import sys, jtqd; print([n for n in sys.modules if n.startswith('jtqd.') or n == 'numpy'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert all(getattr(jtqd, name) is not None for name in jtqd.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        jtqd.nothing  # noqa: B018
