"""Progress of a campaign on standard error: a bar with the remaining time on a terminal, else a line per run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from jtqd.estimator.checked import counted
from jtqd.sysid.campaign.state import DONE, RunState

BETWEEN_RUNS_S: Final = 4.0
"""What a run takes beside its motion, until one has been measured: start of jtqd, set-up of the drives, table."""
_REFRESH_S: Final = 1.0
"""Drawing takes 0.5 ms and happens between two set-points: not more often than necessary."""
_WORTH_A_LINE: Final = 20_000
"""Motions tried in about 4 s."""


def clock_text(seconds: float) -> str:
    """62.4 -> "1:02", 3723 -> "1:02:03"."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Remaining:
    """How long a campaign still takes: motions to be played, and what has been measured between them.

    Args:
        motions_s: lengths of all runs that are to be played, in order.
        now: clock in seconds.
    """

    def __init__(self, motions_s: list[float], now: Callable[[], float] = time.monotonic) -> None:
        self.total_s: Final = sum(motions_s)
        self._left = len(motions_s)
        self._motions_s = self.total_s  # not begun yet, or under way
        self._current_s = 0.0
        self._now = now
        self._began = now()
        self._played_s = 0.0
        self._finished = 0

    def begin(self, motion_s: float) -> None:
        """A run begins."""
        self._current_s = motion_s

    def end(self) -> None:
        """The run that was begun is over, whatever became of it."""
        self._left -= 1
        self._finished += 1
        self._motions_s -= self._current_s
        self._played_s += self._current_s
        self._current_s = 0.0

    def seconds(self, played_s: float = 0.0) -> float:
        """Return the time that is left when played_s of the run under way have been played."""
        between_s = BETWEEN_RUNS_S
        if self._finished:
            elapsed_s = self._now() - self._began
            between_s = max(
                (elapsed_s - self._played_s - played_s) / (self._finished + (played_s > 0.0)), 0.0
            )
        return self._motions_s - played_s + between_s * self._left


class Designing:
    """A bar, or a line, while trajectories are designed; a context manager.

    Args:
        total: motions that will be tried.
    """

    def __init__(self, total: int, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._bar = Progress(console=self._console, transient=True, disable=not self._console.is_terminal)
        self._task = self._bar.add_task("designing trajectories", total=total)
        self._total = total

    def __enter__(self) -> Designing:
        if not self._console.is_terminal and self._total > _WORTH_A_LINE:
            print("jtq campaign: designing trajectories", file=sys.stderr, flush=True)
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def advance(self, tried: int) -> None:
        """So many more motions have been tried."""
        self._bar.advance(self._task, tried)


class Reporter:
    """A context manager around the runs: which one is under way, and what became of it."""

    def __init__(self, motions_s: list[float], total: int, done: int, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._remaining = Remaining(motions_s)
        self._total, self._number = total, done
        self._name = ""
        self._shown = 0.0
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(None),
            TextColumn("{task.percentage:3.0f} %"),
            TextColumn("{task.fields[left]} left"),
            console=self._console,
            auto_refresh=False,
            transient=True,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task("", total=max(self._remaining.total_s, 1e-9), left="")
        self._finished_s = 0.0

    def __enter__(self) -> Reporter:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, name: str, motion_s: float) -> None:
        """A run begins."""
        self._name = name
        self._number += 1
        self._remaining.begin(motion_s)
        self._draw(0.0)

    def on_progress(self, played_s: float, _total_s: float) -> None:
        """Called by the commander between two set-points."""
        if self._console.is_terminal and time.monotonic() - self._shown >= _REFRESH_S:
            self._draw(played_s)

    def attempt_failed(self, name: str, reason: str, attempt: int) -> None:
        """An attempt came to nothing and the run is tried again."""
        self.write_line(f"{name}: attempt {attempt}: {reason}; repeated")

    def end(self, name: str, motion_s: float, state: RunState) -> None:
        """A run is over."""
        self._remaining.end()
        self._finished_s += motion_s
        if self._console.is_terminal and state.status == DONE and not state.findings:
            return
        text = f"run {self._number} of {self._total}: {name}: {state.status}"
        if state.status == DONE:
            text += (
                f", {counted(state.rows, 'row')}, {counted(state.missed + state.incomplete, 'cycle')} missing"
            )
        else:
            text += f": {state.reason}"
        left = self._remaining.seconds()
        self.write_line(text + (f"; {clock_text(left)} left" if left > 0.0 else ""))
        for finding in state.findings:
            self.write_line(f"{name}: {finding}")

    def write_line(self, text: str) -> None:
        """One line on stderr, above the bar where there is one."""
        if self._console.is_terminal:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(f"jtq campaign: {text}", file=sys.stderr, flush=True)

    def _draw(self, played_s: float) -> None:
        if not self._console.is_terminal:
            return
        self._shown = time.monotonic()
        self._bar.update(
            self._task,
            completed=self._finished_s + played_s,
            description=f"{self._number}/{self._total} {self._name}",
            left=clock_text(self._remaining.seconds(played_s)),
            refresh=True,
        )
