"""Agreement of the views: a joint that is no longer that of its file widens sigma; one that still is does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import SLOPE_NM, FusedEstimator, observe_run
from jtqd.estimator.fusion import DOWN_S, Fusion, faded, levels, track_run
from jtqd.estimator.joint import Agreement, Joint
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.test_fused_estimator import NARROW
from tests.estimator.test_zeros import OFF, ON, K, driven

AGREEMENT = Agreement(slow_nm=0.15, fast_nm=0.3, gain=0.02, zero_nm=0.6)
USUAL = replace(NARROW, fused=replace(NARROW.fused, agreement=AGREEMENT))  # type: ignore[type-var]
GAUSS = 1.645

Link = Callable[[FloatArray, FloatArray], FloatArray]
"""Link position of (time, motor's share, link position as the file has it)."""


def judged(
    change: Callable[[FloatArray, FloatArray, FloatArray], FloatArray] | None = None,
    joint: Joint = USUAL,
    settings: EstimatorSettings = ON,
    seconds: float = 8.0,
) -> tuple[EstimateRun, np.ndarray]:
    """Estimate a joint whose link position is changed; the estimates, and where value +- 1.645 sigma holds the torque."""
    columns, torque = driven(seconds)
    dt, current, motor, velocity, link, temperature = columns
    if change is not None:
        link = change(np.cumsum(dt), motor / 100.0, link)
    found = FusedEstimator(joint, settings).run(dt, current, motor, velocity, link, temperature)
    inside = (
        np.abs(found.torque_nm - low_pass(torque, dt, settings.bandwidth_rad_s)) <= GAUSS * found.sigma_nm
    )
    return found, np.asarray(inside)


SOFTER: Link = lambda t, motor, link: motor - 1.2 * (motor - link)  # noqa: E731
WAVIER: Link = lambda t, motor, link: link + 150e-6 * np.sin(200.0 * motor)  # noqa: E731
ECCENTRIC: Link = lambda t, motor, link: link + 150e-6 * np.sin(4.0 * link)  # noqa: E731
ZERO: Link = lambda t, motor, link: link + 200e-6  # noqa: E731


def test_a_joint_as_its_file_says_has_no_doubt() -> None:
    for settings in (ON, OFF):
        with_section, _ = judged(settings=settings)
        without, _ = judged(joint=NARROW, settings=settings)
        assert np.array_equal(with_section.torque_nm, without.torque_nm, equal_nan=True)
        ratio = with_section.sigma_nm[1:] / without.sigma_nm[1:]
        assert ratio.max() < 1.6
        assert ratio.mean() < 1.03
        assert np.array_equal(with_section.status, without.status)


@pytest.mark.parametrize("change", [SOFTER, WAVIER, ECCENTRIC], ids=["softer", "wavier", "eccentric"])
def test_one_thing_changed_since_the_fit_is_within_the_interval(change: Link) -> None:
    found, inside = judged(change)
    _, before = judged(change, NARROW)
    late = slice(1500, None)
    assert before[late].mean() < 0.75
    assert inside[late].mean() > 0.9
    # honest, not endless: it stays of the size of the error
    assert np.nanmean(found.sigma_nm[late]) < 0.05 * NARROW.rated_torque_nm


def test_a_zero_that_nobody_takes_off_is_doubt() -> None:
    _, before = judged(ZERO, NARROW, OFF)
    found, inside = judged(ZERO, USUAL, OFF)
    assert before[1500:].mean() < 0.75
    assert inside[1500:].mean() > 0.95
    tracked, _ = judged(ZERO)
    # what is taken off is no doubt any more
    assert np.nanmean(tracked.sigma_nm[-1000:]) < 0.5 * np.nanmean(found.sigma_nm[-1000:])


def test_great_doubt_lowers_the_status() -> None:
    found, _ = judged(lambda t, motor, link: motor - 1.5 * (motor - link))
    moving = found.status[2000:] != st.STANDSTILL
    assert np.mean(found.status[2000:][moving] == st.DEGRADED) > 0.9
    usual, _ = judged()
    assert np.mean(usual.status[200:] == st.DEGRADED) < 0.01


def test_a_doubt_that_ordinary_days_have_lowers_no_status_and_widens_sigma_as_before() -> None:
    usual, _ = judged(SOFTER)
    for lowered_nm, share in ((0.3, 0.5), (30.0, 0.0)):
        agreement = replace(AGREEMENT, lowered_nm=lowered_nm)
        joint = replace(USUAL, fused=replace(USUAL.fused, agreement=agreement))  # type: ignore[type-var]
        found, _ = judged(SOFTER, joint)
        assert np.mean(found.status[2000:] == st.DEGRADED) >= share
        assert share > 0.0 or np.array_equal(found.status, judged(SOFTER, NARROW)[0].status)
        moving = (found.status == st.VALID) & (usual.status != st.STANDSTILL)
        np.testing.assert_array_equal(found.sigma_nm[moving], usual.sigma_nm[moving])


def test_always_back_driven_a_friction_is_no_gain_that_lowers_the_status() -> None:
    """Torque against the motion throughout: a gain and a friction differ by so little that neither is sure."""
    n = 400 * 16
    t = np.arange(n) * 1e-3
    v = 2.0 * np.sin(2.0 * np.pi * 0.4 * t)
    every = replace(AGREEMENT, slow_nm=1e-3, fast_nm=1e-3, gain=0.0, zero_nm=0.0)
    s, fused = np.sign(v), replace(USUAL.fused, agreement=every)  # type: ignore[type-var]
    doubt = {}
    for name, torque in (("back-driven", -30.0 * s), ("both", np.where(t % 5.0 < 2.5, 30.0, -30.0))):
        apart = 0.03 * torque  # of a gain; against the motion also that of a friction
        *_, gain, _, sure = levels(
            fused,
            USUAL.rated_torque_nm,
            *(np.full(n, 1e-3), apart, s, v, torque, np.full(n, 0.2), np.zeros(n)),
        )
        doubt[name] = gain[-1], sure[-1]
    for name, least, most in (("both", 0.75, 1.0), ("back-driven", 0.0, 0.4)):
        gain, sure = doubt[name]
        assert gain > 0.02
        assert least < sure / (AGREEMENT.gain_factor * gain * 30.0) < most


def test_doubt_fades_when_the_joint_is_again_that_of_its_file() -> None:
    mended, _ = judged(
        lambda t, motor, link: np.where(t < 3.0, WAVIER(t, motor, link), link), seconds=12.0 + DOWN_S
    )
    usual, _ = judged(seconds=12.0 + DOWN_S)
    more = mended.sigma_nm / usual.sigma_nm
    assert np.nanmedian(more[2500:3000]) > 2.0
    assert np.nanmedian(more[-1000:]) < 0.5 * np.nanmedian(more[2500:3000])


def test_sigma_is_the_formula_of_the_levels() -> None:
    """What the estimator adds is recomputed from the signals of the whole run, zeros not taken off."""
    columns, _ = driven(6.0)
    dt, current, motor, velocity, link, temperature = columns
    link = WAVIER(np.cumsum(dt), motor / 100.0, link) + 10e-6
    fused = USUAL.fused
    assert fused is not None
    arrays = (dt, current, motor, velocity, link, temperature)
    got = FusedEstimator(USUAL, OFF).run(*arrays)
    plain = FusedEstimator(NARROW, OFF).run(*arrays)
    seen = observe_run(USUAL, OFF, fused.torsion, *arrays)
    model, on = AdditiveLossModel(fused.loss), seen.status == st.VALID
    raw, v, s = (np.where(np.isnan(x), 0.0, x) for x in (seen.raw_nm, seen.velocity_rad_s, seen.direction))
    loss, half = model.loss_many(raw, v, temperature, s)
    more, _ = model.loss_many(raw + SLOPE_NM, v, temperature, s)
    half = faded(half, dt, ~np.isnan(seen.raw_nm))
    apart = np.where(on, seen.torsion_nm - (raw - loss), 0.0)
    parts = (raw, half, v, np.where(on, seen.torsion_nm, 0.0), np.where(on, seen.open_nm, 0.0))
    alpha, _, _, variance = Fusion(fused.sigma, True).fuse(*parts)
    # `levels` tracks zeros: in so short a run, and with so small a zero, nothing is taken off
    slow, fast, gain, left, sure = levels(
        fused,
        USUAL.rated_torque_nm,
        *(x[on] for x in (dt, apart, s, v, parts[3], variance, (more - loss) / SLOPE_NM)),
    )
    last = np.flatnonzero(on)[-1]
    doubt = AGREEMENT.level_factor**2 * (
        max(slow[-1] - AGREEMENT.slow_nm**2, 0.0) + max(fast[-1] - AGREEMENT.fast_nm**2, 0.0)
    )
    doubt += max(left[-1] ** 2 - AGREEMENT.zero_nm**2, 0.0)
    doubt += (AGREEMENT.gain_factor * max(gain[-1] - AGREEMENT.gain, 0.0) * parts[3][last]) ** 2
    share = max(alpha[last], 1.0 - alpha[last])
    assert doubt > 0.1
    assert sure[-1] ** 2 <= doubt * 1.02
    assert got.sigma_nm[last] ** 2 - plain.sigma_nm[last] ** 2 == pytest.approx(share**2 * doubt, rel=0.02)


def test_a_run_observed_before_is_estimated_alike() -> None:
    columns, _ = driven(3.0)
    fused = USUAL.fused
    assert fused is not None
    seen = observe_run(USUAL, OFF, fused.torsion, *columns)
    whole, again = FusedEstimator(USUAL, OFF).run(*columns), FusedEstimator(USUAL, OFF)
    for _ in range(2):  # the second time nothing is left of the first
        found = again.run_observed(seen)
        np.testing.assert_allclose(found.sigma_nm, whole.sigma_nm, rtol=1e-6, equal_nan=True)


def test_of_a_gain_only_what_is_beyond_its_own_standard_deviations_is_doubt() -> None:
    """Always driven, so that friction and a gain differ by little; `levels` says the gain that is left."""
    fused = USUAL.fused
    assert fused is not None
    n = 6000
    v, one = 1.2 * np.sin(2.5e-3 * np.arange(n) + 0.4), np.ones(n)
    torque = 20.0 * np.sign(v)
    signals = (1e-3 * one, 0.05 * torque, np.sign(v), v, torque, 0.3 * one, 0.0 * one)
    loud = replace(AGREEMENT, slow_nm=20.0, fast_nm=20.0, gain=0.002, zero_nm=20.0)
    found = []
    for sigmas in (0.0, 0.5, 1.0, 10.0):
        of_file = replace(fused, agreement=replace(loud, gain_sigmas=sigmas))
        *_, doubt, _ = track_run(of_file, USUAL.rated_torque_nm, *signals, K * one, False)
        gain = levels(of_file, USUAL.rated_torque_nm, *signals)[2][-1]
        assert doubt[-1] == pytest.approx(loud.gain_factor * max(gain - 0.002, 0.0), rel=1e-9)
        found.append(gain)
    assert found[0] > 0.02
    assert found[0] - found[1] == pytest.approx(found[1] - found[2], rel=1e-9)
    assert found[0] > found[1] > found[2]
    assert found[3] == 0.0


def test_a_zero_that_is_not_taken_off_counts_by_its_factor() -> None:
    fused = USUAL.fused
    assert fused is not None
    n = 4000
    v, one = 1.2 * np.sin(2.5e-3 * np.arange(n) + 0.4), np.ones(n)
    signals = (1e-3 * one, -2.0 * one, np.sign(v), v, 5.0 * np.sin(v), 0.3 * one, 0.0 * one, K * one)
    loud = replace(AGREEMENT, slow_nm=20.0, fast_nm=20.0, gain=1.0)
    doubts = [
        track_run(
            replace(fused, agreement=replace(loud, zero_factor=factor)),
            USUAL.rated_torque_nm,
            *signals,
            False,
        )[3]
        for factor in (1.0, 1.5)
    ]
    assert doubts[0].max() > 1.0
    np.testing.assert_allclose(doubts[1], 2.25 * doubts[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("slow_nm", 0.0),
        ("fast_nm", -1.0),
        ("gain", -0.1),
        ("zero_nm", float("nan")),
        ("zero_factor", 0.9),
        ("gain_sigmas", -0.1),
    ],
)
def test_levels_that_cannot_be_are_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key):
        replace(AGREEMENT, **{key: value})


def test_the_section_survives_a_file() -> None:
    assert Joint.from_mapping(USUAL.to_mapping(), "joint.yaml") == USUAL
    assert USUAL.fused.torsion.stiffness_nm_per_rad == K  # type: ignore[union-attr]
