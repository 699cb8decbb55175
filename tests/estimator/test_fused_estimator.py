"""The fused estimate of one joint: values in steady state, statuses, trust, temperature, faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.estimator import STANDSTILL_SIGMAS, FusedEstimator, estimate_columns, observe_run
from jtqd.estimator.fusion import Fusion
from jtqd.estimator.joint import QUADRANTS, Joint, Standstill
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.native_network import OUTSIDE
from jtqd.estimator.network import PathNetwork
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import Estimate
from tests.estimator.estimator_helpers import Motion
from tests.estimator.fused_helpers import (
    GAIN,
    NARROW,
    PLAIN,
    TRACKED,
    TRACKING,
    TRAINED_C,
    FakeNetwork,
    K,
    everywhere,
    fused_joint,
    fused_network,
    temperatures,
    twisted,
)

FUSED = EstimatorSettings(method="fused")


def estimator(network: Any = None, joint: Joint = PLAIN, **settings: Any) -> FusedEstimator:
    return FusedEstimator(joint, replace(FUSED if network is None else TRACKED, **settings), network)


def says(answer: float | Callable[..., float], **envelope: Any) -> FakeNetwork:
    return FakeNetwork(answer if callable(answer) else lambda *_: answer, everywhere(**envelope))


def steady(  # noqa: PLR0917 - a state and how it is held
    e: FusedEstimator,
    i: float,
    v: float,
    torsion_nm: float = 5.0,
    temperature_c: float = 25.0,
    count: int = 4,
    first: int = 0,
) -> Estimate:
    """Samples `first` and on of a motion with constant speed and torsion."""
    for k in range(first, first + count):
        link = v * 0.001 * k
        last = e.step(0.001, i, 100.0 * (link + torsion_nm / K), 100.0 * v, link, temperature_c)
    return last


def physics(
    i: float, v: float, torsion_nm: float, temperature_c: float = 25.0, joint: Joint = PLAIN
) -> tuple[float, float, float]:
    """(value, sigma before its scale, half) of both paths at a constant state; sigma without the sensor's zero."""
    assert joint.fused is not None
    model = AdditiveLossModel(joint.fused.loss)
    loss, half = model.loss(GAIN * i, v, model.thermal(temperature_c))
    sigma = replace(joint.fused.sigma, reference_nm=0.0)
    found = Fusion(sigma, True).fuse(*np.atleast_1d(GAIN * i, half, v, torsion_nm), loss_nm=loss)
    return float(found.value_nm[0]), float(found.sigma_nm[0]), half


def unproven(  # noqa: PLR0917 - a state and how long it is held
    i: float,
    v: float,
    torsion_nm: float,
    temperature_c: float = 25.0,
    joint: Joint = PLAIN,
    samples: int = 3,
    open_nm: float = 0.0,
) -> float:
    """Part of sigma [Nm] of a torsion that only so many samples of this state have shown to be right."""
    assert joint.fused is not None
    model = AdditiveLossModel(joint.fused.loss)
    loss, half = model.loss(GAIN * i, v, model.thermal(temperature_c))
    columns = np.atleast_1d(GAIN * i, half, v, torsion_nm)
    found = Fusion(joint.fused.sigma, True).fuse(*columns, open_nm=open_nm, loss_nm=loss)
    difference = abs(torsion_nm - GAIN * i + loss)
    distance = half + 3.0 * math.sqrt(float(found.variance_nm2[0]) - half**2)
    proving = v != 0.0 and difference <= distance
    fading = 0.1 / 0.101 if proving else 1.0
    bound = min(fading * joint.rated_torque_nm, difference + distance)
    return float(found.alpha[0]) * fading ** (samples - 1) * bound / 3.0


# ---- values


@pytest.mark.parametrize(("i", "v"), [(3.0, 1.0), (-3.0, -1.0), (-3.0, 1.0), (3.0, -1.0), (0.0, 2.0)])
def test_steady_state_is_the_fusion_of_both_paths(i: float, v: float) -> None:
    """Sigma times the factor of the quadrant, by the name of the quadrant."""
    got = steady(estimator(), i, v, torsion_nm=7.0)
    value, sigma, _ = physics(i, v, 7.0)
    quadrant = f"i_{'pos' if i >= 0 else 'neg'}_w_{'pos' if v >= 0 else 'neg'}"
    assert got.status == st.VALID
    assert got.torque_nm == got.physics_nm == pytest.approx(value, abs=1e-9)
    scaled = sigma * (1.0, 1.2, 0.9, 1.4)[QUADRANTS.index(quadrant)]
    assert got.sigma_nm == pytest.approx(math.hypot(scaled, unproven(i, v, 7.0)), abs=1e-9)
    assert math.isnan(got.network_nm)
    assert math.isnan(got.tob_nm)


