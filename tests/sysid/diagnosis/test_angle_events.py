"""A range of the link's turn that few passes get to: found where it is, and not where other moments happen to be."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.angle_events import predicted_by_passes, turn_range
from jtqd.sysid.diagnosis.events import EventLimits, events
from jtqd.sysid.diagnosis.gaps import locate
from jtqd.sysid.diagnosis.regressors import Index, RunData
from jtqd.sysid.diagnosis.structure import axis_maps
from tests.sysid.diagnosis.diagnose_core_helpers import TORSION1, run_data

STEP_S = 0.005
COUNT = 4000
EDGES = np.linspace(-np.pi, np.pi, 25)


def motion(seed: int, centre_rad: float) -> tuple[FloatArray, FloatArray]:
    """Link angle and velocity of 20 s around an angle."""
    rng = np.random.default_rng([7, seed])
    t, rate, phase = STEP_S * np.arange(COUNT), rng.uniform(0.9, 1.3), rng.uniform(0.0, 6.0)
    return centre_rad + 0.8 * np.sin(rate * t + phase), 0.8 * rate * np.cos(rate * t + phase)


def noise(seed: int) -> FloatArray:
    return np.random.default_rng([seed, 3]).normal(0.0, 0.05, COUNT)


def bins(angle: FloatArray) -> Index:
    wrapped = np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
    return np.clip(np.searchsorted(EDGES, wrapped, side="right") - 1, 0, 23)


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
    maps = {m.axis: m for m in axis_maps(runs, {TORSION1: parts}, STEP_S)}
    limits = EventLimits(np.array([0.0]), STEP_S, 0.5, 0.3)
    first = locate(runs, TORSION1, parts, limits, lines=(), maps=maps)[0]
    assert first.axis == "link_angle"
    edges = maps["link_angle"].edges
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
        found += turn_range([bins(angle)], [x], EDGES, STEP_S) is not None
    assert found <= 6  # 1 % of 300 were 3


def test_a_range_that_most_passes_leave_alone_is_none() -> None:
    angle, _ = motion(1, 0.4)
    place = bins(angle)
    passes = np.flatnonzero(np.diff((np.abs(angle - 0.4) < 0.15).astype(int)) == 1)
    assert len(passes) >= 5
    every, two = noise(1), noise(1)
    for k, start in enumerate(passes):
        every[start : start + 40] += 2.0
        two[start : start + 40] += 2.0 if k < 2 else 0.0
    assert turn_range([place], [every], EDGES, STEP_S) is not None
    assert turn_range([place], [two], EDGES, STEP_S) is None


def test_a_pass_is_predicted_by_the_others() -> None:
    angle, _ = motion(2, 0.4)
    x = np.where(np.abs(angle - 0.4) < 0.15, 2.0, 0.0) + noise(2)
    x[100:140] = np.nan
    place = bins(angle)
    found = turn_range([place], [x], EDGES, STEP_S)
    assert found is not None
    (means,) = predicted_by_passes(found, [place], [x])
    outside = np.ones(COUNT, dtype=bool)
    for _, a, b in found.passes:
        for k in set(place[a:b]):
            others = np.concatenate([x[c:d][place[c:d] == k] for _, c, d in found.passes if c != a])
            assert np.all(means[a:b][place[a:b] == k] == pytest.approx(np.nanmean(others)))
        outside[a:b] = False
    assert np.all(means[outside] == 0.0)


def turning(
    centre: float, moments: tuple[float, ...] = ()
) -> tuple[list[RunData], list[FloatArray], list[FloatArray]]:
    """Runs of whole turns through a cover, which pulls otherwise in each; residuals with it, and without what is an event.

    moments: seconds in run 1 at which something happens elsewhere.
    """
    runs, parts, rest = [], [], []
    for k in range(4):
        t = STEP_S * np.arange(COUNT)
        rate = 0.9 + 0.1 * k
        angle = rate * t + 0.3 * k
        near = np.mod(angle - centre + np.pi, 2.0 * np.pi) - np.pi
        x = np.where(np.abs(near) < 0.2, 2.0 + 0.5 * k, 0.0) + noise(k)
        event = np.abs(near) < 0.22
        for moment in moments if k == 1 else ():
            x[round(moment / STEP_S) :][:30] += 6.0
            event[round(moment / STEP_S) :][:30] = True
        axes = {"link_angle": angle, "velocity": np.full(COUNT, rate), "load": 5.0 * np.cos(t), "time": t}
        runs.append(run_data(f"run{k}", {TORSION1: x}, axes))
        parts.append(x)
        rest.append(np.where(event, np.nan, x))
    return runs, parts, rest


@pytest.mark.parametrize("centre", [3.24, 0.7], ids=["at_the_seam", "within"])
def test_a_cover_whose_passes_are_all_events_is_at_its_angle(centre: float) -> None:
    """The maps leave events out, and with them all angles at which the cover rubs."""
    runs, parts, rest = turning(centre)
    maps = {m.axis: m for m in axis_maps(runs, {TORSION1: rest}, STEP_S)}
    limits = EventLimits(np.array([0.9]), STEP_S, 0.5, 0.3)
    assert events(runs, TORSION1, parts, limits) is not None
    found = locate(runs, TORSION1, parts, limits, lines=(), maps=maps)
    edges = maps["link_angle"].edges
    assert found[0].axis == "link_angle"
    for k in found[0].bins[:2]:
        middle = np.mod(0.5 * (edges[k] + edges[k + 1]) - centre + np.pi, 2.0 * np.pi) - np.pi
        assert abs(middle) < 0.2 + 0.5 * (edges[1] - edges[0])
    assert all(place.burst is None for place in found), "what happens in the range is the range's"


def test_moments_elsewhere_are_told_beside_the_range() -> None:
    runs, parts, rest = turning(0.7, (3.0, 9.7))
    maps = {m.axis: m for m in axis_maps(runs, {TORSION1: rest}, STEP_S)}
    limits = EventLimits(np.array([0.9]), STEP_S, 0.5, 0.3)
    first, second, *_ = locate(runs, TORSION1, parts, limits, lines=(), maps=maps)
    assert first.axis == "link_angle"
    assert second.burst is not None
    assert all(run == "run1" and min(abs(t - 3.0), abs(t - 9.7)) < 0.3 for run, t in second.burst.times), (
        second.burst.times
    )
