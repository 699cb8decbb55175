"""Pieces of one recording are known as such and count once; runs that only resemble each other are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.diagnosis.dataset import build_dataset, piece_notes, recordings, usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import INSUFFICIENT
from jtqd.sysid.diagnosis.model import solve
from jtqd.sysid.diagnosis.signals import JointSignals
from jtqd.sysid.diagnosis.verdict import predict
from jtqd.sysid.runs.files import read_runs
from jtqd.sysid.runs.tables import write_run
from tests.sysid.diagnosis.diagnose_helpers import JOINT, bench_run

JOINTS = {1: JOINT, 2: JOINT}
HALF = 1503


def cut(table: RunTable, rows: slice, *, from_zero: bool = False) -> RunTable:
    def part(columns: JointColumns) -> JointColumns:
        values = {f.name: getattr(columns, f.name) for f in fields(columns)}
        return JointColumns(**{name: None if x is None else x[rows] for name, x in values.items()})

    time = table.time_s[rows]
    joints = {n: part(c) for n, c in table.joints.items()}
    return RunTable(time - time[0] if from_zero else time, joints)


def signals(
    *runs: tuple[str, RunTable], numbers: tuple[int, ...] = (1, 2)
) -> Sequence[Sequence[JointSignals]]:
    found, _ = usable_signals([*runs, ("other", bench_run(seconds=6.0, phase=1.1))], JOINTS, numbers)
    return found


@pytest.mark.parametrize("from_zero", [False, True], ids=["stamps go on", "stamps begin again"])
def test_pieces_go_on_where_another_ends(from_zero: bool) -> None:
    whole = bench_run(seconds=6.0)
    pieces = [cut(whole, slice(0, HALF)), cut(whole, slice(HALF, None), from_zero=from_zero)]
    found = signals(("a", pieces[0]), ("b", pieces[1]))
    assert recordings(found) == [0, 0, 1]
    assert piece_notes(found) == ["a, b: pieces of one recording: they count as one run"]


def test_a_gap_in_the_stamps_is_still_one_recording() -> None:
    whole = bench_run(seconds=6.0)
    found = signals(("a", cut(whole, slice(0, HALF))), ("b", cut(whole, slice(HALF + 100, None))))
    assert recordings(found) == [0, 0, 1]


def test_the_reader_names_its_pieces() -> None:
    runs = [("a.csv (1 of 2)", bench_run()), ("a.csv (2 of 2)", bench_run(phase=2.0))]
    assert recordings(signals(*runs)) == [0, 0, 1]


def test_the_middle_of_one_recording_does_not_go_on_in_another() -> None:
    """Two logs with the same motion and a gap at the same time: the clock of each begins at zero."""
    whole = bench_run(seconds=6.0)
    runs = [
        (f"{name} ({k} of 2)", cut(whole, rows))
        for name in ("a.mcap", "b.mcap")
        for k, rows in ((1, slice(0, HALF)), (2, slice(HALF + 150, None)))
    ]
    assert recordings(signals(*runs)) == [0, 0, 1, 1, 2]


def test_one_recording_whose_time_starts_again_counts_once(tmp_path: Path) -> None:
    """Cut in the middle of the motion: the stamps say two runs, the motion one."""
    whole = bench_run(seconds=6.0)
    halves = [cut(whole, slice(0, HALF)), cut(whole, slice(HALF, None))]
    text = []
    for part in (*halves, bench_run(phase=0.7)):
        write_run(tmp_path / "part.csv", cut(part, slice(None), from_zero=True))
        text += (tmp_path / "part.csv").read_text().splitlines(keepends=True)[1 if text else 0 :]
    (tmp_path / "part.csv").unlink()
    (tmp_path / "a.csv").write_text("".join(text))
    runs = read_runs([tmp_path], segments=True)
    assert [run.name for run in runs] == [f"a.csv (run {k} of 3)" for k in (1, 2, 3)]
    found = signals(*((run.name, run.table) for run in runs))
    assert recordings(found) == [0, 0, 1, 2]


def test_runs_with_motions_of_their_own_are_runs() -> None:
    found = signals(("a", bench_run()), ("b", bench_run(phase=0.7)), ("c", bench_run()))
    assert recordings(found) == [0, 1, 2, 3]
    assert piece_notes(found) == []


def test_pieces_of_one_recording_are_no_two_runs() -> None:
    whole = bench_run(seconds=9.0)
    pieces = [(f"a{k}", cut(whole, slice(1500 * k, 1500 * (k + 1)))) for k in range(3)]
    findings = diagnose(pieces, JOINTS)
    assert findings.verdict == INSUFFICIENT
    assert "found 1 usable run in pieces of one recording, expected at least 2" in findings.reasons[-1]


def test_pieces_share_what_a_run_has_of_its_own_and_are_held_out_together() -> None:
    whole = bench_run(seconds=6.0)
    found = signals(("a", cut(whole, slice(0, HALF))), ("b", cut(whole, slice(HALF, None))), numbers=(1,))
    solution = solve(build_dataset([list(run) for run in found], {1: JOINT}))
    assert len(solution.runs) == 3
    assert len(solution.equations.grams) == len(solution.own_means) == 2
    (squares, *_) = predict(solution).squares.values()
    assert len(squares) == 2


def test_a_dataset_knows_its_pieces() -> None:
    whole = bench_run(seconds=6.0)
    found = signals(("a", cut(whole, slice(0, HALF))), ("b", cut(whole, slice(HALF, None))))
    assert build_dataset([list(run) for run in found], JOINTS).recordings == [0, 0, 1]