def fused_by_hand(view: float, v: float, torsion_nm: float, trust: float = 1.0) -> tuple[float, float]:
    """(value, sigma) of a view of the current path in the first quadrant and the torsion, in steady motion."""
    c = 0.3**2 + (0.2 * v) ** 2 + (0.04 * 3.0 * GAIN) ** 2 + ((1.0 - trust) * OUTSIDE * 40.0) ** 2
    t = 10.5**2 + (0.45 * torsion_nm) ** 2
    alpha = c / (c + t)
    noise = TRACKING.sigma_nm**2 + (TRACKING.viscous_nms_per_rad * v) ** 2 / (1.0 + (v / 0.2) ** 2)
    return view + alpha * (torsion_nm - view), math.hypot(
        0.5 * math.sqrt(alpha * t), alpha * math.sqrt(noise)
    )


PROVEN = 3000
"""Samples in motion, after which nothing of a torsion is left that is not proven."""


def test_a_network_takes_the_place_of_the_law_in_the_current_path() -> None:
    """Its view is tau_r and what it says; weights by both spreads; the physics stands beside it."""
    for v in (0.6, 1.0):
        got = steady(estimator(says(-1.5), track_zeros=False), 3.0, v, count=PROVEN)
        assert got.status == st.VALID
        assert got.network_nm == pytest.approx(3.0 * GAIN - 1.5, abs=1e-9)
        assert (got.torque_nm, got.sigma_nm) == pytest.approx(fused_by_hand(got.network_nm, v, 5.0), abs=1e-4)
        assert got.physics_nm == pytest.approx(physics(3.0, v, 5.0)[0], abs=1e-4)


def test_half_trusted_is_a_wider_sigma_and_less_weight() -> None:
    """Half a kelvin beyond the training range: the value stays, its spread grows."""
    got = steady(
        estimator(says(-1.5), track_zeros=False), 3.0, 1.0, temperature_c=TRAINED_C[1] + 0.5, count=PROVEN
    )
    assert got.network_nm == pytest.approx(3.0 * GAIN - 1.5, abs=1e-9)
    assert (got.torque_nm, got.sigma_nm) == pytest.approx(
        fused_by_hand(got.network_nm, 1.0, 5.0, 0.5), abs=1e-4
    )
    assert got.status == st.VALID, "the torsion is as good as it was"


def test_an_unknown_temperature_takes_the_trust() -> None:
    got = steady(estimator(says(-1.5), track_zeros=False), 3.0, 1.0, temperature_c=math.nan, count=PROVEN)
    assert (got.torque_nm, got.sigma_nm) == pytest.approx(
        fused_by_hand(3.0 * GAIN - 1.5, 1.0, 5.0, 0.0), abs=5e-3
    )
    none = steady(
        estimator(says(-1.5, temperature_c=None), track_zeros=False), 3.0, 1.0, 5.0, math.nan, PROVEN
    )
    assert (none.torque_nm, none.sigma_nm) == pytest.approx(
        fused_by_hand(3.0 * GAIN - 1.5, 1.0, 5.0), abs=1e-4
    )


def test_the_temperature_may_change_at_any_sample() -> None:
    e = estimator()
    for temperature in (25.0, 25.0, 31.5, math.nan, math.nan, 31.5, 20.0):
        got = steady(e, 3.0, 1.0, temperature_c=temperature, count=1)
    for temperature in (31.5, math.nan, 20.0, 20.0):
        got = steady(e, 3.0, 1.0, temperature_c=temperature, count=40)
        assert got.physics_nm == pytest.approx(physics(3.0, 1.0, 5.0, temperature)[0], abs=1e-9)


