"""One-sided bounds: the upper limit of a value that cannot be negative while its best fit is zero or below. It is no cause.

A friction or inertia that is far smaller than in the joint file is near zero, and noise often puts its best fit below. A
value below zero is never named (`guards`). Still it is certain that the value is smaller than in the file, and by how
much at least. This is reported where the best fit lies below zero by less than its interval, and the value fitted to the
other runs, held at zero or above, takes away `LARGE_FALL` of the squared error of every run left out. Source: restricted
least squares, Judge and Takayama 1966, J. Am. Stat. Assoc. 61.

An effect that a guard has refused at its limit is looked at again: the guard refuses a cause, this reports the bound.

The proof holds for this value at its limit with nothing else changed. So the extended joint file sets a friction to its
limit only if it is the only bound of a joint of which nothing is named (`in_the_file`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.diagnosis.acceptance import Found
from jtqd.sysid.diagnosis.causes import values_of
from jtqd.sysid.diagnosis.findings import BoundedValue, Cause, JointName, RunGain, shows_at
from jtqd.sysid.diagnosis.leave_one_out import LARGE_FALL, LeaveOneOut
from jtqd.sysid.diagnosis.refine import parameter, set_torsions
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import ENTER, Hypothesis, Search

_LEAST: Final = 0.0
"""What a friction or an inertia is at least."""


def bounded_values(found: Found) -> list[BoundedValue]:
    """Return the bounds of values of the joint files that these runs put below zero, in addition to the causes."""
    best = found.named.hypothesis
    known = {c.key for c in best.chosen} | {c.key for others in found.classes for c in others}
    out: dict[tuple[str, JointName], BoundedValue] = {}
    for candidate in found.case.search.candidates:
        if candidate.key not in known and candidate.key not in out:
            one = _bounded(found, best, candidate, known)
            if one is not None:
                out[candidate.key] = one
    set_torsions(found.case.dataset, found.named.refined.present)  # as the fit of what is named left them
    return list(out.values())


def in_the_file(bounded: Sequence[BoundedValue], causes: Sequence[Cause]) -> list[BoundedValue]:
    """Return the bounds, those marked that the extended joint file takes."""
    return [
        replace(
            one,
            in_file=EFFECTS[one.name].dissipative
            and [other.joint for other in bounded].count(one.joint) == 1
            and not any(shows_at(cause.joint, int(one.joint)) for cause in causes),
        )
        for one in bounded
    ]


def _bounded(
    found: Found, best: Hypothesis, candidate: EffectCandidate, known: Collection[tuple[str, JointName]]
) -> BoundedValue | None:
    """Return the bound of one effect, None for nothing."""
    search, joint = found.case.search, candidate.joint
    name = next((p.name for p in candidate.effect.parameters if p.key and p.low == _LEAST), None)
    if name is None or candidate.size > 1 or not search.fits_beside(candidate, best.chosen, again=True):
        return None
    file = candidate.term.combine([0.0])[name]
    limit = (_LEAST - file) / (candidate.term.combine([1.0])[name] - file)
    with_it = search.hypothesis((*best.chosen, candidate), best.model)
    [coefficient] = with_it.coefficients(candidate)
    if file <= _LEAST or coefficient * np.sign(limit) <= abs(limit) or with_it.bic > best.bic - ENTER:
        return None
    left_out = LeaveOneOut(found.case.dataset, search)
    before = left_out.squares(best)
    after = left_out.squares_with(with_it, _held_at(search, with_it, candidate, limit))
    pairs = [(sum(b.values()), sum(a.values())) for b, a in zip(before, after, strict=True)]
    if not all(a < (1.0 - LARGE_FALL) * b for b, a in pairs):
        return None
    fit = found.case.fit(with_it)
    value = values_of(fit, [c.key for c in fit.chosen].index(candidate.key))[name]
    if not _LEAST < value.ci95[1] < file:
        return None
    names = [
        found.case.dataset.runs[int(np.argmax(search.mixed.pieces == r))].name
        for r in range(search.mixed.runs)
    ]
    runs = tuple(RunGain(n, b**0.5, a**0.5) for n, (b, a) in zip(names, pairs, strict=True))
    unit = parameter(candidate.effect, name).unit
    found_value = candidate.term.combine([coefficient])[name]
    return BoundedValue(candidate.effect.name, joint, name, unit, file, found_value, value.ci95[1], runs)


def _held_at(
    search: Search, hypothesis: Hypothesis, candidate: EffectCandidate, limit: float
) -> list[FloatArray]:
    """Return per run the coefficients of all other runs, that of the candidate held at its limit where it is beyond; what
    that changes in the others follows from the covariance.
    """
    place = hypothesis.model.columns.index(candidate.first)
    out = []
    for beta, covariance in search.held_out_fits(hypothesis):
        if beta[place] * np.sign(limit) > abs(limit):
            change = covariance[:, place] / covariance[place, place] * (limit - beta[place])
            out.append(beta + change)
        else:
            out.append(beta)
    return out
