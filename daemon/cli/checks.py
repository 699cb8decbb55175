"""Result of a check: an item, GOOD, WARN or FAIL, the figures and the remedy; their report as a table or as JSON."""

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
"""SKIP: does not apply here; the text has the reason."""
_STYLES = {GOOD: "green", WARN: "yellow", FAIL: "bold red", SKIP: "dim"}
_EXIT_STATUS = {GOOD: 0, WARN: 3, FAIL: 1}


@dataclass(frozen=True)
class CheckResult:
    """Result of one item. hint: the remedy, empty if none is needed."""

    item: str
    level: str
    text: str
    hint: str = ""


def judge(item: str, text: str, *rules: tuple[object, str, str]) -> CheckResult:
    """Return the result by the first rule (condition, level, hint) whose condition is true, else GOOD."""
    for condition, level, hint in rules:
        if condition:
            return CheckResult(item, level, text, hint)
    return CheckResult(item, GOOD, text)


def worst(results: Iterable[CheckResult]) -> str:
    """Return the worst level: FAIL, WARN or GOOD."""
    levels = {each.level for each in results}
    return next((level for level in (FAIL, WARN) if level in levels), GOOD)


def report(results: Sequence[CheckResult], schema: str | None, **more: Any) -> int:
    """Print the results on standard output; return the exit status: 0 all good, 3 warnings, 1 failures.

    Args:
        results: in the order of the report.
        schema: print JSON of this schema; None prints a table.
        more: further keys of the JSON.
    """
    level = worst(results)
    if schema is None:
        show(Console(), results)
    else:
        items = [asdict(each) for each in results]
        print(json.dumps({"schema": schema, "result": level, **more, "items": items}))
    return _EXIT_STATUS[level]


def show(console: Console, results: Sequence[CheckResult]) -> None:
    """Print the table and a last line with the counts."""
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
    level = worst(results)
    counts = f": {count[GOOD]} good, {counted(count[WARN], 'warning')}, {counted(count[FAIL], 'failure')}"
    console.print(Text.assemble((level, _STYLES[level]), counts))
