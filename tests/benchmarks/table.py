"""Plain text tables."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as they must be; the first one to the left, the others to the right."""
    lines = [list(head), *map(list, rows)]
    widths = [max(len(line[n]) for line in lines) for n in range(len(head))]

    def text(line: Sequence[str]) -> str:
        cells = [
            cell.ljust(w) if n == 0 else cell.rjust(w)
            for n, (cell, w) in enumerate(zip(line, widths, strict=True))
        ]
        return "  ".join(cells).rstrip()

    return "\n".join([text(lines[0]), "  ".join("-" * w for w in widths), *map(text, lines[1:])])


def mark(value: float, limit: float, *, at_least: bool = False) -> str:
    """PASS or over (under), with the limit."""
    if isnan(value):
        return "not measured"
    good = value >= limit if at_least else value <= limit
    wrong = "under" if at_least else "over"
    return f"{'PASS' if good else wrong} ({'>=' if at_least else '<='} {limit:g})"


def mark_beside_error(value: float, error: float, limit: float) -> str:
    """PASS or over only where the limit is more than two standard errors away, else that the two cannot be told apart."""
    if isnan(value) or isnan(error):
        return "not measured"
    if abs(value - limit) <= 2.0 * error:
        return f"cannot be told from {limit:g}"
    return mark(value, limit)
