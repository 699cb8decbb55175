"""One more run must not take a cause away without a word, and not where it predicts the held-out runs clearly better."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from jtqd.sysid.diagnosis import acceptance, fewer_runs
from jtqd.sysid.diagnosis.acceptance import UNSTEADY, Found
from jtqd.sysid.diagnosis.case import Case, Fit
from jtqd.sysid.diagnosis.dataset import Dataset
from jtqd.sysid.diagnosis.fewer_runs import Compared, Gone, _confirmed, with_fewer
from jtqd.sysid.diagnosis.findings import UNEXPLAINED
from jtqd.sysid.diagnosis.mixed_model import Mixed
from jtqd.sysid.diagnosis.noise import Noise
from jtqd.sysid.diagnosis.refine import Refined
from jtqd.sysid.diagnosis.search import Hypothesis
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.stability import Stability
from jtqd.sysid.diagnosis.unexplained import Unexplained
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, Dense, search_of
from tests.sysid.diagnosis.test_search import LIBRARY, problem
from validation.diagnosis.benches import hidden_size
from validation.diagnosis.entries import Hidden
from validation.diagnosis.measured_bench import MeasuredBench
from validation.diagnosis.recorder import Recorder
from validation.diagnosis.scores import judged


def test_a_search_without_a_run_is_the_search_of_the_others() -> None:
    one = problem(3, {0: 0.8, 2: 0.3})
    part = search_of(one, LIBRARY).without_run(1)
    there = [0, 2, 3, 4]
    others = search_of(Dense(*([part[k] for k in there] for part in (one.x, one.z, one.y))), LIBRARY)
    assert [c.key for c in part.run().chosen] == [c.key for c in others.run().chosen]
    chosen = [c for c in LIBRARY if c.first in (0, 2)]
    assert part.hypothesis(chosen).model.beta == pytest.approx(others.hypothesis(chosen).model.beta)
    assert part.mixed.runs == 4


def test_a_subset_keeps_its_pieces() -> None:
    whole = problem(3, {0: 0.8}).mixed([0.3])
    pieces = copy.copy(whole)
    pieces.pieces = np.array([0, 0, 1, 2, 2])
    pieces.grams = np.array([whole.grams[:2].sum(axis=0), whole.grams[2], whole.grams[3:].sum(axis=0)])
    part: Mixed = pieces.subset([0, 2])
    assert part.pieces.tolist() == [0, 0, 1, 1]
    assert part.grams == pytest.approx(pieces.grams[[0, 2]])


def one_beside_none(squares: Sequence[float]) -> tuple[Compared, Hypothesis]:
    """Nothing named, and an effect with these squared errors on the held-out runs where nothing leaves 1."""
    search = search_of(problem(3, {0: 0.8}), LIBRARY)
    other = search.hypothesis(LIBRARY[:1])

    class LeftOut:
        def squares(self, h: Hypothesis) -> list[dict[str, float]]:
            return [{"motor": x} for x in (squares if h is other else [1.0, 1.0, 1.0])]

    compared = object.__new__(Compared)
    compared.search, compared.named = search, search.hypothesis(())
    vars(compared)["_left_out"] = LeftOut()
    return compared, other


@pytest.mark.parametrize(
    ("squares", "better"),
    [([0.5, 0.9, 1.0], True), ([0.97, 0.98, 0.96], False), ([0.1, 0.2, 1.2], False)],
    ids=["all together", "as good", "one run worse"],
)
def test_clearly_better_is_on_all_runs_together_and_worse_on_none(squares: list[float], better: bool) -> None:
    compared, other = one_beside_none(squares)
    assert compared.clearly_better(other) is better
    assert compared.nm(compared.named) == pytest.approx(1.0)


class Unfitted(Case):
    """A case whose fits are the sets of effects alone, each of 1 Nm rms."""

    def fit(self, hypothesis: Hypothesis) -> Fit:
        return Fit(hypothesis, cast("Refined", None))

    def rms_nm(self, fit: Fit) -> list[dict[Channel, float]]:
        return [{MOTOR1: 1.0} for _ in fit.chosen]


@pytest.mark.parametrize(
    ("left_nm", "ratio", "kept"), [(0.5, 7.0, False), (0.5, 9.0, True), (0.1, 7.0, True)]
)
def test_beside_what_is_left_over_only_what_is_steady_is_kept(
    monkeypatch: pytest.MonkeyPatch, left_nm: float, ratio: float, kept: bool
) -> None:
    """However much better the held-out runs are with it: the unexplained residual may make it so."""
    compared, other = one_beside_none([0.5, 0.5, 0.5])
    monkeypatch.setattr(fewer_runs, "objections", lambda *_: [])
    steady = Stability(ratio, 8.0, "velocity")
    monkeypatch.setattr(acceptance, "stability", lambda _, __, nothing: [steady for _ in nothing])
    case = Unfitted(cast("Dataset", None), cast("Noise", None), compared.search, 0.005)
    nothing, left = case.fit(compared.named), Unexplained((), (), (), (), worst_nm={MOTOR1: left_nm})
    found = Found(case, nothing, nothing, None, left, 0.01, {MOTOR1: 0.2}, ())
    key = LIBRARY[0].key
    best, why = _confirmed(found, compared, [(key, other)])
    assert (best is other, why) == (kept, {} if kept else {key: UNSTEADY})


def test_a_line_says_what_went_and_what_the_runs_left_out_say() -> None:
    text = Gone(LIBRARY[0], ("a.csv", "b.csv", "c.csv", "d.csv"), (0.5, 0.4), "it cancels x").text
    assert text == (
        "coulomb_friction of joint 1 would be named without a.csv, b.csv, c.csv, .., but is not with all runs: "
        "the error on held-out runs is 0.5 Nm rms with it, 0.4 as named; it cancels x"
    )


def test_what_two_recordings_of_a_real_arm_name_does_not_go_without_a_word() -> None:
    size = hidden_size("measured", "torque_constant_saturation", 3.0)
    assert size is not None
    drawn = MeasuredBench().draw(1042395857, [Hidden("torque_constant_saturation", 1, size)])
    three = judged(drawn.runs[:3], drawn.joints, Recorder(), 1)  # two of them name it
    assert three.verdict == UNEXPLAINED
    assert not three.causes
    assert any(r.startswith("coulomb_friction of joint 1 would be named without") for r in three.reasons)


def test_the_signals_end_with_the_torsion_of_what_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer runs are fitted on the same signals; where they name nothing new, what is named is fitted last all the same."""
    fitted = []

    class Recorded:
        def fit(self, hypothesis: object) -> object:
            fitted.append(hypothesis)
            return Fit(cast(Hypothesis, hypothesis), cast(Refined, None))

    def of_fewer(found: Found, here: object, again: object) -> list[tuple[str, list[object]]]:
        cast(Recorded, found.case).fit("of fewer runs")
        return [("run_1", [])]

    monkeypatch.setattr(fewer_runs, "_named_by_fewer", of_fewer)
    best = search_of(problem(3, {0: 0.8}), LIBRARY).hypothesis(())
    found = SimpleNamespace(
        case=Recorded(),
        named=Fit(best, cast(Refined, None)),
        classes=[],
        whole=Fit(best, cast(Refined, None)),
    )
    after, said = with_fewer(cast(Found, found), lambda number: [])
    assert (after, said) == (found, [])
    assert fitted == ["of fewer runs", best]


