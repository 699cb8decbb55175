"""The campaign's outcomes as the table of figures to reach. Pure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from validation.hidden.scores import Outcome

Z: Final = 1.96


@dataclass(frozen=True)
class Figure:
    """One row: what, value (share) with its 95 % interval, text of the target, whether it is reached, trials."""

    what: str
    value: float
    low: float
    high: float
    target: str
    reached: bool | None
    trials: int
    note: str = ""


def figures(outcomes: Sequence[Outcome]) -> list[Figure]:
    """Return the rows of the table; rows without trials are left out."""
    of = {
        kind: [o for o in outcomes if o.kind == kind]
        for kind in ("nothing", "one", "least", "two", "unknown")
    }
    one = [o for o in of["one"] if o.verdict != "invisible"]
    least = [o for o in of["least"] if o.verdict != "invisible"]
    unseen = len(of["one"]) - len(one)
    hidden = [*one, *of["two"]]
    classed = sum(not all(o.named) and all(o.found) for o in one)
    rows = [
        share(
            "hidden effect at 3x its minimum: named, or in a class of at most 3",
            [all(o.found) for o in one],
            0.95,
            f"{classed} in a class, {unseen} not visible in their runs",
        ),
        share(
            "the same at 1x its minimum (no target)", [all(o.found) for o in least], None, "named or classed"
        ),
        share("wrong single name", [bool(o.wrong) for o in hidden], -0.02),
        share(
            "nothing hidden: anything named",
            [bool(o.causes) for o in of["nothing"]],
            -0.01,
            "else than no_gap: " + str(sum(o.verdict != "no_gap" for o in of["nothing"])),
        ),
        share("two effects at once: both found", [all(o.found) for o in of["two"]], 0.85),
        share(
            "not in the library: unexplained, right place in the map",
            [bool(o.place) for o in of["unknown"]],
            0.90,
            "unexplained: " + str(sum(o.verdict == "unexplained" for o in of["unknown"])),
        ),
    ]
    inside = [good for o in hidden for _, _, good in o.inside]
    covered = share("95 % intervals of parameters cover the truth", inside, None)
    if covered is not None:
        reached = 0.90 <= covered.value <= 0.98
        rows.append(Figure(covered.what, *_numbers(covered), "90 to 98 %", reached, covered.trials))
    rows.append(_gain(hidden))
    return [row for row in rows if row is not None]


def _numbers(f: Figure) -> tuple[float, float, float]:
    return f.value, f.low, f.high


def share(what: str, good: Sequence[bool], target: float | None, note: str = "") -> Figure | None:
    """Return a row of a share; target > 0: at least, < 0: at most."""
    n = len(good)
    if n == 0:
        return None
    value = sum(good) / n
    low, high = wilson(sum(good), n)
    if target is None:
        return Figure(what, value, low, high, "", None, n, note)
    reached = value >= target if target > 0 else value <= -target
    text = f"at {'least' if target > 0 else 'most'} {abs(target):.0%}".replace("%", " %")
    return Figure(what, value, low, high, text, reached, n, note)


def _gain(hidden: Sequence[Outcome]) -> Figure | None:
    """Return the gain as a share of the true model's: sums of squares that go away, over all trials."""
    there = [o.gain for o in hidden if o.gain is not None]
    if not there:
        return None
    got = [b * b - a * a for b, a, _ in there]
    could = [b * b - t * t for b, _, t in there]
    shares = sorted(g / c for g, c in zip(got, could, strict=True) if c > 0.0)
    value = _median(shares)
    low, high = shares[int(0.05 * len(shares))], shares[min(int(0.95 * len(shares)), len(shares) - 1)]
    note = f"median with 5 and 95 % quantiles; of all trials together {sum(got) / max(sum(could), 1e-9):.0%}"
    return Figure(
        "gain, as share of what the true model would gain",
        value,
        low,
        high,
        "at least 90 %",
        value >= 0.9,
        len(shares),
        note,
    )


def _median(x: Sequence[float]) -> float:
    n = len(x)
    return 0.5 * (x[(n - 1) // 2] + x[n // 2]) if n else math.nan


def wilson(good: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson)."""
    p = good / n
    centre = (p + Z * Z / (2 * n)) / (1 + Z * Z / n)
    half = Z / (1 + Z * Z / n) * math.sqrt(p * (1 - p) / n + Z * Z / (4 * n * n))
    return max(0.0, centre - half), min(1.0, centre + half)


def table(rows: Sequence[Figure]) -> str:
    """Return the table as text."""
    head = ("figure", "found", "95 %", "to reach", "", "trials")
    body = [
        (
            row.what,
            _percent(row.value),
            f"{_percent(row.low)} .. {_percent(row.high)}",
            row.target,
            {True: "yes", False: "NO", None: ""}[row.reached],
            str(row.trials) + (f"  ({row.note})" if row.note else ""),
        )
        for row in rows
    ]
    widths = [max(len(line[k]) for line in [head, *body]) for k in range(len(head) - 1)]
    lines = [
        "  ".join([*(cell.ljust(w) for cell, w in zip(line, widths, strict=False)), line[-1]]).rstrip()
        for line in [head, *body]
    ]
    return "\n".join(lines)


def _percent(x: float) -> str:
    return f"{100 * x:.1f} %"


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per outcome that is not what it should be, for the developers."""
    bad: dict[str, Callable[[Outcome], bool]] = {
        "nothing": lambda o: bool(o.causes) or o.verdict != "no_gap",
        "one": lambda o: o.verdict != "invisible" and (not all(o.found) or bool(o.wrong)),
        "two": lambda o: not all(o.found) or bool(o.wrong),
        "unknown": lambda o: not o.place,
    }
    lines = []
    for o in outcomes:
        if o.kind in bad and bad[o.kind](o):
            found = ", ".join(f"{n} of {j} {list(c[1:]) or ''}".strip() for n, j, c in o.causes) or "nothing"
            lines.append(
                f"{o.kind} seed {o.seed}: hidden {' + '.join(o.detail) or list(o.wanted)}; {o.verdict}: {found}"
                + (f"; shown: {' | '.join(o.shown)}" if o.kind == "unknown" else "")
            )
    return lines


def coverage_by_parameter(outcomes: Sequence[Outcome]) -> list[str]:
    """Return one line per effect and parameter whose intervals miss more often than 5 % and two times at least."""
    all_of: Counter[tuple[str, str]] = Counter()
    missed: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        if o.kind in ("one", "two"):
            for name, parameter, good in o.inside:
                all_of[name, parameter] += 1
                missed[name, parameter] += not good
    return [
        f"{name} {parameter}: {k} of {all_of[name, parameter]} intervals miss the truth"
        for (name, parameter), k in missed.most_common()
        if k >= 2 and k > 0.1 * all_of[name, parameter]
    ]
