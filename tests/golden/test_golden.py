"""Golden logs: the estimator as it is now against what is stored, and differences that a person can read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jtqd.estimator.observer import reference_of
from jtqd.estimator.settings import METHODS
from tests.benchmarks import replay_speed
from tests.golden.reference import CASES, HERE, Output, difference, replayed, store, stored
from tests.golden.scene import SCENES

MOST_BYTES = 450_000


def test_all_scenes_are_there_and_small() -> None:
    assert {log.stem for log in HERE.glob("*.mcap")} == {case.log for case in CASES.values()} == set(SCENES)
    assert all(log.stat().st_size < MOST_BYTES for log in HERE.glob("*.mcap"))
    assert {
        result.run.setup.config.estimator.method for result in (replayed(CASES[name])[1] for name in SCENES)
    } | {case.method for case in CASES.values() if case.method} == set(METHODS)


@pytest.mark.parametrize("name", CASES)
def test_golden(name: str) -> None:
    now, result = replayed(CASES[name])
    lines = difference(stored(name), now)
    assert not lines, "\n".join([*lines, "on purpose: python -m tests.golden.update -m WHY"])
    if CASES[name].method is None:  # as it was recorded, bit for bit
        assert result.identity is not None
        assert result.identity.explained
        assert result.identity.pdos == result.identity.pdos_equal > 1000
        assert result.identity.whole or name == "network"  # recorded when ONNX Runtime evaluated the networks


@pytest.mark.parametrize("name", SCENES)
def test_the_loop_gives_the_sensor_the_age_of_the_estimate(name: str) -> None:
    """The paper's chain passes 200 rad/s, 5 ms; ours has no delay."""
    bandwidth, age_ms = {"network": (200.0, 5.0), "faults": (np.inf, 0.0)}[name]
    for records in replayed(CASES[name])[1].joints:
        expected = reference_of(records["sensor_torque_nm"], records["dt_s"], bandwidth)
        assert np.isfinite(expected).sum() > 500
        np.testing.assert_array_equal(records["reference_nm"], expected)
        assert set(records["age_ms"]) == {age_ms}


def output() -> Output:
    time = np.arange(1000) * 1e-3
    torque = 10.0 * np.sin(9.0 * time)
    status = np.where(np.abs(torque) < 1.0, 6.0, 2.0)
    return Output(np.arange(1000) + 5, {"j1.torque_nm": torque, "j1.status": status})


def test_a_number_that_differs_is_named_with_cycle_and_size() -> None:
    now = output()
    changed = now.values["j1.torque_nm"].copy()
    changed[400:] += 0.01
    (line,) = difference(now, replace(now, values={**now.values, "j1.torque_nm": changed}))
    assert line.startswith("joint 1 torque_nm differs from cycle 405 on, in 600 cycles: -4.425 -> -4.415 Nm")
    assert "0.01 Nm at most" in line
    assert "lag" not in line
    changed = now.values["j1.torque_nm"] + 1e-7
    assert difference(now, replace(now, values={**now.values, "j1.torque_nm": changed})) == []
    changed = now.values["j1.torque_nm"].copy()
    changed[10] = np.nan
    (line,) = difference(now, replace(now, values={**now.values, "j1.torque_nm": changed}))
    assert "from cycle 15 on, in 1 cycles" in line


@pytest.mark.parametrize(
    ("by", "text"), [(1, "lags by 1 cycle"), (3, "lags by 3 cycles"), (-2, "leads by 2 cycles")]
)
def test_a_delay_is_called_so(by: int, text: str) -> None:
    now = output()
    late = replace(now, values={name: np.roll(values, by) for name, values in now.values.items()})
    late.values["j1.status"] = now.values["j1.status"]
    (line,) = difference(now, late)
    assert line.endswith(text)


def test_statuses_that_moved_or_came() -> None:
    now = output()
    status = now.values["j1.status"].copy()
    row = int(np.flatnonzero(np.diff(status))[0]) + 1
    status[row : row + 4] = status[row - 1]
    (line,) = difference(now, replace(now, values={**now.values, "j1.status": status}))
    assert line == f"joint 1 status standstill -> valid moved from cycle {row + 5} to {row + 9}"
    status = now.values["j1.status"].copy()
    status[100:110] = 4.0
    lines = difference(now, replace(now, values={**now.values, "j1.status": status}))
    assert "joint 1 status valid -> stale: 0 times before (cycles none), 1 now (105)" in lines


def test_stored_text_comes_back(tmp_path: Path) -> None:
    now = output()
    now.values["j1.torque_nm"][3] = np.nan
    store("x", now, tmp_path)
    assert difference(stored("x", tmp_path), now) == []
    head, first, *_ = (tmp_path / "x.csv").read_text().splitlines()
    assert (head, first) == ("cycle,j1.torque_nm,j1.status", "5,0.000000,6")


def test_the_benchmark_of_replay_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No time is asserted."""
    monkeypatch.setattr(replay_speed, "METHODS", {"tob": "network"})
    (found,) = replay_speed.run(tmp_path)
    assert found["cycles"] > 1000
    assert found["exact_times"] > 0
    assert "tob" in replay_speed.text([found])
