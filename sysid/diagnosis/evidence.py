"""Evidence of every effect of the library: alone against the baseline, smallest size detectable, equivalence classes.

An effect of coefficients b lowers the deviance by about d = b' I b. I is the information of its columns, less what the
causes found and the changes from run to run take of it. The effect is detected when d exceeds its cost in BIC plus ENTER;
this gives the minimum detectable size. Where the runs' own changes limit it, their variance is itself estimated from few
runs, and the same evidence needs a larger ratio: t^2 = n (exp(d/n) - 1) instead of d.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from scipy import stats

from jtqd.sysid.diagnosis.findings import CandidateEvidence as Evidence
from jtqd.sysid.diagnosis.findings import JointName, Value
from jtqd.sysid.diagnosis.mixed_model import Mixed, explained, solve
from jtqd.sysid.diagnosis.regressors import EffectCandidate
from jtqd.sysid.diagnosis.search import ENTER, HELD_OUT, Hypothesis, Search, order_of
from jtqd.sysid.diagnosis.stability import CHANCE, jackknife, needed

RELEVANT: Final = 1e-3
"""Part of the rated torque below which a contribution (rms over the runs) is not called an effect, however certain."""


_LARGEST: Final = 0.2
"""Part of the rated torque: a torque that would have to be larger to show is invisible."""
_COLLINEAR: Final = 1e-4
"""Below this part of its information nothing is left beside a rival: no size would distinguish the two."""


def information(
    mixed: Mixed, best: Hypothesis, candidate: EffectCandidate, rival: EffectCandidate | None = None
) -> tuple[float, float]:
    """Return (information of its leading coefficient, share of the uncertainty that is the runs' own changes).

    For waves the worst phase. Columns already chosen for the same effect count as known. rival: another candidate that it
    must be distinguished from.
    """
    base = [k for c in best.chosen if c.key != candidate.key for k in c.columns]
    if rival is not None:
        base += [k for k in rival.columns if k not in base]
    wave = "phase_rad" in candidate.term.basis[0]
    out = []
    for variances in (best.model.variances, np.full_like(best.model.variances, 1e-12)):
        total, _ = mixed.marginal(variances)
        mine = list(candidate.columns)
        inner = total[np.ix_(mine, mine)]
        if base:
            cross = total[np.ix_(mine, base)]
            gram = total[np.ix_(base, base)]
            scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-30))
            gram = gram * scale[:, None] * scale + 1e-9 * np.eye(len(base))
            inner = inner - (cross * scale) @ np.linalg.solve(gram, (cross * scale).T)
        if wave or len(mine) == 1:
            out.append(float(np.linalg.eigvalsh(inner)[0]))
        else:
            rest = inner[1:, 1:]
            lead = inner[0, 0] - inner[0, 1:] @ np.linalg.pinv(rest) @ inner[1:, 0]
            out.append(float(lead))
    known, free = out
    if free <= 0.0:
        return 0.0, 0.0
    return max(known, 0.0), min(max(1.0 - known / free, 0.0), 1.0)


def complete_minimum(search: Search, best: Hypothesis, candidate: EffectCandidate) -> dict[str, float] | None:
    """Return all parameters of a candidate at its minimum detectable size, None where no plausible size shows."""
    ((lead, minimum),) = minimum_size(search, best, candidate).items()
    value = minimum.value
    if not math.isfinite(value):
        return None
    rest = [0.0] * (candidate.size - 1)
    one, none = candidate.term.combine([1.0, *rest]), candidate.term.combine([0.0, *rest])
    step = one[lead] - none.get(lead, 0.0)
    return dict(candidate.term.combine([value / step, *rest]))


def minimum_size(
    search: Search, best: Hypothesis, candidate: EffectCandidate, *, unexplained: bool = False
) -> dict[str, Value]:
    """Return the leading parameter at its minimum detectable size, for a key of the joint file as a difference to it;
    infinite where no plausible size shows. unexplained: something that matters is, see `steady_size`.
    """
    known, share = information(search.mixed, best, candidate)
    for rival in search.candidates:  # found, and at the right joint
        same = (
            rival.effect.name == candidate.effect.name
            and rival.term.basis[0].keys() == candidate.term.basis[0].keys()
        )
        if same and rival.joint != candidate.joint and order_of(rival) == order_of(candidate):
            beside, beside_share = information(search.mixed, best, candidate, rival)
            if _COLLINEAR * known < beside < known:
                known, share = beside, beside_share
    one = candidate.term.combine([1.0, *([0.0] * (candidate.size - 1))])
    none = candidate.term.combine([0.0] * candidate.size)
    moved = [p for p in candidate.effect.parameters if not p.fixed and one.get(p.name) != none.get(p.name)]
    lead = next(p for p in moved or candidate.effect.parameters if p.name not in ("phase_rad", "reference_c"))
    nothing = {lead.name: Value(math.inf, (math.inf, math.inf), lead.unit)}
    if known <= 0.0:
        return nothing
    need = ENTER + search.penalty(candidate)
    runs = search.mixed.runs + 1.0
    square = (1.0 - share) * need + share * runs * math.expm1(min(need / runs, 50.0))
    per_unit = search.column_rms[candidate.first]
    if per_unit <= 0.0:
        return nothing
    size = max(math.sqrt(square / known), search.least_nm / per_unit)
    if unexplained:
        size = max(size, steady_size(search, best, candidate))
    values = candidate.term.combine([size, *([0.0] * (candidate.size - 1))])
    found = abs(values[lead.name] - none.get(lead.name, 0.0))
    if not math.isfinite(found) or found > min(candidate.largest, max(abs(lead.low), abs(lead.high))):
        return nothing
    if lead.unit == "Nm" and found > _LARGEST * search.least_nm / RELEVANT:
        return nothing
    return {lead.name: Value(found, (found, found), lead.unit)}


def steady_size(search: Search, best: Hypothesis, candidate: EffectCandidate) -> float:
    """Return the smallest leading coefficient of a candidate that would be stable over the runs (`stability`), fitted beside
    the best set: the jackknife's standard error times the factor that is needed. For waves the worse phase; infinite for one
    run.
    """
    runs = search.mixed.runs
    if runs < 2:
        return math.inf
    base = [k for c in best.chosen if c.key != candidate.key for k in c.columns]
    marginals, _ = search.mixed.marginal_runs(best.model.variances)
    places = np.array([*base, *candidate.columns, marginals.shape[1] - 1], np.intp)
    marginals = marginals[:, places[:, None], places[None, :]]
    total = marginals.sum(axis=0)
    errors = jackknife(np.array([solve(total - one, len(places) - 1)[0] for one in marginals]))
    leading = candidate.size if "phase_rad" in candidate.term.basis[0] else 1
    return needed(runs) * float(errors[len(base) : len(base) + leading].max())


WITHIN: Final = 6.0
"""An alternative this close in BIC is as good (`strong evidence` begins there)."""
MISFIT: Final = 0.02
"""Part of an effect's evidence that imperfections of the model may be worth: an alternative that explains all but this
of it is not ruled out by it.
"""
_COMPARABLE: Final = 0.5
"""Part of an effect's evidence below which another one is no alternative to it."""


def equivalence_class(
    search: Search, best: Hypothesis, cause: EffectCandidate
) -> tuple[EffectCandidate, ...]:
    """Return the candidates (one per effect and joint) that could stand in the place of `cause`, best first."""
    others = [c for c in best.chosen if c is not cause]
    evidence = search.without(best, cause).model.squares - best.model.squares
    room = WITHIN + MISFIT * max(evidence, 0.0)
    total, _ = search.mixed.marginal(best.model.variances)
    base = [k for c in others for k in c.columns]
    worth = explained(total, base, list(cause.columns)) - search.penalty(cause)
    found: dict[tuple[str, object], Hypothesis] = {}
    where: dict[tuple[str, object], EffectCandidate] = {}
    for candidate in search.candidates:
        if candidate.key == cause.key or not search.fits_beside(candidate, others):
            continue
        drop = explained(total, base, list(candidate.columns)) - search.penalty(candidate)
        if drop < worth - 2.0 * room:
            continue
        rival = search.hypothesis((*others, candidate), best.model)
        worse = rival.model.squares - best.model.squares
        # the runs' own changes may be bought by a rival, but not at a discount
        price = rival.bic - best.bic - max(worse, 0.0)
        # what a drive reads without power is no matter of the model's imperfections
        refuted = search.reading_misfit(rival) - search.reading_misfit(best) > WITHIN
        if worse < room and price < WITHIN and not refuted and search.plausible(rival):
            key = candidate.key
            if key not in found or rival.bic < found[key].bic:
                found[key], where[key] = rival, candidate
    order = sorted(found, key=lambda key: found[key].bic)
    return tuple(where[key] for key in order)


def class_beside(search: Search, best: Hypothesis, cause: EffectCandidate) -> tuple[EffectCandidate, ...]:
    """Return the candidates that could stand in the place of `cause` where a relevant residual is unexplained, best first.

    The unexplained residual is no noise, so no likelihood measures by how much one effect fits better than another. An
    alternative is ruled out when it is worse on the held-out runs, by more than that difference varies from run to run (test
    of Vuong 1989, Econometrica 57, for models of which none is right).
    """
    found = {c.key: c for c in equivalence_class(search, best, cause)}
    others = [c for c in best.chosen if c is not cause]
    total, _ = search.mixed.marginal(best.model.variances)
    base = [k for c in others for k in c.columns]
    worth = explained(total, base, list(cause.columns))
    mine = search.held_out_deviances(best)
    runs = len(mine)
    enough = float(stats.t.isf(CHANCE, max(runs - 1, 1))) / math.sqrt(runs)
    worse_by: dict[tuple[str, object], float] = dict.fromkeys(found, -math.inf)
    for candidate in search.candidates:
        if candidate.key == cause.key or not search.fits_beside(candidate, others):
            continue
        if explained(total, base, list(candidate.columns)) < _COMPARABLE * worth:
            continue
        rival = search.hypothesis((*others, candidate), best.model)
        worse = search.held_out_deviances(rival) - mine
        refuted = search.reading_misfit(rival) - search.reading_misfit(best) > WITHIN
        if worse.mean() > enough * worse.std(ddof=1) or refuted or not search.plausible(rival):
            continue
        if worse.mean() < worse_by.get(candidate.key, math.inf):
            found[candidate.key], worse_by[candidate.key] = candidate, float(worse.mean())
    return tuple(found[key] for key in sorted(found, key=lambda key: worse_by[key]))


def candidate_table(
    search: Search,
    best: Hypothesis,
    rivals: Mapping[tuple[str, JointName], str],
    *,
    unexplained: bool = False,
) -> tuple[Evidence, ...]:
    """Return one row per effect and joint, most evidence first; rivals: (effect, joint) -> cause it could replace;
    unexplained: something that matters is, so that a size must be steady to be detected.
    """
    groups: dict[tuple[str, object], list[EffectCandidate]] = {}
    for c in search.candidates:
        groups.setdefault(c.key, []).append(c)
    rows = [_row(search, best, terms, rivals, unexplained=unexplained) for terms in groups.values()]
    return tuple(sorted(rows, key=lambda row: -row.delta_bic))


def _row(
    search: Search,
    best: Hypothesis,
    terms: Sequence[EffectCandidate],
    rivals: Mapping[tuple[str, JointName], str],
    *,
    unexplained: bool,
) -> Evidence:
    """Return the evidence of one effect of one joint: of the term of it that explains most."""
    nothing = search.hypothesis(())
    total, _ = search.mixed.marginal(nothing.model.variances)
    candidate = max(terms, key=lambda c: explained(total, [], list(c.columns)) - search.penalty(c))
    alone = search.hypothesis((candidate,))
    delta = nothing.bic - alone.bic
    drop = nothing.model.deviance - alone.model.deviance
    held = search.held_out(alone, candidate) / drop if drop > 1.0 else 0.0
    sizes = [minimum_size(search, best, c, unexplained=unexplained) for c in terms]
    minimum = _smallest(sizes)
    minimum_rms = min(_rms_of(search, c, m) for c, m in zip(terms, sizes, strict=True))
    chosen = any(c.key == candidate.key for c in best.chosen)
    if chosen:
        reason = "chosen"
    elif candidate.key in rivals:
        reason = f"class of {rivals[candidate.key]}"
    elif not all(math.isfinite(v.value) for v in minimum.values()):
        reason = "invisible in these runs"
    elif delta < ENTER:
        reason = "below threshold"
    elif held < HELD_OUT:
        reason = "does not help on held-out runs"
    elif search.size_nm(alone, candidate) < search.least_nm:
        reason = "too small to be relevant"
    elif not search.plausible(alone):
        reason = "implausible parameters"
    else:
        reason = "explained by the chosen effects"
    return Evidence(
        candidate.effect.name,
        candidate.joint,
        delta,
        held,
        _shared(search, best, candidate),
        minimum,
        reason,
        tuple(m for c in terms if (m := complete_minimum(search, best, c)) is not None),
        minimum_rms,
    )


def _rms_of(search: Search, candidate: EffectCandidate, size: Mapping[str, Value]) -> float:
    """Return what a candidate of this size of its leading parameter contributes [Nm rms]."""
    ((name, value),) = size.items()
    rest = [0.0] * (candidate.size - 1)
    step = candidate.term.combine([1.0, *rest])[name] - candidate.term.combine([0.0, *rest]).get(name, 0.0)
    return float(abs(value.value / step) * search.column_rms[candidate.first])


def _smallest(found: Sequence[Mapping[str, Value]]) -> Mapping[str, Value]:
    return min(found, key=lambda m: next(iter(m.values())).value)


def _shared(search: Search, best: Hypothesis, candidate: EffectCandidate) -> float:
    """Return which part of the candidate's evidence the chosen causes take away, 0 to 1; NaN without causes."""
    others = [k for c in best.chosen if c.key != candidate.key for k in c.columns]
    if not others:
        return math.nan
    total, _ = search.mixed.marginal(best.model.variances)
    alone = explained(total, [], list(candidate.columns))
    beside = explained(total, others, list(candidate.columns))
    return min(max(1.0 - beside / alone, 0.0), 1.0) if alone > 0.0 else math.nan
