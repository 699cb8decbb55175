"""Views on a terminal: tables and lines of its width, pages of its height and their keys, sparklines, histograms."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Sequence
from math import isfinite, log1p
from typing import Any, Final

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.padding import Padding
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from jtqd.daemon.supervisor.table import first_that_fits

HEAD: Final = "bold"
HEADING: Final = 9
"""Width of the headings of lines."""
_FOOT_LINES: Final = 2
_BLOCKS: Final = "▁▂▃▄▅▆▇█"


class Columns:
    """A table that drops columns, in the order of `dispensable`, where the terminal is too narrow for all.

    Nothing is cut, and a line below names the columns that are not shown.
    """

    def __init__(self, headings: dict[str, str], dispensable: tuple[str, ...] = ()) -> None:
        self._headings = headings
        self._dispensable = dispensable
        self._rows: list[dict[str, str | Text]] = []

    def add(self, *cells: str | Text) -> None:
        """Add a row, one cell per heading."""
        self._rows.append(dict(zip(self._headings, cells, strict=True)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the width of the terminal (called by rich)."""
        tables = [
            self._table([name for name in self._headings if name not in self._dispensable[:dropped]])
            for dropped in range(len(self._dispensable) + 1)
        ]
        shown = first_that_fits(tables, console, options) or tables[-1]
        yield shown
        if dropped := self._dispensable[: tables.index(shown)]:
            names = [name for name in self._headings if name in dropped]
            yield Text(f"no room for: {', '.join(names)}", style="dim")

    def _table(self, names: list[str]) -> Table:
        table = Table(
            box=None, pad_edge=False, padding=(0, 2, 0, 0), collapse_padding=True, header_style=HEAD
        )
        for name in names:
            right = self._headings[name] == "right"
            table.add_column(name, justify="right" if right else "left", no_wrap=True)
        for row in self._rows:
            table.add_row(*(row[name] for name in names))
        return table


def line(heading: str, text: str | Text) -> RenderableType:
    """Return a heading of fixed width and text that wraps beside it."""
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=HEADING, no_wrap=True, style=HEAD)
    grid.add_column(overflow="fold")
    grid.add_row(heading, text)
    return grid


def paged(console: Console, view: RenderableType, number: int) -> tuple[RenderableType, int]:
    """Return one page of a view, with a line below, and its number.

    number: of the wanted page, counted on beyond the last page, which is followed by the first.
    """
    lines = console.render_lines(view, console.options.update(height=None), pad=False)
    height = max(console.height - _FOOT_LINES, 1)
    count = max(1, -(-len(lines) // height))
    number %= count
    rows = [Segments([*each, Segment.line()]) for each in lines[number * height : (number + 1) * height]]
    pages = f"page {number + 1} of {count}, SPACE turns; " if count > 1 else ""
    foot = time.strftime(f"%H:%M:%S  {pages}Ctrl-C ends this view; jtqd continues")
    return Group(*rows, Padding(Text(foot, style="dim"), (1, 0, 0, 0))), number


class Keys:
    """Keys of the terminal, without their echo, while a view is shown; nothing where standard input is none."""

    def __enter__(self) -> Keys:
        self._before: list[Any] | None = None
        if sys.stdin.isatty():
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin.fileno())
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def turned(self, wait_s: float) -> int:
        """Wait, at most until a key comes; return how many pages to turn: SPACE, n forward, b, p back."""
        if self._before is None:
            time.sleep(wait_s)
            return 0
        if not select.select([sys.stdin.fileno()], [], [], wait_s)[0]:
            return 0
        pressed = os.read(sys.stdin.fileno(), 64)
        if not pressed:  # the terminal is closed
            time.sleep(wait_s)
        return sum(pressed.count(key) for key in b" n") - sum(pressed.count(key) for key in b"bp")


def sparkline(values: Sequence[float], columns: int) -> str:
    """Return the newest values as at most `columns` blocks between their extremes; a gap for each that is no number.

    >>> sparkline([0.0, 1.0, float("nan"), 7.0], 8)
    '▁▂ █'
    """
    shown = list(values)[-columns:]
    known = [each for each in shown if isfinite(each)] or [0.0]
    low, span = min(known), (max(known) - min(known)) or 1.0
    top = len(_BLOCKS) - 1
    return "".join(_BLOCKS[round(top * (each - low) / span)] if isfinite(each) else " " for each in shown)


def histogram(bins: Sequence[int], bin_us: float, columns: int) -> str:
    """Return bins as a line of at most `columns` blocks between its edges, e.g. "84 ▇█▂▁ 212 us"; "" without data.

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
    heights = (max(1, round(8 * log1p(each) / top)) if each else 0 for each in sums)
    blocks = "".join((" " + _BLOCKS)[height] for height in heights)
    high = min(first + len(sums) * width, len(bins)) * bin_us
    more = " and more" if last == len(bins) - 1 else ""
    return f"{first * bin_us:.0f} {blocks} {high:.0f} us{more}"
