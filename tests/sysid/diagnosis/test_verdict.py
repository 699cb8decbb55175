"""Whole diagnoses of small sets with something hidden, of which the truth is known, and of data that cannot serve.

The large campaign with sets drawn afresh is `python -m validation trials`; here one seed, so that changes show.
"""

from __future__ import annotations

import pytest

from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import CAUSE, CERTAIN, NO_GAP, UNEXPLAINED, Findings
from validation.diagnosis.entries import Hidden
from validation.diagnosis.scores import score
from validation.diagnosis.trials import joint_files, tables
from validation.generator.draw import Case, Order, draw_many

SEED = 7
KINDS = {
    "nothing": (),
    "ripple": (Hidden("torque_ripple", 1, 0.8),),
    "gain": (Hidden("sensor_gain", "sensor", {"gain": 0.94}),),
    "bursts": (Hidden("friction_bursts", 2, 4.0),),
}


@pytest.fixture(scope="module")
def cases() -> dict[str, Case]:
    orders = [Order(SEED, hidden, runs=4, duration_s=8.0) for hidden in KINDS.values()]
    return dict(zip(KINDS, draw_many(orders), strict=True))


def diagnosed(case: Case, *numbers: int) -> Findings:
    joints = joint_files(case)
    return diagnose(tables(case.runs), {n: joints[n] for n in numbers})


def right(case: Case, found: Findings) -> bool:
    """Whether exactly what is hidden is named, with intervals that hold the truth."""
    outcome = score("one", SEED, case.truth, found)
    return outcome.found == (True,) and not outcome.wrong


def test_nothing_hidden_is_no_gap(cases: dict[str, Case]) -> None:
    found = diagnosed(cases["nothing"], 1, 2)
    assert (found.verdict, found.causes) == (NO_GAP, ())
    assert {(g.joint, g.balance) for g in found.gaps} == {
        (j, b) for j in (1, 2) for b in ("motor", "torsion")
    }
    for gap in found.gaps:
        assert gap.rmse_nm < 1.2 * gap.noise_floor_nm
    rows = {(row.name, row.joint): row for row in found.candidates}
    small = {(c.name, c.joint) for c in found.too_small}
    assert {key for key, row in rows.items() if row.reason.startswith("in the set")} <= small
    (size,) = rows["torque_ripple", 1].minimum.values()
    assert 0.0 < size.value < 0.3, "the ripple hidden below is larger"
    assert len(found.traces) == 4 * 4


def test_one_effect_is_the_cause_with_its_parameters(cases: dict[str, Case]) -> None:
    case = cases["ripple"]
    found = diagnosed(case, 1)
    assert found.verdict == CAUSE
    assert right(case, found)
    (one,) = found.causes
    truth = case.truth[0]["parameters"]
    for name, true in truth.items():
        low, high = one.parameters[name].ci95
        assert low <= true <= high
        assert name == "order_per_motor_rev" or 0.0 < high - low < 0.2
    assert one.balance == "motor"
    assert one.grade == CERTAIN
    assert found.gain is not None
    assert found.gain.rmse_after_nm < found.gain.rmse_before_nm
    assert found.gain.ci95[0] > 0.0
    assert found.next_experiment is None


def test_a_file_that_has_the_effect_leaves_no_gap(cases: dict[str, Case]) -> None:
    case = cases["ripple"]
    known = {1: joint_files(case, hidden=True)[1]}
    assert [e.name for e in known[1].effects] == ["torque_ripple"]
    found = diagnose(tables(case.runs), known)
    assert (found.verdict, found.causes) == (NO_GAP, ())


def test_a_fault_of_the_sensor_is_told_from_faults_of_both_joints(cases: dict[str, Case]) -> None:
    """A reading too small is every constant too large: six and more values of the file, each with odds of its own."""
    found = diagnosed(cases["gain"], 1, 2)
    assert found.verdict == CAUSE
    assert right(cases["gain"], found)
    assert found.causes[0].parameters["gain"].value == pytest.approx(0.94, abs=0.005)


def test_what_is_in_no_library_is_unexplained_and_placed(cases: dict[str, Case]) -> None:
    case = cases["bursts"]
    found = diagnosed(case, 2)
    assert found.verdict == UNEXPLAINED
    assert found.unexplained is not None
    assert found.unexplained.rms_nm > found.unexplained.relevant_nm
    worst = found.gaps[0]
    assert (worst.joint, worst.balance) == (2, "motor")
    assert score("unknown", SEED, case.truth, found).place
    assert any("joint 2, motor balance" in reason for reason in found.reasons)
