"""A fleet of small run tables for the tests of `jtq batch`, and a look at the processes of its tasks."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.paths import ROOT
from tests.sysid.diagnosis.diagnose_helpers import JOINT_FILE, write_runs

CHILD = b"jtqd.daemon.jtq"


def fleet(directory, names):
    """One directory with one short run each, no two the same: too little to judge, and quick."""
    for number, name in enumerate(names):
        (directory / name).mkdir(parents=True)
        write_runs(directory / name, count=1, seconds=1.0 + 0.01 * number)
    return directory


def arguments(logs, out, *more):
    return ["diagnose", str(logs), "--joint", str(JOINT_FILE), "--out", str(out), *more]


def summary(out):
    return json.loads((out / "summary.json").read_text())


def states(out):
    return {group["name"]: group["state"] for group in summary(out)["groups"]}


def results(out):
    """Finished results by key."""
    return {path.stem: json.loads(path.read_text()) for path in (out / "results").glob("*.json")}


def tasks_of(pid):
    """Process-IDs of the tasks that process `pid` has started and that run."""
    try:
        lists = [(each / "children").read_text() for each in Path(f"/proc/{pid}/task").iterdir()]
    except OSError:  # it has just gone
        return []
    return [child for child in map(int, " ".join(lists).split()) if _is_task(child)]


def _is_task(pid):
    try:
        return CHILD in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def wait_for(condition, timeout_s=120.0):
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
    return value


def started(*command, cwd):
    """`jtq batch ...` as a process."""
    return subprocess.Popen(
        [sys.executable, "-m", "jtqd.daemon.jtq", "batch", *command],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that runs the tests in the background has it ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - no threads yet
    )
