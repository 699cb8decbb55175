"""What a step costs: counted with a clock that the test holds, on samples that move, with the methods that are there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from jtqd.sysid.evaluate.evaluation import METHODS, LoopTime, loop_time
from jtqd.sysid.evaluate.inputs import JudgedRun, read_inputs
from jtqd.sysid.evaluate.methods import JointModels, load_models
from tests.sysid.evaluate.evaluate_helpers import make_bench


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bench(tmp_path_factory.mktemp("loop_time"))


def judged(bench: Path, models: tuple[JointModels, ...]) -> tuple[JudgedRun, ...]:
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
    found = loop_time(judged(bench, models), models, ticking(1500, 1_000_000))
    assert found is not None
    assert found.joints == 2
    assert found.step_us == dict.fromkeys(METHODS, pytest.approx(3.0))
    assert found.extra_us("network") == pytest.approx(0.0)
    assert 2000 < found.samples <= 3000
    assert found.run == "variable_1.csv.gz"


def test_a_real_clock_finds_that_the_network_costs_something(bench: Path) -> None:
    models = load_models(bench / "models")
    found = loop_time(judged(bench, models), models)
    assert found is not None
    assert found.step_us["network"] > found.step_us["tob"] > 0.0


def test_extra_is_ours_less_the_other() -> None:
    assert LoopTime({"tob": 3.0, "network": 14.0, "fused": 19.5}, 2, 10, "r").extra_us("network") == 5.5


def test_nothing_is_measured_without_all_methods(bench: Path, tmp_path: Path) -> None:
    for path in (bench / "models").iterdir():
        if path.name not in ("joint1.onnx", "joint2.onnx"):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    models = load_models(tmp_path)
    assert loop_time(judged(bench, models), models) is None
    assert loop_time((), load_models(bench / "models")) is None
