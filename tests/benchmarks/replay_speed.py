"""`replay`: how many times real time the estimates of a log of two joints are.

CPU time of one core, so that what else the machine does counts little. Reading is in `logs`. The logs are golden ones.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from jtqd.daemon.replay.logged import read_runs
from jtqd.daemon.replay.session import Replayer, models_of
from tests.benchmarks.measure import table
from tests.paths import GOLDEN

METHODS = {"tob": "network", "efficiency": "network", "network": "network", "fused": "faults"}
"""Method -> golden log whose inputs it is given."""
TARGET = 500.0
_ROUNDS = 3


def _best(work: Any) -> float:
    """Shortest CPU time [s] of some rounds."""
    times = []
    for _ in range(_ROUNDS):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def _one(log: Path, method: str, scratch: Path) -> dict[str, Any]:
    begun = time.process_time()
    ((run, inputs),) = read_runs([log], scratch)
    read_s = time.process_time() - begun
    models = models_of(run.setup, None, method)  # checks each network against ONNX Runtime: once per replay
    steps = run.steps()

    def exact() -> None:
        for each in models:
            each.estimator.reset()
        Replayer(run.setup, models).run(run.joints, inputs, steps)

    # 1 kHz is what counts, whatever the period of the log
    exact_us = 1e6 * _best(exact) / run.cycles
    return {
        "method": method,
        "cycles": run.cycles,
        "exact_us": exact_us,
        "exact_times": 1000.0 / exact_us,
        "read_us": 1e6 * read_s / run.cycles,
    }


def run(directory: Path) -> list[dict[str, Any]]:
    results = []
    for method, log in METHODS.items():
        scratch = directory / method
        scratch.mkdir()
        results.append(_one(GOLDEN / f"{log}.mcap", method, scratch))
    return results


def text(results: list[dict[str, Any]]) -> str:
    rows = [
        [
            each["method"],
            f"{each['exact_us']:.2f}",
            f"{each['exact_times']:.0f}",
            "PASS" if each["exact_times"] >= TARGET else "under",
        ]
        for each in results
    ]
    head = ["method", "us", "x real time", f">= {TARGET:.0f}"]
    return "Replay of two joints at 1 kHz without reading [us of CPU a cycle]\n\n" + table(head, rows)
