"""What fewer runs would have named: more data must not make a diagnosis worse without a word.

Every recording is left out in turn and the others are searched anew, by the same rules. An effect that they name and all
runs together do not is kept where it predicts the runs left out clearly better, each with the coefficients of the others
(`FALL` of the squared error of all, and no run clearly worse); else a line says that it went, and what the runs left out
say of it. An effect that comes and goes with single runs is unstable in the sense of Meinshausen and Buehlmann 2010,
J. R. Stat. Soc. B 72.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.dataset import FEWEST_RUNS, SHORTEST_MOVING_S, Dataset, moving_s
from jtqd.sysid.diagnosis.findings import JointName, joint_text
from jtqd.sysid.diagnosis.leave_one_out import FALL, LeaveOneOut
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import Hypothesis, Search

Key = tuple[str, JointName]
Names = Callable[[int], Sequence[EffectCandidate]]
"""What is named without a recording, by its number."""
MOST_ANEW: Final = 5
"""Recordings up to which the others are diagnosed anew from their signals on, where it matters (few runs, or something is
left over); else the sums of all runs are searched again, which costs a tenth.
"""
_NAMED_RUNS: Final = 3
"""Runs listed in a line."""


@dataclass(frozen=True)
class Gone:
    """An effect that the runs without some recordings name, and all of them do not; nm: error on runs left out with it, and
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
            f"with all runs: the error on runs left out is {self.nm[0]:.3g} Nm rms with it, {self.nm[1]:.3g} as named{why}"
        )


def kept_text(candidate: EffectCandidate, before_nm: float, after_nm: float) -> str:
    """Return the line about an effect that is kept."""
    return (
        f"{candidate.effect.name} of {joint_text(candidate.joint)} is named because fewer of these runs name it and the "
        f"error on runs left out falls with it from {before_nm:.3g} to {after_nm:.3g} Nm rms"
    )


def named_by_fewer(
    dataset: Dataset, search: Search, names: Names
) -> Iterator[tuple[str, Sequence[EffectCandidate]]]:
    """Yield (run left out, what the others name) of every recording, where the others are enough."""
    for number in range(search.mixed.runs):
        others = dataset.without_recording(number).signals
        if search.mixed.runs - 1 < FEWEST_RUNS or moving_s(others) < SHORTEST_MOVING_S:
            continue
        left_out = dataset.runs[int(np.argmax(search.mixed.pieces == number))].name
        yield left_out, names(number)


def same_candidates(search: Search, chosen: Sequence[EffectCandidate]) -> list[EffectCandidate]:
    """Return the search's own candidates of these effects, of the same term where it has that."""
    out = []
    for c in chosen:
        mine = [o for o in search.candidates if o.key == c.key]
        same = [o for o in mine if dict(o.term.basis[0]) == dict(c.term.basis[0])]
        out += (same or mine)[:1]
    return out


class Compared:
    """Sets of effects by their errors on the runs left out, beside one that is named."""

    def __init__(self, dataset: Dataset, search: Search, named: Hypothesis) -> None:
        self.search = search
        self._left_out = LeaveOneOut(dataset, search)
        self.named = named

    def nm(self, hypothesis: Hypothesis) -> float:
        """Return the error on the runs left out [Nm rms], all balances together."""
        return float(np.sqrt(self._per_run(hypothesis).mean()))

    def clearly_better(self, hypothesis: Hypothesis) -> bool:
        """Return whether a set predicts all runs left out together better by FALL, and none worse by that."""
        mine, named = self._per_run(hypothesis), self._per_run(self.named)
        falls = 1.0 - mine / np.maximum(named, 1e-30)
        return bool(
            1.0 - mine.sum() / max(named.sum(), 1e-30) >= FALL
            and falls.min() > -FALL
            and self.search.plausible(hypothesis)
        )

    def _per_run(self, hypothesis: Hypothesis) -> FloatArray:
        return np.array([sum(run.values()) for run in self._left_out.squares(hypothesis)])
