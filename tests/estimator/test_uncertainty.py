"""Fusion, standard deviations and weights of networks: formulas by hand, limits, Monte Carlo, no jumps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.fusion import HOLD_S, Fusion, faded
from jtqd.estimator.joint import Envelope, FusedSigma
from jtqd.estimator.losses import LossModel
from jtqd.estimator.native_network import (
    DISTANCE_MARGIN,
    TEMPERATURE_MARGIN_K,
    envelope_weights,
    network_weights,
)
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import STANDSTILL, VALID, Estimate
from tests.estimator.estimator_helpers import HIGH, LOW, joint1, reciprocal_efficiency
from tests.estimator.fused_helpers import SIGMA, patches

# ---- fusion

RAW, LOSS, V, TORSION_NM = 12.0, 3.0, 1.0, 8.0


def fused(
    sigma: FusedSigma = SIGMA,
    with_torsion: bool = True,
    *,
    raw: Any = RAW,
    half: Any = 0.0,
    v: Any = V,
    torsion: Any = TORSION_NM,
    open_nm: Any = 0.0,
    loss: Any = LOSS,
) -> FloatArray:
    """Value and standard deviation [2, n] (or [2] for numbers)."""
    _, value, sd, _ = Fusion(sigma, with_torsion).fuse(
        *np.atleast_1d(raw, half, v, torsion, open_nm), loss_nm=loss
    )
    return np.array((value, sd)).squeeze()


CURRENT_ALONE = (RAW - LOSS, (0.2**2 + 0.1**2 + (0.02 * RAW) ** 2 + SIGMA.reference_nm**2) ** 0.5)


@pytest.mark.parametrize(
    ("sigma", "with_torsion", "expected"),
    [
        (replace(SIGMA, torsion_nm=1e-9, torsion_load=0.0), True, (TORSION_NM, SIGMA.reference_nm)),
        (replace(SIGMA, torsion_nm=1e9), True, CURRENT_ALONE),
        (SIGMA, False, CURRENT_ALONE),
        (FusedSigma(0.3, 0.0, 0.0, 0.3, 0.0, 0.0, (1.0,) * 4), True, (8.5, 0.3 / 2**0.5)),
    ],
    ids=["exact torsion", "worthless torsion", "no torsion", "both alike"],
)
def test_limits_of_the_fusion(sigma: FusedSigma, with_torsion: bool, expected: tuple[float, float]) -> None:
    assert fused(sigma, with_torsion) == pytest.approx(expected, abs=1e-9)


def test_at_rest_the_torsion_takes_over() -> None:
    """The wider the friction interval of the current path, the more of the result is torsion, without end."""
    away = np.abs(fused(half=[0.0, 1.0, 5.0, 50.0, 1e4], v=0.0)[0] - TORSION_NM)
    assert (np.diff(away) < 0.0).all()
    assert away[-1] < 1e-6


@pytest.mark.parametrize(
    ("raw", "v", "half", "torsion"), [(12.0, 1.0, 0.0, 8.0), (-30.0, 2.5, 0.0, -20.0), (5.0, 0.0, 2.0, 3.0)]
)
def test_sigma_is_the_scatter_of_the_result(raw: float, v: float, half: float, torsion: float) -> None:
    """Both paths and the reference scattered as the formula has it: 400 000 draws around one truth, 1 % tolerance."""
    found = Fusion(SIGMA, True).fuse(*np.atleast_1d(raw, half, v, torsion))
    alpha, sigma = float(found.alpha[0]), float(found.sigma_nm[0])
    rng = np.random.default_rng(11)
    current_sd = (0.2**2 + (0.1 * v) ** 2 + (0.02 * raw) ** 2 + half**2) ** 0.5
    torsion_sd = (0.35**2 + (0.015 * torsion) ** 2) ** 0.5
    assert found.variance_nm2[0] == pytest.approx(current_sd**2 + torsion_sd**2)
    a, b, offset = (rng.normal(0.0, sd, 400_000) for sd in (current_sd, torsion_sd, SIGMA.reference_nm))
    assert np.std(a + alpha * (b - a) - offset) == pytest.approx(sigma, rel=0.01)
    best = min(np.std(a + share * (b - a)) for share in np.linspace(0.0, 1.0, 101))
    assert np.std(a + alpha * (b - a)) == pytest.approx(best, rel=0.001)  # no other weights do better


def test_an_unknown_slip_widens_sigma_and_gives_the_weight_to_the_current() -> None:
    """As if the torsion's own standard deviation were that much larger."""
    sigma = replace(SIGMA, torsion_load=0.0)
    wider = replace(sigma, torsion_nm=(0.35**2 + 0.4**2) ** 0.5)
    known, opened = fused(sigma), fused(sigma, open_nm=0.4)
    assert opened == pytest.approx(fused(wider), abs=1e-12)
    assert opened[1] > known[1]
    assert abs(opened[0] - (RAW - LOSS)) < abs(known[0] - (RAW - LOSS))


