"""Recursions in arrays against the loops they stand for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from jtqd.estimator.guard import Guard
from jtqd.estimator.observer import FusedObserver, Observer
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.whole_observers import (
    bounded_sums,
    fading_maximum,
    observe_fused,
    observe_paper,
    recursion,
    warm_up_steps,
)
from jtqd.estimator.whole_run import observe_run
from jtqd.models.files import load_joint, shipped


def test_recursion_is_the_loop() -> None:
    """Steps of different lengths, places where it begins anew, more than one block."""
    rng = np.random.default_rng(2)
    count = (1 << 18) + 7001
    a = np.exp(-200.0 * rng.choice([1e-3, 0.9e-3, 5e-3], count))
    a[[0, 5000, 5001, 70_000, (1 << 18) - 1, 1 << 18]] = 0.0
    x = rng.normal(size=(2, count)) * [[1.0], [1e6]]
    z = recursion(a, x)
    assert z is not None
    for row in (0, 1):
        state = 0.0
        expected = []
        for share, new in zip(a.tolist(), x[row].tolist(), strict=True):
            state = share * state + new
            expected.append(state)
        np.testing.assert_allclose(z[row], expected, rtol=1e-12, atol=1e-12 * np.abs(x[row]).max())


def test_recursion_leaves_to_the_loop_what_it_cannot_do_well() -> None:
    assert recursion(np.full(100, 0.5), np.ones((1, 100))) is None, "too short"
    assert warm_up_steps(np.full(10_000, 1.0)) is None, "never forgets"
    assert warm_up_steps(np.full(10_000, np.exp(-1e-3))) is None, "forgets too slowly"
    assert warm_up_steps(np.full(10_000, np.exp(-0.2))) == 226


@pytest.mark.parametrize("count", [1, 520, 521, 522, 5000])
def test_bounded_sums(count: int) -> None:
    rng = np.random.default_rng(count)
    for size in (0.01, 0.3, 3.0):
        steps = rng.normal(0.2 * size * np.sin(np.arange(count) / 300), size)
        low, high = bounded_sums(steps)
        a, b = -1.0, 1.0
        for k, step in enumerate(steps.tolist()):
            a, b = min(max(a + step, -1.0), 1.0), min(max(b + step, -1.0), 1.0)
            assert (low[k], high[k]) == (pytest.approx(a, abs=1e-11), pytest.approx(b, abs=1e-11))


def test_fading_maximum() -> None:
    rng = np.random.default_rng(3)
    values = np.where(rng.random(4000) < 0.01, rng.random(4000), 0.0)
    kept = rng.uniform(0.5, 1.0, 4000)
    got, memory = fading_maximum(values, kept), 0.0
    for value, share, found in zip(values.tolist(), kept.tolist(), got.tolist(), strict=True):
        memory = max(value, share * memory)
        assert found == pytest.approx(memory, rel=1e-12)


def samples(count: int = 9000) -> list[np.ndarray]:
    """A joint that stands, moves and turns round, with gaps, long steps and a step back in time."""
    rng = np.random.default_rng(4)
    dt = np.full(count, 1e-3)
    dt[[0, 3000, 6000]] = 0.0
    dt[1500], dt[4500], dt[7000], dt[7500] = 0.06, 0.012, -0.5, 0.0011
    time = np.cumsum(np.abs(dt))
    v = np.where((time % 3.0) < 0.5, 0.0, 120.0 * np.sin(3.0 * time))
    angle = np.cumsum(v * 1e-3)
    current = 2.0 * np.sin(2.0 * time) + rng.normal(0, 0.05, count)
    link = angle / 100 - 2e-3 * np.sin(2.0 * time) + rng.normal(0, 2e-6, count)
    return [dt, current, angle, v, link]


@pytest.mark.parametrize("fused", [False, True])
def test_observers_over_a_run_are_those_of_the_loop(fused: bool) -> None:
    joint = load_joint(shipped("trained/joint1.yaml"))
    settings = EstimatorSettings(method="fused" if fused else "tob")
    columns = samples()
    assert joint.fused is not None
    torsion = joint.fused.torsion
    made = (
        observe_fused(joint, settings, torsion, columns) if fused else observe_paper(joint, settings, columns)
    )
    assert made is not None
    status, rows = made
    observer = FusedObserver(joint, torsion, 200.0, 200.0) if fused else Observer(joint, 200.0, 200.0)
    guard = Guard(observer, joint, settings)  # type: ignore[type-var]
    for k, sample in enumerate(zip(*(column.tolist() for column in columns), strict=True)):
        seen = guard.step(*sample)
        assert status[k] == guard.status, k
        if seen is None:
            assert np.isnan(rows[:, k]).all()
        else:
            np.testing.assert_allclose(rows[:, k], seen, rtol=1e-9, atol=1e-9, err_msg=str(k))  # type: ignore[arg-type]
    assert len(set(status.tolist())) == 3
    assert sum(a != b for a, b in pairwise(status.tolist())) > 8


def test_garbage_goes_the_slow_way() -> None:
    """The guard starts again at places that only the loop knows."""
    joint = load_joint(shipped("trained/joint1.yaml"))
    settings = EstimatorSettings(method="fused")
    assert joint.fused is not None
    for column, value in ((1, np.nan), (1, 1e5), (4, 50.0), (2, np.inf)):
        columns = samples()
        columns[column] = columns[column].copy()
        columns[column][5000] = value
        assert observe_fused(joint, settings, joint.fused.torsion, columns) is None
        dt, current, angle, v, link = columns
        run = observe_run(joint, settings, joint.fused.torsion, dt, current, angle, v, link)
        assert (run.status == 15).any()
