"""Sigma, standstill and trust in both networks: formulas by hand, borders without jumps, twins, the envelope's metadata."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from jtqd.estimator.checked import ConfigError
from jtqd.estimator.decoder import decode
from jtqd.estimator.joint import Envelope
from jtqd.estimator.losses import FrictionModel, LossModel
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.uncertainty import (
    DISTANCE_MARGIN,
    TEMPERATURE_MARGIN_K,
    FusedTrust,
    Trust,
    Uncertainty,
)
from tests.estimator.estimator_helpers import HIGH, LOW, joint1
from tests.estimator.fused_helpers import everywhere, patches

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


def test_weight_against_its_formula_in_arrays() -> None:
    rng = np.random.default_rng(13)
    x = rng.normal(size=(4000, 6)) * np.array(HIGH) * 0.6
    difference = 8.0 * rng.normal(size=4000)
    x[5, 3] = difference[6] = np.nan
    difference[7] = np.inf
    t = trust()
    single = [t.weight(*row, d) for row, d in zip(x.tolist(), difference.tolist(), strict=True)]
    assert sum(0 < w < 1 for w in single) > 100
    low, high = np.array(LOW), np.array(HIGH)
    with np.errstate(invalid="ignore"):
        beyond = np.max(np.maximum(low - x, x - high) / (0.05 * (high - low)), axis=1)
        far = (np.abs(difference) - 0.75 * LIMIT) / (0.25 * LIMIT)
        expected = np.clip(1.0 - np.maximum(beyond, far), 0.0, 1.0)
    assert single == pytest.approx(np.nan_to_num(expected), abs=1e-9)


def test_settings_are_checked() -> None:
    assert decode(EstimatorSettings, {}, "c.yaml", "estimator") == EstimatorSettings()
    settings = decode(EstimatorSettings, {"method": "tob", "bandwidth_rad_s": 80}, "c.yaml", "e")
    assert (settings.method, settings.bandwidth_rad_s) == ("tob", 80.0)
    for bad in ({"method": "magic"}, {"bandwidth_rad_s": 0}, {"bandwith_rad_s": 80}, {"max_gap_s": math.nan}):
        with pytest.raises(ConfigError, match=r"^c\.yaml: key 'e\."):
            decode(EstimatorSettings, bad, "c.yaml", "e")
    for wrong in ({"method": "x"}, {"sigma_floor": -1.0}, {"torque_limit": math.inf}):
        with pytest.raises(ConfigError):
            EstimatorSettings(**wrong)  # type: ignore[arg-type]
    assert FrictionModel(joint1().friction).static == 3.8


ENVELOPE = Envelope(
    velocity_step_rad_s=0.5,
    torque_step_nm=4.0,
    known=((0, 0, 0, 0, 0), (0, 1, 1, 0, 0), (0, 1, 1, 1, 0), (0, 0, 1, 1, 1), (0, 0, 0, 1, 1)),
    distance_nm=2.0,
    temperature_c=(20.0, 30.0),
)
NAN = math.nan


def fused_weight(
    v: float, raw: float, distance: float = 0.0, temperature: float = 25.0, **changes: Any
) -> float:
    return FusedTrust(replace(ENVELOPE, **changes)).weight(v, raw, distance, temperature)


def test_fused_weight_is_one_inside_and_zero_outside() -> None:
    """Rows are v = -1, -0.5, 0, 0.5, 1 rad/s, columns tau_raw = -8, -4, 0, 4, 8 Nm."""
    for v, raw in ((0.0, 0.0), (-0.5, -4.0), (-0.25, -2.0), (0.25, 2.0), (0.5, 8.0), (1.0, 8.0), (0.75, 6.0)):
        assert fused_weight(v, raw) == 1.0
    for v, raw in ((-1.0, 0.0), (0.5, -4.0), (0.75, -6.0), (1.5, 8.0), (0.0, 12.0), (3.0, 0.0), (0.0, -99.0)):
        assert fused_weight(v, raw) == 0.0
    assert fused_weight(1e300, 0.0) == fused_weight(0.0, -1e300) == 0.0


def test_between_cells_it_is_bilinear() -> None:
    assert fused_weight(-0.75, 0.0) == pytest.approx(0.5)  # half way from unknown to known
    assert fused_weight(0.0, -6.0) == pytest.approx(0.5)
    assert fused_weight(-0.375, 3.0) == pytest.approx(1 - 0.75 * 0.75)  # three corners of the cell are known
    assert fused_weight(1.0, 9.0) == pytest.approx(
        0.75
    )  # beyond the outermost known cell it falls within one step
    assert fused_weight(1.25, 10.0) == pytest.approx(0.25)


def test_distance_between_torsion_and_current() -> None:
    edge = 2.0 * DISTANCE_MARGIN
    for sign in (1.0, -1.0):
        assert fused_weight(0.0, 0.0, sign * 2.0) == 1.0
        assert fused_weight(0.0, 0.0, sign * (2.0 + 0.3 * edge)) == pytest.approx(0.7)
        assert fused_weight(0.0, 0.0, sign * (2.0 + edge)) == 0.0
        assert fused_weight(0.0, 0.0, sign * 1e9) == 0.0


def test_temperature() -> None:
    for temperature, expected in (
        (20.0, 1.0),
        (30.0, 1.0),
        (30.0 + 0.25 * TEMPERATURE_MARGIN_K, 0.75),
        (20.0 - 0.5 * TEMPERATURE_MARGIN_K, 0.5),
        (31.0, 0.0),
        (45.0, 0.0),  # 15 K warmer
        (-math.inf, 0.0),
        (math.inf, 0.0),
        (NAN, 0.0),  # not known, where the data had one
    ):
        assert fused_weight(0.0, 0.0, 0.0, temperature) == pytest.approx(expected)
        assert fused_weight(0.0, 0.0, 0.0, temperature, temperature_c=None) == 1.0


@pytest.mark.parametrize("seed", [61, 62, 63])
def test_fused_weight_has_no_jump(seed: int) -> None:
    """Lipschitz: between random pairs, near and far, the change is at most the sum of the slopes."""
    envelope = patches(seed)
    trust = FusedTrust(envelope)
    rng = np.random.default_rng(seed)
    slopes = np.array(
        (1 / 0.5, 1 / 6.0, 1 / (DISTANCE_MARGIN * envelope.distance_nm), 1 / TEMPERATURE_MARGIN_K)
    )
    low, high = np.array((-4.0, -45.0, -20.0, 17.0)), np.array((4.0, 45.0, 20.0, 35.0))
    seen = []
    for _ in range(4000):
        a = rng.uniform(low, high)
        b = a + rng.normal(size=4) * (high - low) * 10.0 ** rng.uniform(-9.0, -0.5)
        first, second = trust.weight(*a.tolist()), trust.weight(*b.tolist())
        assert abs(first - second) <= float(slopes @ np.abs(b - a)) + 1e-12, (seed, a, b)
        assert 0.0 <= first <= 1.0
        seen.append(first)
    assert sum(0.01 < w < 0.99 for w in seen) > 300
    assert min(seen.count(0.0), seen.count(1.0)) > 50


@pytest.mark.parametrize("seed", [71, 72])
@pytest.mark.parametrize("temperature_c", [(20.0, 30.0), None])
def test_fused_weight_against_an_interpolator(seed: int, temperature_c: tuple[float, float] | None) -> None:
    envelope = patches(seed, temperature_c)
    trust = FusedTrust(envelope)
    rng = np.random.default_rng(seed)
    columns = rng.uniform((-5.0, -60.0, -20.0, 15.0), (5.0, 60.0, 20.0, 35.0), (3000, 4)).T
    columns[3, ::7] = rng.choice([NAN, math.inf, -math.inf, 1e300], len(columns[3, ::7]))
    columns[:3, ::11] = np.round(columns[:3, ::11])  # on cells and borders
    known = np.pad(np.array(envelope.known, float), 1)
    axes = [
        step * (np.arange(n) - (n - 1) / 2)
        for step, n in zip((envelope.velocity_step_rad_s, envelope.torque_step_nm), known.shape, strict=True)
    ]
    inside = RegularGridInterpolator(axes, known, bounds_error=False, fill_value=0.0)(columns[:2].T)
    beyond = np.maximum(np.abs(columns[2]) / envelope.distance_nm - 1.0, 0.0) / DISTANCE_MARGIN
    expected = inside * np.maximum(0.0, 1.0 - beyond)
    if temperature_c is not None:
        low, high = temperature_c
        away = np.maximum(np.maximum(low - columns[3], columns[3] - high), 0.0) / TEMPERATURE_MARGIN_K
        expected *= np.nan_to_num(np.maximum(0.0, 1.0 - away))
    one = [trust.weight(*row) for row in columns.T.tolist()]
    assert one == pytest.approx(expected, abs=1e-9)


# ---- metadata


def test_envelope_round_trip() -> None:
    for envelope in (ENVELOPE, everywhere(), replace(ENVELOPE, temperature_c=None)):
        assert Envelope.from_mapping(json.loads(json.dumps(envelope.to_mapping()))) == envelope


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("known", ..., "expected the keys velocity_step_rad_s, torque_step_nm, known"),
        ("counts", [[1]], "expected the keys"),
        ("velocity_step_rad_s", 0.0, "velocity_step_rad_s: found 0.0, expected 1e-06 to 1e+06"),
        ("velocity_step_rad_s", True, "velocity_step_rad_s: found True"),
        ("torque_step_nm", NAN, "torque_step_nm: found nan"),
        ("torque_step_nm", "3", "torque_step_nm: found '3'"),
        ("distance_nm", -1.0, "distance_nm: found -1.0"),
        ("distance_nm", 1e-320, "distance_nm: found 1e-320"),
        ("known", [], "known: found [], expected a list of rows"),
        ("known", [1, 0, 1], "known: found [1, 0, 1], expected a list of rows"),
        ("known", [[]], "known: found 1 rows of 0 cells, expected odd numbers"),
        ("known", [[1, 1, 1], [1, 1, 1]], "known: found 2 rows of 3 cells, expected odd numbers"),
        ("known", [[1, 1]], "known: found 1 rows of 2 cells, expected odd numbers"),
        ("known", [[1, 1, 1], [1], [1, 1, 1]], "known: found 3 rows of 1, 3 cells"),
        ("known", [[2]], "known: found other cells, expected 0 and 1"),
        ("known", [[True]], "known: found other cells"),
        ("known", [[0.5]], "known: found other cells"),
        ("known", [[[1]]], "known: found other cells"),
        (
            "temperature_c",
            [30.0, 20.0],
            "temperature_c: found [30.0, 20.0], expected null or [lowest, highest]",
        ),
        ("temperature_c", [20.0], "temperature_c: found [20.0]"),
        ("temperature_c", 25.0, "temperature_c: found 25.0"),
        ("temperature_c", [20.0, math.inf], "temperature_c: found [20.0, inf]"),
        ("temperature_c", [20.0, None], "temperature_c: found [20.0, None]"),
    ],
)
def test_wrong_envelopes_are_refused(key: str, value: object, words: str) -> None:
    mapping = {k: v for k, v in (ENVELOPE.to_mapping() | {key: value}).items() if v is not ...}
    with pytest.raises(ValueError, match="found") as caught:
        Envelope.from_mapping(mapping)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_envelope_that_is_no_mapping() -> None:
    for value in (None, [], "x", 3):
        with pytest.raises(ValueError, match="expected the keys"):
            Envelope.from_mapping(value)
