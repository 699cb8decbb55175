"""`jtq batch diagnose|replay`: one command over many logs.

Run one `jtq` command over groups of logs and keep each result by its content, so that a batch resumes.

    OUT/results/KEY.json     a finished task: parameters, hashes of its logs, what the command printed
    OUT/results/KEY/         what the command wrote beside (a report)

KEY is a hash of the command, of version and code of jtqd, of the parameters and of the content of the logs. Files are put
in place whole. Every task is a process of its own, so that one that runs out of memory or hangs is only a failed group.

Summarise a batch: summary.json and index.html, one line per group.
"""

from __future__ import annotations

import argparse
import datetime as dt
import hashlib
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import jtqd
from jtqd.estimator.command_line import (
    HelpFormatter,
    check_installed,
    command_parser,
    count,
    make_directory,
    seconds,
)
from jtqd.estimator.decoder import read_json
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.files import open_regular, write_whole
from jtqd.estimator.settings import METHODS
from jtqd.estimator.text import counted
from jtqd.sysid.progress import bar
from jtqd.sysid.report import page
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import LOGS, NO_RUNS, TABLES, ends_in
from jtqd.sysid.runs.options import UsageError, check_joint_files, joint_files
from jtqd.sysid.runs.run_file import RunError

SCHEMA: Final = "jtq.batch.result/1"
DONE, KEPT, FAILED = "done", "kept", "failed"
"""State of a group: done now; finished by an earlier batch; failed, and tried again by the next batch."""
BY_RUN, BY_DIRECTORY, BY_FILE = "run", "directory", "file"
WAYS: Final = (BY_RUN, BY_DIRECTORY, BY_FILE)
_UNFINISHED: Final = ".mcap.active"
_PART: Final = re.compile(r"-\d{4,}(?=\.mcap$)", re.ASCII)
_CODE: Final = (".py", ".j2", ".css", ".eds")
_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_CONNECT_S: Final = 10.0
_RUNNING: Final[set[subprocess.Popen[bytes]]] = set()
_ENDING: Final = threading.Event()


class BatchError(Exception):
    """The batch cannot start or go on; finished results are kept. One line."""


class GroupError(ValueError):
    """No logs to work on; one line: what was named, found, expected."""


@dataclass(frozen=True)
class Group:
    """Logs of one task, in the order of their names; `name` is unique in a batch."""

    name: str
    files: tuple[Path, ...]


@dataclass(frozen=True)
class Task:
    """One command of jtq on one group: absolute paths of the logs, arguments besides these, --json and --out.

    writes: the command takes --out DIR; what it writes there is part of the result. timeout_s: longest duration; None: no
    limit.
    """

    command: str
    files: tuple[str, ...] = ()
    arguments: tuple[str, ...] = ()
    writes: bool = False
    timeout_s: float | None = None


@dataclass(frozen=True)
class Outcome:
    """What a task returned: JSON result and written files by name, or one line of error; tool: `tool_version()` there."""

    exit_status: int | None
    result: dict[str, Any] | None
    error: str
    seconds: float
    tool: str
    files: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """State of one group at the end; content: the stored result, None where it failed."""

    group: Group
    state: str
    key: str | None
    content: Mapping[str, Any] | None
    error: str
    seconds: float


