"""What a self-test found, item by item: GOOD, WARN or FAIL, the figures, and what to do (`jtq check`, `jtq doctor`)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

GOOD, WARN, FAIL, SKIP = "GOOD", "WARN", "FAIL", "-"
"""SKIP: does not apply here, and says why."""
_STYLES = {GOOD: "green", WARN: "yellow", FAIL: "bold red", SKIP: "dim"}


@dataclass(frozen=True)
class Finding:
    """One item. `hint` says what to do, and is empty where nothing is to be done."""

    item: str
    level: str
    text: str
    hint: str = ""


def exit_status(findings: Iterable[Finding]) -> int:
    """0 nothing to do, 3 warnings, 1 failures."""
    levels = {each.level for each in findings}
    return 1 if FAIL in levels else 3 if WARN in levels else 0


def as_json(schema: str, findings: Sequence[Finding], **more: Any) -> dict[str, Any]:
    """Plain data: worst level, exit status and every item."""
    status = exit_status(findings)
    return {
        "schema": schema,
        "result": {0: GOOD, 3: WARN, 1: FAIL}[status],
        **more,
        "items": [asdict(each) for each in findings],
    }


def show(console: Console, findings: Sequence[Finding]) -> None:
    """Print the table and a last line."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True, style="bold")
    table.add_column(overflow="fold")
    for each, following in zip(findings, (*findings[1:], None), strict=True):
        text = Text(each.text)
        if each.hint and (following is None or following.hint != each.hint):  # one hint for a row of them
            text.append(f"\n> {each.hint}", style="italic")
        table.add_row(Text(each.level, style=_STYLES[each.level]), each.item, text)
    console.print(table)
    count = {level: sum(each.level == level for each in findings) for level in (GOOD, WARN, FAIL)}
    status = {0: GOOD, 3: WARN, 1: FAIL}[exit_status(findings)]
    console.print(
        Text.assemble(
            (status, _STYLES[status]), f": {count[GOOD]} good, {count[WARN]} warnings, {count[FAIL]} failures"
        )
    )
