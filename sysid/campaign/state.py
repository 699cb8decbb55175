"""campaign.json: what has become of every run, written so that a campaign that was killed can go on (jtq.campaign/1).

The directory belongs to one campaign at a time (a lock that ends with its process), and to one plan.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from jtqd.estimator.checked import ConfigError, Section
from jtqd.sysid.campaign.plan import Plan, load_plan

SCHEMA: Final = "jtq.campaign/1"
STATE_FILE: Final = "campaign.json"
PLAN_FILE: Final = "plan.yaml"
LOCK_FILE: Final = ".lock"
PARTS: Final = ".part"
"""Suffix of a run's directory while the run is under way."""
ENDINGS: Final = (".csv.gz", ".json", ".mcap")
"""Files of a run that is done; further parts of its log are NAME@2.mcap, NAME@3.mcap ...."""
EVIDENCE: Final = (".stopped.mcap", ".failed.mcap", ".jtqd.log")
"""What is left of an attempt that came to nothing, until the next attempt."""
DONE, STOPPED, FAILED, PENDING = STATUSES = ("done", "stopped", "failed", "pending")


class StateError(Exception):
    """The directory cannot be used for this campaign; one line."""


@dataclass(frozen=True)
class RunState:
    """What has become of one run.

    Attributes:
        status: done; stopped (a limit, or the bus); failed (nothing usable was recorded); pending.
        reason: one line for stopped and failed. attempts: how often it was begun.
        played_s: length of the set-points that were sent in the last attempt.
        rows: of the run table. missed, incomplete: cycles that are no rows (see log_to_run).
        findings: what the table looks wrong by, a line each. sha256: of NAME.csv.gz.
    """

    status: str = PENDING
    reason: str = ""
    attempts: int = 0
    played_s: float = 0.0
    rows: int = 0
    missed: int = 0
    incomplete: int = 0
    incomplete_by: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    sha256: str = ""


class CampaignDirectory:
    """A campaign's directory, locked for this process until `close`; the state in it is that of the last `put`.

    Args:
        path: made if missing.

    Raises:
        StateError: another campaign is at work there, or what is there is no campaign's.
        OSError: it cannot be made or written.
    """

    def __init__(self, path: Path) -> None:
        self.path: Final = path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise StateError(f"{path}: found a file, expected a directory or nothing") from None
        self._lock = os.open(path / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            raise StateError(f"{path}: another campaign is at work in this directory") from None
        self.name = ""
        self.plan_sha256 = ""
        self.recipe: Mapping[str, Any] = {}
        self.runs: dict[str, RunState] = {}
        try:
            self._load()
        except BaseException:
            self.close()
            raise

    @property
    def begun(self) -> bool:
        """Whether a campaign has been begun here."""
        return bool(self.plan_sha256)

    def close(self) -> None:
        """Give the directory up."""
        os.close(self._lock)

    def same_recipe(self, recipe: Mapping[str, Any]) -> Plan | None:
        """The plan that was begun here from the same recipe: made once, so that it need not be designed again."""
        if not self.begun or self.recipe != recipe:
            return None
        try:
            plan = load_plan(self.path / PLAN_FILE)
        except ConfigError:
            return None
        return plan if plan.sha256 == self.plan_sha256 else None

    def begin(self, plan: Plan, recipe: Mapping[str, Any]) -> None:
        """Begin, or go on: runs that are done stay done, everything half-written is removed.

        Raises:
            StateError: another plan was begun here.
        """
        if self.begun and self.plan_sha256 != plan.sha256:
            raise StateError(
                f"{self.path}: found campaign '{self.name}' of another plan ({self.plan_sha256[:8]}), expected "
                f"'{plan.name}' ({plan.sha256[:8]}): give another --out, or the same campaign with the same options"
            )
        if not self.begun:
            foreign = [path.name for run in plan.runs for path in _files_of(self.path, run.name)]
            if foreign:
                raise StateError(
                    f"{self.path}: found {foreign[0]} and no {STATE_FILE}, expected a directory without runs"
                )
        self.name, self.plan_sha256, self.recipe = plan.name, plan.sha256, dict(recipe)
        self.runs = {run.name: self._still_done(run.name) for run in plan.runs}
        for name, state in self.runs.items():
            shutil.rmtree(self.path / (name + PARTS), ignore_errors=True)
            if state.status != DONE:
                for path in _files_of(self.path, name):
                    path.unlink()
        _write_whole(self.path / PLAN_FILE, plan.to_yaml())
        self._save()

    def put(self, name: str, state: RunState) -> None:
        """Write the state of a run, whole or not at all."""
        self.runs[name] = state
        self._save()

    def _still_done(self, name: str) -> RunState:
        """The state of a run as recorded; pending again when it is not done, or its files have gone."""
        state = self.runs.get(name, RunState())
        if state.status == DONE and all((self.path / (name + ending)).is_file() for ending in ENDINGS):
            return state
        return RunState()

    def _load(self) -> None:
        path = self.path / STATE_FILE
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return
        try:
            top = Section(json.loads(text), str(path))
            top.text("schema", (SCHEMA,))
            self.name, sha256 = top.text("name"), top.text("plan_sha256")
            self.recipe = top.raw("recipe")
            self.runs = {section.text("name"): _run_state(section) for section in top.sections("runs")}
        except (ValueError, ConfigError) as error:  # ConfigError names the file itself
            said = str(error) if isinstance(error, ConfigError) else f"{path}: not JSON: {error}"
            raise StateError(said) from None
        self.plan_sha256 = sha256

    def _save(self) -> None:
        content = {
            "schema": SCHEMA,
            "name": self.name,
            "plan_sha256": self.plan_sha256,
            "recipe": self.recipe,
            "runs": [{"name": name, **asdict(state)} for name, state in self.runs.items()],
        }
        _write_whole(self.path / STATE_FILE, json.dumps(content, indent=1) + "\n")


def _run_state(section: Section) -> RunState:
    section.text("status", STATUSES)
    values = {item.name: section.raw(item.name) for item in fields(RunState)}
    values["findings"] = tuple(values["findings"])
    return RunState(**values)


def _files_of(directory: Path, run: str) -> list[Path]:
    """Files of a run that are there, all parts of its log among them."""
    endings = "|".join(map(re.escape, (*ENDINGS, *EVIDENCE)))
    of_run = re.compile(rf"{re.escape(run)}(@\d+)?({endings})")
    return sorted(path for path in directory.iterdir() if of_run.fullmatch(path.name))


def _write_whole(path: Path, text: str) -> None:
    """Replace a file so that whoever reads it, also after a crash, finds the old or the new one, never a part."""
    temporary = path.with_name(f".{path.name}.new")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


# What is said while a campaign runs: a bar with the remaining time on a terminal, else a line per run; on stderr.


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
        """Time that is left when played_s of the run under way have been played."""
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
    """A context manager around the runs. Results are not its matter."""

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
        self.say(f"{name}: attempt {attempt}: {reason}; once more")

    def end(self, name: str, motion_s: float, state: RunState) -> None:
        """A run is over."""
        self._remaining.end()
        self._finished_s += motion_s
        if self._console.is_terminal and state.status == DONE and not state.findings:
            return
        text = f"run {self._number} of {self._total}: {name}: {state.status}"
        if state.status == DONE:
            text += f", {state.rows} rows, {state.missed + state.incomplete} cycles missing"
        else:
            text += f": {state.reason}"
        left = self._remaining.seconds()
        self.say(text + (f"; {clock_text(left)} left" if left > 0.0 else ""))
        for finding in state.findings:
            self.say(f"{name}: {finding}")

    def say(self, text: str) -> None:
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