def test_a_known_part_of_the_torsion_s_variance_moves_the_weight_and_never_all_of_it() -> None:
    one = np.ones(3)
    seen = (5.0 * one, 0.0 * one, 1.0 * one, 5.0 * one, 0.0 * one)
    plain = Fusion(SIGMA, True).fuse(*seen)
    alpha, _, sigma, variance = Fusion(SIGMA, True).fuse(*seen, known_nm2=np.array([0.0, 0.05, 1e6]))
    np.testing.assert_allclose((alpha[0], sigma[0]), (plain.alpha[0], plain.sigma_nm[0]))
    np.testing.assert_array_equal(variance, plain.variance_nm2)
    assert alpha[0] < alpha[1] < alpha[2] < 1.0
    assert sigma[0] > sigma[1] > sigma[2] > SIGMA.reference_nm
    c = 0.2**2 + 0.1**2 + (0.02 * 5.0) ** 2
    t = 0.35**2 + (0.015 * 5.0) ** 2 - 0.05
    assert alpha[1] == pytest.approx(c / (c + t))
    assert sigma[1] == pytest.approx(np.sqrt(c * t / (c + t) + 0.15**2))


def after(half: float, before: float, dt: float) -> float:
    """The second of two samples whose first had `before`."""
    return float(faded(np.array((before, half)), np.array((1.0, dt)), np.ones(2, np.bool_))[1])


def test_the_friction_interval_is_forgotten_over_50_ms() -> None:
    """A wider interval counts at once, a narrower one only as the memory fades: e^-1 after HOLD_S, in steps of any size."""
    assert after(3.0, 1.0, 0.001) == 3.0
    assert after(0.0, 3.0, 0.001) == pytest.approx(3.0 * (1.0 - 0.001 / HOLD_S), rel=1e-3)
    for dt in (0.0002, 0.001, 0.003):
        memory = 3.0
        for _ in range(round(HOLD_S / dt)):
            memory = after(0.0, memory, dt)
        assert memory == pytest.approx(3.0 * np.exp(-1.0), rel=0.04)
    rng = np.random.default_rng(5)
    for half, before, dt in rng.uniform((0.0, 0.0, 1e-4), (5.0, 5.0, 2e-3), (500, 3)).tolist():
        now = after(half, before, dt)
        assert max(half, before * np.exp(-dt / HOLD_S)) <= now <= max(half, before)
        assert after(half + 1e-9, before + 1e-9, dt) - now <= 1e-9 + 1e-15  # continuous


def test_the_memory_of_a_run_starts_again_where_nothing_was_observed() -> None:
    rng = np.random.default_rng(6)
    half, dt = np.maximum(rng.normal(size=400), 0.0) * 5.0, rng.uniform(0.0005, 0.002, 400)
    running = rng.random(400) > 0.05
    got = faded(half, dt, running)
    memory = 0.0
    for k in range(400):
        memory = after(half[k], memory, dt[k]) if running[k] else 0.0
        assert got[k] == memory
    begins = np.flatnonzero(~running[:-1] & running[1:]) + 1
    assert len(begins) > 5
    assert np.array_equal(got[begins], half[begins])
    assert not got[~running].any()


# ---- standard deviation of the paper's methods


def steady(method: str, current_a: float, v: float, **changes: Any) -> Estimate:
    """Estimate at constant current and velocity, physics alone."""
    joint = replace(joint1(), **changes)

    class Far:
        joint, sigma_nm = "joint1", 1.0
        envelope_low = envelope_high = (1e9,) * 6

        def run_one(self, *_: float) -> float:
            return 0.0

    e = JointEstimator(joint, EstimatorSettings(method=method), Far() if method == "network" else None)  # type: ignore[arg-type]
    for k in range(3):
        found = e.step(0.001, current_a, 0.1 * v * k, 100.0 * v, 0.001 * v * k)
    return found


RECIPROCAL = replace(joint1(), efficiency=reciprocal_efficiency(joint1()))
ETA = LossModel(RECIPROCAL).eta(3.0, 1.0)


@pytest.mark.parametrize(
    ("method", "current_a", "changes", "load"),
    [
        ("efficiency", 3.0, {}, 0.01963 * 18.6),
        ("network", -3.0, {}, 0.05599 * 18.6),
        ("tob", 3.0, {}, 0.15 * 18.6),
        ("network", 3.0, {"efficiency": None}, 0.15 * 18.6),
        # eta' = 1/eta known to rmse: tau = G Kt i/eta' is known to rmse G Kt |i|/eta'^2
        (
            "efficiency",
            3.0,
            {"efficiency": RECIPROCAL.efficiency},
            0.01963 * 18.6 * LossModel(RECIPROCAL).eta(3.0, 1.0) ** 2,
        ),
    ],
)
def test_sigma_by_hand(method: str, current_a: float, changes: dict[str, Any], load: float) -> None:
    """Floor 0.5 % of 40 Nm; friction 15 % of 3 + 2*1 Nm; load: RMSE of the quadrant, or 15 % of tau_raw."""
    expected = math.sqrt(load**2 + (0.15 * 5.0) ** 2 + 0.2**2)
    assert steady(method, current_a, 1.0, **changes).sigma_nm == pytest.approx(expected, rel=1e-6)