def find_groups(
    named: Sequence[Path], by: str, kinds: Sequence[Sequence[str]]
) -> tuple[list[Group], list[Path]]:
    """Find the logs among and below `named`; return the groups by name, and the logs left out as still being written.

    Of each directory the files of the first kind (endings) that it has are taken: a campaign's directory holds log and
    table of every run. by: one of `WAYS`. Raises GroupError where a path does not exist, or no log is there; OSError.
    """
    files: set[Path] = set()
    active: list[Path] = []
    for path in named:
        if not path.exists():
            raise GroupError(
                f"{path}: found no such file or directory, expected a log or a directory of logs"
            )
        inside = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
        unfinished = sorted(each for each in inside if each.name.endswith(_UNFINISHED))
        wanted = _first_kind(inside, kinds)
        if not wanted and not unfinished:
            kind = "no log in it" if path.is_dir() else f"a file ending in {path.suffix!r}"
            endings = ", ".join(ending for kind in kinds for ending in kind)
            raise GroupError(f"{path}: found {kind}, expected names ending in {endings}")
        files |= {Path(os.path.abspath(each)) for each in wanted}
        active += unfinished
    if not files:
        raise GroupError(f"{active[0]}: still being written (`jtq recover` ends it), and no other log found")
    grouped: dict[str, list[Path]] = {}
    for path in sorted(files):
        run = path.with_name(_PART.sub("", path.name))
        grouped.setdefault(str({BY_DIRECTORY: path.parent, BY_RUN: run}.get(by, path)), []).append(path)
    top = os.path.commonpath([path.parent for path in files])
    names = {key: os.path.relpath(key, top) for key in grouped}
    groups = [
        Group(os.path.basename(top) or "logs" if names[key] == "." else names[key], tuple(paths))
        for key, paths in sorted(grouped.items())
    ]
    return groups, active


def _first_kind(inside: Sequence[Path], kinds: Sequence[Sequence[str]]) -> list[Path]:
    """Return the files of each directory that are of the first kind it has, without hidden ones and plans of motions."""
    by_directory: dict[Path, list[Path]] = {}
    for path in inside:
        if not path.name.startswith(NO_RUNS):
            by_directory.setdefault(path.parent, []).append(path)
    found: list[Path] = []
    for paths in by_directory.values():
        of_kinds = ([path for path in paths if ends_in(path, tuple(kind))] for kind in kinds)
        found += next((chosen for chosen in of_kinds if chosen), [])
    return found


