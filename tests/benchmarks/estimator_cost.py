"""What the estimator's parts cost in a tight loop: `python -m tests.benchmarks.estimator_cost` prints the table.

CPU time, least of several rounds: warm caches and no sleep in between. In the loop, which sleeps between cycles, the
same code costs more; the stage table (`python -m tests.benchmarks stages`) shows how much.
"""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from estimator_helpers import joint1, motion, small_network

from estimator.joint_estimator import METHODS, EstimatorSettings, JointEstimator, estimate_run
from estimator.losses import LossModel
from estimator.network import TorqueNetwork

SAMPLES = 60_000


def best_us(call: Callable[[], object], number: int = 2000, rounds: int = 9) -> float:
    """Least CPU time of one call in microseconds over several rounds."""
    best = float("inf")
    gc.disable()
    for _ in range(rounds):
        began = time.process_time_ns()
        for _ in range(number):
            call()
        best = min(best, (time.process_time_ns() - began) / number / 1e3)
    gc.enable()
    return best


def costs_us() -> dict[str, float]:
    """Cost of each part by name [us]."""
    network = TorqueNetwork(small_network().data)
    losses = LossModel(joint1())
    costs = {
        "loss": best_us(lambda: losses.loss(0.5, 1.0)),
        "network, one sample": best_us(lambda: network.run_one(1.0, 2.0, 3.0, 0.1, 0.2, 5.0)),
    }
    for method in METHODS:
        step = JointEstimator(joint1(), EstimatorSettings(method=method), network).step
        step(0.001, 2.0, 1.0, 100.0, 0.01)
        costs[f"step, {method}"] = best_us(lambda step=step: step(0.001, 2.0, 1.0, 100.0, 0.01))
    run = motion(1, SAMPLES).arrays()
    began = time.process_time()
    estimate_run(joint1(), EstimatorSettings(), network, *run)
    costs["whole run, per sample"] = (time.process_time() - began) / SAMPLES * 1e6
    return costs


if __name__ == "__main__":
    for name, cost in costs_us().items():
        print(f"{name:24s} {cost:6.2f} us")