@pytest.mark.parametrize("answer", [math.nan, math.inf, -math.inf, 140.0, -140.0, 1e300])
def test_a_network_that_says_no_torque_is_refused(answer: float) -> None:
    """Limit three times 40 Nm; the record still shows what it said."""
    got = steady(estimator(says(answer)), 3.0, 1.0, count=30)
    alone = steady(estimator(track_torsion=True), 3.0, 1.0, count=30)
    assert got.status == st.DEGRADED
    assert (got.torque_nm, got.sigma_nm) == (alone.torque_nm, alone.sigma_nm)
    assert got.torque_nm == got.physics_nm
    assert got.network_nm == pytest.approx(3.0 * GAIN + answer, nan_ok=True)


def test_towards_standstill_the_torsion_takes_over() -> None:
    """The friction interval is in the spread of the view; at rest the estimate is that without a network."""
    for torsion_nm in (7.0, 18.0):
        for v, low, high in ((0.6, 0.62, 0.75), (0.03, 0.76, 0.9)):
            got = steady(estimator(says(-1.5), NARROW), 2.0, v, torsion_nm, count=200)
            view = 2.0 * GAIN - 1.5
            assert low < (got.torque_nm - view) / (torsion_nm - view) < high
        rest, alone = (
            steady(estimator(each, NARROW, track_torsion=True), 2.0, 0.0, torsion_nm, count=30)
            for each in (says(-1.5), None)
        )
        assert rest.status == st.STANDSTILL
        assert (rest.torque_nm, rest.sigma_nm) == (alone.torque_nm, alone.sigma_nm)


ONE = replace(PLAIN, fused=replace(PLAIN.fused, torsion=None, tracking=None))  # type: ignore[type-var]


def test_one_encoder_has_the_network_alone() -> None:
    got = steady(estimator(says(-1.5), ONE), 3.0, 0.6, count=30)
    assert (got.status, got.torque_nm) == (st.VALID, got.network_nm)
    spread = math.sqrt(0.3**2 + 0.12**2 + (0.04 * 3.0 * GAIN) ** 2)
    assert got.sigma_nm == pytest.approx(0.5 * spread, abs=1e-9)
    far = steady(estimator(says(-1.5), ONE), 3.0, 0.6, temperature_c=TRAINED_C[1] + 5.0, count=30)
    assert (far.status, far.torque_nm) == (st.DEGRADED, got.torque_nm)
    assert far.sigma_nm == pytest.approx(0.5 * math.hypot(spread, OUTSIDE * 40.0), abs=1e-9)
    rest = steady(estimator(says(-1.5), ONE), 3.0, 0.0, count=30)
    assert (rest.status, rest.torque_nm, rest.sigma_nm) == (st.STANDSTILL, rest.network_nm, 0.8)
    silent = steady(estimator(says(math.nan), ONE), 3.0, 0.6, count=30)
    assert (silent.status, silent.torque_nm) == (st.DEGRADED, silent.physics_nm)


# ---- statuses


def test_standstill_value_and_sigma() -> None:
    """The middle of the friction interval, drawn to the torsion; the smaller of both half widths."""
    for torsion_nm in (9.0, 15.0):
        got = steady(estimator(joint=NARROW), 2.0, 0.0, torsion_nm=torsion_nm)
        value, sigma, half = physics(2.0, 0.0, torsion_nm, joint=NARROW)
        assert half > 2.0
        assert got.status == st.STANDSTILL
        assert got.torque_nm == pytest.approx(value, abs=1e-9)
        assert abs(got.torque_nm - torsion_nm) < 0.1 * abs(2.0 * GAIN - torsion_nm)
        wide = math.hypot(STANDSTILL_SIGMAS * sigma, unproven(2.0, 0.0, torsion_nm, joint=NARROW))
        assert got.sigma_nm == pytest.approx(wide, abs=1e-9)
    assert PLAIN.fused is not None
    rigid = replace(PLAIN, fused=replace(PLAIN.fused, torsion=None))
    got = steady(estimator(joint=rigid), 2.0, 0.0)
    assert got.status == st.STANDSTILL
    assert got.sigma_nm == pytest.approx(1.15 * half + 0.2, abs=1e-9)
    assert got.torque_nm == pytest.approx(
        2.0 * GAIN - AdditiveLossModel(PLAIN.fused.loss).loss(12.4, 0.0, 0.0)[0]
    )