def sha256(path: Path) -> str:
    """Return the hash of a file's content. Raises OSError."""
    with open(open_regular(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tool_version() -> str:
    """Return version and code hash of jtqd here and now, e.g. "0.1.0+code.3fa9c1d2e4b7"; takes 0.1 s."""
    found = hashlib.sha256()
    for root in sorted(path for top in jtqd.__path__ for path in Path(top).iterdir() if path.is_dir()):
        for path in sorted(root.rglob("*")):
            if path.suffix in _CODE and path.is_file():
                found.update(f"{root.name}/{path.relative_to(root)} ".encode() + path.read_bytes())
    return f"{version('jtqd')}+code.{found.hexdigest()[:12]}"


def key_of(command: str, tool: str, parameters: Mapping[str, Any], hashes: Sequence[str]) -> str:
    """Return the name of a result: the same logs, parameters and tool give the same, wherever the logs are."""
    content = [SCHEMA, command, tool, dict(parameters), list(hashes)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def run_task(task: Task) -> Outcome:
    """Run the command as a process of its own; every failure is in the outcome."""
    began = time.monotonic()

    def outcome(
        status: int | None, result: Any, error: str, files: dict[str, bytes] | None = None
    ) -> Outcome:
        return Outcome(status, result, error, round(time.monotonic() - began, 3), tool_version(), files or {})

    with tempfile.TemporaryDirectory(prefix="jtq-batch-") as scratch:
        out = Path(scratch) / "out"
        arguments = [task.command, *task.files, *task.arguments, "--json"]
        arguments += ["--out", str(out)] if task.writes else []
        try:
            status, stdout, stderr = _jtq(arguments, task.timeout_s)
        except subprocess.TimeoutExpired:
            return outcome(None, None, f"took longer than {task.timeout_s:g} s")
        if status < 0:
            reason = " (out of memory?)" if -status == signal.SIGKILL else ""
            return outcome(status, None, f"ended by {signal.Signals(-status).name}{reason}")
        if status not in (0, 3):
            lines = stderr.decode(errors="replace").strip().splitlines() or [f"exit status {status}"]
            text = lines[-1].removeprefix(f"jtq {task.command}: ")
            for path in task.files:
                text = text.replace(path, os.path.basename(path))
            return outcome(status, None, text[:400])
        try:
            result = json.loads(stdout)
        except ValueError:
            return outcome(status, None, f"jtq {task.command} printed no JSON")
        written = [path for path in out.rglob("*") if path.is_file() and path.suffix != ".json"]
        return outcome(status, result, "", {str(p.relative_to(out)): p.read_bytes() for p in written})


def _jtq(arguments: Sequence[str], timeout_s: float | None) -> tuple[int, bytes, bytes]:
    """Return exit status, standard output and standard error. Raises subprocess.TimeoutExpired."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "jtqd.daemon.jtq", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=dict.fromkeys(_THREADS, "1") | dict(os.environ),
    ) as process:
        _RUNNING.add(process)
        if _ENDING.is_set():  # between the start of the process and its entry here
            process.kill()
        try:
            stdout, stderr = process.communicate(timeout=timeout_s)
        finally:
            process.kill()
            _RUNNING.discard(process)
    return process.returncode, stdout, stderr


@contextmanager
def executor(scheduler: str | None, jobs: int | None) -> Iterator[tuple[Executor, str]]:
    """Yield the executor of the tasks and its description.

    scheduler: of dask; None: this machine, a pool of threads that each wait for one process, `jobs` at a time (None: one
    per usable processor). Raises BatchError where dask is not installed, or no scheduler answers.
    """
    if scheduler is None:
        count = jobs or len(os.sched_getaffinity(0))
        local = ThreadPoolExecutor(count)
        try:
            yield local, f"this machine, {count} at a time"
        finally:
            local.shutdown(wait=False, cancel_futures=True)
            _ENDING.set()
            for process in tuple(_RUNNING):
                process.kill()
            local.shutdown(wait=True)
            _ENDING.clear()
        return
    try:
        from distributed import Client
    except ImportError:
        raise BatchError("--scheduler needs dask.distributed: pip install 'jtqd[cluster]'") from None
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise BatchError(f"{scheduler}: no dask scheduler answers: {error or type(error).__name__}") from None
    try:
        workers = len(client.scheduler_info(n_workers=-1)["workers"])
        yield client.get_executor(retries=0), f"{scheduler}, {workers} worker{'s' if workers != 1 else ''}"
    finally:
        client.close(timeout=_CONNECT_S)


def stored(out: Path, key: str) -> dict[str, Any] | None:
    """Return the finished result `key`, None where there is none, or half of one."""
    try:
        content = read_json(out / "results" / f"{key}.json")
    except (OSError, ValueError):
        return None
    good = isinstance(content, dict) and (content.get("schema"), content.get("key")) == (SCHEMA, key)
    return content if good else None


def store(out: Path, key: str, content: Mapping[str, Any], files: Mapping[str, bytes]) -> dict[str, Any]:
    """Keep a result: first the files written beside, then the JSON that marks it as finished. Raises OSError."""
    place = out / "results" / key
    shutil.rmtree(place, ignore_errors=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(data)
    whole = {"schema": SCHEMA, "key": key, **content, "files": sorted(files)}
    write_whole(place.with_suffix(".json"), json.dumps(whole, indent=1, allow_nan=False).encode())
    return whole


def run_batch(
    base: Task,
    parameters: Mapping[str, Any],
    groups: Sequence[Group],
    out: Path,
    workers: Executor,
    *,
    again: bool = False,
    progress: Callable[[Row], None] = lambda row: None,
) -> list[Row]:
    """Run the command on every group whose result is not kept yet; return one row per group, in their order.

    base: the task without files. parameters: its arguments with files replaced by their hashes. Groups with the same
    content are worked on once. again: finished ones too. Raises BatchError where the executor takes or returns no more
    tasks, OSError.
    """
    tool = tool_version()
    rows: dict[str, Row] = {}
    waiting: dict[str, tuple[list[Group], list[str]]] = {}
    running: dict[Future[Outcome], str] = {}
    finished: queue.SimpleQueue[Future[Outcome]] = queue.SimpleQueue()

    def end(row: Row) -> None:
        rows[row.group.name] = row
        progress(row)

    try:
        for group in groups:
            try:
                hashes = [sha256(path) for path in group.files]
            except OSError as error:
                end(Row(group, FAILED, None, None, f"{error.filename}: {error.strerror}", 0.0))
                continue
            key = key_of(base.command, tool, parameters, hashes)
            content = None if again else stored(out, key)
            if content is not None:
                end(Row(group, KEPT, key, content, "", content["seconds"]))
            elif key in waiting:
                waiting[key][0].append(group)
            else:
                waiting[key] = ([group], hashes)
                future = workers.submit(run_task, replace(base, files=tuple(map(str, group.files))))
                running[future] = key
                future.add_done_callback(finished.put)
        while running:
            future = finished.get()
            key = running.pop(future)
            outcome = _outcome(future, tool)
            content = None
            if not outcome.error:
                made = {
                    "command": base.command,
                    "tool": outcome.tool,
                    "parameters": dict(parameters),
                    "logs_sha256": waiting[key][1],
                    "exit_status": outcome.exit_status,
                    "seconds": outcome.seconds,
                    "result": outcome.result,
                }
                content = store(out, key, made, outcome.files)
            for group in waiting[key][0]:
                state = DONE if content is not None else FAILED
                end(Row(group, state, key, content, outcome.error, outcome.seconds))
    except RuntimeError as error:  # the executor was shut down
        raise BatchError(f"no more tasks are taken: {error}") from None
    finally:
        for future in running:
            future.cancel()
    return [rows[group.name] for group in groups]


def _outcome(future: Future[Outcome], here: str) -> Outcome:
    """Return what the task returned, or one line for what its worker raised; another tool than `here` is an error. Raises
    BatchError when the scheduler is gone.
    """
    try:
        outcome = future.result()
    except CancelledError:
        raise BatchError("the scheduler has ended or lost the tasks") from None
    except Exception as error:
        lines = str(error).strip().splitlines() or ["no reason given"]
        died = type(error).__name__ == "KilledWorker"
        text = "the workers that tried it died" if died else f"{type(error).__name__}: {lines[0]}"
        return Outcome(None, None, text, 0.0, here)
    if not outcome.error and outcome.tool != here:
        return replace(outcome, error=f"the worker has jtqd {outcome.tool}, expected {here} as here")
    return outcome


SUMMARY_SCHEMA: Final = "jtq.batch/1"
DIAGNOSE, REPLAY = "diagnose", "replay"
REPORT: Final = "report.html"
FAILED_BADGE: Final = ("ink", "failed")
HEADINGS: Final = {
    DIAGNOSE: ("gap, Nm", "noise, Nm", "after, Nm", "causes"),
    REPLAY: ("difference, Nm", "length", "identical cycles", "to the sensor, Nm"),
}
"""Of the columns beside name, badge and time; the first is also drawn as a bar."""
GAP: Final = {
    DIAGNOSE: "error of the joint file's simulation, RMSE",
    REPLAY: "largest difference between replay and log",
}


@dataclass(frozen=True)
class Figures:
    """Of one result: badge (colour role, text), cells under `HEADINGS`, size of the gap [Nm], causes, values for
    summary.json.
    """

    badge: tuple[str, str]
    cells: tuple[str, ...]
    gap_nm: float | None
    causes: tuple[str, ...]
    values: Mapping[str, Any]


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Return state -> number of groups, and the number of all."""
    states = Counter(row.state for row in rows)
    return {"groups": len(rows), **{state: states[state] for state in (DONE, KEPT, FAILED)}}


def to_mapping(
    command: str, parameters: Mapping[str, Any], tool: str, rows: Sequence[Row], where: str
) -> dict[str, Any]:
    """Return the content of summary.json."""
    return {
        "schema": SUMMARY_SCHEMA,
        "command": command,
        "tool": tool,
        "parameters": dict(parameters),
        "where": where,
        "counts": counts(rows),
        "groups": [
            {
                "name": row.group.name,
                "logs": [str(path) for path in row.group.files],
                "state": row.state,
                "key": row.key,
                "exit_status": None if row.content is None else row.content["exit_status"],
                "error": row.error or None,
                "seconds": row.seconds,
                "figures": None if (figures := figures_of(command, row)) is None else dict(figures.values),
            }
            for row in rows
        ],
    }


def render(command: str, rows: Sequence[Row], where: str, made: str) -> str:
    """Return index.html, self-contained but for the links to the groups' reports; made: the foot of the page."""
    every = [(row, figures_of(command, row)) for row in rows]
    largest = max((each.gap_nm or 0.0 for _, each in every if each is not None), default=0.0)
    lines = [_line(row, each, largest) for row, each in every]
    content = {
        "command": command,
        "where": where,
        "made": made,
        "counts": counts(rows),
        "headings": HEADINGS[command],
        "gap": GAP[command],
        "lines": sorted(lines, key=lambda line: (not line["error"], -(line["bar"] or 0.0), line["name"])),
        "badges": Counter(line["badge"] for line in lines).most_common(),
        "causes": Counter(
            name for _, each in every if each is not None for name in each.causes
        ).most_common(),
        "logs": sum(len(row.group.files) for row in rows),
        "seconds": sum(row.seconds for row in rows),
    }
    return page.render("jtqd.sysid.batch", "summary.html.j2", content)


def _line(row: Row, figures: Figures | None, largest: float) -> dict[str, Any]:
    """Return one row of the table; bar: share of the largest gap, None where there is none."""
    gap = None if figures is None else figures.gap_nm
    reported = row.content is not None and REPORT in row.content["files"]
    return {
        "name": row.group.name,
        "logs": [path.name for path in row.group.files],
        "badge": FAILED_BADGE if figures is None else figures.badge,
        "cells": () if figures is None else figures.cells,
        "bar": None if gap is None or largest <= 0.0 else gap / largest,
        "link": f"results/{row.key}/{REPORT}" if reported else "",
        "kept": row.state == KEPT,
        "error": row.error,
        "seconds": row.seconds,
    }


def figures_of(command: str, row: Row) -> Figures | None:
    """Return the figures of what `jtq COMMAND --json` printed, None for a failed group."""
    if row.content is None:
        return None
    result = row.content["result"]
    return _diagnosis_figures(result) if command == DIAGNOSE else _replay_figures(result)


def _nm(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _diagnosis_figures(result: Mapping[str, Any]) -> Figures:
    from jtqd.sysid.diagnosis.report import (  # scipy, which --help does not need
        BADGES,
        effect_title,
        place,
    )

    gap, gain, verdict = result["gap"], result["gain"], str(result["verdict"])
    causes = [
        f"{' or '.join(effect_title(name) for name in each['class'])} ({place(each['joint'])})"
        for each in result["causes"]
    ]
    cells = (_nm(gap["rmse_nm"]), _nm(gap["noise_floor_nm"]), _nm(gain["rmse_after_nm"]))
    values = {
        "verdict": verdict,
        "joint": gap["joint"],
        "rmse_nm": gap["rmse_nm"],
        "noise_floor_nm": gap["noise_floor_nm"],
        "rmse_after_nm": gain["rmse_after_nm"],
        "causes": [
            {key: each[key] for key in ("name", "joint", "class", "parameters")} for each in result["causes"]
        ],
    }
    badge = BADGES.get(verdict, ("warn", verdict))
    return Figures(
        badge, (*cells, "; ".join(causes) or "–"), gap["rmse_nm"], tuple(dict.fromkeys(causes)), values
    )


def _replay_figures(result: Mapping[str, Any]) -> Figures:
    runs: Sequence[Mapping[str, Any]] = result["runs"]
    joints = [joint for run in runs for joint in run["joints"]]
    same = [run["identity"] for run in runs if run["identity"] is not None]
    values = {
        "runs": len(runs),
        "cycles": sum(run["cycles"] for run in runs),
        "seconds": sum(run["seconds"] for run in runs),
        "identical": sum(each["identical"] for each in same) if len(same) == len(runs) else None,
        "max_nm": _largest(joint["max_nm"] for joint in joints),
        "sensor_logged_nm": _largest(joint["sensor_logged_nm"] for joint in joints),
        "sensor_replayed_nm": _largest(joint["sensor_replayed_nm"] for joint in joints),
    }
    cells = (
        _nm(values["max_nm"]),
        f"{values['seconds']:.0f} s",
        "–" if values["identical"] is None else f"{values['identical']} of {values['cycles']}",
        f"{_nm(values['sensor_logged_nm'])} → {_nm(values['sensor_replayed_nm'])}",
    )
    return Figures(_sameness(same, len(runs)), cells, values["max_nm"], (), values)


def _sameness(same: Sequence[Mapping[str, Any]], runs: int) -> tuple[str, str]:
    if len(same) < runs:
        return "after", "other models"
    if all(each["bit_identical"] for each in same):
        return "good", "identical"
    if all(each["explained"] for each in same):
        return "good", "identical, differences explained"
    return "warn", "differs"


def _largest(values: Iterable[Any]) -> float | None:
    return max((float(value) for value in values if value is not None), default=None)


BY: Final = "jtq batch"
PAGE, SUMMARY = "index.html", "summary.json"
_KINDS: Final = {DIAGNOSE: (TABLES, LOGS), REPLAY: (LOGS,)}
_SCHEDULER: Final = re.compile(r"(\w+://)?[^\s/]+:\d{1,5}")
_GROUP_BY: Final = {DIAGNOSE: BY_DIRECTORY, REPLAY: BY_RUN}
_EXAMPLES: Final = """examples:
  jtq batch diagnose fleet/ --joint models/joint1.yaml --out fleet_diagnosis
  jtq batch replay /var/log/jtqd --out replayed --jobs 4
  jtq batch replay logs/ --model trained/ --out new_model --scheduler tcp://10.0.0.5:8786

One group of logs is one task. Each task is a separate process on this machine or on a worker of a dask cluster (which
must have the same jtqd and the logs under the same paths). A finished result is stored in DIR/results under a hash of
the logs, the options, and version and code of jtqd. The same command again runs only missing groups. DIR/index.html has
the summary.

exit status: 0 every group finished (whatever the result), 3 some failed, 1 the batch failed, 2 usage"""


def main(argv: list[str]) -> int:
    """Run a batch; returns the exit status."""
    options = parser().parse_args(argv)
    try:
        check_installed("analysis", "jinja2")
        groups, active = find_groups(
            options.logs, options.group_by or _GROUP_BY[options.command], _KINDS[options.command]
        )
        arguments, parameters = _diagnose(options) if options.command == DIAGNOSE else _replay(options)
        make_directory(options.out)
    except UsageError as error:
        return _error(error, 2)
    except (GroupError, ConfigError, RunError) as error:
        return _error(error)
    for path in active:
        _error(f"{path}: left out, still being written (`jtq recover` ends it)")
    task = Task(options.command, (), arguments, options.command == DIAGNOSE, options.timeout)
    try:
        return _run(options, groups, task, parameters)
    except BatchError as error:
        return _error(error)
    except KeyboardInterrupt:
        return _error("interrupted; the same command continues from here")


def _error(text: object, status: int = 1) -> int:
    print(f"{BY}: {text}", file=sys.stderr, flush=True)
    return status


def _run(options: argparse.Namespace, groups: Sequence[Group], task: Task, parameters: dict[str, Any]) -> int:
    """Run the batch and write the summary. Raises BatchError, OSError."""
    (options.out / "results").mkdir(parents=True, exist_ok=True)
    tool = tool_version()
    with executor(options.scheduler, options.jobs) as (workers, where), bar("groups", len(groups)) as advance:

        def finished(row: Row) -> None:
            advance(1)
            if row.state == FAILED:
                _error(_failure(row))

        rows = run_batch(
            task, parameters, groups, options.out, workers, again=options.again, progress=finished
        )
    mapping = to_mapping(task.command, parameters, tool, rows, where)
    text = json.dumps(mapping, indent=1, allow_nan=False)
    write_whole(options.out / SUMMARY, f"{text}\n".encode())
    made = dt.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    foot = f"{made} · jtqd {tool}"
    foot += f" · options: {' '.join(task.arguments)}" if task.arguments else ""
    write_whole(options.out / PAGE, render(task.command, rows, where, foot).encode())
    number = counts(rows)
    if options.json:
        print(text)
    else:
        print(
            f"{counted(number['groups'], 'group')}: {number['done']} done, {number['kept']} finished before, "
            f"{number['failed']} failed"
        )
        for row in rows:
            if row.error:
                print(f"  {_failure(row)}")
    _error(f"wrote {options.out / PAGE}")
    return 3 if number["failed"] else 0


def _failure(row: Row) -> str:
    """Return group and error of a row; a file that is its own group is named once."""
    return f"{row.group.name}: {row.error.removeprefix(f'{Path(row.group.name).name}: ')}"


def _diagnose(options: argparse.Namespace) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the arguments of `jtq diagnose`, and the same by content. Raises UsageError, ConfigError, RunError."""
    columns = None if options.columns is None else ColumnMap.load(options.columns)
    files = joint_files(options.joint, columns)
    check_joint_files(files)
    arguments: list[str] = []
    for text in options.joint:
        number, equals, path = text.rpartition("=")
        arguments += ["--joint", f"{number}{equals}{os.path.abspath(path)}"]
    parameters: dict[str, Any] = {"joint": {str(key): _hash(path) for key, path in files.items()}}
    if options.columns is not None:
        arguments += ["--columns", os.path.abspath(options.columns)]
        parameters["columns"] = _hash(options.columns)
    return tuple(arguments), parameters


def _replay(options: argparse.Namespace) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the arguments of `jtq replay`, and the same by content. Raises ConfigError."""
    arguments: list[str] = []
    parameters: dict[str, Any] = {}
    if options.model is not None:
        if not options.model.is_dir():
            raise ConfigError(f"--model {options.model}: found no such directory, expected one with models")
        arguments += ["--model", os.path.abspath(options.model)]
        inside = sorted(path for path in options.model.rglob("*") if path.is_file())
        parameters["model"] = {str(path.relative_to(options.model)): _hash(path) for path in inside}
    if options.method is not None:
        arguments += ["--method", options.method]
        parameters["method"] = options.method
    return tuple(arguments), parameters


def _hash(path: Path) -> str:
    try:
        return sha256(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None


def parser() -> argparse.ArgumentParser:
    """Arguments of `jtq batch`."""
    about = "Run one command over many logs, on this machine or on a dask cluster, and summarise the results."
    result = command_parser(BY, about, _EXAMPLES)
    commands = result.add_subparsers(dest="command", required=True, metavar="diagnose|replay")
    diagnose = _common(
        commands, DIAGNOSE, "diagnose the simulation error of a joint file on each group of runs"
    )
    diagnose.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="[N=]FILE",
        help="joint file of all joints, or of joint N; may be given again (default: those that the column map names)",
    )
    diagnose.add_argument(
        "--columns", type=Path, metavar="FILE", help="column map for other names, units and signs"
    )
    replay = _common(commands, REPLAY, "replay the estimator over each run, and compare")
    replay.add_argument("--model", type=Path, metavar="DIR", help="other models; see jtq replay --help")
    replay.add_argument("--method", choices=METHODS, help="another method of the estimator")
    return result


def _scheduler(text: str) -> str:
    """Address of a scheduler. Raises argparse.ArgumentTypeError."""
    if not _SCHEDULER.fullmatch(text):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected tcp://HOST:PORT")
    return text


def _common(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    made: argparse.ArgumentParser = commands.add_parser(
        name,
        help=text,
        description=text,
        epilog=_EXAMPLES,
        formatter_class=HelpFormatter,
    )
    add = made.add_argument
    add("logs", nargs="+", type=Path, metavar="LOGS", help="logs, or directories of them")
    add("--out", type=Path, required=True, metavar="DIR", help="results; created if missing")
    ways = f"logs of one task: the parts of one run, a directory, a file (default: {_GROUP_BY[name]})"
    add("--group-by", choices=WAYS, help=ways)
    where = "dask scheduler (default: this machine; extra: cluster)"
    add("--scheduler", type=_scheduler, metavar="tcp://HOST:PORT", help=where)
    add("--jobs", type=count, metavar="N", help="tasks at a time on this machine (default: CPUs)")
    add("--timeout", type=seconds, metavar="S", help="time limit of a group [s]")
    add("--again", action="store_true", help="run finished groups again")
    add("--json", action="store_true", help="print summary.json")
    return made


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
