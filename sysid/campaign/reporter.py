"""Progress of a campaign on standard error: a bar with the remaining time on a terminal, else a line per run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from jtqd.estimator.text import counted
from jtqd.sysid.campaign.state import DONE, RunState

BETWEEN_RUNS_S: Final = 4.0
"""Assumed before the first run is measured: start of jtqd, set-up of the drives, run table."""
_REFRESH_S: Final = 1.0
"""Drawing takes 0.5 ms between two set-points."""


def clock_text(seconds: float) -> str:
    """62.4 -> "1:02", 3723 -> "1:02:03"."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Remaining:
    """Remaining time of a campaign: motions to be played, and the measured time between them.

    Args:
        motions_s: lengths of all runs that are to be played.
        now: clock in seconds.
    """

    def __init__(self, motions_s: list[float], now: Callable[[], float] = time.monotonic) -> None:
        self.total_s: Final = sum(motions_s)
        self.played_s = 0.0
        """Motions of the runs that are over."""
        self._left = len(motions_s)
        self._over = 0
        self._now, self._began = now, now()

    def end(self, motion_s: float) -> None:
        """Count a run that is over."""
        self.played_s += motion_s
        self._left -= 1
        self._over += 1

    def seconds(self, played_s: float = 0.0) -> float:
        """Return the remaining time after played_s of the current run."""
        motion_s = self.played_s + played_s
        between_s = BETWEEN_RUNS_S
        if self._over:
            begun = self._over + (played_s > 0.0)
            between_s = max((self._now() - self._began - motion_s) / begun, 0.0)
        return self.total_s - motion_s + between_s * self._left


class Reporter:
    """A context manager around the runs: the current one, and the outcome of each."""

    def __init__(self, motions_s: list[float], total: int, done: int, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._remaining = Remaining(motions_s)
        self._total, self._number = total, done
        self._name = ""
        self._shown_s = 0.0
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

    def __enter__(self) -> Reporter:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def begin(self, name: str) -> None:
        """Show the next run."""
        self._name = name
        self._number += 1
        self._shown_s = -_REFRESH_S
        self.on_progress(0.0, 0.0)

    def on_progress(self, played_s: float, _total_s: float) -> None:
        """Draw the bar; called by the commander between two set-points."""
        if not self._console.is_terminal or time.monotonic() - self._shown_s < _REFRESH_S:
            return
        self._shown_s = time.monotonic()
        self._bar.update(
            self._task,
            completed=self._remaining.played_s + played_s,
            description=f"{self._number}/{self._total} {self._name}",
            left=clock_text(self._remaining.seconds(played_s)),
            refresh=True,
        )

    def attempt_failed(self, name: str, reason: str, attempt: int) -> None:
        """Report an attempt that is repeated."""
        self.write_line(f"{name}: attempt {attempt}: {reason}; repeated")

    def end(self, name: str, motion_s: float, state: RunState) -> None:
        """Report a run that is over."""
        self._remaining.end(motion_s)
        if self._console.is_terminal and state.status == DONE and not state.findings:
            return
        text = f"run {self._number} of {self._total}: {name}: {state.status}"
        if state.status == DONE:
            missing = counted(state.missed + state.incomplete, "cycle")
            text += f", {counted(state.rows, 'row')}, {missing} missing"
        else:
            text += f": {state.reason}"
        left_s = self._remaining.seconds()
        self.write_line(text + (f"; {clock_text(left_s)} left" if left_s > 0.0 else ""))
        for finding in state.findings:
            self.write_line(f"{name}: {finding}")

    def write_line(self, text: str) -> None:
        """Write a line on stderr, above the bar where there is one."""
        if self._console.is_terminal:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(f"jtq campaign: {text}", file=sys.stderr, flush=True)
