"""Targets, each on both sides of its goal and unknown without data; the time of a step, with a simulated clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.sysid.evaluate.evaluation import TIMED, Evaluation, LoopTime, loop_time, targets
from jtqd.sysid.evaluate.inputs import EvaluatedRun, JointModels, Samples, load_models, read_inputs
from jtqd.sysid.evaluate.scores import (
    Jump,
    Outside,
    PlateauScore,
    Range,
    Score,
    error_tables,
    interval_tables,
    score,
)
from tests.sysid.evaluate.evaluate_helpers import known, samples

EMPTY = Evaluation(
    models=(),
    runs=(),
    findings=(),
    plateaus=(),
    variable=error_tables([], {}),
    constant_tables=error_tables([], {}),
    intervals={},
    standstill={},
    jumps={},
    passages={},
    outside=(),
    picture=None,
)


def with_mse(run: str = "run", number: int = 1, **mse_nm2: float) -> Samples:
    errors = {method: np.full(50, math.sqrt(value)) for method, value in mse_nm2.items()}
    return samples(errors, run=run, number=number)


def variable(*runs: Samples) -> Evaluation:
    return replace(EMPTY, variable=error_tables(runs, dict.fromkeys((each.run for each in runs), 1)))


def ratios(tested: float, other: float) -> Evaluation:
    return variable(with_mse(network=1.0, fused=tested), with_mse(number=2, network=1.0, fused=other))


def against_physics(*mse_nm2: float) -> Evaluation:
    """A run at variable velocity, further ones at constant velocity; the physics has an MSE of 1 Nm^2."""
    first, *more = (with_mse(f"r{k}", physics=1.0, fused=each) for k, each in enumerate(mse_nm2))
    return replace(variable(first), constant_tables=error_tables(more, {}))


def back_driven(error_nm: float) -> Evaluation:
    hard = PlateauScore("hard", 1, 0.0, 1.0, "back", 2.5, -4.0, -30.0, 40.0, {"tob": 6.0, "fused": error_nm})
    easy = replace(hard, run="easy", torque_nm=10.0, errors_nm={"tob": 0.0, "fused": 4.0})
    return replace(EMPTY, plateaus=(easy, hard))


def covered(*shares: float, kinds: tuple[str, ...] = ("variable",)) -> Evaluation:
    """One quadrant for each share."""
    n, runs = 1000, []
    for k, share in enumerate(shares):
        sign = np.full(n, 1.0 - 2.0 * k)
        error = np.where(np.arange(n) < share * n, 0.0, 9.0)
        runs.append(samples({"fused": error}, run=str(k), raw_nm=sign, velocity_rad_s=sign))
    tables = known(interval_tables(runs))
    return replace(EMPTY, intervals=dict.fromkeys(kinds, tables))


def outside(*rmse_nm: tuple[float, float | None], flagged: float = 1.0) -> Evaluation:
    """Joints with the RMSE of ours and of the physics."""

    def scored(rmse: float) -> Score:
        return known(score([samples({"fused": np.full(10, rmse)})], "fused"))

    limits = Range((-9.0, 9.0), None)
    joints = [
        Outside(n, limits, 10, 10, 10, 0, scored(a), None if b is None else scored(b), flagged)
        for n, (a, b) in enumerate(rmse_nm, 1)
    ]
    return replace(EMPTY, outside=tuple(joints))


def jumping(nm: float) -> Evaluation:
    jump = Jump(nm, "run", 1, 0.5, "v = 0", 3, 0.1, 0.4, 0.15)
    return replace(EMPTY, jumps={"fused": jump, "network": jump}, passages={"fused": replace(jump, nm=0.9)})


def costing(ours_us: float) -> Evaluation:
    return replace(EMPTY, loop_time=LoopTime({"tob": 4.0, "network": 15.0, "fused": ours_us}, 2, 3000, "run"))


@pytest.mark.parametrize(
    ("key", "result", "reached", "ours", "detail"),
    [
        # the bench must be as hard as the paper's
        *(
            ("tob_mse", variable(with_mse(tob=tob)), reached, f"{tob:.2f} Nm²", "of the bench")
            for tob, reached in ((6.9, False), (7.1, True), (13.9, True), (14.1, False))
        ),
        ("tob_to_paper", variable(with_mse(tob=10.07, network=0.22)), None, "45.8", "all joints: 45.8"),
        # in velocity mode and of all joints: the larger one counts
        ("ours_to_paper", ratios(0.49, 0.49), True, "0.490", "all joints 0.490"),
        ("ours_to_paper", ratios(0.49, 0.6), False, "0.545", "velocity mode 0.490"),
        ("ours_to_paper", ratios(0.51, 0.1), False, "0.510", "all joints 0.305"),
        # runs at constant velocity count; a network of share 0 proves nothing
        ("every_run", against_physics(0.9), True, "0 of 1", ""),
        ("every_run", against_physics(0.9, 1.01), False, "1 of 2", "r1 j1: 1.0100 against 1.0000 Nm²"),
        ("every_run", against_physics(1.0), None, "none: they are one number", ""),
        ("back_drive", back_driven(0.79), True, "1.98 % of rated", "20.0 % of the torque, hard j1"),
        ("back_drive", back_driven(-0.81), False, "2.02 % of rated", "ours worst in hard j1"),
        # every quadrant, also where the mean is good; runs at constant velocity are shown, and not judged
        ("coverage", covered(0.88, 0.92), True, "88.0 to 92.0 %", ""),
        ("coverage", covered(0.88, 0.94), False, "88.0 to 94.0 %", "driving: 94.0 %"),
        ("coverage", covered(0.86, 0.9), False, "86.0 to 90.0 %", "driving: 86.0 %"),
        ("coverage", covered(0.9, kinds=("constant", "all")), None, "not known", "90.0 % overall"),
        ("outside_rmse", outside((0.5, 1.0), (1.0, 1.0)), True, "1.0000", "j2: 1.000 against 1.000 Nm"),
        ("outside_rmse", outside((0.5, 1.0), (1.01, 1.0)), False, "1.0100", ""),
        ("outside_rmse", outside((0.5, None)), None, "no network: ours is its physics", "j1: 0.500 Nm"),
        ("outside_rmse", outside((0.5, None), (0.5, 0.4)), False, "1.2500", ""),
        ("outside_rmse", EMPTY, None, "not evaluated (--outside)", ""),
        ("outside_flagged", outside((0.5, 1.0), flagged=0.96), None, "96.00 %", "by definition"),
        ("jump_fused", jumping(0.19), True, "0.19 Nm", "one exceeds 0.15 Nm"),
        ("jump_fused", jumping(0.21), False, "0.21 Nm", "standstill included: 0.90 Nm"),
        ("jump_network", jumping(0.21), None, "0.21 Nm", "0.40 Nm without allowance"),
        ("loop_time", costing(29.0), True, "14.0 us", "over the classical TOB 25.0 us"),
        ("loop_time", costing(31.0), False, "16.0 us", "over the classical TOB 27.0 us"),
    ],
)
def test_a_target_on_both_sides_of_its_goal(
    key: str, result: Evaluation, reached: bool | None, ours: str, detail: str
) -> None:
    (found,) = [each for each in targets(result) if each.key == key]
    assert (found.reached, found.ours) == (reached, ours)
    assert not detail or any(detail in line for line in found.details)


def test_nothing_is_reached_without_data() -> None:
    found = targets(EMPTY)
    assert [each.reached for each in found] == [None] * len(found)
    assert len({each.key for each in found}) == len(found)


# Time of a step -----------------------------------------------------------------------------------------


def runs_of(bench: Path, models: tuple[JointModels, ...]) -> tuple[EvaluatedRun, ...]:
    return read_inputs([bench / "runs" / "variable_1.csv.gz"], models).runs


def ticking(step_ns: int, slow_ns: int = 0) -> Callable[[], int]:
    """A clock that a step takes step_ns by, and every tenth one slow_ns more."""
    now, calls = 0, 0

    def read() -> int:
        nonlocal now, calls
        calls += 1
        now += step_ns + (slow_ns if calls % 20 == 0 else 0)
        return now

    return read


def test_both_joints_count_and_the_median_leaves_out_what_the_machine_did(bench: Path) -> None:
    models = load_models(bench / "models")
    found = known(loop_time(runs_of(bench, models), models, ticking(1500, 1_000_000)))
    assert found.joints == 2
    assert found.step_us == dict.fromkeys(TIMED, pytest.approx(3.0))
    assert found.extra_us("network") == pytest.approx(0.0)
    assert 2000 < found.samples <= 3000
    assert found.run == "variable_1.csv.gz"


def test_a_real_clock_finds_that_the_network_costs_something(bench: Path) -> None:
    models = load_models(bench / "models")
    found = known(loop_time(runs_of(bench, models), models))
    assert found.step_us["network"] > found.step_us["tob"] > 0.0


def test_nothing_is_measured_without_all_methods(bench: Path, tmp_path: Path) -> None:
    for path in (bench / "models").iterdir():
        if path.name not in ("joint1.onnx", "joint2.onnx"):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    models = load_models(tmp_path)
    assert loop_time(runs_of(bench, models), models) is None
    assert loop_time((), load_models(bench / "models")) is None
