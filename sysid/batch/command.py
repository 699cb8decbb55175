"""`jtq batch diagnose|replay`: one command over many logs."""

from __future__ import annotations

import argparse
import datetime as dt
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from jtqd.estimator.command_line import check_installed, count, make_directory, seconds
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.settings import METHODS
from jtqd.estimator.text import counted
from jtqd.sysid.batch.run import (
    BY_DIRECTORY,
    BY_RUN,
    FAILED,
    WAYS,
    BatchError,
    Group,
    GroupError,
    Row,
    Task,
    executor,
    find_groups,
    run_batch,
    sha256,
    tool_version,
    write_whole,
)
from jtqd.sysid.batch.summary import DIAGNOSE, REPLAY, counts, render, to_mapping
from jtqd.sysid.runs.column_map import ColumnMap
from jtqd.sysid.runs.files import LOGS, TABLES
from jtqd.sysid.runs.options import UsageError, check_joint_files, joint_files
from jtqd.sysid.runs.run_file import RunError

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
    with executor(options.scheduler, options.jobs) as (workers, where), _progress(len(groups)) as progress:
        rows = run_batch(
            task, parameters, groups, options.out, workers, again=options.again, progress=progress
        )
    mapping = to_mapping(task.command, parameters, tool, rows, where)
    text = json.dumps(mapping, indent=1, allow_nan=False)
    write_whole(options.out / SUMMARY, f"{text}\n")
    made = dt.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    foot = f"{made} · jtqd {tool}"
    foot += f" · options: {' '.join(task.arguments)}" if task.arguments else ""
    write_whole(options.out / PAGE, render(task.command, rows, where, foot))
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


@contextmanager
def _progress(groups: int) -> Iterator[Callable[[Row], None]]:
    """Show a bar on a terminal, and a line for each group that failed. Yields what is to be called with each row."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("groups", total=groups)

        def finished(row: Row) -> None:
            bar.advance(task)
            if row.state == FAILED:
                _error(_failure(row))

        yield finished


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
    result = argparse.ArgumentParser(
        prog=BY,
        description="Run one command over many logs, on this machine or on a dask cluster, and summarise the results.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
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
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("logs", nargs="+", type=Path, metavar="LOGS", help="logs, or directories of them")
    made.add_argument("--out", type=Path, required=True, metavar="DIR", help="results; created if missing")
    made.add_argument(
        "--group-by",
        choices=WAYS,
        help=f"logs of one task: the parts of one run, a directory, a file (default: {_GROUP_BY[name]})",
    )
    made.add_argument(
        "--scheduler",
        type=_scheduler,
        metavar="tcp://HOST:PORT",
        help="dask scheduler (default: this machine; extra: cluster)",
    )
    made.add_argument(
        "--jobs", type=count, metavar="N", help="tasks at a time on this machine (default: CPUs)"
    )
    made.add_argument("--timeout", type=seconds, metavar="S", help="time limit of a group [s]")
    made.add_argument("--again", action="store_true", help="run finished groups again")
    made.add_argument("--json", action="store_true", help="print summary.json")
    return made
