"""`jtq batch diagnose|replay`: one command over many logs."""

from __future__ import annotations

import argparse
import datetime as dt
import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from jtqd.estimator.checked import ConfigError, count, seconds
from jtqd.sysid.batch.executors import ClusterError, executor
from jtqd.sysid.batch.figures import DIAGNOSE, REPLAY, REPORT
from jtqd.sysid.batch.groups import BY_DIRECTORY, BY_RUN, WAYS, Found, GroupError, find_groups
from jtqd.sysid.batch.options import Passed, passed_to_diagnose, passed_to_replay
from jtqd.sysid.batch.progress import Progress
from jtqd.sysid.batch.run import Batch, BatchError, Job, Row
from jtqd.sysid.batch.store import Store, StoreError, write_whole
from jtqd.sysid.batch.summary import counts, render, to_mapping
from jtqd.sysid.batch.tool import tool_version
from jtqd.sysid.runs.files import LOGS, TABLES, RunError
from jtqd.sysid.runs.joints import UsageError

BY: Final = "jtq batch"
PAGE, SUMMARY = "index.html", "summary.json"
_KINDS: Final = {DIAGNOSE: (TABLES, LOGS), REPLAY: (LOGS,)}
_GROUP_BY: Final = {DIAGNOSE: BY_DIRECTORY, REPLAY: BY_RUN}
_EXAMPLES: Final = """examples:
  jtq batch diagnose fleet/ --joint models/joint1.yaml --out fleet_diagnosis
  jtq batch replay /var/log/jtqd --out replayed --jobs 4
  jtq batch replay logs/ --model trained/ --out new_model --scheduler tcp://10.0.0.5:8786

One group of logs is one task, and each task a process of its own, on this machine or on a worker of a dask cluster (which
must have the same jtqd and see the logs under the same paths). A finished result is kept in DIR/results under a hash of
the logs, the options, and version and code of jtqd: the same command again does only what is missing. DIR/index.html has
the summary.

exit status: 0 every group finished (whatever was found), 3 some failed, 1 the batch failed, 2 usage"""


def main(argv: list[str]) -> int:
    """Run a batch; returns the exit status."""
    options = _parser().parse_args(argv)
    needed = [name for name in ("jinja2",) if importlib.util.find_spec(name) is None]
    if needed:
        print(f"{BY}: {', '.join(needed)} not installed: pip install 'jtqd[train]'", file=sys.stderr)
        return 1
    command = options.command
    try:
        found = find_groups(options.logs, options.group_by or _GROUP_BY[command], _KINDS[command])
        passed = passed_to_diagnose(options) if command == DIAGNOSE else passed_to_replay(options)
    except (UsageError, GroupError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 2
    except (ConfigError, RunError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
        return 1
    for path in found.active:
        print(f"{BY}: {path}: left out, it is not ended (`jtq recover` does that)", file=sys.stderr)
    store = None
    try:
        store = Store(options.out)
        return _run(options, found, passed, store)
    except (BatchError, ClusterError, StoreError) as error:
        print(f"{BY}: {error}", file=sys.stderr)
    except KeyboardInterrupt:
        print(f"{BY}: interrupted; the same command goes on from here", file=sys.stderr)
    finally:
        if store is not None:
            store.close()
    return 1


def _run(options: argparse.Namespace, found: Found, passed: Passed, store: Store) -> int:
    """The batch itself. Raises BatchError, ClusterError, OSError."""
    job = Job(
        options.command,
        passed.arguments,
        passed.parameters,
        options.command == DIAGNOSE,
        tool_version(),
        options.timeout,
        options.again,
    )
    with (
        executor(options.scheduler, options.jobs) as (workers, where),
        Progress(len(found.groups), BY) as progress,
    ):
        rows = Batch(job, found.groups, store, workers, progress.finished).run()
    mapping = to_mapping(job, rows, where)
    text = json.dumps(mapping, indent=1, allow_nan=False)
    write_whole(options.out / SUMMARY, f"{text}\n".encode())
    made = dt.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    page = render(job, rows, where, made, _links(rows, store))
    write_whole(options.out / PAGE, page.encode())
    print(text if options.json else _lines(mapping))
    print(f"{BY}: wrote {options.out / PAGE}", file=sys.stderr)
    return 3 if counts(rows)["failed"] else 0


def _links(rows: Sequence[Row], store: Store) -> dict[str, str]:
    return {
        row.key: store.link(row.key, REPORT)
        for row in rows
        if row.key is not None and row.content is not None and REPORT in row.content["files"]
    }


def _lines(mapping: dict[str, Any]) -> str:
    """The outcome for people: one line of counts, one per failed group."""
    number = mapping["counts"]
    lines = [
        f"{number['groups']} groups: {number['done']} done, {number['kept']} finished before, {number['failed']} failed"
    ]
    lines += [f"  {each['name']}: {each['error']}" for each in mapping["groups"] if each["error"]]
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=BY,
        description="Run one command over many logs, on this machine or on a dask cluster, and sum up.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="diagnose|replay")
    diagnose = _common(commands, DIAGNOSE, "what a joint file's simulation gets wrong on each group of runs")
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
    replay = _common(commands, REPLAY, "the estimator over each run again, and the difference")
    replay.add_argument("--model", type=Path, metavar="DIR", help="other models; see jtq replay --help")
    replay.add_argument("--method", metavar="NAME", help="another method of the estimator")
    replay.add_argument("--exact", action="store_true", help="cycle by cycle, whatever the length")
    return parser


def _common(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    made: argparse.ArgumentParser = commands.add_parser(
        name,
        help=text,
        description=text,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("logs", nargs="+", type=Path, metavar="LOGS", help="logs, or directories of them")
    made.add_argument("--out", type=Path, required=True, metavar="DIR", help="results; made if missing")
    made.add_argument(
        "--group-by",
        choices=WAYS,
        help=f"what makes one task: the parts of one run, a directory, a file (default: {_GROUP_BY[name]})",
    )
    made.add_argument(
        "--scheduler",
        metavar="tcp://HOST:PORT",
        help="dask scheduler (default: this machine; extra: cluster)",
    )
    made.add_argument(
        "--jobs", type=count, metavar="N", help="tasks at a time on this machine (default: CPUs)"
    )
    made.add_argument("--timeout", type=seconds, metavar="S", help="a group that takes longer has failed")
    made.add_argument("--again", action="store_true", help="do it again although it is finished")
    made.add_argument("--json", action="store_true", help="print summary.json")
    return made