def test_what_is_left_over_is_that_of_what_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """All effects found and what they leave are of one fit, also when fewer runs have added one."""
    search = search_of(problem(3, {0: 0.8}), LIBRARY)
    before, kept = search.hypothesis(()), search.hypothesis(LIBRARY[:1])

    class WithLeft(Unfitted):
        def unexplained(self, fit: Fit) -> Unexplained:
            return Unexplained((), (), (), (), worst_nm={MOTOR1: 0.1 if fit.chosen else 0.5})

        def held_nm(self, fit: Fit) -> dict[Channel, float]:
            return {}

        @property
        def limits(self) -> dict[Channel, float]:
            return {MOTOR1: 0.2}

    case = WithLeft(cast("Dataset", None), cast("Noise", None), search, 0.005)
    found = Found.of(case, case.fit(before), case.fit(before), None, ())
    assert found.matters
    monkeypatch.setattr(fewer_runs, "_named_by_fewer", lambda *_: [("run_1", LIBRARY[:1])])
    monkeypatch.setattr(fewer_runs, "_confirmed", lambda *_: (kept, {}))
    monkeypatch.setattr(Compared, "__init__", lambda self, *_: None)
    monkeypatch.setattr(Compared, "nm", lambda *_: 0.3)
    after, said = with_fewer(found, lambda number: [])
    assert after.whole.hypothesis is after.named.hypothesis is kept
    assert after.left.worst_nm == {MOTOR1: 0.1}
    assert not after.matters
    assert said[0].startswith("coulomb_friction of joint 1 is named because fewer")
