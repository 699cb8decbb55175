"""Accept the effects that are relevant, pass every guard, and stay stable in the presence of unexplained residual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

from jtqd.sysid.diagnosis.case import Case, Fit
from jtqd.sysid.diagnosis.evidence import class_beside, equivalence_class
from jtqd.sysid.diagnosis.findings import joint_text
from jtqd.sysid.diagnosis.guards import nothing_of, objections
from jtqd.sysid.diagnosis.leave_one_out import LeaveOneOut
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.stability import stability
from jtqd.sysid.diagnosis.unexplained import Unexplained

UNEXPLAINED_SHARE: Final = 0.05
"""Part of all structure (as squares) that must stay unexplained as well for it to matter."""
FEW_UNEXPLAINED_SHARE: Final = 0.2
"""The same with two or three runs, where more of the unexplained residual is the runs' own."""
UNSTEADY: Final = "its size is not the same in all runs and under all conditions"
BESIDE: Final = 0.02
"""Part of the largest cause's contribution below which another one is within the model's own inaccuracy."""
_FAR_FROM_CERTAIN: Final = 0.25
"""Part of the stability that is needed below which effects are taken away at once, not one by one."""
_MOST_LINES: Final = 4
"""Lines about effects that fit and are not named."""


@dataclass(frozen=True)
class Found:
    """What was found in a case, and what may be named of it.

    whole: all that no guard objects to; named: what of it is certain enough; few: the rule for few runs, None with enough;
    left: what `whole` leaves over; share: of all structure; limits: rms from which it matters [Nm]; refused: the objections.
    """

    case: Case
    whole: Fit
    named: Fit
    few: LeaveOneOut | None
    left: Unexplained
    share: float
    limits: Mapping[Channel, float]
    refused: Sequence[str]

    @classmethod
    def of(cls, case: Case, whole: Fit, named: Fit, few: LeaveOneOut | None, refused: Sequence[str]) -> Found:
        """Return it with what `whole` leaves over."""
        left = case.unexplained(whole)
        share = left.share(sum(case.energies_nm2(whole)))
        return cls(case, whole, named, few, left, share, case.limits, refused)

    @property
    def large(self) -> bool:
        """Whether the unexplained residual is relevant by its size."""
        return any(nm > self.limits[c] for c, nm in self.left.worst_nm.items())

    @cached_property
    def held_nm(self) -> dict[Channel, float]:
        """What held channels cost, where that is relevant by its size [Nm]."""
        return {c: nm for c, nm in self.case.held_nm(self.whole).items() if nm > self.limits[c]}

    def remains_nm2(self, left: Unexplained) -> float:
        """Return the energy of the unexplained residual and of what `held_nm` is made of, summed over channels [Nm^2]."""
        held = self.case.held_energies_nm2(self.whole) if self.held_nm else {}
        return left.energy_nm2() + sum(held[c] for c in self.held_nm)

    @property
    def matters(self) -> bool:
        """Whether something is not explained that matters: the unexplained residual, or what is wrong with a channel."""
        return self.left_matters or bool(self.held_nm)

    @property
    def left_matters(self) -> bool:
        """Whether the unexplained residual matters: by its size, and as a part of the gap."""
        part = UNEXPLAINED_SHARE if self.few is None else FEW_UNEXPLAINED_SHARE
        return self.large and (self.share > part or not self.whole.chosen)

    @property
    def beside(self) -> bool:
        """Whether causes have to be certain in the presence of an unexplained residual, however small a part of the
        gap it is: a small effect may imitate it. With few runs they have a rule of their own.
        """
        return self.large and self.few is None

    @cached_property
    def classes(self) -> list[tuple[EffectCandidate, ...]]:
        """Per effect that may be named the alternatives that these runs do not rule out."""
        best = self.named.hypothesis
        if self.few is not None:
            return [self.few.rivals(best, c) for c in best.chosen]
        alternatives = class_beside if self.beside else equivalence_class
        return [alternatives(self.case.search, best, c) for c in best.chosen]


def found_in(case: Case, fit: Fit) -> Found:
    """Return what was found in a case; fit: of the best set of its search."""
    few = LeaveOneOut(case.dataset, case.search) if case.few else None
    whole, refused = _guarded(case, fit, bounds_only=few is not None)
    found = Found.of(case, whole, whole, few, refused)
    if few is not None:  # the unexplained residual is judged with all that was found, names need more
        named, refused = _guarded(case, case.fit(few.confirmed(whole.hypothesis)))
        with_names = Found.of(case, named, named, few, refused)
        if with_names.left.energy_nm2() < found.left.energy_nm2():
            return with_names
        return replace(found, named=named, refused=refused)
    if not found.beside:
        return found
    sure = certain(case, whole)
    weak = [c for c in whole.chosen if c not in sure.chosen]
    if weak and not found.matters:  # what is not certain is unexplained, too
        return Found.of(case, sure, sure, few, [*refused, *(_refused(c, UNSTEADY) for c in weak)])
    return replace(found, named=sure)


def named_in(case: Case, fit: Fit) -> Sequence[EffectCandidate]:
    """Return what may be named of a case, without a look at fewer runs."""
    return found_in(case, fit).named.chosen


def certain(case: Case, fit: Fit) -> Fit:
    """Return the fit of those effects only that are stable in the presence of any unexplained residual (`stability`)."""
    while fit.chosen:
        margins = [s.margin for s in stability(fit.refined, case.noise, nothing_of(fit.hypothesis))]
        if min(margins) >= 1.0:
            break
        least = max(min(margins), _FAR_FROM_CERTAIN)
        fit = case.refit(fit, [c for c, m in zip(fit.chosen, margins, strict=True) if m > least])
    return _relevant(case, fit)


def _guarded(case: Case, fit: Fit, *, bounds_only: bool = False) -> tuple[Fit, list[str]]:
    """Return the fit without irrelevant effects and without those that a guard objects to, and the objections; with enough
    runs the search is made again without the first of them.
    """
    refused: list[str] = []
    while True:
        fit = _relevant(case, fit)
        against = objections(case.dataset, fit.hypothesis, fit.refined, bounds_only=bounds_only)
        if not against:
            return fit, refused[:_MOST_LINES]
        again = not refused and not case.few
        weak = [fit.chosen[k] for k, _ in against]
        refused += [_refused(c, why) for c, (_, why) in zip(weak, against, strict=True)]
        case.search.rejected.update(c.key for c in weak)
        rest = [c for c in fit.chosen if c not in weak]
        fit = case.fit(case.search.confirmed()) if again else case.refit(fit, rest)


def _relevant(case: Case, fit: Fit) -> Fit:
    """Return the fit without effects that are too small to matter, by themselves or beside the largest."""
    while True:
        sizes = [max(rms.values(), default=0.0) for rms in case.rms_nm(fit)]
        least = max(case.search.least_nm, BESIDE * max(sizes, default=0.0))
        large = [c for c, size in zip(fit.chosen, sizes, strict=True) if size >= least]
        if len(large) == len(fit.chosen):
            return fit
        fit = case.refit(fit, large)


def _refused(candidate: EffectCandidate, why: str) -> str:
    return f"{candidate.effect.name} of {joint_text(candidate.joint)} fits but is not named: {why}"
