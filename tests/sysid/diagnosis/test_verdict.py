"""Whole diagnoses of small sets with something hidden, of which the truth is known, and of data that cannot serve.

The large campaign with sets drawn afresh is `python -m validation trials`; here one seed, so that changes show.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis import dataset
from jtqd.sysid.diagnosis import diagnose as module
from jtqd.sysid.diagnosis.acceptance import Found
from jtqd.sysid.diagnosis.case import Case as Judged
from jtqd.sysid.diagnosis.case import Fit
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.findings import CAUSE, INSUFFICIENT, NO_GAP, UNEXPLAINED, Findings
from jtqd.sysid.diagnosis.leave_one_out import LeaveOneOut
from jtqd.sysid.diagnosis.noise import Noise
from jtqd.sysid.diagnosis.refine import Refined
from jtqd.sysid.diagnosis.search import Hypothesis
from jtqd.sysid.diagnosis.signals import Channel, Line
from jtqd.sysid.diagnosis.unexplained import Unexplained
from jtqd.sysid.diagnosis.verdict import _remaining
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, search_of
from tests.sysid.diagnosis.diagnose_helpers import JOINT, RIPPLE, bench_run, findings
from tests.sysid.diagnosis.test_search import LIBRARY, problem
from validation.diagnosis.entries import Hidden
from validation.diagnosis.scores import score
from validation.diagnosis.trials import joint_files, tables
from validation.generator.draw import Case, Order, draw_many

SEED = 3
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
    assert (found.verdict, found.causes, found.gain) == (NO_GAP, (), None)
    assert {(g.joint, g.balance) for g in found.gaps} == {
        (j, b) for j in (1, 2) for b in ("motor", "torsion")
    }
    for gap in found.gaps:
        assert gap.rmse_nm < 1.2 * gap.noise_floor_nm
    rows = {(row.name, row.joint): row for row in found.candidates}
    assert all(row.reason != "chosen" for row in rows.values())
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
    assert one.held_out_gain > 0.5
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


def test_what_a_file_has_too_little_of_is_reported_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cause that the file has already: once more without it, so that the cause is the whole and not what is missing."""
    known = (Effect("torque_ripple", {"amplitude_nm": 0.2}), Effect("sensor_gain", {"gain": 1.01}))
    asked: list[list[str]] = []

    def stand_in(runs: object, joints: dict[int, Joint], numbers: tuple[int, ...], *_: object) -> Findings:
        asked.append([e.name for e in joints[1].effects])
        return findings(CAUSE, (RIPPLE,), reasons=(f"diagnosis {len(asked)}",))

    monkeypatch.setattr(module, "_diagnosed", stand_in)
    runs = [("run", bench_run(numbers=(1,)))]
    found = diagnose(runs, {1: replace(JOINT, effects=known)})
    assert asked == [["torque_ripple", "sensor_gain"], ["sensor_gain"]]
    assert found.reasons == ("diagnosis 2",)
    asked.clear()
    diagnose(runs, {1: replace(JOINT, effects=known[1:])})
    assert asked == [["sensor_gain"]], "another effect of the file stays, and once is enough"


def test_a_fault_of_the_sensor_is_told_from_faults_of_both_joints(cases: dict[str, Case]) -> None:
    """A reading too small is every constant too large: six changes, which shrink the noise too (`search.units_changed`)."""
    found = diagnosed(cases["gain"], 1, 2)
    assert found.verdict == CAUSE
    assert right(cases["gain"], found)
    assert found.causes[0].parameters["gain"].value == pytest.approx(0.94, abs=0.005)
    reasons = {(row.name, row.joint): row.reason for row in found.candidates}
    assert reasons["torque_constant", 1] not in ("chosen", "below threshold")


def test_what_is_in_no_library_is_not_named(cases: dict[str, Case]) -> None:
    case = cases["bursts"]
    found = diagnosed(case, 2)
    assert (found.verdict, found.causes, found.gain) == (UNEXPLAINED, (), None)
    worst = found.gaps[0]
    assert (worst.joint, worst.balance) == (2, "motor")
    assert score("unknown", SEED, case.truth, found).place
    assert any("joint 2, motor balance" in reason for reason in found.reasons)


def reason_of(runs: list[tuple[str, RunTable]], joints: dict[int, Joint]) -> str:
    found = diagnose(runs, joints)
    assert found.verdict == INSUFFICIENT
    assert (found.causes, found.gaps, found.gain) == ((), (), None)
    return found.reasons[0]


def test_data_that_cannot_serve_are_said_to_be_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "next_experiment", lambda *_, **__: None)
    joints = {1: JOINT}
    runs = [(f"run{k}", bench_run(phase=0.7 * k, numbers=(1,))) for k in range(2)]
    assert "found 1 usable run, expected" in reason_of(runs[:1], joints)
    assert "found no joint" in reason_of(runs, {3: JOINT})
    slow = [(name, every(table, 25)) for name, table in runs]
    assert "found 20 samples per second" in reason_of(slow, joints)
    deaf = [(name, RunTable(t.time_s, {1: replace(t.joints[1], torque_nm=None)})) for name, t in runs]
    assert reason_of(deaf, joints).startswith("run0: j1.torque_nm: missing")
    still = [(name, slice_of(table, 0.5)) for name, table in runs]
    assert "s in motion in all runs, expected at least 5 s" in reason_of(still, joints)
    monkeypatch.setattr(dataset, "moving_s", lambda _: 4.97)
    assert reason_of(runs, joints) == "found 4.9 s in motion in all runs, expected at least 5 s"


def every(table: RunTable, k: int) -> RunTable:
    columns = table.joints[1]
    names = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
    return RunTable(table.time_s[::k], {1: replace(columns, **{n: getattr(columns, n)[::k] for n in names})})


def slice_of(table: RunTable, seconds: float) -> RunTable:
    columns, n = table.joints[1], int(np.sum(table.time_s < seconds))
    names = ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
    return RunTable(table.time_s[:n], {1: replace(columns, **{k: getattr(columns, k)[:n] for k in names})})


class Two(Judged):
    """A case in which the unexplained residual falls with every effect."""

    @property
    def few(self) -> bool:
        return True

    def fit(self, hypothesis: Hypothesis) -> Fit:
        return Fit(hypothesis, cast("Refined", None))

    def unexplained(self, fit: Fit) -> Unexplained:
        line = Line(MOTOR1, 2.5, 0.6 - 0.5 * len(fit.chosen), 30.0)
        return Unexplained((), (), (), (line,), worst_nm={MOTOR1: line.amplitude_nm})

    def held_nm(self, fit: Fit) -> dict[Channel, float]:
        return {}


@pytest.mark.parametrize(("limit_nm", "matters"), [(0.2, False), (0.05, True)])
def test_what_is_left_over_is_of_the_fit_that_is_shown(limit_nm: float, matters: bool) -> None:
    """Not confirmed by few runs: the causes leave it, and nothing else is printed; that it is explained is said with it."""
    search = search_of(problem(3, {0: 0.8}), LIBRARY)
    case = Two(cast("Dataset", None), cast("Noise", None), search, 0.005)
    whole, named = case.fit(search.hypothesis(LIBRARY[:1])), case.fit(search.hypothesis(()))
    few = cast("LeaveOneOut", object())
    found = Found(case, whole, named, few, case.unexplained(whole), 1.0, {MOTOR1: limit_nm}, ())
    assert found.matters is matters
    left, shown = _remaining(found, named)
    assert shown is (whole if matters else named)
    assert left.worst_nm == case.unexplained(shown).worst_nm
