"""Equivalence classes: which other effects would explain the same runs as well as the one chosen. Pure."""

from __future__ import annotations

from typing import Final

from sysid.diagnosis.columns import Candidate
from sysid.diagnosis.mixed import explained
from sysid.diagnosis.search import Hypothesis, Search

WITHIN: Final = 6.0
"""An alternative this close in BIC is as good (`strong evidence` begins there)."""
MISFIT: Final = 0.02
"""Part of an effect's evidence that imperfections of the model may be worth: an alternative that explains all but this
of it is not ruled out by it.
"""


def equivalence_class(search: Search, best: Hypothesis, cause: Candidate) -> tuple[Candidate, ...]:
    """Return the candidates (one per effect and joint) that could stand in the place of `cause`, best first."""
    others = [c for c in best.chosen if c is not cause]
    without = search.hypothesis(others, best.model)
    evidence = without.model.squares - best.model.squares
    room = WITHIN + MISFIT * max(evidence, 0.0)
    total, _ = search.mixed.marginal(best.model.variances)
    base = [k for c in others for k in c.columns]
    worth = explained(total, base, list(cause.columns)) - search.penalty(cause)
    found: dict[tuple[str, object], Hypothesis] = {}
    where: dict[tuple[str, object], Candidate] = {}
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
        refuted = search.unread(rival) - search.unread(best) > WITHIN
        if worse < room and price < WITHIN and not refuted and search.plausible(rival):
            key = candidate.key
            if key not in found or rival.bic < found[key].bic:
                found[key], where[key] = rival, candidate
    order = sorted(found, key=lambda key: found[key].bic)
    return tuple(where[key] for key in order)
