"""Faults at the gateway, judged by the true torque: the gateway, the judge, and a part of the table."""

import ast
from dataclasses import replace

import numpy as np
import pytest

from tests.paths import ROOT
from tests.slow.faults import gateway as gw
from tests.slow.faults.__main__ import SEED, coverage, main, totals
from tests.slow.faults.gateway import Active, Gateway
from tests.slow.faults.runs import PLANTS, STATES, runs_of
from tests.slow.faults.table import ROWS, Draw, pairs, singles
from tests.slow.faults.trial import VALID, Case, Outcome, healthy, judge, judged, rng_of, watch

PRACTICE: int = 3
"""Seed of these tests."""
EVERY: int = 8
"""Of the cases of the table, so that these tests last some twenty seconds."""


def test_the_gateway_shares_no_code_with_jtqd() -> None:
    tree = ast.parse((ROOT / "tests/slow/faults/gateway.py").read_text())
    imported = [each.module or "" for each in ast.walk(tree) if isinstance(each, ast.ImportFrom)]
    imported += [name.name for each in ast.walk(tree) if isinstance(each, ast.Import) for name in each.names]
    assert not [name for name in imported if name.startswith(("jtqd", "tests"))]


def test_no_choice_is_made_on_the_seed_of_the_docs() -> None:
    assert PRACTICE != SEED


def _draw(k: int = 0) -> Draw:
    return Draw(rng_of("draw", k), 0.4, runs_of("bench", PRACTICE)["reversing"], 1)


UNCHANGED = {"wall clock set"}
"""It is no frame that this one changes."""


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.group}-{row.name}")
def test_each_row_changes_what_reaches_jtqd_and_only_while_it_lasts(row: object) -> None:
    assert row in ROWS
    draw = _draw()
    drawn = next(each for each in ROWS if each is row).make(draw)
    run, begin, end = draw.run, 2900, 2900 + round(1000 * (drawn.seconds or 1.0))
    gateway = Gateway(run.at, [Active(begin, end, drawn.act)])
    changed = [k for k in range(2800, min(end + 50, 7000)) if list(gateway.answers(k)) != list(run.at(k))]
    name = next(each.name for each in ROWS if each is row)
    assert bool(changed) == (name not in UNCHANGED)
    assert all(begin <= k < end for k in changed)


def test_the_same_seed_gives_the_same_cases_and_frames() -> None:
    one, two = singles(PRACTICE, 1)[2], singles(PRACTICE, 1)[2]
    assert one.injected == two.injected
    run = runs_of(one.plant, PRACTICE)[one.state]
    cycles = range(one.begin, one.begin + 50)
    first, second = Gateway(run.at, one.faults), Gateway(run.at, two.faults)
    assert [list(first.answers(k)) for k in cycles] == [list(second.answers(k)) for k in cycles]


def test_the_draw_covers_every_plant_and_state() -> None:
    cases = [*singles(PRACTICE), *pairs(PRACTICE)]
    assert len(singles(PRACTICE)) >= 250
    assert len(pairs(PRACTICE)) >= 100
    found = [(case.plant, case.state) for case in cases]
    counts = [found.count((plant, state)) for plant in PLANTS for state in STATES]
    assert min(counts) > 0.8 * max(counts)


@pytest.mark.parametrize(
    "arguments", [["--match", "("], ["--match", "no such fault"], ["--match", "noise", "--write"]]
)
def test_arguments_that_would_judge_nothing_are_refused(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["--seed", str(PRACTICE), "--per-row", "1", "--pairs", "0", *arguments])
    assert refused.value.code == 2
    assert "error: " in capsys.readouterr().err


# The judge ----------------------------------------------------------------------------------------------------------


def _judged(off_nm: float = 0.0, status: int = VALID, torque_is_there: bool = True) -> Outcome:
    """Judge a run whose torque is `off_nm` off in 100 cycles of joint 1, with this status."""
    run, twin = runs_of("bench", PRACTICE)["moving"], healthy("bench", "moving", PRACTICE)
    at = slice(3000, 3100)
    torque, codes = twin.torque_nm.copy(), twin.status.copy()
    torque[at, 0], codes[at, 0] = (run.true_nm[at, 0] + off_nm if torque_is_there else np.nan), status
    case = Case("", "", "bench", "moving", PRACTICE, "", 2990, 3050, ())
    return judged(case, run, twin._replace(torque_nm=torque, status=codes), twin)


def test_a_wrong_torque_with_a_good_status_is_dangerous() -> None:
    found = _judged(5.0)
    assert found.dangerous > 90
    assert found.dangerous_nm == pytest.approx(5.0)
    assert not found.harmless
    assert found.unreported
    assert found.right_s == pytest.approx(0.05)
    assert found.sent_share >= 5.0 / 40.0


def test_the_same_with_status_3_is_counted_there() -> None:
    found = _judged(5.0, 3)
    assert found.dangerous == 0
    assert found.degraded_beyond > 90
    assert found.reported_by == "status 3"
    assert not found.unreported


def test_a_small_error_and_a_torque_that_is_withheld_are_harmless() -> None:
    assert _judged(0.02).harmless
    found = _judged(0.0, 15, torque_is_there=False)
    assert found.harmless
    assert (found.reported_by, found.reported_s) == ("status 15", pytest.approx(0.01))


def test_a_run_without_a_fault_is_not_reported() -> None:
    run, twin = runs_of("typical", PRACTICE)["reversing"], healthy("typical", "reversing", PRACTICE)
    case = Case("", "", "typical", "reversing", PRACTICE, "", 3000, 3050, ())
    found = judged(case, run, watch(run), twin)
    assert (found.dangerous, found.reported_s, found.right_s, found.latched) == (0, None, 0.0, False)


def test_a_fault_that_everybody_must_see() -> None:
    run = runs_of("bench", PRACTICE)["moving"]
    fault = Active(3000, 3300, gw.silent(1))
    case = Case("", "", "bench", "moving", PRACTICE, "", 3000, 3300, (fault,))
    found = judge(case)
    assert found.reported_by == "status 4"
    assert found.reported_s is not None
    assert found.reported_s <= 0.002
    assert run.at(3000) == run.frames[3000]


# The table ----------------------------------------------------------------------------------------------------------


def test_a_part_of_the_table() -> None:
    """Bounds are figures of the commit that set them: they are lowered, never raised."""
    cases = [*singles(PRACTICE)[::EVERY], *pairs(PRACTICE)[::EVERY]]
    found = totals([judge(replace(case)) for case in cases])
    print(found, coverage(found))
    assert found.cases >= 60
    assert found.wrong == 0
    assert found.unreported == 0
    assert found.beyond <= 0.001 * found.degraded