def test_a_calibrated_interval_at_rest_counts_what_is_left_open_in_full() -> None:
    """k standard deviations by the weights, and what friction and slip leave open as bounds."""
    assert NARROW.fused is not None
    assert NARROW.fused.torsion is not None
    slipping = replace(NARROW.fused.torsion, hysteresis_nm=1.5, hysteresis_travel_rad=2e-4)
    for torsion, open_nm in ((NARROW.fused.torsion, 0.0), (slipping, 1.5)):
        calibrated = replace(NARROW.fused, torsion=torsion, standstill=Standstill(1.8))
        got = steady(estimator(joint=replace(NARROW, fused=calibrated)), 2.0, 0.0, torsion_nm=7.0)
        raw, half = 2.0 * GAIN, physics(2.0, 0.0, 7.0, joint=NARROW)[2]
        c, t = 0.2**2 + (0.02 * raw) ** 2, 0.35**2 + (0.015 * 7.0) ** 2
        alpha = (c + half**2) / (c + half**2 + t + open_nm**2)
        spread = math.sqrt(alpha**2 * t + (1.0 - alpha) ** 2 * c)
        assert got.status == st.STANDSTILL
        interval = 1.8 * spread + alpha * open_nm + (1.0 - alpha) * half
        wide = math.hypot(interval, unproven(2.0, 0.0, 7.0, joint=NARROW, open_nm=open_nm))
        assert got.sigma_nm == pytest.approx(wide, abs=1e-9)


def test_views_apart_widen_a_calibrated_interval_at_rest() -> None:
    """By as many standard deviations as where nothing is calibrated."""
    assert NARROW.fused is not None
    loss, half = AdditiveLossModel(NARROW.fused.loss).loss(2.0 * GAIN, 0.0, 0.0)
    raw = 2.0 * GAIN
    c = 0.2**2 + (0.02 * raw) ** 2
    torsion_nm = raw - loss
    for _ in range(20):  # s_t grows with the torsion
        t = 0.35**2 + (0.015 * torsion_nm) ** 2
        distance = math.sqrt(c + half**2 + t)
        torsion_nm = raw - loss + half + 3.6 * math.sqrt(c + t)
    calibrated = replace(NARROW, fused=replace(NARROW.fused, standstill=Standstill(1.8)))
    got = steady(estimator(joint=calibrated), 2.0, 0.0, torsion_nm=torsion_nm)
    alpha = (c + half**2) / distance**2
    width = 1.8 * math.sqrt(alpha**2 * t + (1.0 - alpha) ** 2 * c) + (1.0 - alpha) * half
    more = max(alpha, 1.0 - alpha) * 0.6 * math.sqrt(c + t)
    assert got.status == st.STANDSTILL
    wide = math.hypot(width, STANDSTILL_SIGMAS * more, unproven(2.0, 0.0, torsion_nm, joint=NARROW))
    assert got.sigma_nm == pytest.approx(wide, rel=1e-6)


def test_a_friction_interval_is_about_the_current_path_not_about_the_value() -> None:
    """Friction that holds little: the far end of its interval counts, however wide the fusion's is."""
    assert NARROW.fused is not None
    wide = replace(NARROW, fused=replace(NARROW.fused, standstill=Standstill(50.0)))
    loss, half = AdditiveLossModel(NARROW.fused.loss).loss(2.0 * GAIN, 0.0, 0.0)
    for torsion_nm in (7.0, 10.0):
        got = steady(estimator(joint=wide), 2.0, 0.0, torsion_nm=torsion_nm)
        value = physics(2.0, 0.0, torsion_nm, joint=NARROW)[0]
        ends = 2.0 * GAIN - loss + np.array((-1.0, 1.0)) * (1.15 * half + 0.2)
        interval = math.hypot(np.abs(ends - value).max(), unproven(2.0, 0.0, torsion_nm, joint=NARROW))
        assert got.sigma_nm == pytest.approx(interval, abs=1e-9)


def test_more_than_three_times_rated_is_invalid() -> None:
    seen = set()
    for torsion_nm in range(100, 180, 5):
        got = steady(estimator(), 22.0, 1.0, torsion_nm=float(torsion_nm))
        value = physics(22.0, 1.0, float(torsion_nm))[0]
        assert got.physics_nm == pytest.approx(value, abs=1e-9)  # kept for the record in any case
        assert got.status == (st.INVALID if value > 120.0 else st.VALID)
        assert math.isnan(got.torque_nm) == math.isnan(got.sigma_nm) == (value > 120.0)
        seen.add(got.status)
    assert seen == {st.VALID, st.INVALID}


