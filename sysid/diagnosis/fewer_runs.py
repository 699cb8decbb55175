"""Causes that a subset of the runs supports and the full set does not: each is reported with its reason.

Every recording is left out in turn and the others are searched again, by the same rules. Some effects are named by such a
subset and not by all runs together. Such an effect is kept where it predicts the held-out runs clearly better, each with
the coefficients of the others (`FALL` of the squared error of all, and no run clearly worse). Else a line reports that it
went, and its error on the held-out runs. An effect that comes and goes with single runs is unstable in the sense of
Meinshausen and Buehlmann 2010, J. R. Stat. Soc. B 72.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.acceptance import UNSTEADY, Found, certain, named_in
from jtqd.sysid.diagnosis.case import Case
from jtqd.sysid.diagnosis.dataset import FEWEST_RUNS, SHORTEST_MOVING_S, Dataset, moving_s
from jtqd.sysid.diagnosis.findings import JointName, joint_text
from jtqd.sysid.diagnosis.guards import objections
from jtqd.sysid.diagnosis.leave_one_out import FALL, LeaveOneOut
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import Hypothesis, Search

Key = tuple[str, JointName]
Names = Callable[[int], Sequence[EffectCandidate]]
"""What is named without a recording, by its number."""
MOST_REPEATED: Final = 5
"""Recordings up to which the others are diagnosed again from their signals on, where it matters (few runs, or something is
unexplained); else the sums of all runs are searched again, which costs a tenth.
"""
_NAMED_RUNS: Final = 3
"""Runs listed in a line."""


@dataclass(frozen=True)
class Gone:
    """An effect that the runs without some recordings name, and all of them do not; nm: error on held-out runs with it, and
    with what is named [Nm rms]; why: what a guard objects to.
    """

    candidate: EffectCandidate
    without: tuple[str, ...]
    nm: tuple[float, float]
    why: str = ""

    @property
    def text(self) -> str:
        """One line for the reasons."""
        names = ", ".join(self.without[:_NAMED_RUNS]) + (", .." if len(self.without) > _NAMED_RUNS else "")
        why = f"; {self.why}" if self.why else ""
        return (
            f"{self.candidate.effect.name} of {joint_text(self.candidate.joint)} would be named without {names}, but is not "
            f"with all runs: the error on held-out runs is {self.nm[0]:.3g} Nm rms with it, {self.nm[1]:.3g} as named{why}"
        )


def kept_text(candidate: EffectCandidate, before_nm: float, after_nm: float) -> str:
    """Return the line about an effect that is kept."""
    return (
        f"{candidate.effect.name} of {joint_text(candidate.joint)} is named because fewer of these runs name it and the "
        f"error on held-out runs falls with it from {before_nm:.3g} to {after_nm:.3g} Nm rms"
    )


class Compared:
    """Sets of effects by their errors on the held-out runs, beside one that is named."""

    def __init__(self, dataset: Dataset, search: Search, named: Hypothesis) -> None:
        self.search = search
        self._left_out = LeaveOneOut(dataset, search)
        self.named = named

    def nm(self, hypothesis: Hypothesis) -> float:
        """Return the error on the held-out runs [Nm rms], all balances together."""
        return float(np.sqrt(self._per_run(hypothesis).mean()))

    def clearly_better(self, hypothesis: Hypothesis) -> bool:
        """Return whether a set predicts all held-out runs together better by FALL, and none worse by that."""
        mine, named = self._per_run(hypothesis), self._per_run(self.named)
        falls = 1.0 - mine / np.maximum(named, 1e-30)
        return bool(
            1.0 - mine.sum() / max(named.sum(), 1e-30) >= FALL
            and falls.min() > -FALL
            and self.search.plausible(hypothesis)
        )

    def _per_run(self, hypothesis: Hypothesis) -> FloatArray:
        return np.array([sum(run.values()) for run in self._left_out.squares(hypothesis)])


def with_fewer(found: Found, names_without: Names) -> tuple[Found, list[str]]:
    """Return what was found, with what only fewer runs name where held-out runs confirm it, and a line about each such
    effect; names_without: what a diagnosis without a recording reports.
    """
    case, best = found.case, found.named.hypothesis
    here = {c.key for c in best.chosen} | {c.key for others in found.classes for c in others}
    gone: dict[Key, tuple[EffectCandidate, list[str]]] = {}
    sets: list[Sequence[EffectCandidate]] = []
    for without, chosen in _named_by_fewer(found, here, names_without):
        new = [c for c in chosen if c.key not in here]
        for c in new:
            gone.setdefault(c.key, (c, []))[1].append(without)
        sets += [chosen] if new else []
    if not gone:
        case.fit(best)  # the signals have the torsion of the last fit, which was of fewer runs
        return found, []
    beside = {
        key: case.search.hypothesis((*best.chosen, c), best.model)
        for key, (c, _) in gone.items()
        if case.search.fits_beside(c, best.chosen)
    }
    compared = Compared(case.dataset, case.search, best)
    together = [(None, case.search.hypothesis(chosen, best.model)) for chosen in sets]
    kept, why = _confirmed(found, compared, [*beside.items(), *together])
    fit = case.fit(kept)  # whatever is kept: as above
    lines = [kept_text(c, compared.nm(best), compared.nm(kept)) for c in kept.chosen if c.key in gone]
    there = {c.key for c in kept.chosen}
    for key, (c, runs) in gone.items():
        if key not in there:
            with_it = beside.get(key) or case.search.hypothesis([c], best.model)
            errors = (compared.nm(with_it), compared.nm(kept))
            lines.append(Gone(c, tuple(runs), errors, why.get(key, "")).text)
    if kept is best:
        return found, lines
    if found.whole.hypothesis is best:
        return Found.of(case, fit, fit, found.few, found.refused), lines
    return replace(found, named=fit), lines


def _named_by_fewer(
    found: Found, here: Collection[Key], names_without: Names
) -> Iterator[tuple[str, Sequence[EffectCandidate]]]:
    """Yield (run left out, what the others name) of every recording, where the others are enough; here: what is named with
    all runs, and its alternatives.
    """
    case = found.case
    count = case.search.mixed.runs
    afresh = (found.large or found.few is not None) and count <= MOST_REPEATED
    for number in range(count if count > FEWEST_RUNS else 0):
        part = case.without_recording(number)
        if moving_s(part.dataset.signals) < SHORTEST_MOVING_S:
            continue
        left_out = case.dataset.runs[int(np.argmax(case.search.mixed.pieces == number))].name
        yield (
            left_out,
            _same_candidates(case.search, names_without(number)) if afresh else _named_again(part, here),
        )


def _named_again(part: Case, here: Collection[Key]) -> Sequence[EffectCandidate]:
    """Return what the sums of some runs name, searched again."""
    best = part.search.confirmed()
    quick = LeaveOneOut(part.dataset, part.search).confirmed(best) if part.few else best
    if all(c.key in here for c in quick.chosen):
        return quick.chosen  # nothing to look at closer
    return named_in(part, part.fit(best))


def _same_candidates(search: Search, chosen: Sequence[EffectCandidate]) -> list[EffectCandidate]:
    """Return the search's own candidates of these effects, of the same term where it has that."""
    out = []
    for c in chosen:
        mine = [o for o in search.candidates if o.key == c.key]
        same = [o for o in mine if dict(o.term.basis[0]) == dict(c.term.basis[0])]
        out += (same or mine)[:1]
    return out


def _confirmed(
    found: Found, compared: Compared, tried: Sequence[tuple[Key | None, Hypothesis]]
) -> tuple[Hypothesis, dict[Key, str]]:
    """Return the set that predicts the held-out runs best (the named one competes too) and, by key, the objection to an
    effect that would have been better. In the presence of an unexplained residual all must be as certain as any cause.
    """
    kept, why = compared.named, {}
    for key, other in tried:
        if not compared.clearly_better(other) or compared.nm(other) >= compared.nm(kept):
            continue
        fit = found.case.fit(other)
        against = [reason for _, reason in objections(found.case.dataset, other, fit.refined)]
        if not against and found.beside and certain(found.case, fit).hypothesis is not other:
            against = [UNSTEADY]
        if not against:
            kept = other
        elif key is not None:
            why[key] = against[0]
    return kept, why