def test_standstill_is_the_interval_that_friction_can_hold() -> None:
    losses = LossModel(joint1())
    for i in np.linspace(-6, 6, 49).tolist():
        raw, found = 6.2 * i, steady("efficiency", i, 0.0)
        assert found.status == STANDSTILL
        low, high = found.torque_nm - found.sigma_nm, found.torque_nm + found.sigma_nm
        if (
            abs(i) >= 2.0
        ):  # well above i_b: the losses of the first motion, G Kt |i| |1 - eta| at the lowest speed
            forward, backward = (abs(raw * (1.0 - losses.eta(i, v))) for v in (0.2, -0.2))
            assert found.torque_nm == pytest.approx(raw - 0.5 * (forward - backward), abs=1e-9)
            assert found.sigma_nm == pytest.approx(1.15 * 0.5 * (forward + backward) + 0.2, abs=1e-9)
        # friction stronger than the file's by its uncertainty still holds the joint inside
        for v in (-0.02, 0.02):
            assert low <= raw - 1.15 * losses.loss(i, v) <= high
        # creeping either way at any speed below the threshold, the true torque stays inside
        for v in (-0.02, -0.01, -0.003, 0.0, 0.003, 0.01, 0.02):
            assert low <= raw - losses.loss(i, v) <= high
    assert steady("tob", 1.0, 1.0).status == VALID


# ---- weight of the paper's network

MIDDLE = np.array([(low + high) / 2 for low, high in zip(LOW, HIGH, strict=True)])
SPAN = np.array(HIGH) - np.array(LOW)
LIMIT = 10.0


def weight(x: Any = MIDDLE, difference: float = 0.0, low: Any = LOW, high: Any = HIGH) -> float:
    return float(network_weights(low, high, 0.05, LIMIT, [x], [difference])[0])


def test_weight_is_one_inside_and_zero_beyond_the_margin() -> None:
    assert weight() == weight(LOW) == weight(HIGH) == 1.0
    for n in range(6):
        for side, sign in ((LOW, -1.0), (HIGH, 1.0)):
            for part, expected in ((0.25, 0.75), (0.5, 0.5), (0.99, 0.01), (1.0, 0.0), (3.0, 0.0)):
                x = MIDDLE.copy()
                x[n] = side[n] + sign * part * 0.05 * SPAN[n]
                assert weight(x) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("difference", "expected"),
    [(7.5, 1.0), (-7.5, 1.0), (8.75, 0.5), (-8.75, 0.5), (10.0, 0.0), (1e9, 0.0)]
    + [(nonsense, 0.0) for nonsense in (math.nan, math.inf, -math.inf)],
)
def test_weight_falls_before_the_limit_and_is_zero_for_nonsense(difference: float, expected: float) -> None:
    assert weight(difference=difference) == pytest.approx(expected)


def test_a_feature_that_never_changed_in_training_and_one_that_is_nan() -> None:
    zero = (0.0,) * 6
    assert weight(zero, low=zero, high=zero) == 1.0
    assert weight((0.1, *zero[1:]), low=zero, high=zero) == 0.0
    assert weight((*MIDDLE[:2], math.nan, *MIDDLE[3:])) == 0.0


def test_weight_against_its_formula_in_arrays() -> None:
    rng = np.random.default_rng(13)
    x = rng.normal(size=(4000, 6)) * np.array(HIGH) * 0.6
    difference = 8.0 * rng.normal(size=4000)
    x[5, 3] = difference[6] = np.nan
    difference[7] = np.inf
    found = network_weights(LOW, HIGH, 0.05, LIMIT, x, difference)
    assert np.count_nonzero((found > 0) & (found < 1)) > 100
    with np.errstate(invalid="ignore"):
        beyond = np.max(np.maximum(np.array(LOW) - x, x - np.array(HIGH)) / (0.05 * SPAN), axis=1)
        far = (np.abs(difference) - 0.75 * LIMIT) / (0.25 * LIMIT)
        expected = np.clip(1.0 - np.maximum(beyond, far), 0.0, 1.0)
    assert found == pytest.approx(np.nan_to_num(expected), abs=1e-9)


# ---- weight of a fused network