# ---- two views that disagree


def test_an_encoder_that_is_noisier_than_the_files_widens_sigma_by_its_noise() -> None:
    """13 µrad of white noise are 0.16 Nm; less what the file knows of, which alone widens nothing."""
    joint = replace(NARROW, fused=replace(NARROW.fused, tracking=TRACKING, agreement=None))  # type: ignore[type-var]
    loss = AdditiveLossModel(joint.fused.loss).loss(GAIN * 3.0, 1.0, 0.0)[0]  # type: ignore[union-attr]
    torsion_nm = GAIN * 3.0 - loss
    n, rng, runs = 4000, np.random.default_rng(4), []
    for noise_rad in (0.0, 6e-6, 13e-6):
        link = 1e-3 * np.arange(n)
        motor, read = 100.0 * (link + torsion_nm / K), link + rng.normal(0.0, noise_rad, n)
        columns = np.full(n, 3.0), motor, np.full(n, 100.0), read, np.full(n, 25.0)
        runs.append(FusedEstimator(joint, TRACKED).run(np.full(n, 1e-3), *columns))
    quiet, usual, noisy = (np.median(run.sigma_nm[2500:] ** 2) for run in runs)
    alpha = (
        Fusion(replace(joint.fused.sigma, reference_nm=0.0), True)
        .fuse(  # type: ignore[union-attr]
            *np.atleast_1d(GAIN * 3.0, 0.0, 1.0, torsion_nm)
        )
        .alpha[0]
    )
    assert usual == pytest.approx(quiet, rel=2e-3)
    assert noisy - quiet == pytest.approx(
        alpha**2 * ((13e-6 * K) ** 2 - 1.2 * TRACKING.sigma_nm**2), rel=0.15
    )


def test_views_apart_widen_sigma_at_once_and_lower_the_status() -> None:
    """3 standard deviations of their distance are free, sigma is what is more; from 4 on the status is 3."""
    value, sigma, _ = physics(3.0, 1.0, 5.0, joint=NARROW)
    loss = AdditiveLossModel(NARROW.fused.loss).loss(GAIN * 3.0, 1.0, 0.0)[0]  # type: ignore[union-attr]
    current = GAIN * 3.0 - loss
    c, t = (0.2**2 + 0.1**2 + (0.02 * GAIN * 3.0) ** 2), 0.35**2
    for sigmas, status in ((2.5, st.VALID), (3.5, st.VALID), (4.5, st.DEGRADED), (-9.0, st.DEGRADED)):
        torsion_nm = current
        for _ in range(20):  # s_t grows with the torsion
            torsion_nm = current + sigmas * math.sqrt(c + t + (0.015 * torsion_nm) ** 2)
        e = estimator(joint=NARROW)
        steady(e, 3.0, 1.0, torsion_nm=torsion_nm, count=1)
        got = e.step(0.001, 3.0, 100.0 * (0.001 + torsion_nm / K), 100.0, 0.001, 25.0)
        value, sigma, _ = physics(3.0, 1.0, torsion_nm, joint=NARROW)
        assert (got.status, got.torque_nm) == (status, pytest.approx(value, abs=1e-6))
        distance = math.sqrt(c + t + (0.015 * torsion_nm) ** 2)
        worse = max(abs(value - current), abs(value - torsion_nm)) / abs(torsion_nm - current)
        more = max(0.0, abs(sigmas) - 3.0) * distance * worse
        wide = math.hypot(sigma, more, unproven(3.0, 1.0, torsion_nm, joint=NARROW, samples=1))
        assert got.sigma_nm == pytest.approx(wide, abs=1e-6)
        if abs(sigmas) > 5.0:
            assert abs(torsion_nm - got.torque_nm) < 1.645 * got.sigma_nm + 3.0 * distance


