"""The campaign: what it hides, what it writes, how it goes on, what its table counts. The diagnosis itself is replaced."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.sysid.diagnosis.findings import Cause, Findings
from validation.hidden.scores import Outcome
from validation.worlds import campaign as campaigns
from validation.worlds.campaign import Counts, campaign, jobs, main, read
from validation.worlds.figures import failures, figures, lost_to_wrong
from validation.worlds.judge import REFUSED, judged, write
from validation.worlds.measured_bench import MeasuredBench
from validation.worlds.oracle import key, sizes
from validation.worlds.recorder import PRESETS, Recorder, record
from validation.worlds.sets import SENSOR, Columns, Hidden

FEW = Counts(per_effect=1, none=2, pairs=3, foreign=1)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Recorder]:
    """The diagnosis names current_offset of joint 1 in every set."""
    calls: list[Recorder] = []

    def instead(
        runs: Sequence[Columns], joints: Mapping[int, Mapping[str, Any]], recorder: Recorder, seed: int
    ) -> Findings:
        calls.append(recorder)
        cause = Cause("current_offset", 1, ("current_offset",), {}, 100.0, 0.5, 1.0, "motor")
        return Findings("cause", (), ("run1.csv",), (1,), causes=(cause,))

    monkeypatch.setattr(campaigns, "judged", instead)
    return calls


def test_the_same_seed_hides_the_same_whatever_the_recorder() -> None:
    bench = MeasuredBench()
    first, again, other = (jobs(bench, seed, FEW) for seed in (5, 5, 6))
    assert first == again
    assert {job.key for job in first} == {job.key for job in other}
    assert first != other


def test_a_campaign_has_all_kinds_in_their_sizes() -> None:
    bench = MeasuredBench()
    there = jobs(bench, 5, Counts())
    count = {kind: sum(job.kind == kind for job in there) for kind in {job.kind for job in there}}
    usable = len({job.hidden[0].name for job in there if job.kind == "single"})
    assert usable >= 14
    assert count == {
        "single": 3 * usable,
        "half": 3 * usable,
        "nothing": 40,
        "pair": 40,
        "foreign": 18,
        "beside": 18,
    }
    visible = sizes("measured")
    for job in there:
        factor = {"single": 3.0, "half": 1.5, "pair": 3.0}.get(job.kind)
        if factor is not None:
            assert all(h.size == pytest.approx(factor * visible[key(h.name, h.variant)]) for h in job.hidden)
        if job.kind == "pair":
            assert len({h.name for h in job.hidden}) == 2
        if job.kind in ("foreign", "beside"):
            assert job.hidden[0].name in bench.foreign
    late = {h.variant for job in there for h in job.hidden if h.name == "channel_delay"}
    assert late == {"sensor", "current"}
    plain = {job.seed for job in there if job.kind == "nothing"}
    assert len(plain) == 40
    assert {job.seed for job in there} == plain  # of a real bench


def test_a_set_of_a_real_bench_counts_beside_the_one_that_hides_nothing() -> None:
    plain = outcome("nothing", causes=(("cogging", 1, ("cogging",)),))
    same = outcome("single", named=(True,), classed=(False,), wrong=("cogging of 1",))
    new = outcome("single", named=(True,), classed=(False,), wrong=("unbalance of 1",))
    both = {row.what: row for row in figures([plain, same, new], real=True)}
    assert both["a wrong name"].value == pytest.approx(1 / 3)
    assert both["single, three times visible: named, or class of at most 3"].trials == 2
    named = outcome("nothing", causes=(("torque_ripple", 1, ("torque_ripple",)),))
    assert not any(row.what.startswith("single") for row in figures([named, same], real=True))
    assert not any(row.what.startswith("single") for row in figures([same], real=True))


def test_the_files_do_not_tell_what_is_hidden(tmp_path: Path) -> None:
    bench = MeasuredBench()
    secret = [Hidden("torque_ripple", 1, 0.05), Hidden("clipping_sensor", SENSOR)]
    plain, drawn = bench.draw(4), bench.draw(4, secret)
    write(tmp_path, drawn.runs, drawn.joints, PRESETS["full"], 4)
    there = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert sorted(there) == ["joint1.yaml", *(f"run{k + 1}.csv" for k in range(len(drawn.runs)))]
    for name in ("torque_ripple", *bench.foreign, "hidden", "truth", "seed"):
        assert not any(name in text for text in there.values())
    assert drawn.joints == plain.joints


def test_what_is_recorded_is_what_is_diagnosed(monkeypatch: pytest.MonkeyPatch) -> None:
    read_tables = []

    def instead(runs: Any, joints: Any) -> Findings:
        read_tables.extend(run.table for run in runs)
        return Findings("no_gap", (), (), (1,))

    monkeypatch.setattr("validation.worlds.judge.diagnosed", instead)
    drawn = MeasuredBench().draw(4)
    assert judged(drawn.runs, drawn.joints, PRESETS["workshop"], 9).verdict == "no_gap"
    for table, columns in zip(read_tables, record(drawn.runs, PRESETS["workshop"], 9), strict=True):
        assert np.array_equal(table.time_s, columns["time_s"])
        assert np.array_equal(table.joints[1].current_a, columns["j1.current_a"])


def test_a_traceback_of_the_diagnosis_is_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def instead(runs: Any, joints: Any) -> Findings:
        raise ZeroDivisionError("no runs")

    monkeypatch.setattr("validation.worlds.judge.diagnosed", instead)
    drawn = MeasuredBench().draw(4)
    findings = judged(drawn.runs, drawn.joints, PRESETS["full"], 9)
    assert (findings.verdict, findings.reasons) == (REFUSED, ("ZeroDivisionError: no runs",))


def test_it_goes_on_where_it_stopped(asked: list[Recorder], tmp_path: Path) -> None:
    path = tmp_path / "a.jsonl"
    campaign(path, "measured", 5, "full", FEW, kinds=["nothing"])
    assert len(asked) == 2
    whole = path.read_text()
    path.write_text(whole[:-20])  # killed while it wrote
    campaign(path, "measured", 5, "full", FEW, kinds=["nothing"])
    assert len(asked) == 3
    header, outcomes = read(path)
    assert header["seed"] == 5
    assert sorted(outcomes) == ["nothing.0", "nothing.1"]
    again = [json.loads(line) for line in path.read_text().splitlines()[1:]]
    before = [json.loads(line) for line in whole.splitlines()[1:]]
    for a, b in zip(before, again, strict=True):
        assert {k: v for k, v in a.items() if not k.endswith("_s")} == {
            k: v for k, v in b.items() if not k.endswith("_s")
        }
    with pytest.raises(ValueError, match="found a campaign with seed 5, expected 6"):
        campaign(path, "measured", 6, "full", FEW)


def test_a_part_is_the_first_of_the_same_sets(asked: list[Recorder], tmp_path: Path) -> None:
    campaign(tmp_path / "a.jsonl", "measured", 5, "full", FEW, most=3)
    assert list(read(tmp_path / "a.jsonl")[1]) == [job.key for job in jobs(MeasuredBench(), 5, FEW)[:3]]


def test_it_ends_in_time(asked: list[Recorder], tmp_path: Path) -> None:
    campaign(tmp_path / "a.jsonl", "measured", 5, "full", FEW, minutes=0.0)
    assert not asked


def test_the_command_prints_the_table_and_compares(
    asked: list[Recorder], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [
        "--bench",
        "measured",
        "--seed",
        "5",
        "--per-effect",
        "1",
        "--none",
        "2",
        "--pairs",
        "1",
        "--foreign",
        "1",
    ]
    full, seven = str(tmp_path / "full.jsonl"), str(tmp_path / "seven.jsonl")
    few = ["--kinds", "single,nothing"]
    assert main([*options, *few, "--out", full]) == campaigns.MISSED
    printed = capsys.readouterr().out
    assert "bench measured, recorder full, seed 5" in printed
    assert "nothing hidden: a name, or unexplained" in printed
    assert (
        main([*options, *few, "--recorder", "seven_digits", "--out", seven, "--against", full])
        == campaigns.MISSED
    )
    assert "a wrong name instead of a found one: 0 sets" in capsys.readouterr().out
    assert asked[-1] == PRESETS["seven_digits"]
    assert main(["--table", full]) == campaigns.MISSED
    assert main(["--table", str(tmp_path / "no.jsonl")]) == campaigns.FAILED
    (tmp_path / "other.jsonl").write_text("{}\n")
    assert main(["--table", str(tmp_path / "other.jsonl")]) == campaigns.FAILED
    assert main(["--bench", "measured"]) == campaigns.USAGE


def test_a_missing_mujoco_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["--bench", "mujoco", "--seed", "1", "--out", str(tmp_path / "a")]) == campaigns.FAILED
    assert capsys.readouterr().err.count("\n") == 1


def outcome(kind: str, **values: Any) -> Outcome:
    return Outcome(kind, 1, (("torque_ripple", 1),), values.pop("verdict", "cause"), **values)


def test_the_table_counts_what_the_targets_ask() -> None:
    found, missed = (
        outcome("single", named=(True,), classed=(False,)),
        outcome("single", named=(False,), classed=(False,)),
    )
    wrong = outcome("half", named=(False,), classed=(True,), wrong=("cogging of 1",))
    refused = outcome("foreign", verdict="unexplained", place=True)
    rows = {
        row.what: row
        for row in figures([found, missed, wrong, outcome("nothing", verdict="unexplained"), refused])
    }
    assert rows["single, three times visible: named, or class of at most 3"].value == 0.5
    assert rows["half of that size"].value == 1.0
    assert rows["a wrong name"].value == pytest.approx(1 / 4)
    assert rows["nothing hidden: a name, or unexplained"].value == 1.0
    assert rows["foreign: refused and placed"].reached
    assert rows["foreign worth more than the relevance called no_gap"].reached
    beside = outcome("beside", named=(True,), classed=(False,), wrong=("cogging of 1",))
    with_it = {f.what: f for f in figures([found, beside])}
    assert with_it["a wrong name"].value == 0.5
    assert with_it["cause beside a foreign effect: named"].value == 1.0
    assert failures([found, beside])[0].startswith("beside")
    gone = outcome("foreign", verdict="no_gap", place=False)
    row = "foreign worth more than the relevance called no_gap"
    assert not {f.what: f for f in figures([gone])}[row].reached
    assert {f.what: f for f in figures([replace(gone, slight=True)])}[row].reached


def test_a_found_name_that_turns_wrong_is_seen() -> None:
    full = {
        "a": outcome("single", named=(True,), classed=(False,)),
        "b": outcome("single", named=(True,), classed=(False,)),
    }
    recorded = {
        "a": outcome("single", named=(False,), classed=(False,), wrong=("cogging of 1",)),
        "b": outcome("single", named=(False,), classed=(False,)),
    }
    assert lost_to_wrong(full, recorded) == ["a"]


def test_what_the_recorder_does_itself_is_no_wrong_name(
    asked: list[Recorder], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def late(runs: Any, joints: Any, recorder: Recorder, seed: int) -> Findings:
        cause = Cause("channel_delay", "sensor", ("channel_delay",), {}, 100.0, 0.5, 1.0, "motor")
        return Findings("cause", (), ("run1.csv",), (1,), causes=(cause,))

    monkeypatch.setattr(campaigns, "judged", late)
    for recorder, wrong in (("ages", ()), ("full", ("channel_delay of sensor",))):
        path = tmp_path / f"{recorder}.jsonl"
        campaign(path, "measured", 5, recorder, FEW, kinds=["nothing"])
        assert all(tuple(o.wrong) == wrong for o in read(path)[1].values())
