"""A range of the link's turn that few passes get to: found where it is, and not where other moments happen to be."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.structure import Balance, View, _passes, at_angle, events, pursue
from tests.sysid.diagnosis.diagnose_core_helpers import TORSION1, run_data

STEP_S = 0.005
COUNT = 4000


def motion(seed: int, centre_rad: float) -> tuple[FloatArray, FloatArray]:
    """Link angle and velocity of 20 s around an angle."""
    rng = np.random.default_rng([7, seed])
    t, rate, phase = STEP_S * np.arange(COUNT), rng.uniform(0.9, 1.3), rng.uniform(0.0, 6.0)
    return centre_rad + 0.8 * np.sin(rate * t + phase), 0.8 * rate * np.cos(rate * t + phase)


def noise(seed: int) -> FloatArray:
    return np.random.default_rng([seed, 3]).normal(0.0, 0.05, COUNT)


def balance(runs: list[RunData]) -> Balance:
    return Balance(runs, TORSION1, STEP_S, 50.0)


def turn_range(angle: FloatArray, x: FloatArray) -> View | None:
    """The range of the link's turn that the events of one run belong to; another run is at all other angles."""
    elsewhere = np.linspace(angle.max() + 0.2, angle.min() - 0.2 + 2.0 * np.pi, COUNT)
    parts = [x, noise(99)]
    runs = [
        run_data(f"run{k}", {TORSION1: part}, {"link_angle": a})
        for k, (part, a) in enumerate(zip(parts, (angle, elsewhere), strict=True))
    ]
    moments = events(balance(runs), parts)
    return None if moments is None else at_angle(balance(runs), parts, moments)


@pytest.mark.parametrize("centre", [0.4, np.pi], ids=["within_a_turn", "across_its_seam"])
def test_a_cover_that_one_run_alone_reaches_is_at_its_angle(centre: float) -> None:
    axes, parts = [], []
    for k in range(4):
        angle, velocity = motion(k, centre if k == 2 else centre - 2.5)
        rubs = np.abs(angle - centre) < 0.15
        parts.append(np.where(rubs, 1.5 * np.sign(velocity), 0.0) + noise(k))
        axes.append({"link_angle": angle, "velocity": velocity, "load": 5.0 * velocity})
    runs = [
        run_data(f"run{k}", {TORSION1: x}, a | {"time": STEP_S * np.arange(COUNT)})
        for k, (x, a) in enumerate(zip(parts, axes, strict=True))
    ]
    first = pursue(balance(runs), parts)[0]
    assert first.axis == "link_angle"
    edges = first.edges
    assert edges is not None
    low, high = edges[first.bins[0]], edges[first.bins[0] + 1]
    middle = np.mod(0.5 * (low + high) - centre + np.pi, 2.0 * np.pi) - np.pi
    assert abs(middle) < 0.15 + 0.5 * (high - low)


def test_moments_that_have_nothing_to_do_with_the_angle_are_no_range() -> None:
    found = 0
    for seed in range(300):
        rng = np.random.default_rng([11, seed])
        angle, _ = motion(seed, float(rng.uniform(-3.0, 3.0)))
        x = noise(seed)
        for start in rng.integers(0, COUNT - 100, int(rng.integers(2, 9))):
            x[start : start + int(rng.integers(10, 100))] += 2.0
        found += turn_range(angle, x) is not None
    assert found <= 6  # 1 % of 300 were 3


def test_a_range_that_most_passes_leave_alone_is_none() -> None:
    angle, _ = motion(1, 0.4)
    passes = np.flatnonzero(np.diff((np.abs(angle - 0.4) < 0.15).astype(int)) == 1)
    assert len(passes) >= 5
    every, two = noise(1), noise(1)
    for k, start in enumerate(passes):
        every[start : start + 40] += 2.0
        two[start : start + 40] += 2.0 if k < 2 else 0.0
    assert turn_range(angle, every) is not None
    assert turn_range(angle, two) is None


def test_a_pass_is_a_stay_in_a_bin() -> None:
    """Leaving a bin for less than a second, as noise at its edge does, makes no second pass of one."""
    place = np.repeat([3, 4, 3, 4, 3, 4], [150, 2, 40, 220, 90, 60])
    x = np.arange(len(place), dtype=np.float64)
    found = [(int(k[0]), y.tolist()) for k, y in _passes(place, x, STEP_S)]
    first = [*range(150), *range(152, 192)]
    assert found == [
        (3, first),
        (3, [*range(412, 502)]),
        (4, [150, 151, *range(192, 412), *range(502, 562)]),
    ]


def turning(centre: float, moments: tuple[float, ...] = ()) -> tuple[list[RunData], list[FloatArray]]:
    """Runs of whole turns through a cover, which pulls otherwise in each; residuals with it.

    moments: seconds in run 1 at which something happens elsewhere.
    """
    runs, parts = [], []
    for k in range(4):
        t = STEP_S * np.arange(COUNT)
        rate = 0.9 + 0.1 * k
        angle = rate * t + 0.3 * k
        near = np.mod(angle - centre + np.pi, 2.0 * np.pi) - np.pi
        x = np.where(np.abs(near) < 0.2, 2.0 + 0.5 * k, 0.0) + noise(k)
        for moment in moments if k == 1 else ():
            x[round(moment / STEP_S) :][:30] += 6.0
        axes = {"link_angle": angle, "velocity": np.full(COUNT, rate), "load": 5.0 * np.cos(t), "time": t}
        runs.append(run_data(f"run{k}", {TORSION1: x}, axes))
        parts.append(x)
    return runs, parts


@pytest.mark.parametrize("centre", [3.24, 0.7], ids=["at_the_seam", "within"])
def test_a_cover_whose_passes_are_all_events_is_at_its_angle(centre: float) -> None:
    """What deviates at every pass stands out of the noise, and is no matter of moments."""
    runs, parts = turning(centre)
    assert events(balance(runs), parts) is not None
    found = pursue(balance(runs), parts)
    edges = found[0].edges
    assert edges is not None
    assert found[0].axis == "link_angle"
    for k in found[0].bins[:2]:
        middle = np.mod(0.5 * (edges[k] + edges[k + 1]) - centre + np.pi, 2.0 * np.pi) - np.pi
        assert abs(middle) < 0.2 + 0.5 * (edges[1] - edges[0])
    assert not any(place.what for place in found), "what happens in the range is the range's"


def test_moments_elsewhere_come_after_the_range() -> None:
    runs, parts = turning(0.7, (3.0, 9.7))
    first, second, *_ = pursue(balance(runs), parts)
    assert first.axis == "link_angle"
    assert second.what == "events"
    assert all(run == "run1" and min(abs(t - 3.0), abs(t - 9.7)) < 0.3 for run, t in second.times), (
        second.times
    )