def test_the_status_stays_lowered_for_a_moment() -> None:
    e = estimator(joint=NARROW)
    agreed = physics(3.0, 1.0, 5.0, joint=NARROW)[0]
    for _ in range(8):
        agreed = physics(3.0, 1.0, agreed, joint=NARROW)[0]
    steady(e, 3.0, 1.0, torsion_nm=agreed + 20.0, count=40)
    lowered = [steady(e, 3.0, 1.0, torsion_nm=agreed, count=1, first=k).status for k in range(40, 440)]
    assert lowered[0] == st.DEGRADED
    assert lowered[-1] == st.VALID
    back = lowered.index(st.VALID)
    assert 100 <= back < 150
    assert set(lowered[back:]) == {st.VALID}


def test_what_is_degraded_is_degraded_at_standstill() -> None:
    """Outside of the envelope, and two views apart: status 3, and a standard deviation in place of an interval."""
    own = replace(NARROW, fused=replace(NARROW.fused, envelope=everywhere()))  # type: ignore[type-var]
    cold = steady(estimator(joint=own), 2.0, 0.0, 10.0, temperature_c=TRAINED_C[0] - 5.0)
    assert cold.status == st.DEGRADED
    value, sigma, _ = physics(2.0, 0.0, 10.0, TRAINED_C[0] - 5.0, NARROW)
    wide = math.hypot(sigma, unproven(2.0, 0.0, 10.0, TRAINED_C[0] - 5.0, NARROW))
    assert (cold.torque_nm, cold.sigma_nm) == (pytest.approx(value), pytest.approx(wide))
    apart = steady(estimator(joint=NARROW), 2.0, 0.0, 90.0)
    assert apart.status == st.DEGRADED
    assert apart.sigma_nm > 10.0


def test_at_rest_the_distance_of_the_views_is_friction_and_takes_no_trust() -> None:
    """Else a standing joint is degraded and at rest by turns, as friction happens to lie."""
    close = replace(everywhere(), distance_nm=1.0)
    own = replace(NARROW, fused=replace(NARROW.fused, envelope=close))  # type: ignore[type-var]
    for torsion_nm in (11.0, 15.0, 18.0):
        assert steady(estimator(joint=own), 2.0, 0.0, torsion_nm).status == st.STANDSTILL
    assert steady(estimator(joint=own), 2.0, 1.0, 7.5).status == st.DEGRADED


def test_no_float_raises_and_no_number_is_published_without_a_status() -> None:
    """Seeded storms of ordinary, huge, tiny and absent numbers, also with a network that gives such."""
    seed = 8100
    rng = np.random.default_rng(seed)
    nasty = (0.0, -0.0, 1e-320, 1e-30, 0.001, 1.0, 50.0, 1e3, 1e9, 1e150, 1e300, 1.79e308, math.inf, math.nan)

    def draw() -> float:
        return float(rng.choice(nasty) * rng.choice((-1.0, 1.0)))

    seen = set()
    for round_ in range(6):
        e = estimator(says(lambda *_: draw()), joint=(PLAIN, fused_joint(round_))[round_ % 2])
        for k in range(2000):
            calm = rng.random() < 0.7
            dt = 0.001 if calm else draw()
            link = 0.9e-3 * k
            got = e.step(
                dt, *((2.0, 100 * (link + 5 / K), 90.0, link, 25.0) if calm else [draw() for _ in range(5)])
            )
            seen.add(got.status)
            published = got.status in st.PUBLISHED
            assert math.isfinite(got.torque_nm) == math.isfinite(got.sigma_nm) == published, (seed, round_)
            assert not published or (abs(got.torque_nm) <= 120.0 and got.sigma_nm > 0.0), (seed, round_)
    assert {st.STARTING, st.VALID, st.DEGRADED, st.INVALID} <= seen


