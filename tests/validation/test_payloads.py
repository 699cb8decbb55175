"""Joints that carry a payload on the benches: weight and inertia reach gear and sensor, and the study's table."""

from __future__ import annotations

import math

import numpy as np
import pytest

from validation.goals import payloads
from validation.goals.goals import Figure
from validation.goals.identify import the_four

THREE = the_four()[1:]
KNOWN = payloads.Known(0.0, 0.0, 0.0)


def test_weight_of_a_payload_in_closed_form() -> None:
    load = payloads.Known(0.0, 0.0, 0.1).load(8.0)
    weight = 8.0 * payloads.GRAVITY_M_S2 * payloads.LEVER_M
    q = 0.7
    expected = (
        weight * math.sin(q - 0.1) + payloads.ARM.sine_nm * math.sin(q) + payloads.ARM.cosine_nm * math.cos(q)
    )
    assert load.sine_nm * math.sin(q) + load.cosine_nm * math.cos(q) == pytest.approx(expected)
    assert load.inertia_kgm2 == pytest.approx(0.09 + 8.0 * (0.09 + payloads.GYRATION_M**2))


@pytest.mark.parametrize(
    ("plant", "number"),
    [*((plant, 1) for plant in THREE), (THREE[-1], 2)],
    ids=lambda x: getattr(x, "name", x),
)
def test_the_gear_carries_weight_and_inertia(plant: payloads.PlantFile, number: int) -> None:
    velocity = payloads.velocity_of(np.random.default_rng(3), 3.0)
    load = KNOWN.load(5.0)
    [run] = payloads.carried(payloads.alone(plant, number), [velocity], [load], 11)
    columns = run.table.joints[1]
    assert columns.link_position_rad is not None
    assert columns.torque_nm is not None
    q = columns.link_position_rad
    weight = load.sine_nm * np.sin(q) + load.cosine_nm * np.cos(q)
    smooth = np.ones(101) / 101.0
    acceleration = np.gradient(np.gradient(np.convolve(q, smooth, "same"), 1e-3), 1e-3)
    expected = np.convolve(weight + load.inertia_kgm2 * acceleration, smooth, "same")[500:-500]
    found = np.convolve(run.true_nm, smooth, "same")[500:-500]
    assert np.ptp(expected) > 5.0
    assert np.std(found - expected) < 0.1 * np.std(expected)
    measured = np.convolve(columns.torque_nm, smooth, "same")[500:-500]
    assert np.std(measured - found) < 0.05
    assert abs(np.mean(measured - found)) < 1.0


def test_motions_keep_their_limits() -> None:
    for seed in range(5):
        v = payloads.velocity_of(np.random.default_rng(seed), 10.0)
        assert len(v) == 10_000
        assert np.abs(v).max() <= 2.5
        assert np.abs(np.gradient(v, 1e-3)).max() <= 4.01
        assert np.abs(np.cumsum(v) * 1e-3).max() <= 2.21
        assert v[0] == v[-1] == 0.0


def test_targets_are_those_of_two_payloads() -> None:
    def rows(rmse: float, inside: float) -> list[payloads.Row]:
        kinds = {"two payloads": rmse, "sensor": 0.2, payloads.BENCH: 0.5}
        return [
            payloads.Row("p", kind, Figure(value, 0.0), Figure(inside, 0.0)) for kind, value in kinds.items()
        ]

    assert payloads.table_of(rows(0.25, 90.0))[1]
    assert not payloads.table_of(rows(0.27, 90.0))[1]
    assert not payloads.table_of(rows(0.25, 96.0))[1]
    assert not payloads.table_of(rows(0.25, 84.0))[1]
    assert not payloads.table_of(rows(math.nan, math.nan))[1]
    assert payloads.table_of(rows(0.25, 90.0))[0].rows[0][3] == "1.25"
