"""How the loop is doing, for whoever looks: a live table on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import time
from types import TracebackType

from rich.console import Console
from rich.live import Live

from daemon.shared.snapshot import SnapshotReader
from daemon.supervisor.live_table import LiveTable, plain_line
from daemon.supervisor.say import INFO, Say

_TABLE_PERIOD_S = 0.2
_LOG_PERIOD_S = 5.0


class Display:
    """Use it as a context manager; `turn` whenever there is time.

    Args:
        reader: of the loop's snapshot.
        bitrate: of the bus [bit/s].
        title: of the table.
        say: takes the lines.
    """

    def __init__(self, reader: SnapshotReader, bitrate: int, title: str, say: Say) -> None:
        console = Console(stderr=True)
        self._terminal = console.is_terminal
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._reader, self._bitrate, self._title, self._say = reader, bitrate, title, say
        self._previous = reader.read()
        self._shown = time.monotonic()

    def __enter__(self) -> Display:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def turn(self, now: float) -> None:
        """Show what is due at `now` (CLOCK_MONOTONIC [s])."""
        if now - self._shown < (_TABLE_PERIOD_S if self._terminal else _LOG_PERIOD_S):
            return
        view = self._reader.read()
        if self._terminal:
            table = LiveTable(self._reader, self._previous, view, self._bitrate, self._title)
            self._live.update(table, refresh=True)
        else:
            line = plain_line(self._reader, self._previous, view, self._bitrate)
            self._say(line.removeprefix("jtqd: "), INFO)
        self._previous, self._shown = view, now
