"""A study's report: tables in one form with seeds and commit beneath, for a terminal, a page and a program.

A study is a module with `options(parser)` and `run(options) -> Report`; `python -m validation` runs it.
"""

from __future__ import annotations

import math
import multiprocessing
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import msgspec
import numpy as np
from rich.progress import Progress

SCHEMA: Final = "jtq.validation/1"
ROOT: Final = Path(__file__).resolve().parents[1]
Work = TypeVar("Work")
Result = TypeVar("Result")
Z95: Final = 1.96
"""Standard deviations of a 95 % interval."""


class UsageError(ValueError):
    """Options that do not go together; one line."""


class Table(NamedTuple):
    """Cells as text: head, rows, and a title that may be empty."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""


@dataclass(frozen=True)
class Report:
    """What a study found. seeds: by name; notes: lines beneath the tables; values: for programs, of types that msgspec
    knows; reached: False where a target is missed.
    """

    tables: Sequence[Table]
    seeds: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    values: Any = None
    reached: bool = True


@dataclass(frozen=True)
class Share:
    """A row of a table of shares: value with its 95 % interval, the target in words and whether it is reached, trials."""

    what: str
    value: float
    low: float
    high: float
    target: str
    reached: bool | None
    trials: int
    note: str = ""


def share(what: str, good: Sequence[bool], target: float | None, note: str = "") -> Share | None:
    """Return a row of a share, None without trials; target > 0: at least, < 0 or -0.0: at most, None: no target."""
    if not good:
        return None
    value = sum(good) / len(good)
    low, high = wilson(sum(good), len(good))
    if target is None:
        return Share(what, value, low, high, "", None, len(good), note)
    reached = value >= target if target > 0 else value <= -target
    text = f"at {'least' if target > 0 else 'most'} {100 * abs(target):.0f} %"
    return Share(what, value, low, high, text, reached, len(good), note)


def wilson(good: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    p, z = good / count, Z95
    centre = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return max(0.0, centre - half), min(1.0, centre + half)


def share_table(rows: Sequence[Share], title: str = "") -> Table:
    marks = {True: "yes", False: "NO", None: ""}
    return Table(
        ("figure", "found", "95 %", "target", "reached", "trials", "note"),
        [
            (
                row.what,
                percent(row.value),
                f"{percent(row.low)} to {percent(row.high)}",
                row.target,
                marks[row.reached],
                str(row.trials),
                row.note,
            )
            for row in rows
        ],
        title,
    )


def percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def commit() -> str:
    """Return the commit of the source tree, "unknown" outside of git."""
    try:
        found = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()


def lines_of(table: Table) -> list[str]:
    """Return a table as Markdown whose cells are padded, so that it can be read as text."""
    every = [table.head, *table.rows]
    widths = [max(len(cells[k]) for cells in every) for k in range(len(table.head))]
    rows = [f"| {' | '.join(f'{c:<{w}}' for c, w in zip(cells, widths, strict=True))} |" for cells in every]
    title = [table.title, ""] if table.title else []
    return [*title, rows[0], f"|{'|'.join('-' * (w + 2) for w in widths)}|", *rows[1:]]


def text_of(report: Report) -> str:
    """Return the whole report: tables, notes, and what they were made from."""
    blocks = [lines_of(table) for table in report.tables]
    seeds = ", ".join(f"{name} {seed}" for name, seed in report.seeds.items())
    blocks += [list(report.notes), [f"{seeds or 'no seed'}; commit {commit()}"]]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def json_of(name: str, report: Report) -> bytes:
    """Return the report for programs; a number that does not exist is null."""
    values = {
        "schema": SCHEMA,
        "study": name,
        "commit": commit(),
        "seeds": report.seeds,
        "tables": [table._asdict() for table in report.tables],
        "values": report.values,
    }
    encoded = msgspec.json.encode(values, enc_hook=_plain)
    return msgspec.json.format(encoded, indent=1) + b"\n"


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise NotImplementedError(f"found {type(value).__name__}, expected a value for JSON")


def in_processes(
    function: Callable[[Work], Result], work: Sequence[Work], processes: int, title: str
) -> Iterator[Result]:
    """Yield the results of a function in the order of its work, with a bar of progress on a terminal."""
    with Progress(disable=not sys.stderr.isatty()) as progress:
        bar = progress.add_task(title, total=len(work))

        def counted(results: Iterable[Result]) -> Iterator[Result]:
            for result in results:
                progress.advance(bar)
                yield result

        if processes <= 1:
            yield from counted(map(function, work))
            return
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            yield from counted(pool.imap(function, work))
