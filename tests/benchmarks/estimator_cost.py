"""What the estimator's parts cost in a tight loop: `python -m tests.benchmarks.estimator_cost` prints the table.

CPU time, least of several rounds: warm caches and no sleep in between. In the loop, which sleeps between cycles, the
same code costs more: the last lines are both joints' steps after a sleep of 0.9 ms, median and p99; the stage table
(`python -m tests.benchmarks stages`) shows it in the loop.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import replace

from jtqd.estimator.estimator import JointEstimator, make_estimator
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.losses import LossModel
from jtqd.estimator.network import FusedNetwork, TorqueNetwork, load_network
from jtqd.estimator.settings import METHODS, EstimatorSettings, recommended
from tests.benchmarks.measure import mark, quantile
from tests.estimator.estimator_helpers import joint1, motion, small_network
from tests.estimator.fused_configuration import joint_of, network_of

SAMPLES = 60_000
JOINTS = 2
FUSED_LIMIT_US = 15.0
"""What method `fused` may cost more than the others, both joints together."""
_ROUNDS = 15
_STEP = (0.001, 2.0, 1.0, 100.0, 0.01, 25.0)


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


def step_costs_us() -> dict[str, float]:
    """Cost of one step by method [us], networks included; the methods take turns, so that a busy machine hurts all alike."""
    networks = {"network": small_network().data, "fused": network_of(1)}
    steps = {}
    for method in METHODS:
        data = networks.get(method)
        joint = joint_of(1) if method == "fused" else joint1()
        network = None if data is None else load_network(method, data)
        steps[method] = make_estimator(joint, recommended(method), network).step
        steps[method](*_STEP)
    rounds = [
        {method: best_us(lambda step=step: step(*_STEP), rounds=1) for method, step in steps.items()}
        for _ in range(_ROUNDS)
    ]
    return {method: min(each[method] for each in rounds) for method in METHODS}


def with_effects(count: int) -> Joint:
    """Return the joint of method fused with so many effects."""
    effects = (
        Effect("viscous_friction", {"viscous_nms_per_rad": 4.0}),
        Effect("hysteresis", {"torque_nm": 1.5, "travel_rad": 2e-4}),
        Effect("encoder_eccentricity", {"amplitude_rad": 1e-4, "phase_rad": 0.3}),
        Effect("coulomb_friction", {"coulomb_nm": 5.5}),
    )
    return replace(joint_of(1), effects=effects[:count])


def costs_us() -> dict[str, float]:
    """Cost of each part by name [us]."""
    network = TorqueNetwork(small_network().data)
    losses = LossModel(joint1())
    costs = {
        "loss": best_us(lambda: losses.loss(0.5, 1.0)),
        "network, one sample": best_us(lambda: network.run_one(1.0, 2.0, 3.0, 0.1, 0.2, 5.0)),
    }
    costs |= {f"step, {method}": cost for method, cost in step_costs_us().items()}
    graph = network_of(1)
    foreign = FusedNetwork(graph)
    foreign.perceptron = None  # type: ignore[misc]
    for name, joint, used in (
        ("step, fused, network by ONNX Runtime", joint_of(1), foreign),
        ("step, fused, one effect", with_effects(1), FusedNetwork(graph)),
        ("step, fused, four effects", with_effects(4), FusedNetwork(graph)),
    ):
        step = make_estimator(joint, recommended("fused"), used).step
        costs[name] = best_us(lambda step=step: step(*_STEP))
    run = motion(1, SAMPLES).arrays()
    began = time.process_time()
    JointEstimator(joint1(), EstimatorSettings(), network).run(*run)
    costs["whole run, per sample"] = (time.process_time() - began) / SAMPLES * 1e6
    return costs


COLD_LIMIT_US = 8.0
"""Both joints, network included, after a sleep."""
_SLEEP_S, _COLD_ROUNDS = 900e-6, 1500


def cold_us() -> dict[str, tuple[float, float]]:
    """Median and p99 [us] of one step of both joints after a sleep, by what evaluates their networks, in turns."""

    def two(method: str, foreign: tuple[bool, bool]) -> tuple[Callable[..., object], ...]:
        steps = []
        for n in (1, 2):
            joint = joint_of(n) if method == "fused" else joint1()
            network = load_network(method, network_of(n) if method == "fused" else small_network().data)
            if foreign[n - 1]:
                network.perceptron = None  # type: ignore[misc]
            steps.append(make_estimator(joint, recommended(method), network).step)
        return tuple(steps)

    cases = {
        "fused": two("fused", (False, False)),
        "network": two("network", (False, False)),
        "fused, one joint by ONNX Runtime": two("fused", (True, False)),
        "fused, both by ONNX Runtime": two("fused", (True, True)),
    }
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(_COLD_ROUNDS):
        for name, (one, other) in cases.items():
            time.sleep(_SLEEP_S)
            began = time.perf_counter_ns()
            one(*_STEP)
            other(*_STEP)
            times[name].append((time.perf_counter_ns() - began) / 1e3)
    return {name: (quantile(each, 0.5), quantile(each, 0.99)) for name, each in times.items()}


if __name__ == "__main__":
    costs = costs_us()
    for name, cost in costs.items():
        print(f"{name:40s} {cost:6.2f} us")
    for method in ("network", "tob"):
        more = JOINTS * (costs["step, fused"] - costs[f"step, {method}"])
        print(f"{f'fused over {method}, both joints':40s} {more:6.2f} us  {mark(more, FUSED_LIMIT_US)}")
    print("\nboth joints after a sleep of 0.9 ms, median and p99")
    for name, (median, p99) in cold_us().items():
        ours = mark(median, COLD_LIMIT_US) if name in ("fused", "network") else ""
        print(f"{name:40s} {median:6.1f} {p99:6.1f} us  {ours}")
