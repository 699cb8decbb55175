"""Result of a check, its report on a terminal and as JSON, and numbers for people. Pure, but for `report`.

`jtq check` and `jtq doctor` are lists of `CheckResult`: an item, GOOD, WARN or FAIL, the figures, and what to do.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from math import isfinite, log1p
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jtqd.estimator.checked import counted

GOOD, WARN, FAIL, SKIP = "GOOD", "WARN", "FAIL", "-"
"""SKIP: does not apply here, and says why."""
_STYLES = {GOOD: "green", WARN: "yellow", FAIL: "bold red", SKIP: "dim"}
_BLOCKS = " ▁▂▃▄▅▆▇█"
_UNITS = ("B", "kB", "MB", "GB", "TB")
NOTHING = "-"


@dataclass(frozen=True)
class CheckResult:
    """Result of one item. `hint` is the remedy, empty if none is needed."""

    item: str
    level: str
    text: str
    hint: str = ""


def report(results: Sequence[CheckResult], schema: str | None, **more: Any) -> int:
    """Print the results on standard output and return the exit status.

    Args:
        results: in the order of the report.
        schema: print JSON of this schema; None prints a table.
        more: what the JSON also holds.
    """
    if schema is not None:
        print(json.dumps(as_json(schema, results, **more)))
    else:
        show(Console(), results)
    return exit_status(results)


def exit_status(results: Iterable[CheckResult]) -> int:
    """Return the exit status: 0 all good, 3 warnings, 1 failures."""
    levels = {each.level for each in results}
    return 1 if FAIL in levels else 3 if WARN in levels else 0


def as_json(schema: str, results: Sequence[CheckResult], **more: Any) -> dict[str, Any]:
    """Return plain data: worst level, exit status and every item."""
    status = exit_status(results)
    return {
        "schema": schema,
        "result": {0: GOOD, 3: WARN, 1: FAIL}[status],
        **more,
        "items": [asdict(each) for each in results],
    }


def show(console: Console, results: Sequence[CheckResult]) -> None:
    """Print the table and a last line."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="bold")
    table.add_column(overflow="fold")
    for each, following in zip(results, (*results[1:], None), strict=True):
        text = Text(each.text)
        if each.hint and (following is None or following.hint != each.hint):  # one hint for a row of them
            text.append(f"\n> {each.hint}", style="italic")
        table.add_row(Text(each.level, style=_STYLES[each.level]), each.item, text)
    console.print(table)
    count = {level: sum(each.level == level for each in results) for level in (GOOD, WARN, FAIL)}
    status = {0: GOOD, 3: WARN, 1: FAIL}[exit_status(results)]
    console.print(
        Text.assemble(
            (status, _STYLES[status]),
            f": {count[GOOD]} good, {counted(count[WARN], 'warning')}, {counted(count[FAIL], 'failure')}",
        )
    )


def number(value: float, digits: int = 2) -> str:
    """Format with fixed digits, or "-" if unknown."""
    return f"{value:.{digits}f}" if isfinite(value) else NOTHING


def share(value: float) -> str:
    """Format a share: 0.848 -> "84.8 %"."""
    return f"{100 * value:.1f} %" if isfinite(value) else NOTHING


def size(count: int | None) -> str:
    """Format bytes in decimal units with three digits."""
    if count is None:
        return NOTHING
    value = float(count)
    for unit in _UNITS:
        if value < 999.5 or unit == _UNITS[-1]:
            return f"{value:.0f} {unit}" if value >= 100 or unit == "B" else f"{value:.3g} {unit}"
        value /= 1000.0
    raise AssertionError("unreachable")


def duration(seconds: float) -> str:
    """Format a duration with at most two units: "45 ms", "2.3 s", "12 min 31 s", "3 h 05 min", "2 d 04 h"."""
    if not isfinite(seconds):
        return NOTHING
    if seconds < 0.9995:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    if whole < 86400:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    return f"{whole // 86400} d {whole % 86400 // 3600:02d} h"


def histogram(bins: Sequence[int], bin_us: float, columns: int) -> str:
    """Format bins as a line of at most `columns` blocks between its edges, e.g. "84 ▇█▂▁ 212 us"; "" without data.

    From the first bin that holds something to the last, which takes everything above it. The height is logarithmic, so that
    one cycle in a million can be seen.
    """
    filled = [n for n, count in enumerate(bins) if count]
    if not filled:
        return ""
    first, last = filled[0], filled[-1]
    width = -(-(last - first + 1) // columns)
    sums = [sum(bins[n : n + width]) for n in range(first, last + 1, width)]
    top = log1p(max(sums))
    blocks = "".join(_BLOCKS[0 if not each else max(1, round(8 * log1p(each) / top))] for each in sums)
    high = min(first + len(sums) * width, len(bins)) * bin_us
    more = " and more" if last == len(bins) - 1 else ""
    return f"{first * bin_us:.0f} {blocks} {high:.0f} us{more}"
