"""Targets, each on both sides of its goal and unknown without data; the time of a step, with a simulated clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.sysid.evaluate.evaluation import TIMED, Evaluation, LoopTime, Target, loop_time, targets
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
from tests.sysid.evaluate.evaluate_helpers import samples

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


def target(result: Evaluation, key: str) -> Target:
    (found,) = [each for each in targets(result) if each.key == key]
    return found


def with_mse(**mse_nm2: float) -> Samples:
    return samples({method: np.full(50, math.sqrt(value)) for method, value in mse_nm2.items()})


def variable(*runs: Samples) -> Evaluation:
    return replace(EMPTY, variable=error_tables(runs, dict.fromkeys((each.run for each in runs), 1)))


def test_nothing_is_reached_without_data() -> None:
    found = targets(EMPTY)
    assert [each.reached for each in found] == [None] * len(found)
    assert len({each.key for each in found}) == len(found)


@pytest.mark.parametrize(("tob", "reached"), [(6.9, False), (7.1, True), (13.9, True), (14.1, False)])
def test_the_bench_must_be_as_hard_as_the_papers(tob: float, reached: bool) -> None:
    assert target(variable(with_mse(tob=tob)), "tob_mse").reached is reached


def test_tob_to_papers_chain_is_shown_and_no_goal() -> None:
    found = target(variable(with_mse(tob=10.07, network=0.22)), "tob_to_paper")
    assert found.reached is None
    assert (found.paper, found.ours) == ("46", "45.8")


@pytest.mark.parametrize(
    ("tested", "other", "reached"), [(0.49, 0.49, True), (0.49, 0.6, False), (0.51, 0.1, False)]
)
def test_ours_to_papers_chain_in_velocity_mode_and_of_all_joints(
    tested: float, other: float, reached: bool
) -> None:
    one = with_mse(network=1.0, fused=tested)
    two = replace(with_mse(network=1.0, fused=other), number=2)
    result = variable(one, two)
    assert target(result, "ours_to_paper").reached is reached
    assert target(result, "ours_to_paper").ours == f"{max(tested, 0.5 * (tested + other)):.3f}"


def test_every_run_counts_those_at_constant_velocity_included() -> None:
    good, bad = with_mse(physics=1.0, fused=0.9), replace(with_mse(physics=1.0, fused=1.01), run="bad")
    result = variable(good)
    assert target(result, "every_run").reached is True
    found = target(replace(result, constant_tables=error_tables([bad], {})), "every_run")
    assert found.reached is False
    assert found.ours == "1 of 2"
    assert "bad j1" in found.details[0]
    same = target(variable(with_mse(physics=1.0, fused=1.0)), "every_run")
    assert same.reached is None, "a network of share 0 proves nothing"


@pytest.mark.parametrize(("error", "reached"), [(0.79, True), (-0.81, False)])
def test_the_hardest_plateau(error: float, reached: bool) -> None:
    errors = {"tob": 6.0, "fused": error}
    hard = PlateauScore("hard", 1, 0.0, 1.0, "back", 2.5, -4.0, -30.0, 40.0, errors)
    easy = replace(hard, run="easy", torque_nm=10.0, errors_nm={"tob": 0.0, "fused": 4.0})
    found = target(replace(EMPTY, plateaus=(easy, hard)), "back_drive")
    assert found.reached is reached
    assert found.ours == f"{abs(error) / 0.4:.2f} % of rated"
    assert any("20.0 % of the torque, hard" in line for line in found.details)


@pytest.mark.parametrize(
    ("shares", "reached"), [((0.88, 0.92), True), ((0.88, 0.94), False), ((0.86, 0.9), False)]
)
def test_every_quadrant_must_be_covered(shares: tuple[float, float], reached: bool) -> None:
    """Two quadrants; their mean would be good each time."""
    n = 1000
    runs = []
    for k, share in enumerate(shares):
        error = np.where(np.arange(n) < share * n, 0.0, 9.0)
        sign = np.full(n, 1.0 - 2.0 * k)
        runs.append(samples({"fused": error}, run=str(k), raw_nm=sign, velocity_rad_s=sign))
    tables = interval_tables(runs)
    assert tables is not None
    found = target(replace(EMPTY, intervals={"variable": tables}), "coverage")
    assert found.reached is reached
    assert found.ours == f"{100 * min(shares):.1f} to {100 * max(shares):.1f} %"
    # runs at constant velocity are shown, and not judged
    assert target(replace(EMPTY, intervals={"constant": tables, "all": tables}), "coverage").reached is None


def _score(rmse_nm: float) -> Score:
    found = score([samples({"fused": np.full(10, rmse_nm)})], "fused")
    assert found is not None
    return found


@pytest.mark.parametrize(("ours", "flagged", "reached"), [(1.0, 0.96, True), (1.01, 0.94, False)])
def test_outside_every_joint_counts(ours: float, flagged: float, reached: bool) -> None:
    good = Outside(1, Range((-9.0, 9.0), None), 10, 10, 10, 0, _score(0.5), _score(1.0), 1.0)
    other = replace(good, number=2, ours=_score(ours), flagged=flagged)
    result = replace(EMPTY, outside=(good, other))
    assert target(result, "outside_rmse").reached is reached
    by_itself = target(result, "outside_flagged")
    assert by_itself.reached is None, "outside is defined by what is judged"
    assert by_itself.ours == f"{100 * flagged:.2f} %"


def test_outside_ours_without_a_network_is_not_compared_with_itself() -> None:
    alone = Outside(1, Range((-9.0, 9.0), None), 10, 10, 10, 0, _score(0.5), None, 1.0)
    found = target(replace(EMPTY, outside=(alone,)), "outside_rmse")
    assert (found.ours, found.reached) == ("no network: ours is its physics", None)
    assert found.details == ("j1: 0.500 Nm, 10 samples outside",)
    beside = replace(alone, number=2, physics=_score(0.4))
    assert target(replace(EMPTY, outside=(alone, beside)), "outside_rmse").ours == "1.2500"


@pytest.mark.parametrize(("nm", "reached"), [(0.19, True), (0.21, False)])
def test_the_largest_jump_of_ours_counts_and_the_papers_is_shown(nm: float, reached: bool) -> None:
    jump = Jump(nm, "run", 1, 0.5, "v = 0", 3, 0.1, 0.4, 0.15)
    result = replace(EMPTY, jumps={"fused": jump, "network": jump}, passages={"fused": replace(jump, nm=0.9)})
    assert target(result, "jump_fused").reached is reached
    assert target(result, "jump_network").reached is None
    assert target(result, "jump_network").ours == f"{nm:.2f} Nm"
    assert "0.15 Nm" in target(result, "jump_fused").details[1]
    assert "0.90 Nm" in target(result, "jump_fused").details[2]


@pytest.mark.parametrize(("ours", "reached"), [(29.0, True), (31.0, False)])
def test_extra_time_is_that_over_the_papers_chain(ours: float, reached: bool) -> None:
    cost = LoopTime({"tob": 4.0, "network": 15.0, "fused": ours}, 2, 3000, "run")
    found = target(replace(EMPTY, loop_time=cost), "loop_time")
    assert found.reached is reached
    assert found.ours == f"{ours - 15.0:.1f} us"
    assert f"over the classical TOB {ours - 4.0:.1f} us" in found.details[0]


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
    found = loop_time(runs_of(bench, models), models, ticking(1500, 1_000_000))
    assert found is not None
    assert found.joints == 2
    assert found.step_us == dict.fromkeys(TIMED, pytest.approx(3.0))
    assert found.extra_us("network") == pytest.approx(0.0)
    assert 2000 < found.samples <= 3000
    assert found.run == "variable_1.csv.gz"


def test_a_real_clock_finds_that_the_network_costs_something(bench: Path) -> None:
    models = load_models(bench / "models")
    found = loop_time(runs_of(bench, models), models)
    assert found is not None
    assert found.step_us["network"] > found.step_us["tob"] > 0.0


def test_extra_is_ours_less_the_other() -> None:
    assert LoopTime({"tob": 3.0, "network": 14.0, "fused": 19.5}, 2, 10, "r").extra_us("network") == 5.5


def test_nothing_is_measured_without_all_methods(bench: Path, tmp_path: Path) -> None:
    for path in (bench / "models").iterdir():
        if path.name not in ("joint1.onnx", "joint2.onnx"):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    models = load_models(tmp_path)
    assert loop_time(runs_of(bench, models), models) is None
    assert loop_time((), load_models(bench / "models")) is None
