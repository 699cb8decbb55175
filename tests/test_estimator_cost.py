"""What a step costs on this machine. `pytest -s tests/test_estimator_cost.py` prints the table.

The bounds are 3 times the budget, so that a loaded machine passes and a mistake in the hot path (a numpy
scalar, a rebuilt session) does not.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

import numpy as np
from estimator_helpers import joint1, motion, small_network

from estimator.joint_estimator import METHODS, EstimatorSettings, JointEstimator, estimate_run
from estimator.losses import LossModel
from estimator.network import TorqueNetwork


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


def test_cost_of_a_step() -> None:
    network = TorqueNetwork(small_network().data)
    losses = LossModel(joint1())
    costs = {
        "loss": (best_us(lambda: losses.loss(0.5, 1.0)), 1.5 * 3),
        "network, one sample": (best_us(lambda: network.run_one(1.0, 2.0, 3.0, 0.1, 0.2, 5.0)), 9.0 * 3),
    }
    for method, bound in zip(METHODS, (4.0 * 3, 5.0 * 3, 14.0 * 3), strict=True):
        estimator = JointEstimator(joint1(), EstimatorSettings(method=method), network)
        estimator.step(0.001, 2.0, 1.0, 100.0, 0.01)
        costs[f"step, {method}"] = best_us(lambda e=estimator: e.step(0.001, 2.0, 1.0, 100.0, 0.01)), bound
    m = motion(1, 60_000)
    began = time.process_time()
    estimate_run(joint1(), EstimatorSettings(), network, *m.arrays())
    costs["whole run, per sample"] = (time.process_time() - began) / 60_000 * 1e6, 8.0 * 3
    print()
    for name, (cost, bound) in costs.items():
        print(f"{name:24s} {cost:6.2f} us")
        assert cost < bound, name
    assert np.isfinite(costs["loss"][0])
