"""Which kind of motion separates what the runs cannot: of effects that look alike, and of one that does not show.

What an effect needs to be seen at all is its `Effect.experiment`; what separates it from one that looks alike stands in
`Effect.confused_with`. Of all kinds that a diagnosis would like, at most MOST_KINDS are planned, those
that serve most pairs first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Final

from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.planner.experiments import EXPERIMENTS

MOST_KINDS: Final = 3
_DEFAULT: Final = "excitation"

PAIRS: Final = {
    frozenset((name, other)): kind
    for name, effect in EFFECTS.items()
    for other, kind in effect.confused_with.items()
}
"""Two names -> the kind that separates them."""


def kind_of(name: str) -> str:
    """Return the kind of experiment that shows an effect (a name that the library does not have: the general one)."""
    return EFFECTS[name].experiment if name in EFFECTS else _DEFAULT


def kinds_for(classes: Iterable[Sequence[str]]) -> tuple[str, ...]:
    """Return the kinds that separate the members of every class, and show the effect of a class of one; at most MOST_KINDS.

    Kinds that serve more pairs come first; no class at all: the general excitation and its repetition, which give the
    noise floor.
    """
    votes: Counter[str] = Counter()
    for names in classes:
        if len(names) == 1:
            votes[kind_of(names[0])] += 1
        for a, b in combinations(dict.fromkeys(names), 2):
            separating = PAIRS.get(frozenset((a, b)))
            votes.update({separating} if separating else {kind_of(a), kind_of(b)})
    if not votes:
        return (_DEFAULT, "repeat")
    order = list(EXPERIMENTS)
    return tuple(sorted(votes, key=lambda kind: (-votes[kind], order.index(kind)))[:MOST_KINDS])
