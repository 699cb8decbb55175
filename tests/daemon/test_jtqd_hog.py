"""A processor hog (fault 39): a real one, above the loop's priority, on the only CPU that daemon and bench may use.

What must come out follows from what the hog has seen of its own time, not from the speed of the machine.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jtqd.daemon.logs import read_topic
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_POSITION
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.estimator.status import PUBLISHED
from tests.daemon.slow_bench import slow_configuration

pytestmark = pytest.mark.native

PERIOD_US = 5_000
HOG_S = 0.2
INPUTS = FLAG_POSITION | FLAG_MOTION
HOG = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
began = last = time.monotonic_ns()
longest = 0
while last - began < float(sys.argv[2]) * 1e9:
    now = time.monotonic_ns()
    longest = max(longest, now - last)
    last = now
print(began, last, longest)
"""


def published(directory: Path) -> int:
    return sum(SnapshotReader(path).read().counters["published"] for path in directory.glob("*/snapshot"))


def test_a_processor_hog_costs_counted_cycles_and_nothing_that_is_published_is_stale(tmp_path: Path) -> None:
    cpu = max(os.sched_getaffinity(0))
    logs, directory = tmp_path / "logs", tmp_path / "run"
    directory.mkdir()
    deadlines = {"wait_us": 2000, "deadline_us": 4250}  # daemon and bench take turns on one processor
    config = slow_configuration(tmp_path, PERIOD_US, inputs=deadlines)
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "jtqd.daemon.jtqd", "--bus", "sim", "--config", str(config)),
            *("--duration", "6", "--record", str(logs), "--json"),
        ],
        env={**os.environ, "RUNTIME_DIRECTORY": str(directory), "LOGS_DIRECTORY": ""},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, {cpu}),  # noqa: PLW1509 - no threads here
    )
    until = time.monotonic() + 60
    while published(directory) < 200:
        assert process.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    hog = subprocess.run(
        [sys.executable, "-c", HOG, str(cpu), str(HOG_S)], capture_output=True, text=True, check=False
    )
    said = json.loads(process.communicate(timeout=60)[0])
    if "PermissionError" in hog.stderr:
        pytest.skip("CPU HOG NOT TESTED: no right to a real-time priority")
    began, ended, longest = map(int, hog.stdout.split())
    taken = (ended - began - 2 * longest) // (1000 * PERIOD_US) - 1
    assert said["missed"] >= taken > 20, "what the hog took from the loop is counted"
    assert process.returncode == 0
    loop = read_topic(list(logs.glob("*.mcap")), "/can/frames")
    sent_ns, cycle = loop["sync_monotonic_ns"], loop["cycle"]
    assert not np.any((sent_ns > began + longest) & (sent_ns < ended - longest)), "the hog had it all"
    before, after = np.searchsorted(sent_ns, [began + longest, ended - longest]) - [1, 0]
    slots = round((sent_ns[after] - sent_ns[before]) / (1000 * PERIOD_US))
    assert cycle[after] - cycle[before] == slots > taken, "the grid is the same, no slot is made up"
    counted = said["missed"] + said["counters"]["sync_gaps"]
    assert cycle[-1] + 1 == len(cycle) + counted, "each slot is a record or is counted"
    assert said["cycles"] == len(cycle)
    for number in (1, 2):
        joint = read_topic(list(logs.glob("*.mcap")), f"/joint/{number}/state")
        told = np.isin(joint["status"], tuple(PUBLISHED))
        fresh = (joint["input_flags"] & INPUTS) == INPUTS
        assert np.all(fresh[told]), "no torque from inputs of another cycle"
        assert np.count_nonzero(told[after : after + 200]) >= 20, "it goes on"
