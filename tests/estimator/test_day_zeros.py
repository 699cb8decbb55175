"""Section `fused.zeros`: what is known of the day's zero is taken off value and sigma; where nothing is known, nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import SLOPE_NM, FusedEstimator, observe_run
from jtqd.estimator.fusion import Fusion, faded, levels, track_run
from jtqd.estimator.joint import DayZeros, Joint
from jtqd.estimator.losses import AdditiveLossModel
from tests.estimator.fused_helpers import SIGMA
from tests.estimator.test_agreement import AGREEMENT, WAVIER
from tests.estimator.test_fused_estimator import NARROW
from tests.estimator.test_zeros import OFF, ON, K, driven, error, tracked

DAYS = DayZeros(2.5e-5, 0.3, SIGMA.scale)
LEARNING = replace(NARROW, fused=replace(NARROW.fused, zeros=DAYS))  # type: ignore[type-var]


@pytest.mark.parametrize("zero", [2.5e-5, -3.5e-5])
def test_an_ordinary_zero_is_learned_and_the_interval_is_the_narrower_for_it(zero: float) -> None:
    columns, torque = driven(8.0, link_zero_rad=zero)
    without, known = tracked(columns)
    found, zeros = tracked(columns, LEARNING)
    assert abs(zeros.link_used_rad - zero) < 0.5 * abs(zero)
    assert error(found, torque) < 0.9 * error(without, torque)  # most of it is the age
    assert zeros.link_rad == pytest.approx(known.link_rad, abs=3e-6)
    moving = (found.status == st.VALID) & (np.arange(len(torque)) > 5000)
    assert found.sigma_nm[moving].mean() < 0.9 * without.sigma_nm[moving].mean()


def test_with_the_noise_of_the_fits_days_an_ordinary_zero_is_learned_sooner() -> None:
    columns, _ = driven(3.0, link_zero_rad=DAYS.spread_rad)
    quick = replace(LEARNING, fused=replace(LEARNING.fused, zeros=replace(DAYS, correlation_s=0.02)))  # type: ignore[type-var]
    (one, slow), (other, fast) = tracked(columns, LEARNING), tracked(columns, quick)
    assert abs(fast.link_used_rad - DAYS.spread_rad) < 0.6 * abs(slow.link_used_rad - DAYS.spread_rad)
    assert other.sigma_nm[-1] < one.sigma_nm[-1]
    # what is told, and what a joint that has changed is judged by, is as wary as before
    assert fast.link_rad == pytest.approx(slow.link_rad, rel=0.01)
    assert fast.link_sigma_rad == pytest.approx(slow.link_sigma_rad, rel=0.01)


def test_before_the_joint_has_moved_both_ways_value_and_sigma_are_those_of_the_file() -> None:
    one_way, _ = driven(0.4, velocity=lambda t: 1.0 + 0.3 * np.sin(2.5 * t), friction_nm=0.3)
    without, found = (tracked(one_way, joint)[0] for joint in (NARROW, LEARNING))
    moving = found.status == st.VALID
    np.testing.assert_allclose(found.sigma_nm[moving], without.sigma_nm[moving], rtol=0.06)
    np.testing.assert_allclose(found.torque_nm[moving], without.torque_nm[moving], atol=0.05)


def test_friction_of_the_day_is_at_most_a_part_of_the_spread() -> None:
    one_way, _ = driven(8.0, velocity=lambda t: 1.0 + 0.3 * np.sin(2.5 * t), friction_nm=0.3)
    assert abs(tracked(one_way, LEARNING)[1].link_used_rad) < DAYS.spread_rad
    both, _ = driven(8.0, friction_nm=0.3)
    assert abs(tracked(both, LEARNING)[1].link_used_rad) * K < 0.1


def test_a_zero_far_beyond_the_days_of_the_fit_is_found_as_without_the_section() -> None:
    columns, torque = driven(8.0, link_zero_rad=1e-3)
    found, zeros = tracked(columns, LEARNING)
    assert zeros.link_used_rad == pytest.approx(1e-3, abs=2e-5)
    assert error(found, torque) < 0.4
    assert found.status[-1] == st.VALID


def test_an_encoder_that_slips_makes_sigma_as_wide_as_the_file_s_again() -> None:
    at = np.where(np.arange(6000) < 4000, 0.0, 6e-4)
    columns, _ = driven(6.0, link_zero_rad=at)
    without, found = (tracked(columns, joint)[0] for joint in (NARROW, LEARNING))
    assert found.sigma_nm[3900] < 0.95 * without.sigma_nm[3900]
    slipped = slice(4310, 4500)  # views were apart for JUMP_S
    assert (found.sigma_nm[slipped] > 0.85 * without.sigma_nm[slipped]).all()


def test_fits_see_what_the_loop_does() -> None:
    """`track_run` and `levels` of the signals of a run: zeros, what is known of them, and what doubt adds of both."""
    columns, _ = driven(8.0, link_zero_rad=4e-5)
    dt, _, motor, _, link, temperature = columns
    wavy = link + 0.5 * (WAVIER(np.cumsum(dt), motor / 100.0, link) - link)
    columns = (*columns[:4], wavy, temperature)
    both = replace(LEARNING, fused=replace(LEARNING.fused, agreement=AGREEMENT))  # type: ignore[type-var]
    assert both.fused is not None
    seen = observe_run(both, ON, both.fused.torsion, *columns)
    on = seen.status == st.VALID
    raw, v, s, torsion, open_nm, half_dt = (
        x[on] for x in (seen.raw_nm, seen.velocity_rad_s, seen.direction, seen.torsion_nm, seen.open_nm, dt)
    )
    model = AdditiveLossModel(both.fused.loss)
    loss, half = model.loss_many(raw, v, temperature[on], s)
    slope = (model.loss_many(raw + SLOPE_NM, v, temperature[on], s)[0] - loss) / SLOPE_NM
    parts = (raw, faded(half, half_dt, np.ones(len(raw), bool)), v, torsion, open_nm)
    fusion = Fusion(both.fused.sigma, True)
    signals = (half_dt, torsion - (raw - loss), s, v, torsion, fusion.fuse(*parts).variance_nm2, slope)
    taken, _, known, *_ = track_run(both.fused, both.rated_torque_nm, *signals, np.full(len(raw), K))
    slow, fast, gain, left, _ = (each[-1] for each in levels(both.fused, both.rated_torque_nm, *signals))

    plain, zeros = tracked(columns, LEARNING)
    doubted, _ = tracked(columns, both)
    assert taken[-1] / K == pytest.approx(zeros.link_used_rad, rel=2e-3)
    last = int(np.flatnonzero(on)[-1])
    alpha = float(fusion.fuse(*parts, known_nm2=known).alpha[-1])
    doubt = AGREEMENT.level_factor**2 * (
        max(slow - AGREEMENT.slow_nm**2, 0.0) + max(fast - AGREEMENT.fast_nm**2, 0.0)
    )
    doubt += max(left**2 - AGREEMENT.zero_nm**2, 0.0)
    assert 0.05 < known[-1] < 0.5 * doubt
    doubt += (AGREEMENT.gain_factor * max(gain - AGREEMENT.gain, 0.0) * float(torsion[-1])) ** 2
    more = max(alpha, 1.0 - alpha) ** 2 * doubt + alpha**2 * known[-1]
    assert doubted.sigma_nm[last] ** 2 - plain.sigma_nm[last] ** 2 == pytest.approx(more, rel=0.03)
    assert alpha**2 * known[-1] > 0.06 * more


def test_what_is_not_yet_taken_off_is_not_known() -> None:
    n = 4000
    v = 1.2 * np.sin(2.5e-3 * np.arange(n) + 0.4)
    one, zero_nm = np.ones(n), 12.0
    assert LEARNING.fused is not None
    taken, _, known, *_ = track_run(
        LEARNING.fused,
        40.0,
        1e-3 * one,
        -zero_nm * one,
        np.sign(v),
        v,
        5.0 * np.sin(v),
        0.3 * one,
        0.0 * one,
        K * one,
    )
    late = zero_nm - taken
    assert taken[-1] == pytest.approx(zero_nm, rel=0.01)
    assert known[late > DAYS.spread_nm].max() < 1e-3
    assert known[-1] > 0.02


def test_where_zeros_are_not_tracked_the_section_changes_nothing() -> None:
    columns, _ = driven(link_zero_rad=5e-5)
    one, other = (FusedEstimator(joint, OFF).run(*columns) for joint in (NARROW, LEARNING))
    assert one.torque_nm.tobytes() == other.torque_nm.tobytes()
    assert one.sigma_nm.tobytes() == other.sigma_nm.tobytes()


def test_its_scale_counts_where_zeros_are_tracked() -> None:
    wider = replace(DAYS, scale=tuple(2.0 * each for each in DAYS.scale))
    joint = replace(LEARNING, fused=replace(LEARNING.fused, zeros=wider))  # type: ignore[type-var]
    columns, _ = driven(2.0)
    one, other = (tracked(columns, each)[0] for each in (LEARNING, joint))
    moving = (one.status == st.VALID) & (np.arange(len(one.status)) > 100)  # the two paths have met
    np.testing.assert_allclose(other.sigma_nm[moving], 2.0 * one.sigma_nm[moving], rtol=1e-9)


def test_before_the_zero_is_known_the_spread_is_wider_by_a_factor_that_fades() -> None:
    columns, _ = driven(8.0, link_zero_rad=2e-5)
    wary = replace(LEARNING, fused=replace(LEARNING.fused, zeros=replace(DAYS, early=1.8)))  # type: ignore[type-var]
    one, other = (tracked(columns, each)[0] for each in (LEARNING, wary))
    assert one.torque_nm.tobytes() == other.torque_nm.tobytes()
    moving = (one.status == st.VALID) & (np.arange(len(one.status)) > 100)
    factor = other.sigma_nm[moving] / one.sigma_nm[moving]
    assert 1.65 < factor[0] <= factor.max() <= 1.8
    assert 1.0 < factor[-1] < 1.4
    off, wide = (FusedEstimator(joint, OFF).run(*columns) for joint in (LEARNING, wary))
    assert off.sigma_nm.tobytes() == wide.sigma_nm.tobytes()


def test_without_the_key_nothing_is_wider() -> None:
    mapping = LEARNING.to_mapping()
    del mapping["fused"]["zeros"]["early"]
    old = Joint.from_mapping(mapping, "a.yaml")
    assert old.fused is not None
    assert old.fused.zeros is not None
    assert old.fused.zeros.early == 1.0
    columns, _ = driven(4.0, link_zero_rad=2e-5)
    dt, _, motor, *_ = columns
    on = np.full(len(dt), K)
    v = np.gradient(motor / 100.0, 1e-3)
    *_, early = track_run(
        old.fused, 40.0, dt, 0.1 * on / K, np.sign(v), v, 5.0 * on / K, 0.3 * on / K, 0.0 * on, on
    )
    assert np.array_equal(early, np.ones(len(dt)))


def test_a_file_says_it_and_one_that_cannot_be_is_refused() -> None:
    mapping = LEARNING.to_mapping()
    assert mapping["fused"]["zeros"]["spread_nm"] == 0.3
    assert Joint.from_mapping(mapping, "a.yaml") == LEARNING
    mapping["fused"]["zeros"]["early"] = 0.9
    with pytest.raises(
        ConfigError, match=r"a\.yaml.*fused\.zeros\.early.*found 0\.9, expected a number from 1"
    ):
        Joint.from_mapping(mapping, "a.yaml")
    mapping["fused"]["zeros"] |= {"early": 1.0, "spread_nm": 0.36}
    with pytest.raises(
        ConfigError, match=r"a\.yaml.*spread_nm.*0\.36.*less than sigma\.torsion_nm \(0\.35 Nm\)"
    ):
        Joint.from_mapping(mapping, "a.yaml")
