"""Outcomes of one bench as its table. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from validation.hidden.figures import Figure, share
from validation.hidden.scores import Outcome

KINDS: Final = ("single", "half", "pair", "nothing", "foreign", "beside")


def figures(outcomes: Sequence[Outcome], real: bool = False) -> list[Figure]:
    """Return the rows of the table; rows without sets are left out. real: of a bench that `beyond` is for."""
    if real:
        outcomes = beyond(outcomes)
    of = {kind: [o for o in outcomes if o.kind == kind] for kind in KINDS}
    known = [*of["single"], *of["half"], *of["pair"], *of["nothing"]]
    named = [*known, *of["beside"]]
    rows = [
        share(
            "single, three times visible: named, or class of at most 3",
            _found(of["single"]),
            0.98,
            _alone(of["single"]),
        ),
        share("half of that size", _found(of["half"]), 0.92, _alone(of["half"])),
        share("pairs: both", _found(of["pair"]), 0.90, _alone(of["pair"])),
        share(
            "a wrong name", [bool(o.wrong) for o in named], -0.02, _most(n for o in named for n in o.wrong)
        ),
        share(
            "nothing hidden: a name, or unexplained",
            [bool(o.causes) or o.verdict == "unexplained" for o in of["nothing"]],
            -0.01,
            _most(o.verdict for o in of["nothing"]),
        ),
        share(
            "foreign: refused and placed",
            [bool(o.place) for o in of["foreign"]],
            0.90,
            _most(o.verdict for o in of["foreign"]),
        ),
        share(
            "foreign worth more than the relevance called no_gap",
            [o.verdict == "no_gap" and not o.slight for o in of["foreign"]],
            -0.0,
            f"{sum(o.slight for o in of['foreign'])} worth less",
        ),
        share(
            "cause beside a foreign effect: named",
            _found(of["beside"]),
            0.80,
            _most(o.verdict for o in of["beside"]),
        ),
    ]
    inside = [good for o in known for _, _, good in o.inside]
    covered = share("95 % intervals hold the truth", inside, None)
    if covered is not None:
        reached = 0.93 <= covered.value <= 0.97
        rows.append(
            Figure(
                covered.what, covered.value, covered.low, covered.high, "93 to 97 %", reached, covered.trials
            )
        )
    return [row for row in rows if row is not None]


def beyond(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Return the sets as they are beside the set with nothing hidden of the same seed: names that this one has as well are
    not wrong; what it names already cannot be found, and a set without it is left out.
    """
    plain = {o.seed: o for o in outcomes if o.kind == "nothing"}
    out = []
    for o in outcomes:
        if o.kind == "nothing":
            out.append(replace(o, wrong=()))
        elif o.seed in plain:
            there = plain[o.seed].causes
            named = {f"{name} of {joint}" for name, joint, _ in there}
            if not any(f"{name} of {joint}" in named for name, joint in o.wanted):
                out.append(replace(o, wrong=tuple(w for w in o.wrong if w not in named)))
    return out


def _found(outcomes: Sequence[Outcome]) -> list[bool]:
    return [all(o.found) for o in outcomes]


def _alone(outcomes: Sequence[Outcome]) -> str:
    return f"{sum(all(o.named) for o in outcomes)} named alone"


def _most(names: object) -> str:
    counted = Counter(names)  # type: ignore[call-overload]
    return ", ".join(f"{n} {name}" for name, n in counted.most_common(4))


def lost_to_wrong(full: Mapping[str, Outcome], recorded: Mapping[str, Outcome]) -> list[str]:
    """Return the sets in which the recorder makes a wrong name of a found one: keys."""
    return [
        key
        for key, o in recorded.items()
        if o.kind in ("single", "half", "pair")
        and all(full[key].found)
        and not full[key].wrong
        and not all(o.found)
        and o.wrong
    ]


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per set that is not as it should be."""
    bad: dict[str, Callable[[Outcome], bool]] = {
        "nothing": lambda o: bool(o.causes) or o.verdict != "no_gap",
        "foreign": lambda o: not o.place,
        **dict.fromkeys(("single", "half", "pair", "beside"), lambda o: not all(o.found) or bool(o.wrong)),
    }
    lines = []
    for o in outcomes:
        if bad[o.kind](o):
            found = ", ".join(f"{n} of {j} {list(c[1:]) or ''}".strip() for n, j, c in o.causes) or "nothing"
            shown = f"; shown: {' | '.join(o.shown)}" if o.kind == "foreign" else ""
            lines.append(
                f"{o.kind} seed {o.seed}: {' + '.join(o.detail) or 'nothing hidden'}; {o.verdict}: {found}{shown}"
            )
    return lines