def test_without_a_network_the_envelope_of_the_joint_file_lowers_the_status_and_nothing_else() -> None:
    """Half a step beyond the last known cell ends what the fit has seen; so do speed and temperature; rest is its own."""
    known = everywhere(velocity=2.0, torque=30.0)
    own = replace(PLAIN, fused=replace(PLAIN.fused, envelope=known))  # type: ignore[type-var]
    inside, light = steady(estimator(joint=own), 31.0 / GAIN, 1.0), steady(estimator(), 31.0 / GAIN, 1.0)
    assert inside[:3] == light[:3]
    assert inside.status == st.VALID
    heavy, plain = steady(estimator(joint=own), 32.0 / GAIN, 1.0), steady(estimator(), 32.0 / GAIN, 1.0)
    assert (heavy.torque_nm, heavy.sigma_nm) == (plain.torque_nm, plain.sigma_nm)
    assert (heavy.status, plain.status) == (st.DEGRADED, st.VALID)
    assert steady(estimator(joint=own), 3.0, 2.2).status == st.DEGRADED
    assert steady(estimator(joint=own), 3.0, 1.0, temperature_c=TRAINED_C[1] + 0.4).status == st.VALID
    assert steady(estimator(joint=own), 3.0, 1.0, temperature_c=TRAINED_C[1] + 0.6).status == st.DEGRADED
    close = replace(own, fused=replace(own.fused, envelope=replace(known, distance_nm=1.0)))  # type: ignore[type-var]
    assert steady(estimator(joint=close), 3.0, 1.0).status == st.DEGRADED
    assert steady(estimator(joint=close), 0.0, 0.0).status == st.STANDSTILL
    for share, status in (
        (1.01, st.VALID),
        (0.99, st.DEGRADED),
    ):  # of the load, however little the motor does
        load = replace(known, load_nm=share * abs(physics(-1.0, 1.0, -8.0)[0]))
        light = replace(own, fused=replace(own.fused, envelope=load))  # type: ignore[type-var]
        assert steady(estimator(joint=light), -1.0, 1.0, -8.0).status == status
    assert steady(estimator(says(-1.5), own), 32.0 / GAIN, 1.0).status == st.DEGRADED, (
        "with a network as well"
    )


# ---- runs

FIELDS = ("torque_nm", "sigma_nm", "status", "tob_nm", "physics_nm", "network_nm")


def test_the_door_for_run_tables() -> None:
    """`estimate_columns` is the same run, its steps from the time, its temperature from the table."""
    m = twisted(12)
    time = np.cumsum(m.dt_s)
    temperature = temperatures("rising", 12, len(time))
    network = PathNetwork(fused_network(12).data)
    inputs = m.arrays()[1:]
    columns = JointColumns(
        inputs[0], inputs[1], inputs[2], link_position_rad=inputs[3], temperature_c=temperature
    )
    joint = fused_joint(12)
    door = estimate_columns(joint, TRACKED, network, time, columns)
    steps = replace(m, dt_s=np.diff(time, prepend=time[0]))
    direct = FusedEstimator(joint, TRACKED, network).run(*steps.arrays(), temperature)
    for name in (*FIELDS, "features"):
        assert np.array_equal(getattr(door, name), getattr(direct, name), equal_nan=True), name
    with pytest.raises(
        ValueError, match="joint joint1: the run has no motor_velocity_rad_s, link_position_rad"
    ):
        estimate_columns(joint, FUSED, None, time, JointColumns(inputs[0], inputs[1]))


def test_features_are_what_the_network_gets() -> None:
    asked: list[tuple[float, ...]] = []

    def answer(*x: float) -> float:
        asked.append(x)
        return 0.0

    m, joint = twisted(3, 800), fused_joint(3)
    run = FusedEstimator(joint, TRACKED, FakeNetwork(answer)).run(*m.arrays(), None)
    running = np.isfinite(run.physics_nm)
    assert np.array(asked).tolist() == run.features[running].tolist()
    assert not np.isfinite(run.features[~running]).any()
    assert FusedEstimator(joint, TRACKED).run(*m.arrays(), None).features.shape == (800, 0)


def test_lengths_and_emptiness() -> None:
    joint = fused_joint()
    empty = FusedEstimator(joint, TRACKED, PathNetwork(fused_network().data)).run(
        *Motion(*([np.zeros(0)] * 5)).arrays(), None
    )
    assert all(len(getattr(empty, name)) == 0 for name in FIELDS)
    with pytest.raises(ValueError, match="expected all of one length"):
        observe_run(joint, FUSED, None, *([np.zeros(3)] * 4), np.zeros(4))
    with pytest.raises(ValueError, match="expected all of one length"):
        observe_run(joint, FUSED, None, *([np.zeros(3)] * 5), np.zeros(2))
    with pytest.raises(ValueError, match="read-only"):
        FusedEstimator(joint, FUSED, None).run(*twisted(1, 700).arrays(), None).torque_nm[0] = 1.0
