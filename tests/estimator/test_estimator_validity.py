"""Sigma, standstill and trust in the network: formulas by hand, borders without jumps, twins."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.checked import ConfigError, Section
from jtqd.estimator.decoder import decode
from jtqd.estimator.losses import FrictionModel, LossModel
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.validity import Trust, Uncertainty
from tests.estimator.estimator_helpers import HIGH, LOW, joint1

MIDDLE = [(low + high) / 2 for low, high in zip(LOW, HIGH, strict=True)]
LIMIT = 10.0


def trust(margin: float = 0.05) -> Trust:
    return Trust(LOW, HIGH, margin, LIMIT)


def uncertainty(method: str, **changes: object) -> Uncertainty:
    joint = replace(joint1(), **changes)  # type: ignore[arg-type]
    return Uncertainty(joint, EstimatorSettings(method=method), LossModel(joint))


def test_sigma_by_hand() -> None:
    """Floor 0.5 % of 40 Nm; friction 15 % of 3 + 2*1 Nm; load: RMSE of the quadrant, or 15 % of tau_raw."""
    raw, i = 18.6, 3.0
    efficiency = uncertainty("efficiency").moving(raw, i, 1.0)
    assert efficiency == pytest.approx(
        math.sqrt((0.01963 * 18.6) ** 2 + (0.15 * 5.0) ** 2 + 0.2**2), rel=1e-9
    )
    driven = uncertainty("network").moving(-raw, -i, 1.0)
    assert driven == pytest.approx(math.sqrt((0.05599 * 18.6) ** 2 + (0.15 * 5.0) ** 2 + 0.2**2), rel=1e-9)
    expected = math.sqrt((0.15 * 18.6) ** 2 + (0.15 * 5.0) ** 2 + 0.2**2)
    assert uncertainty("tob").moving(raw, i, 1.0) == pytest.approx(expected, rel=1e-9)
    assert uncertainty("network", efficiency=None).moving(raw, i, 1.0) == pytest.approx(expected, rel=1e-9)


def test_standstill_is_the_interval_that_friction_can_hold() -> None:
    assert uncertainty("tob").standing(7.0, 7.0 / 6.2) == (7.0, pytest.approx(1.15 * 3.8 + 0.2))
    assert uncertainty("efficiency").standing(0.0, 0.0) == pytest.approx((0.0, 1.15 * 3.8 + 0.2))
    joint = joint1()
    losses = LossModel(joint)
    for i in np.linspace(-6, 6, 49).tolist():
        raw = 6.2 * i
        value, sigma = uncertainty("efficiency").standing(raw, i)
        # friction stronger than the file's by its uncertainty still holds the joint inside
        stronger = [raw - 1.15 * losses.loss(i, v) for v in (-0.02, 0.02)]
        assert all(value - sigma <= torque <= value + sigma for torque in stronger)
        # creeping either way at any speed below the threshold, the true torque stays inside
        for v in (-0.02, -0.01, -0.003, 0.0, 0.003, 0.01, 0.02):
            assert value - sigma <= raw - losses.loss(i, v) <= value + sigma


def test_uncertainty_twins() -> None:
    rng = np.random.default_rng(12)
    raw, v = 20 * rng.normal(size=3000), rng.normal(size=3000)
    i = raw / 6.2
    for method in ("tob", "efficiency"):
        u = uncertainty(method)
        rows = list(zip(raw.tolist(), i.tolist(), v.tolist(), strict=True))
        assert u.moving_many(raw, i, v) == pytest.approx([u.moving(*row) for row in rows], abs=1e-12)
        value, sigma = u.standing_many(raw, i)
        assert np.column_stack((value, sigma)) == pytest.approx(
            np.array([u.standing(a, b) for a, b, _ in rows]), abs=1e-12
        )


def test_weight_is_one_inside_and_zero_beyond_the_margin() -> None:
    t = trust()
    assert t.weight(*MIDDLE, 0.0) == 1.0
    assert t.weight(*LOW, 0.0) == 1.0
    assert t.weight(*HIGH, 0.0) == 1.0
    for n, (low, high) in enumerate(zip(LOW, HIGH, strict=True)):
        margin = 0.05 * (high - low)
        for side, sign in ((low, -1.0), (high, 1.0)):
            for part, expected in ((0.25, 0.75), (0.5, 0.5), (0.99, 0.01), (1.0, 0.0), (3.0, 0.0)):
                x = list(MIDDLE)
                x[n] = side + sign * part * margin
                assert t.weight(*x, 0.0) == pytest.approx(expected, abs=1e-9)


def test_weight_falls_before_the_limit_and_is_zero_for_nonsense() -> None:
    t = trust()
    for difference, expected in ((7.5, 1.0), (-7.5, 1.0), (8.75, 0.5), (-8.75, 0.5), (10.0, 0.0), (1e9, 0.0)):
        assert t.weight(*MIDDLE, difference) == pytest.approx(expected)
    for nonsense in (math.nan, math.inf, -math.inf):
        assert t.weight(*MIDDLE, nonsense) == 0.0
    x = list(MIDDLE)
    x[2] = math.nan
    assert t.weight(*x, 0.0) == 0.0


def test_a_feature_that_never_changed_in_training() -> None:
    t = Trust((0.0,) * 6, (0.0,) * 6, 0.05, LIMIT)
    assert t.weight(*[0.0] * 6, 0.0) == 1.0
    assert t.weight(0.1, *[0.0] * 5, 0.0) == 0.0


def test_weight_twin() -> None:
    rng = np.random.default_rng(13)
    x = rng.normal(size=(4000, 6)) * np.array(HIGH) * 0.6
    difference = 8.0 * rng.normal(size=4000)
    x[5, 3] = difference[6] = np.nan
    difference[7] = np.inf
    t = trust()
    single = [t.weight(*row, d) for row, d in zip(x.tolist(), difference.tolist(), strict=True)]
    assert sum(0 < w < 1 for w in single) > 100
    assert t.weight_many(x, difference) == pytest.approx(single, abs=1e-12)


def test_settings_are_checked() -> None:
    assert decode(EstimatorSettings, Section({}, "c.yaml", "estimator")) == EstimatorSettings()
    settings = decode(EstimatorSettings, Section({"method": "tob", "bandwidth_rad_s": 80}, "c.yaml", "e"))
    assert (settings.method, settings.bandwidth_rad_s) == ("tob", 80.0)
    for bad in ({"method": "magic"}, {"bandwidth_rad_s": 0}, {"bandwith_rad_s": 80}, {"max_gap_s": math.nan}):
        with pytest.raises(ConfigError, match=r"^c\.yaml: key 'e\."):
            decode(EstimatorSettings, Section(bad, "c.yaml", "e"))
    for wrong in ({"method": "x"}, {"sigma_floor": -1.0}, {"torque_limit": math.inf}):
        with pytest.raises(ConfigError):
            EstimatorSettings(**wrong)  # type: ignore[arg-type]
    assert FrictionModel(joint1().friction).static == 3.8
