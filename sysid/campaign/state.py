"""campaign.json: the state of every run, written after each, so that an interrupted campaign can go on (jtq.campaign/1).

The directory belongs to one campaign at a time (a lock that ends with its process), and to one plan.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

from jtqd.estimator.decoder import Text, below, choice, in_file, read, read_json, split
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import write_whole
from jtqd.sysid.planner.plan import Plan, load_plan

SCHEMA: Final = "jtq.campaign/1"
STATE_FILE: Final = "campaign.json"
PLAN_FILE: Final = "plan.yaml"
LOCK_FILE: Final = ".lock"
PARTS: Final = ".part"
"""Suffix of a run's directory while the run is under way."""
ENDINGS: Final = (".csv.gz", ".json", ".mcap")
"""Files of a run that is done; further parts of its log are NAME@2.mcap, NAME@3.mcap, ..."""
EVIDENCE: Final = (".stopped.mcap", ".failed.mcap", ".jtqd.log")
"""Files of a failed attempt, until the next attempt."""
DONE, STOPPED, FAILED, PENDING = STATUSES = ("done", "stopped", "failed", "pending")


class StateError(Exception):
    """The directory cannot be used for this campaign; one line."""


@dataclass(frozen=True)
class RunState:
    """State of one run.

    status: done; stopped (a limit, or the bus); failed (nothing usable was recorded); pending. reason: of stopped, failed.
    played_s: length of the set-points of the last attempt. rows: of the run table, `interpolated` of them interpolated.
    missed, incomplete: cycles that are no rows. findings: faults of the table. sha256: of NAME.csv.gz. pieces: run tables.
    """

    status: Annotated[str, choice(STATUSES)] = PENDING
    reason: str = ""
    attempts: int = 0
    played_s: float = 0.0
    rows: int = 0
    missed: int = 0
    incomplete: int = 0
    incomplete_by: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    sha256: str = ""
    interpolated: int = 0
    pieces: int = 1

    def tables(self, name: str) -> list[str]:
        """Return the names of its tables: its own, or NAME~1, NAME~2, ... of its partial runs."""
        return [name] if self.pieces == 1 else [f"{name}~{number}" for number in range(1, self.pieces + 1)]


class CampaignDirectory:
    """A campaign's directory, made if missing, locked for this process until `close`; its state is that of the last `put`.

    Raises StateError where another campaign is running there, or campaign.json cannot be read; OSError.
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
            raise StateError(f"{path}: another campaign is running in this directory") from None
        self.name = ""
        self.plan_sha256 = ""
        self.recipe: Mapping[str, Any] = {}
        self.runs: dict[str, RunState] = {}
        try:
            self._load()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Unlock the directory."""
        os.close(self._lock)

    def same_recipe(self, recipe: Mapping[str, Any]) -> Plan | None:
        """Return the plan of this directory if it was made from the same recipe; else None."""
        if not self.plan_sha256 or self.recipe != recipe:
            return None
        try:
            plan = load_plan(self.path / PLAN_FILE)
        except ConfigError:
            return None
        return plan if plan.sha256 == self.plan_sha256 else None

    def begin(self, plan: Plan, recipe: Mapping[str, Any]) -> None:
        """Begin, or go on: runs that are done stay done, files of all others are removed.

        Raises StateError for a directory of another plan.
        """
        if self.plan_sha256 and self.plan_sha256 != plan.sha256:
            raise StateError(
                f"{self.path}: found campaign '{self.name}' of another plan ({self.plan_sha256[:8]}), expected "
                f"'{plan.name}' ({plan.sha256[:8]}): give another --out, or the same campaign with the same options"
            )
        if not self.plan_sha256:
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
        write_whole(self.path / PLAN_FILE, plan.to_yaml().encode())
        self._save()

    def put(self, name: str, state: RunState) -> None:
        """Set the state of a run, and write the file."""
        self.runs[name] = state
        self._save()

    def _still_done(self, name: str) -> RunState:
        """Return the state of a run; pending where it is not done or one of its files is missing."""
        state = self.runs.get(name, RunState())
        files = (self.path / (table + ending) for table in state.tables(name) for ending in ENDINGS)
        if state.status == DONE and all(file.is_file() for file in files):
            return state
        return RunState()

    def _load(self) -> None:
        path = self.path / STATE_FILE
        try:
            content = read_json(path)
            with in_file(str(path)):
                file = read(_StateFile, content)
                self.runs = dict(_run_state(n, each) for n, each in enumerate(file.runs))
        except FileNotFoundError:
            return
        except (ValueError, ConfigError) as error:  # ConfigError names the file itself
            text = str(error) if isinstance(error, ConfigError) else f"{path}: not JSON: {error}"
            raise StateError(text) from None
        self.name, self.plan_sha256, self.recipe = file.name, file.plan_sha256, file.recipe

    def _save(self) -> None:
        content = {
            "schema": SCHEMA,
            "name": self.name,
            "plan_sha256": self.plan_sha256,
            "recipe": self.recipe,
            "runs": [{"name": name, **asdict(state)} for name, state in self.runs.items()],
        }
        write_whole(self.path / STATE_FILE, f"{json.dumps(content, indent=1)}\n".encode())


@dataclass(frozen=True)
class _StateFile:
    schema: Annotated[str, choice((SCHEMA,))]
    name: Text
    plan_sha256: Text
    recipe: Mapping[str, Any]
    runs: tuple[Mapping[str, Any], ...] = ()


def _run_state(n: int, section: Mapping[str, Any]) -> tuple[str, RunState]:
    with below(f"runs[{n}]"):
        name, state = split(section, "name", Text)
        return name, read(RunState, state)


def _files_of(directory: Path, run: str) -> list[Path]:
    """Return the files of a run, all parts of its log included."""
    endings = "|".join(map(re.escape, (*ENDINGS, *EVIDENCE)))
    of_run = re.compile(rf"{re.escape(run)}(~\d+)?(@\d+)?({endings})")
    return sorted(path for path in directory.iterdir() if of_run.fullmatch(path.name))
