"""Evidence of every effect of the library, for the table of the report: alone against the baseline. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from sysid.diagnosis.columns import Candidate
from sysid.diagnosis.findings import Candidate as Evidence
from sysid.diagnosis.findings import JointName, Value
from sysid.diagnosis.minimum import complete_minimum, minimum_size
from sysid.diagnosis.mixed import explained
from sysid.diagnosis.search import ENTER, HELD_OUT, Hypothesis, Search


def candidate_table(
    search: Search, best: Hypothesis, rivals: Mapping[tuple[str, JointName], str]
) -> tuple[Evidence, ...]:
    """Return one row per effect and joint, most evidence first; rivals: (effect, joint) -> cause it could replace."""
    nothing = search.hypothesis(())
    total, _ = search.mixed.marginal(nothing.model.variances)
    rows = []
    groups: dict[tuple[str, object], list[Candidate]] = {}
    for c in search.candidates:
        groups.setdefault(c.key, []).append(c)
    for terms in groups.values():
        strongest = max(terms, key=lambda c: explained(total, [], list(c.columns)) - search.penalty(c))
        rows.append(_row(search, best, nothing, strongest, terms, rivals))
    return tuple(sorted(rows, key=lambda row: -row.delta_bic))


def _row(  # noqa: PLR0917
    search: Search,
    best: Hypothesis,
    nothing: Hypothesis,
    candidate: Candidate,
    terms: Sequence[Candidate],
    rivals: Mapping[tuple[str, JointName], str],
) -> Evidence:
    alone = search.hypothesis((candidate,))
    delta = nothing.bic - alone.bic
    drop = nothing.model.deviance - alone.model.deviance
    held = search.held_out(alone, candidate) / drop if drop > 1.0 else 0.0
    minimum = _smallest([minimum_size(search, best, c) for c in terms])
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
        reason = "does not help on runs left out"
    elif search.size_nm(alone, candidate) < search.least_nm:
        reason = "too small to matter"
    elif not search.plausible(alone):
        reason = "implausible parameters"
    else:
        reason = "explained by what was chosen"
    return Evidence(
        candidate.effect.name,
        candidate.joint,
        delta,
        held,
        _shared(search, best, candidate),
        minimum,
        reason,
        tuple(m for c in terms if (m := complete_minimum(search, best, c)) is not None),
    )


def _smallest(found: Sequence[Mapping[str, Value]]) -> Mapping[str, Value]:
    return min(found, key=lambda m: next(iter(m.values())).value)


def _shared(search: Search, best: Hypothesis, candidate: Candidate) -> float:
    """Return which part of the candidate's evidence the chosen causes take away, 0 to 1; NaN without causes."""
    others = [k for c in best.chosen if c.key != candidate.key for k in c.columns]
    if not others:
        return math.nan
    total, _ = search.mixed.marginal(best.model.variances)
    alone = explained(total, [], list(candidate.columns))
    beside = explained(total, others, list(candidate.columns))
    return min(max(1.0 - beside / alone, 0.0), 1.0) if alone > 0.0 else math.nan
