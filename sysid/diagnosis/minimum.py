"""Smallest size of every effect that these runs would show: the minimum detectable effect. Pure.

An effect of coefficients b lowers the deviance by about b' I b, I being the information of its columns that the causes
found and the changes from run to run leave. It is detected when that exceeds its cost in BIC plus ENTER. Where the
runs' own changes are what limits it, their variance is itself estimated from few runs, and the same evidence needs a
larger ratio: t^2 = n (exp(d/n) - 1) instead of d.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sysid.diagnosis.columns import Candidate
from sysid.diagnosis.findings import Value
from sysid.diagnosis.mixed import Mixed
from sysid.diagnosis.search import ENTER, Hypothesis, Search

RELEVANT: Final = 1e-3
"""Part of the rated torque below which a contribution (rms over the runs) is not called an effect, however certain."""


_LARGEST: Final = 0.2
"""Part of the rated torque: a torque that would have to be larger to show is invisible."""
_COLLINEAR: Final = 1e-4
"""Below this part of its information nothing is left beside a rival: no size would tell the two apart."""


def _order(candidate: Candidate) -> float:
    return float(candidate.term.basis[0].get("order_per_motor_rev", 0.0))


def information(
    mixed: Mixed, best: Hypothesis, candidate: Candidate, rival: Candidate | None = None
) -> tuple[float, float]:
    """Return (information of its leading coefficient, share of the uncertainty that is the runs' own changes).

    For waves the worst phase. Columns already chosen for the same effect count as known. rival: another candidate that it
    must be told from.
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


def complete_minimum(search: Search, best: Hypothesis, candidate: Candidate) -> dict[str, float] | None:
    """Return all parameters of a candidate at its minimum detectable size, None where no plausible size shows."""
    value = next(iter(minimum_size(search, best, candidate).values())).value
    if not math.isfinite(value):
        return None
    rest = [0.0] * (candidate.size - 1)
    one, none = candidate.term.combine([1.0, *rest]), candidate.term.combine([0.0, *rest])
    lead = next(iter(minimum_size(search, best, candidate)))
    step = one[lead] - none.get(lead, 0.0)
    return dict(candidate.term.combine([value / step, *rest]))


def minimum_size(search: Search, best: Hypothesis, candidate: Candidate) -> dict[str, Value]:
    """Return the leading parameter at its minimum detectable size, for a key of the joint file as a difference to it;
    infinite where no plausible size shows.
    """
    known, share = information(search.mixed, best, candidate)
    for rival in search.candidates:  # found, and at the right joint
        same = (
            rival.effect.name == candidate.effect.name
            and rival.term.basis[0].keys() == candidate.term.basis[0].keys()
        )
        if same and rival.joint != candidate.joint and _order(rival) == _order(candidate):
            told, told_share = information(search.mixed, best, candidate, rival)
            if _COLLINEAR * known < told < known:
                known, share = told, told_share
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
    values = candidate.term.combine([size, *([0.0] * (candidate.size - 1))])
    found = abs(values[lead.name] - none.get(lead.name, 0.0))
    if not math.isfinite(found) or found > min(candidate.largest, max(abs(lead.low), abs(lead.high))):
        return nothing
    if lead.unit == "Nm" and found > _LARGEST * search.least_nm / RELEVANT:
        return nothing
    return {lead.name: Value(found, (found, found), lead.unit)}
