"""Which condition is named first: residuals of which it is known what they follow, beside conditions that go with it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.sysid.diagnosis.regressors import RunData
from jtqd.sysid.diagnosis.signals import Channel
from jtqd.sysid.diagnosis.structure import Balance, View, explained_by_bins, pursue
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, run_data

STEP_S = 0.005
COUNT = 4000
Residual = Callable[[dict[str, FloatArray], int], FloatArray]


def motion(seed: int) -> dict[str, FloatArray]:
    """Back and forth under a load that goes along with the velocity for the most part."""
    rng = np.random.default_rng(seed)
    t = STEP_S * np.arange(COUNT)
    rate, phase = rng.uniform(0.8, 1.2), rng.uniform(0.0, 6.0)
    link = 0.8 * np.sin(rate * t + phase) + rng.uniform(-0.3, 0.3)
    velocity = 0.8 * rate * np.cos(rate * t + phase)
    return {
        "velocity": velocity,
        "load": 20.0 * velocity + 6.0 * np.sin(1.9 * t + 2.0 * phase),
        "link_angle": link,
        "motor_angle": 100.0 * link,
        "current": 0.02 * velocity + 0.05 * np.sin(1.9 * t + 2.0 * phase),
        "temperature": 25.0 + 3.0 * seed + 0.1 * t,
        "time": t,
    }


def noise(seed: int) -> FloatArray:
    e = np.random.default_rng([seed, 3]).normal(0.0, 0.05, COUNT)
    out = np.zeros(COUNT)
    for k in range(1, COUNT):
        out[k] = 0.9 * out[k - 1] + e[k]
    return out


def found(residual: Residual, channel: Channel = MOTOR1, seed: int = 0) -> list[View]:
    """The views of a residual of six runs, of a joint of 50 Nm: events from 0.5 Nm on, means over seconds from 0.3 Nm on."""
    axes = [motion(seed + k) for k in range(6)]
    parts = [residual(a, k) + noise(seed + k) for k, a in enumerate(axes)]
    runs: list[RunData] = [
        run_data(f"run{k}", {channel: x}, a) for k, (x, a) in enumerate(zip(parts, axes, strict=True))
    ]
    return pursue(Balance(runs, channel, STEP_S, 50.0), parts)


@pytest.mark.parametrize(
    ("axis", "shape"),
    [
        (
            "velocity",
            lambda a: np.exp(-(((np.abs(a["velocity"]) - 0.4) / 0.08) ** 2)) * np.sign(a["velocity"]),
        ),
        ("load", lambda a: np.exp(-(((a["load"] - 8.0) / 2.0) ** 2))),
        ("link_angle", lambda a: np.exp(-(((a["link_angle"] - 0.3) / 0.1) ** 2)) * np.sign(a["velocity"])),
        ("current", lambda a: np.sign(a["current"]) * np.exp(-((np.abs(a["current"]) / 0.008) ** 2))),
    ],
)
def test_the_condition_itself_comes_before_those_that_go_along(
    axis: str, shape: Callable[[dict[str, FloatArray]], FloatArray]
) -> None:
    places = found(lambda a, _: np.asarray(0.6 * shape(a)))
    assert places[0].axis == axis
    assert places[0].energy_nm2 > 2.0 * sum(p.energy_nm2 for p in places[1:])
    values = np.concatenate([motion(k)[axis] for k in range(6)])
    shapes = np.concatenate([np.abs(shape(motion(k))) for k in range(6)])
    edges, k = places[0].edges, places[0].bins[0]
    assert edges is not None
    here = (values >= edges[k]) & (values <= edges[k + 1])
    assert np.mean(shapes[here] ** 2) > 3.0 * np.mean(shapes**2), "the bin that explains most is where it is"


def test_the_second_place_explains_what_the_first_does_not() -> None:
    def two(a: dict[str, FloatArray], _: int) -> FloatArray:
        angle = np.exp(-(((a["link_angle"] - 0.3) / 0.1) ** 2))
        return np.asarray(0.03 * a["load"] + 0.5 * angle)

    places = found(two, TORSION1)
    assert [p.axis for p in places[:2]] == ["load", "link_angle"]


def test_noise_has_no_place() -> None:
    for seed in range(5):
        assert found(lambda a, _: 0.0 * a["load"], seed=10 * seed) == []


def test_what_only_one_run_shows_is_not_its_temperature() -> None:
    """One run is off as a whole: every condition that only this run has would explain it, and no other run confirms it."""
    places = found(lambda a, k: np.full(COUNT, 0.8 if k == 2 else 0.0) + 0.0 * a["load"], TORSION1)
    assert places[0].what == "seconds"
    assert {run for run, _ in places[0].times} == {"run2"}


def test_events_are_the_moments_and_not_where_the_joint_was() -> None:
    def dropped(a: dict[str, FloatArray], k: int) -> FloatArray:
        x = np.zeros(COUNT)
        for start in np.random.default_rng([5, k]).integers(100, COUNT - 100, 3):
            x[start : start + 20] = a["load"][start]
        return x

    places = found(dropped)
    assert places[0].what == "events"
    rng_times = {
        (f"run{k}", s * STEP_S)
        for k in range(6)
        for s in np.random.default_rng([5, k]).integers(100, 3900, 3)
    }
    for run, t in places[0].times:
        assert any(run == r and abs(t - u) < 0.2 for r, u in rng_times)


def test_a_step_on_every_pass_is_the_angles() -> None:
    places = found(lambda a, _: np.where(np.abs(a["link_angle"] - 0.3) < 0.15, 1.5, 0.0), TORSION1)
    assert places[0].axis == "link_angle"


@pytest.mark.parametrize(("amplitude", "at"), [(0.2, 1), (1.0, 0)])
def test_a_line_is_ranked_by_its_energy(amplitude: float, at: int) -> None:
    def residual(a: dict[str, FloatArray], k: int) -> FloatArray:
        return np.asarray(0.02 * a["load"] + amplitude * np.cos(2.0 * np.pi * 6.0 * a["time"] + k))

    places = found(residual, TORSION1)
    assert [p.line is not None for p in places[:2]] == [k == at for k in range(2)]
    line = places[at].line
    assert line is not None
    assert (line.unit, line.order) == ("Hz", pytest.approx(6.0, abs=0.13))


def test_other_runs_predict_this_one() -> None:
    """The energy explained is that of plain leave-one-out means, sample by sample."""
    rng = np.random.default_rng(2)
    places = [rng.integers(0, 3, 400) for _ in range(4)]
    parts = [np.array([0.5, 0.0, -1.0])[p] + rng.normal(0.0, 0.3, 400) for p in places]
    parts[1][50:90] = np.nan
    energy, means = explained_by_bins(places, parts, 3, 1.0 / STEP_S)
    for r in range(4):
        others = [k for k in range(4) if k != r]
        x = np.concatenate([parts[k] for k in others])
        p = np.concatenate([places[k] for k in others])
        for b in range(3):
            mean = np.nansum(x[p == b]) / (np.isfinite(x[p == b]).sum() + 200.0)
            mine = parts[r][places[r] == b]
            assert energy[r, b] == pytest.approx(np.nansum(mine**2 - (mine - mean) ** 2))
            assert np.all(means[r][places[r] == b] == pytest.approx(mean))
