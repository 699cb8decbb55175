"""Result of a check, its report on a terminal and as JSON, and numbers for people. Pure, but for `report`.

`jtq check` and `jtq doctor` are lists of `CheckResult`: an item, GOOD, WARN or FAIL, the figures, and what to do.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from jtqd.estimator.text import counted

GOOD, WARN, FAIL, SKIP = "GOOD", "WARN", "FAIL", "-"
"""SKIP: does not apply here, and says why."""
_STYLES = {GOOD: "green", WARN: "yellow", FAIL: "bold red", SKIP: "dim"}


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