ENVELOPE = Envelope(
    velocity_step_rad_s=0.5,
    torque_step_nm=4.0,
    known=((0, 0, 0, 0, 0), (0, 1, 1, 0, 0), (0, 1, 1, 1, 0), (0, 0, 1, 1, 1), (0, 0, 0, 1, 1)),
    distance_nm=2.0,
    temperature_c=(20.0, 30.0),
)
"""Rows are v = -1, -0.5, 0, 0.5, 1 rad/s, columns tau_raw = -8, -4, 0, 4, 8 Nm."""
EDGE = 2.0 * DISTANCE_MARGIN


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        *(
            (point, 1.0)
            for point in ((0, 0), (-0.5, -4), (-0.25, -2), (0.25, 2), (0.5, 8), (1, 8), (0.75, 6))
        ),
        *(
            (point, 0.0)
            for point in ((-1, 0), (0.5, -4), (0.75, -6), (1.5, 8), (0, 12), (3, 0), (0, -99), (1e300, 0))
        ),
        ((0.0, -1e300), 0.0),
        ((-0.75, 0.0), 0.5),  # half way from unknown to known
        ((0.0, -6.0), 0.5),
        ((-0.375, 3.0), 1 - 0.75 * 0.75),  # three corners of the cell are known
        ((1.0, 9.0), 0.75),  # beyond the outermost known cell it falls within one step
        ((1.25, 10.0), 0.25),
        *(
            ((0.0, 0.0, sign * distance), expected)
            for sign in (1.0, -1.0)
            for distance, expected in ((2.0, 1.0), (2.0 + 0.3 * EDGE, 0.7), (2.0 + EDGE, 0.0), (1e9, 0.0))
        ),
        ((0.0, 0.0, 0.0, 20.0), 1.0),
        ((0.0, 0.0, 0.0, 30.0), 1.0),
        ((0.0, 0.0, 0.0, 30.0 + 0.25 * TEMPERATURE_MARGIN_K), 0.75),
        ((0.0, 0.0, 0.0, 20.0 - 0.5 * TEMPERATURE_MARGIN_K), 0.5),
        *(((0.0, 0.0, 0.0, t), 0.0) for t in (31.0, 45.0, -math.inf, math.inf, math.nan)),
    ],
)
def test_weight_in_an_envelope_by_hand(point: tuple[float, ...], expected: float) -> None:
    columns = [[float(x)] for x in point]
    assert envelope_weights(ENVELOPE, *columns)[0] == pytest.approx(expected)  # type: ignore[arg-type]
    if len(point) == 4:
        assert envelope_weights(replace(ENVELOPE, temperature_c=None), *columns)[0] == 1.0  # type: ignore[arg-type]


def of_rows(envelope: Envelope) -> Callable[[FloatArray], FloatArray]:
    return lambda rows: envelope_weights(envelope, *rows.T)


@pytest.mark.parametrize("seed", [61, 62, 63])
def test_weight_in_an_envelope_has_no_jump(seed: int) -> None:
    """Lipschitz: between random pairs, near and far, the change is at most the sum of the slopes."""
    envelope = patches(seed)
    rng = np.random.default_rng(seed)
    slopes = np.array(
        (1 / 0.5, 1 / 6.0, 1 / (DISTANCE_MARGIN * envelope.distance_nm), 1 / TEMPERATURE_MARGIN_K)
    )
    low, high = np.array((-4.0, -45.0, -20.0, 17.0)), np.array((4.0, 45.0, 20.0, 35.0))
    a = rng.uniform(low, high, (4000, 4))
    b = a + rng.normal(size=(4000, 4)) * (high - low) * 10.0 ** rng.uniform(-9.0, -0.5, (4000, 1))
    first, second = (of_rows(envelope)(each) for each in (a, b))
    assert (np.abs(first - second) <= np.abs(b - a) @ slopes + 1e-12).all()
    assert ((first >= 0.0) & (first <= 1.0)).all()
    assert np.count_nonzero((first > 0.01) & (first < 0.99)) > 300
    assert min(np.count_nonzero(first == 0.0), np.count_nonzero(first == 1.0)) > 50


@pytest.mark.parametrize("seed", [71, 72])
@pytest.mark.parametrize("temperature_c", [(20.0, 30.0), None])
def test_weight_in_an_envelope_against_an_interpolator(
    seed: int, temperature_c: tuple[float, float] | None
) -> None:
    envelope = patches(seed, temperature_c)
    rng = np.random.default_rng(seed)
    columns = rng.uniform((-5.0, -60.0, -20.0, 15.0), (5.0, 60.0, 20.0, 35.0), (3000, 4)).T
    columns[3, ::7] = rng.choice([math.nan, math.inf, -math.inf, 1e300], len(columns[3, ::7]))
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
    assert envelope_weights(envelope, *columns) == pytest.approx(expected, abs=1e-9)
