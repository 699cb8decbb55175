"""How far a batch is: a bar on a terminal, a line for each failed group elsewhere."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from jtqd.sysid.batch.run import FAILED, Row


class Progress:
    """For a `with` statement.

    Args:
        groups: how many there are.
        by: name of the command, before each line.
    """

    def __init__(self, groups: int, by: str) -> None:
        self._by = by
        self._failed = 0
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[failed]}"),
            console=Console(stderr=True),
            disable=not sys.stderr.isatty(),
        )
        self._task = self._bar.add_task("groups", total=groups, failed="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def finished(self, row: Row) -> None:
        """One group is."""
        if row.state == FAILED:
            self._failed += 1
            line = f"{self._by}: {row.group.name}: {row.error}"
            if self._bar.disable:
                print(line, file=sys.stderr, flush=True)
            else:
                self._bar.console.print(line, markup=False, highlight=False)
        failed = f"{self._failed} failed" if self._failed else ""
        self._bar.update(self._task, advance=1, failed=failed)
