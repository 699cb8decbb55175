"""Where the network is trusted: 1 inside what it was trained on, 0 outside, continuous in between, and its metadata."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.validity import DISTANCE_MARGIN, TEMPERATURE_MARGIN_K, Envelope, FusedTrust
from tests.estimator.fused_helpers import everywhere, patches

ENVELOPE = Envelope(
    velocity_step_rad_s=0.5,
    torque_step_nm=4.0,
    known=((0, 0, 0, 0, 0), (0, 1, 1, 0, 0), (0, 1, 1, 1, 0), (0, 0, 1, 1, 1), (0, 0, 0, 1, 1)),
    distance_nm=2.0,
    temperature_c=(20.0, 30.0),
)
NAN = math.nan


def weight(v: float, raw: float, distance: float = 0.0, temperature: float = 25.0, **changes: Any) -> float:
    return FusedTrust(replace(ENVELOPE, **changes)).weight(v, raw, distance, temperature)


def test_inside_is_one_and_outside_zero() -> None:
    """Rows are v = -1, -0.5, 0, 0.5, 1 rad/s, columns tau_raw = -8, -4, 0, 4, 8 Nm."""
    for v, raw in ((0.0, 0.0), (-0.5, -4.0), (-0.25, -2.0), (0.25, 2.0), (0.5, 8.0), (1.0, 8.0), (0.75, 6.0)):
        assert weight(v, raw) == 1.0
    for v, raw in ((-1.0, 0.0), (0.5, -4.0), (0.75, -6.0), (1.5, 8.0), (0.0, 12.0), (3.0, 0.0), (0.0, -99.0)):
        assert weight(v, raw) == 0.0
    assert weight(1e300, 0.0) == weight(0.0, -1e300) == 0.0


def test_between_cells_it_is_bilinear() -> None:
    assert weight(-0.75, 0.0) == pytest.approx(0.5)  # half way from unknown to known
    assert weight(0.0, -6.0) == pytest.approx(0.5)
    assert weight(-0.375, 3.0) == pytest.approx(1 - 0.75 * 0.75)  # three corners of the cell are known
    assert weight(1.0, 9.0) == pytest.approx(0.75)  # beyond the outermost known cell it falls within one step
    assert weight(1.25, 10.0) == pytest.approx(0.25)


def test_distance_between_torsion_and_current() -> None:
    edge = 2.0 * DISTANCE_MARGIN
    for sign in (1.0, -1.0):
        assert weight(0.0, 0.0, sign * 2.0) == 1.0
        assert weight(0.0, 0.0, sign * (2.0 + 0.3 * edge)) == pytest.approx(0.7)
        assert weight(0.0, 0.0, sign * (2.0 + edge)) == 0.0
        assert weight(0.0, 0.0, sign * 1e9) == 0.0


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
        assert weight(0.0, 0.0, 0.0, temperature) == pytest.approx(expected)
        assert weight(0.0, 0.0, 0.0, temperature, temperature_c=None) == 1.0


@pytest.mark.parametrize("seed", [61, 62, 63])
def test_no_jump_anywhere(seed: int) -> None:
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
def test_the_vectorised_twin(seed: int, temperature_c: tuple[float, float] | None) -> None:
    trust = FusedTrust(patches(seed, temperature_c))
    rng = np.random.default_rng(seed)
    columns = rng.uniform((-5.0, -60.0, -20.0, 15.0), (5.0, 60.0, 20.0, 35.0), (3000, 4)).T
    columns[3, ::7] = rng.choice([NAN, math.inf, -math.inf, 1e300], len(columns[3, ::7]))
    columns[:3, ::11] = np.round(columns[:3, ::11])  # on cells and borders
    one = [trust.weight(*row) for row in columns.T.tolist()]
    assert np.max(np.abs(trust.weight_many(*columns) - one)) < 1e-12


# ---- metadata


def test_round_trip() -> None:
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
def test_wrong_metadata(key: str, value: object, words: str) -> None:
    mapping = {k: v for k, v in (ENVELOPE.to_mapping() | {key: value}).items() if v is not ...}
    with pytest.raises(ValueError, match="found") as caught:
        Envelope.from_mapping(mapping)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_metadata_that_is_no_mapping() -> None:
    for value in (None, [], "x", 3):
        with pytest.raises(ValueError, match="expected the keys"):
            Envelope.from_mapping(value)
