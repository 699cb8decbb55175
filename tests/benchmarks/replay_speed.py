"""`replay`: how many times real time the estimates of a log of two joints are, cycle by cycle and in arrays, in one run.

CPU time of one core, so that what else the machine does counts little. Reading is in `logs`.

The log is a golden one, made longer: its states again and again, with the cycle numbers and times going on.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from jtqd.daemon.replay.estimates import ExactReplay, replay_whole
from jtqd.daemon.replay.frames import decode
from jtqd.daemon.replay.runs import Part, read_part, steps_of
from jtqd.daemon.replay.session import Models, other_models
from tests.benchmarks.table import table
from tests.paths import GOLDEN

METHODS = {"tob": "network", "efficiency": "network", "network": "network", "fused": "faults"}
"""Method -> golden log whose inputs it is given."""
TARGET = 500.0
_ROUNDS = 3


def longer(part: Part, times: int) -> tuple[Any, Any]:
    """States of both joints `times` times in a row, as one run."""
    result = []
    for records in part.joints:
        count = len(records)
        out = np.concatenate([records] * times)
        turn = np.repeat(np.arange(times), count)
        span = int(records["cycle"][-1]) + 1
        out["cycle"] += (turn * span).astype(np.uint64)
        out["sync_monotonic_ns"] += turn * span * part.origin.config.period_ns
        again = (turn > 0) & (out["dt_s"] == 0.0)
        out["dt_s"][again] = part.origin.config.period_ns * 1e-9
        result.append(out)
    return result[0], result[1]


def _best(work: Any) -> float:
    """Shortest CPU time [s] of some rounds."""
    times = []
    for _ in range(_ROUNDS):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def _one(log: Path, method: str, seconds: float, scratch: Path) -> dict[str, Any]:
    """Times real time of one method both ways."""
    begun = time.process_time()
    part = read_part(log, scratch)
    frames = decode(part.origin, part.frames(), part.joints)
    read_s = time.process_time() - begun
    config = part.origin.config
    models: Models = other_models(part.origin, None, method)
    safety = models.safety(config)
    steps = [steps_of(each, config) for each in part.joints]
    logged_s = len(part.joints[0]) * config.period_ns * 1e-9

    estimators = models.estimators()  # compares each network with ONNX Runtime: once per replay, however long

    def exact() -> None:
        for each in estimators:
            each.reset()
        ExactReplay(part.origin, estimators, safety).run(part.joints, frames, steps)

    times = max(1, round(seconds / logged_s))
    joints = longer(part, times)
    many = [steps_of(each, config) for each in joints]

    def whole() -> None:
        for model, limits, records, each in zip(models.joints, safety, joints, many, strict=True):
            replay_whole(model, limits, records, each)

    # 1 kHz is what counts, whatever the period of the log
    cycle_us = 1e6 * _best(whole) / len(joints[0])
    exact_us = 1e6 * _best(exact) / len(part.joints[0])
    return {
        "method": method,
        "cycles": len(joints[0]),
        "arrays_us": cycle_us,
        "arrays_times": 1000.0 / cycle_us,
        "exact_us": exact_us,
        "exact_times": 1000.0 / exact_us,
        "read_us": 1e6 * read_s / len(part.joints[0]),
    }


def run(directory: Path, seconds: float = 300.0) -> list[dict[str, Any]]:
    """One entry per method; `seconds`: length of the run in arrays."""
    results = []
    for method, log in METHODS.items():
        scratch = directory / method
        scratch.mkdir()
        results.append(_one(GOLDEN / f"{log}.mcap", method, seconds, scratch))
    return results


def text(results: list[dict[str, Any]]) -> str:
    """Table, target marked."""
    rows = [
        [
            each["method"],
            f"{each['arrays_us']:.2f}",
            f"{each['arrays_times']:.0f}",
            f"{each['exact_us']:.1f}",
            f"{each['exact_times']:.0f}",
            "PASS" if each["exact_times"] >= TARGET else "under",
        ]
        for each in results
    ]
    head = ["method", "arrays us", "x real time", "exact us", "x real time", f">= {TARGET:.0f}"]
    count = results[0]["cycles"]
    return (
        f"Replay of two joints at 1 kHz without reading, {count} cycles in arrays [us of CPU a cycle]\n\n"
        + table(head, rows)
    )
