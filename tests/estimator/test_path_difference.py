"""Difference of the two paths: offsets of the day, agreement with the joint file, waves over the motor's turn, the state."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.daemon.shared.snapshot import PAST_WORDS
from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import (
    SLOPE_NM,
    Estimator,
    FusedEstimator,
    make_estimator,
    observe_run,
    quadrants,
)
from jtqd.estimator.fusion import (
    DOWN_S,
    EVERY,
    LEAST_S,
    TURN_BLOCK,
    TURN_MEMORY_S,
    TURN_TREND_S,
    Fusion,
    faded,
    levels,
    track_run,
    turn_waves,
)
from jtqd.estimator.joint import TURN_WAVES, Agreement, Effect, Joint, Turn
from jtqd.estimator.losses import AdditiveLossModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import LEARNED, PAST_LAYOUT, TRACKED, Zeros, same_past
from tests.estimator.fused_helpers import (
    AGREEMENT,
    DAYS,
    LEARNING,
    NARROW,
    OFF,
    ON,
    SIGMA,
    TRACKING,
    USUAL,
    FakeNetwork,
    K,
    driven,
    wavier,
    with_section,
)

LIMITED = with_section(torsion=replace(NARROW.fused.torsion, zero_limit_rad=5e-4))  # type: ignore[type-var, union-attr]

# ---- offsets


def tracked(columns: tuple[FloatArray, ...], joint: Joint = NARROW) -> tuple[EstimateRun, Zeros]:
    e = FusedEstimator(joint, ON)
    run = e.run(*columns)
    assert e.zeros is not None
    return run, e.zeros


def error(run: EstimateRun, torque: FloatArray, last: int = 1500) -> float:
    return float(np.sqrt(np.mean((run.torque_nm - torque)[-last:] ** 2)))


@pytest.mark.parametrize("zero", [1e-4, -1e-3])
def test_a_zero_of_the_link_encoder_is_taken_off_and_reported(zero: float) -> None:
    columns, torque = driven(link_zero_rad=zero)
    run, zeros = tracked(columns)
    assert zeros.link_rad == pytest.approx(zero, abs=1e-5)
    assert zeros.link_used_rad == pytest.approx(zero, abs=1e-5)
    assert abs(zeros.link_rad - zero) < 3.0 * zeros.link_sigma_rad < 4e-5
    assert zeros.plausible
    without = FusedEstimator(NARROW, OFF).run(*columns)
    assert error(without, torque) > 0.2
    assert error(run, torque) < 0.4 * error(without, torque)
    assert run.status[-1] == st.VALID


def test_where_there_is_no_zero_nothing_is_changed() -> None:
    columns, _ = driven()
    run, zeros = tracked(columns)
    assert (zeros.link_used_rad, zeros.current_used_a) == (0.0, 0.0)
    np.testing.assert_array_equal(run.torque_nm, FusedEstimator(NARROW, OFF).run(*columns).torque_nm)


def test_a_zero_that_the_files_sigma_covers_is_known_and_left_alone() -> None:
    """0.3 Nm where the file's sigma of the torsion is 0.35: however long it is seen, it may be an error of model."""
    columns, _ = driven(8.0, link_zero_rad=2.5e-5)
    zeros = tracked(columns)[1]
    assert zeros.link_rad == pytest.approx(2.5e-5, abs=8e-6)
    assert abs(zeros.link_used_rad) < 5e-6
    assert 4.0 * zeros.link_sigma_rad < 4e-5


def test_friction_is_no_zero_and_motion_one_way_does_not_separate_them() -> None:
    """0.3 Nm more friction than the file has: one and a half of its standard deviations."""
    one_way, _ = driven(velocity=lambda t: 1.0 + 0.3 * np.sin(2.5 * t), friction_nm=0.3)
    zeros = tracked(one_way)[1]
    assert zeros.link_sigma_rad * K > 0.8 * SIGMA.current_nm
    assert zeros.link_used_rad == 0.0
    both, _ = driven(friction_nm=0.3)
    zeros = tracked(both)[1]
    assert zeros.link_sigma_rad * K < 0.7 * SIGMA.current_nm
    assert abs(zeros.link_rad) * K < 0.1
    assert zeros.link_used_rad == 0.0


def test_a_push_of_10_nm_is_no_zero() -> None:
    columns, _ = driven(
        load=lambda t: 8.0 * np.sin(1.7 * t) + np.where(t > 2.0, 10.0, 0.0), link_zero_rad=1e-4
    )
    assert tracked(columns)[1].link_rad == pytest.approx(1e-4, abs=1.2e-5)


def test_at_rest_nothing_is_learned() -> None:
    columns, _ = driven(velocity=lambda t: 0.0 * t, link_zero_rad=3e-4)
    zeros = tracked(columns)[1]
    assert (zeros.link_rad, zeros.link_used_rad) == (0.0, 0.0)
    assert zeros.link_sigma_rad == pytest.approx(0.3 * 40.0 / K)


def test_an_encoder_that_slips_in_the_run_is_found_again() -> None:
    at = np.where(np.arange(8000) < 4000, 0.0, 6e-4)
    columns, torque = driven(8.0, link_zero_rad=at)
    run, zeros = tracked(columns)
    assert zeros.link_used_rad == pytest.approx(6e-4, abs=5e-6)
    assert st.DEGRADED in run.status[4000:4100]
    assert run.status[-1] == st.VALID
    assert error(run, torque) < 0.3


@pytest.mark.parametrize("joint", [NARROW, USUAL], ids=["plain", "agreement"])
@pytest.mark.parametrize(("zero", "encoder"), [(1e-3, 4), (-1e-3, 4), (1e-3, 2), (3e-4, 4)])
def test_a_spike_of_an_encoder_does_not_cost_what_was_learned(
    joint: Joint, zero: float, encoder: int
) -> None:
    """20 ms in motion, large and small, long after the offset was learned: a second later all is as without it."""
    columns, torque = driven(12.0, link_zero_rad=zero)
    usual, known = tracked(columns, joint)
    for share in (0.3, 1e-3):
        broken = [each.copy() for each in columns]
        broken[encoder][9000:9020] += share * np.ptp(columns[encoder])
        found, zeros = tracked(tuple(broken), joint)
        assert st.DEGRADED in found.status[9000:9050]
        assert zeros.link_used_rad == pytest.approx(known.link_used_rad, abs=5e-6)
        assert error(found, torque, 2000) < 1.1 * error(usual, torque, 2000)


def test_a_link_encoder_that_drifts_and_comes_back_leaves_what_was_learned() -> None:
    """0.4 mrad in 0.9 s are learned as an offset; the step back is out of order."""
    columns, torque = driven(12.0, link_zero_rad=3e-4)
    usual, _ = tracked(columns)
    columns[4][7000:7900] += np.linspace(0.0, 4e-4, 900)
    after = slice(8200, 9700)
    rms = [np.sqrt(np.mean((each.torque_nm - torque)[after] ** 2)) for each in (tracked(columns)[0], usual)]
    assert rms[0] < 1.1 * rms[1]


def test_a_current_that_is_off_for_a_while_is_forgotten_in_a_second() -> None:
    """12 Nm for 0.3 s: paths as far apart the one way as the other do not agree by what they have learned."""
    columns, torque = driven(9.5, link_zero_rad=3e-4)
    usual, _ = tracked(columns)
    columns[1][7000:7300] += 2.0
    assert error(tracked(columns)[0], torque, 1000) < 1.25 * error(usual, torque, 1000)


@pytest.mark.parametrize("gain", [0.85, 1.15])
def test_a_gain_that_has_changed_is_not_in_agreement_where_there_is_no_load(gain: float) -> None:
    """Seen under 15 Nm for 3 s; without load the paths agree by what was kept before it, as they would by any gain."""

    def load(t: FloatArray) -> FloatArray:
        high = np.convolve(np.where((t > 5.0) & (t < 8.0), 15.0, 0.0), np.full(200, 5e-3), "same")
        swing: FloatArray = np.where(t < 5.0, 8.0, 2.0) * np.sin(1.7 * t)
        return high + swing

    columns, _ = driven(11.0, load=load, link_zero_rad=3e-4)
    columns[1][5000:] *= gain
    run, _ = tracked(columns, USUAL)
    assert st.VALID in run.status[3000:5000]
    assert set(run.status[8000:]) == {st.DEGRADED}


@pytest.mark.parametrize("at", [1000, 1500])
def test_a_spike_before_anything_is_kept_costs_a_second(at: int) -> None:
    columns, torque = driven(6.0, link_zero_rad=1e-3)
    columns[4][at : at + 20] += 1e-3
    run, zeros = tracked(columns)
    assert zeros.link_used_rad == pytest.approx(1e-3, abs=1e-5)
    assert error(run, torque, 1500) < 0.2


def test_a_zero_beyond_the_limit_of_the_file_is_not_plausible_and_lowers_the_status() -> None:
    columns, _ = driven(link_zero_rad=1e-3)
    run, zeros = tracked(columns, LIMITED)
    assert not zeros.plausible
    assert run.status[-1] == st.DEGRADED


def test_reset_forgets_and_a_gap_does_not() -> None:
    columns, _ = driven(link_zero_rad=1e-3)
    e = FusedEstimator(NARROW, ON)
    e.run(*columns)
    known = e.zeros
    e.step(10.0, 0.0, 0.0, 0.0, 0.0)
    assert e.zeros == known
    e.reset()
    assert e.zeros is not None
    assert (e.zeros.link_rad, e.zeros.link_used_rad) == (0.0, 0.0)


def test_without_torsion_or_where_it_is_not_wanted_there_are_none() -> None:
    rigid = replace(NARROW, fused=replace(NARROW.fused, torsion=None))  # type: ignore[type-var]
    assert FusedEstimator(rigid, ON).zeros is None
    assert FusedEstimator(NARROW, OFF).zeros is None


# ---- spread of the offset over the days


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
    quick = with_section(zeros=replace(DAYS, correlation_s=0.02))
    (one, slow), (other, fast) = tracked(columns, LEARNING), tracked(columns, quick)
    assert abs(fast.link_used_rad - DAYS.spread_rad) < 0.6 * abs(slow.link_used_rad - DAYS.spread_rad)
    assert other.sigma_nm[-1] < one.sigma_nm[-1]
    # what is reported, and what a joint that has changed is judged by, is as wary as before
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
    wavy = link + 0.5 * (wavier(np.cumsum(dt), motor / 100.0, link) - link)
    columns = (*columns[:4], wavy, temperature)
    both = with_section(LEARNING, agreement=AGREEMENT)
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
    none = np.zeros(len(raw))
    whole = (half_dt, *parts, signals[1], s, slope, none + K, none, none, none > 0.0)
    _, taken, *_, known = track_run(both.fused, both.rated_torque_nm, *whole)
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
    doubt += (AGREEMENT.gain_factor * max(gain - AGREEMENT.gain, 0.0) * float(torsion[-1])) ** 2
    more = max(alpha, 1.0 - alpha) ** 2 * doubt
    assert doubted.sigma_nm[last] ** 2 - plain.sigma_nm[last] ** 2 == pytest.approx(more, rel=0.03)


def run_of(v: FloatArray, difference_nm: FloatArray, torsion_nm: FloatArray) -> tuple[FloatArray, ...]:
    """What `track_run` takes of a run at 1 kHz whose friction is one-sided and whose loss does not depend on the load."""
    none = np.zeros(len(v))
    raw = torsion_nm - difference_nm
    return (
        1e-3 + none,
        raw,
        none,
        v,
        torsion_nm,
        none,
        difference_nm,
        np.sign(v),
        none,
        K + none,
        none,
        none,
        none > 0.0,
    )


def test_what_the_torsion_is_ahead_by_counts_whole_until_it_is_proven() -> None:
    """3 Nm ahead, a bound of three standard deviations, as the rest of U."""
    assert USUAL.fused is not None
    run = run_of(np.full(3000, 1.0), np.zeros(3000), np.full(3000, 5.0))
    alpha, *_, more, _ = track_run(USUAL.fused, USUAL.rated_torque_nm, *run, False)
    wider = track_run(USUAL.fused, USUAL.rated_torque_nm, *run[:10], run[10] + 3.0, *run[11:], False)[4]
    assert wider[0] ** 0.5 - more[0] ** 0.5 == pytest.approx(alpha[0] * 3.0 / 3.0, rel=1e-3)
    assert wider[-1] == pytest.approx(more[-1], abs=1e-6)


def test_what_the_tracking_filter_leaves_of_two_readings_is_added_where_both_share_it() -> None:
    assert USUAL.fused is not None
    run = run_of(np.full(300, 1.0), np.zeros(300), np.full(300, 5.0))
    *_, more, _ = track_run(USUAL.fused, USUAL.rated_torque_nm, *run, False)
    left = np.where(np.arange(300) % 2, 0.49, -0.25)
    wider = track_run(USUAL.fused, USUAL.rated_torque_nm, *run[:11], left, run[12], False)[4]
    np.testing.assert_allclose(wider - more, np.maximum(left, 0.0), atol=1e-12)


def test_what_is_not_yet_taken_off_is_not_known() -> None:
    n = 4000
    v = 1.2 * np.sin(2.5e-3 * np.arange(n) + 0.4)
    one, zero_nm = np.ones(n), 12.0
    assert LEARNING.fused is not None
    _, taken, *_, known = track_run(LEARNING.fused, 40.0, *run_of(v, -zero_nm * one, 5.0 * np.sin(v)))
    late = zero_nm - taken
    assert taken[-1] == pytest.approx(zero_nm, rel=0.01)
    assert known[late > DAYS.spread_nm].max() < 1e-3
    assert known[-1] > 0.02


def test_where_zeros_are_not_tracked_the_section_changes_nothing() -> None:
    columns, _ = driven(link_zero_rad=5e-5)
    one, other = (FusedEstimator(joint, OFF).run(*columns) for joint in (NARROW, LEARNING))
    assert one.torque_nm.tobytes() == other.torque_nm.tobytes()
    assert one.sigma_nm.tobytes() == other.sigma_nm.tobytes()


def of_scale(columns: tuple[FloatArray, ...], joint: Joint, settings: EstimatorSettings = ON) -> FloatArray:
    """Part of sigma^2 [n] that is a factor of the file times the spread: sigma^2 = scale^2 spread^2 + more."""
    assert joint.fused is not None
    fused = joint.fused
    found = []
    for factor in (1.0, 2.0, 3.0):
        scale = tuple(factor * each for each in fused.sigma.scale)
        wider = replace(fused, sigma=replace(fused.sigma, scale=scale))
        if fused.zeros is not None:
            days = tuple(factor * each for each in fused.zeros.scale)
            wider = replace(wider, zeros=replace(fused.zeros, scale=days))
        found.append(FusedEstimator(replace(joint, fused=wider), settings).run(*columns))
    one, two, three = (run.sigma_nm**2 for run in found)
    moving = np.isin(found[0].status, (st.VALID, st.DEGRADED))
    part = np.where(moving, (two - one) / 3.0, np.nan)
    np.testing.assert_allclose((three - one)[moving], 8.0 * part[moving], rtol=1e-9)
    return part


UNSEEN = DAYS.spread_rad**2 / (DAYS.spread_rad**2 + (0.3 * NARROW.rated_torque_nm / K) ** 2)
"""Known part of the day's offset before the first block: the prior is 0.3 of the rated torque."""


def test_its_scale_counts_where_zeros_are_tracked() -> None:
    """What the doubled scale adds is three times the square of the file's scale times the spread, and nothing else."""
    joint = with_section(zeros=replace(DAYS, scale=(0.5, 0.6, 0.7, 0.8)))
    columns, _ = driven(2.0)
    assert joint.fused is not None
    part, found = of_scale(columns, joint), tracked(columns, joint)[0]
    seen = observe_run(joint, ON, joint.fused.torsion, *columns)
    model = AdditiveLossModel(joint.fused.loss)
    on = np.flatnonzero(np.isfinite(part))[:15]  # before the first block
    raw, v, s = seen.raw_nm[on], seen.velocity_rad_s[on], seen.direction[on]
    half = faded(model.loss_many(raw, v, columns[5][on], s)[1], columns[0][on], on >= 0)
    known = np.full(len(on), UNSEEN * DAYS.spread_nm**2)
    paths = Fusion(replace(joint.fused.sigma, reference_nm=0.0), True)
    file = (raw, half, v, seen.torsion_nm[on], seen.open_nm[on])
    alpha, (share, *_, variance) = paths.fuse(*file, known_nm2=known).alpha, paths.fuse(*file)
    rest = (1.0 - share) * variance - DAYS.spread_nm**2  # of the torsion, without the day's offset
    spread = np.sqrt(alpha * rest)
    scale = np.array(joint.fused.zeros.scale)[quadrants(raw, v)]  # type: ignore[union-attr]
    np.testing.assert_allclose(part[on], (scale * spread) ** 2, rtol=1e-6)
    assert (found.sigma_nm[on] ** 2 - part[on]).min() > 0.0


def test_what_is_not_known_of_the_day_counts_whole_up_to_its_weight() -> None:
    """Paths that agree in motion one way may share their error: with motion both ways it is known."""
    assert LEARNING.fused is not None
    one = np.ones(4000)
    for v, bounded in ((one, True), (np.sin(2.5e-3 * np.arange(4000) + 0.4), False)):
        run = run_of(v, 0.0 * one, 5.0 * one)
        (alpha, *_, more, known), (*_, others, _) = (
            track_run(LEARNING.fused, 40.0, *run, on) for on in (True, False)
        )
        expected = alpha * DAYS.spread_nm**2 if bounded else DAYS.spread_nm**2 - known
        np.testing.assert_allclose((more - others)[3000:], expected[3000:], rtol=1e-6, atol=1e-9)


def test_a_file_with_the_factor_of_before_is_read_and_the_same() -> None:
    mapping = LEARNING.to_mapping()
    assert "early" not in mapping["fused"]["zeros"]
    mapping["fused"]["zeros"]["early"] = 1.8
    columns, _ = driven(2.0, link_zero_rad=2e-5)
    old = tracked(columns, Joint.from_mapping(mapping, "a.yaml"))[0]
    assert old.sigma_nm.tobytes() == tracked(columns, LEARNING)[0].sigma_nm.tobytes()


# ---- agreement

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


def held_by_spread(change: Link, settings: EstimatorSettings = ON) -> np.ndarray:
    """Where the scaled spread alone holds the torque of the changed joint, in motion after 1.5 s."""
    columns, torque = driven(8.0)
    dt, current, motor, velocity, link, temperature = columns
    columns = (dt, current, motor, velocity, change(np.cumsum(dt), motor / 100.0, link), temperature)
    part = of_scale(columns, NARROW, settings)
    error = FusedEstimator(NARROW, settings).run(*columns).torque_nm - low_pass(
        torque, dt, settings.bandwidth_rad_s
    )
    late = np.isfinite(part) & (np.arange(len(dt)) >= 1500)
    return np.asarray(np.abs(error[late]) <= GAUSS * np.sqrt(part[late]))


SOFTER: Link = lambda t, motor, link: motor - 1.2 * (motor - link)  # noqa: E731
ECCENTRIC: Link = lambda t, motor, link: link + 150e-6 * np.sin(4.0 * link)  # noqa: E731
ZERO: Link = lambda t, motor, link: link + 200e-6  # noqa: E731


def test_a_joint_that_is_its_file_s_has_no_mismatch() -> None:
    for settings in (ON, OFF):
        with_section, _ = judged(settings=settings)
        without, _ = judged(joint=NARROW, settings=settings)
        assert np.array_equal(with_section.torque_nm, without.torque_nm, equal_nan=True)
        ratio = with_section.sigma_nm[1:] / without.sigma_nm[1:]
        assert ratio.max() < 1.6
        assert ratio.mean() < 1.03
        assert np.array_equal(with_section.status, without.status)


@pytest.mark.parametrize("change", [SOFTER, wavier, ECCENTRIC], ids=["softer", "wavier", "eccentric"])
def test_one_thing_changed_since_the_fit_is_within_the_interval(change: Link) -> None:
    found, inside = judged(change)
    late = slice(1500, None)
    assert held_by_spread(change).mean() < 0.8
    assert inside[late].mean() > 0.9
    # honest, not endless: it stays of the size of the error
    assert np.nanmean(found.sigma_nm[late]) < 0.05 * NARROW.rated_torque_nm


def test_a_zero_that_nobody_takes_off_is_doubt() -> None:
    found, inside = judged(ZERO, USUAL, OFF)
    assert held_by_spread(ZERO, OFF).mean() < 0.75
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


@pytest.mark.parametrize("frozen", [1, 3])
def test_what_was_learned_from_a_current_or_a_velocity_at_fault_is_forgotten(frozen: int) -> None:
    """It stands still for a second of motion; a second after its end all is as if it had not been."""
    columns, _ = driven(8.0, link_zero_rad=1e-4)
    broken = [each.copy() for each in columns]
    broken[frozen][4000:5000] = broken[frozen][4000]
    usual, zeros = tracked(columns, USUAL)
    found, after = tracked(tuple(broken), USUAL)
    assert np.isin(found.status[4000:5000], (st.DEGRADED, st.STANDSTILL, st.INVALID)).mean() > 0.3
    late = slice(6000, None)
    assert after.link_used_rad == pytest.approx(zeros.link_used_rad, abs=1e-5)
    assert np.mean(found.status[late] != usual.status[late]) < 0.01
    assert np.nanmax(found.sigma_nm[late] / usual.sigma_nm[late]) < 1.5


def test_a_doubt_that_ordinary_days_have_lowers_no_status_and_widens_sigma_as_before() -> None:
    usual, _ = judged(SOFTER)
    for lowered_nm, share in ((0.3, 0.5), (30.0, 0.0)):
        agreement = replace(AGREEMENT, lowered_nm=lowered_nm)
        joint = with_section(agreement=agreement)
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
    s, fused = np.sign(v), with_section(agreement=every).fused
    assert fused is not None
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
        lambda t, motor, link: np.where(t < 3.0, wavier(t, motor, link), link), seconds=12.0 + DOWN_S
    )
    usual, _ = judged(seconds=12.0 + DOWN_S)
    more = mended.sigma_nm / usual.sigma_nm
    assert np.nanmedian(more[2500:3000]) > 2.0
    assert np.nanmedian(more[-1000:]) < 0.5 * np.nanmedian(more[2500:3000])


def test_sigma_is_the_formula_of_the_levels() -> None:
    """What the estimator adds is recomputed from the signals of the whole run, zeros not taken off."""
    columns, _ = driven(6.0)
    dt, current, motor, velocity, link, temperature = columns
    link = wavier(np.cumsum(dt), motor / 100.0, link) + 10e-6
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


def test_of_a_gain_only_what_is_beyond_its_own_standard_deviations_is_doubt() -> None:
    """Always driven, so that friction and a gain differ by little; `levels` has the gain that remains."""
    fused = USUAL.fused
    assert fused is not None
    n = 6000
    v = 1.2 * np.sin(2.5e-3 * np.arange(n) + 0.4)
    torque = 20.0 * np.sign(v)
    run = run_of(v, 0.05 * torque, torque)
    variance = Fusion(fused.sigma, True).fuse(*run[1:6]).variance_nm2
    signals = (run[0], run[6], run[7], v, torque, variance, run[8])
    loud = replace(AGREEMENT, slow_nm=20.0, fast_nm=20.0, gain=0.002, zero_nm=20.0)
    found = []
    for sigmas in (0.0, 0.5, 1.0, 10.0):
        of_file = replace(fused, agreement=replace(loud, gain_sigmas=sigmas))
        alpha, *_, more, _ = track_run(of_file, USUAL.rated_torque_nm, *run, False)
        gain = levels(of_file, USUAL.rated_torque_nm, *signals)[2][-1]
        doubt = loud.gain_factor * max(gain - 0.002, 0.0) * max(alpha[-1], 1.0 - alpha[-1]) * torque[-1]
        assert more[-1] == pytest.approx(doubt**2, rel=1e-6, abs=1e-6)
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
    run = run_of(v, -2.0 * one, 5.0 * np.sin(v))
    loud = replace(AGREEMENT, slow_nm=20.0, fast_nm=20.0, gain=1.0)
    doubts = [
        track_run(
            replace(fused, agreement=replace(loud, zero_factor=factor)),
            USUAL.rated_torque_nm,
            *run,
            False,
        )[4]
        for factor in (1.0, 1.5, 2.0)
    ]
    wider, widest = doubts[1] - doubts[0], doubts[2] - doubts[0]  # without what the views differ by
    assert wider.max() > 1.0
    np.testing.assert_allclose(1.25 * widest, 3.0 * wider, rtol=1e-12, atol=1e-12)


# ---- waves over the motor's turn

NONE = (0.0,) * TURN_WAVES
DIAGONAL = tuple(0.01 * float(m == n) for m in range(TURN_WAVES) for n in range(m + 1))
TURN = Turn(NONE, NONE, NONE, NONE, covariance_nm2=DIAGONAL, limit=15.0)
LARGE = Agreement(slow_nm=20.0, fast_nm=20.0, gain=1.0, zero_nm=20.0)
"""Levels that nothing here is beyond: what degrades is the waves."""
COS_OF = {1: 0, 2: 2, 4: 4}
PARTS: dict[str, tuple[float, Callable[[FloatArray, FloatArray], FloatArray]]] = {
    "constant_nm": (0.7, lambda v, loss: np.ones_like(v)),
    "loss_share": (0.25, lambda v, loss: loss),
    "viscous_nms_per_rad": (0.8, lambda v, loss: v),
    "quadratic_nms2_per_rad2": (0.8, lambda v, loss: v * v),
}
"""Size of a part of a wave of another joint, and what it goes with, by speed and loss."""


def joint_of(turn: Turn | None = TURN) -> Joint:
    return with_section(agreement=replace(LARGE, turn=turn))


def with_wave(order: int, key: str, seconds: float = 5.0) -> tuple[FloatArray, ...]:
    """Samples of a joint whose torsion has a wave: cos of an order of the motor's turn, times one part."""
    (dt, current, motor, velocity, link, temperature), torque = driven(seconds)
    v = velocity / 100.0
    raw = torque.copy()
    for _ in range(20):  # raw torque of a torque: the loss depends on it
        loss = AdditiveLossModel(NARROW.fused.loss).loss_many(raw, v, temperature, np.tanh(v / 0.02))[0]  # type: ignore[union-attr]
        raw = torque + loss
    size, part = PARTS[key]
    return dt, current, motor, velocity, link - size * part(v, loss) * np.cos(order * motor) / K, temperature


def first_degraded_s(found: EstimateRun) -> float:
    degraded = found.status == st.DEGRADED
    return float(np.argmax(degraded)) * 1e-3 if degraded.any() else np.inf


def own(order: int, key: str, factor: float = 1.0) -> Turn:
    """Return what a file has of the wave."""
    values = [0.0] * TURN_WAVES
    values[COS_OF[order]] = factor * PARTS[key][0]
    return replace(TURN, **{key: tuple(values)})


@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("key", PARTS)
def test_a_wave_that_is_not_the_files_degrades_within_a_second_and_its_own_never(
    order: int, key: str
) -> None:
    columns = with_wave(order, key)
    assert first_degraded_s(FusedEstimator(joint_of(None), ON).run(*columns)) == np.inf
    assert first_degraded_s(FusedEstimator(joint_of(), ON).run(*columns)) < 1.0
    assert first_degraded_s(FusedEstimator(joint_of(own(order, key)), ON).run(*columns)) == np.inf
    assert first_degraded_s(FusedEstimator(joint_of(own(order, key, -1.0)), ON).run(*columns)) < 1.0


def test_waves_that_are_not_the_files_widen_sigma_by_their_size_and_its_own_by_nothing() -> None:
    """0.7 Nm are 0.5 Nm rms: which path has them is not known, so the larger weight of both counts."""
    columns = with_wave(2, "constant_nm")
    without, foreign, known = (
        FusedEstimator(joint_of(turn), ON).run(*columns) for turn in (None, TURN, own(2, "constant_nm"))
    )
    late = (without.status == st.VALID) & (np.abs(columns[3]) > 20.0) & (np.cumsum(columns[0]) > 1.0)
    more = np.sqrt(foreign.sigma_nm**2 - without.sigma_nm**2)[late]
    assert 0.5 * 0.9 * 0.7 / math.sqrt(2.0) < np.median(more) < 1.05 * 0.7 / math.sqrt(2.0)
    np.testing.assert_allclose(known.sigma_nm[late], without.sigma_nm[late], rtol=1e-3)


@pytest.mark.parametrize("counted", [True, False])
def test_a_network_is_judged_by_the_difference_that_it_leaves(counted: bool) -> None:
    """With levels of its own that of its path, with none those of the file, without the waves of the file's loss."""
    assert NARROW.fused is not None
    loss = AdditiveLossModel(NARROW.fused.loss)

    def answer(*x: float) -> float:
        return -loss.loss(x[0], x[5], loss.thermal(x[11]))[0]

    network: Any = FakeNetwork(answer)
    network.sigma = replace(network.sigma, current_nm=0.2)
    if counted:
        network.zeros, network.agreement = None, replace(LARGE, turn=TURN)
    following = replace(NARROW, fused=replace(joint_of(None).fused, tracking=TRACKING))  # type: ignore[type-var]
    found = FusedEstimator(following, replace(ON, track_torsion=True), network)
    columns = with_wave(2, "constant_nm", 3.0)
    assert (first_degraded_s(found.run(*columns)) < 1.0) == counted


def test_a_file_without_the_key_is_as_before() -> None:
    columns = with_wave(2, "constant_nm")
    without, with_turn = (FusedEstimator(joint_of(turn), ON).run(*columns) for turn in (None, TURN))
    assert first_degraded_s(without) == np.inf
    np.testing.assert_array_equal(without.torque_nm, with_turn.torque_nm)
    moving = (with_turn.status == st.VALID) & (without.status == st.VALID)
    assert moving.any()
    assert (with_turn.sigma_nm >= without.sigma_nm)[moving].all()


@pytest.mark.parametrize("settings", [ON, OFF], ids=["tracked", "not tracked"])
def test_friction_and_zero_of_the_day_are_no_waves(settings: EstimatorSettings) -> None:
    """Each reversal is a step of twice the day's friction: trends start again behind it. The start is one, too."""
    columns, _ = driven(friction_nm=1.0, link_zero_rad=5e-5)
    without, with_turn = (FusedEstimator(joint_of(turn), settings).run(*columns) for turn in (None, TURN))
    np.testing.assert_array_equal(with_turn.status, without.status)


def test_what_was_another_joint_is_forgotten_in_motion() -> None:
    (dt, *_), _ = driven(8.0)
    mended = list(with_wave(2, "constant_nm", 8.0))
    mended[4] = np.where(np.cumsum(dt) < 2.0, mended[4], driven(8.0)[0][4])
    found = FusedEstimator(joint_of(), ON).run(*mended)
    assert first_degraded_s(found) < 1.0
    assert not (found.status[-2000:] == st.DEGRADED).any()


def plain(x: FloatArray, y: FloatArray) -> FloatArray:
    """The waves [blocks, 6] of samples taken: least squares, written as the equations are."""
    trends, rows = np.column_stack((x, y))[0], []
    way = 1.0 - np.exp(-EVERY * 1e-3 / TURN_TREND_S)
    for row in np.column_stack((x, y))[1:]:
        trends = trends + way * (row - trends)
        rows.append(row - trends)
    rest, found = np.array(rows), []
    for last in range(TURN_BLOCK, len(rest) + 1, TURN_BLOCK):
        block = (last - 1 - np.arange(last)) // TURN_BLOCK
        weight = EVERY * 1e-3 * np.exp(-block * TURN_BLOCK * EVERY * 1e-3 / TURN_MEMORY_S)
        a, b = rest[:last, :-1], rest[:last, -1]
        found.append(
            np.linalg.solve(a.T @ (weight[:, None] * a) + LEAST_S * np.eye(TURN_WAVES), a.T @ (weight * b))
        )
    return np.array(found)


def test_the_waves_are_those_of_least_squares() -> None:
    source = np.random.default_rng(8)
    n = 40 * EVERY * TURN_BLOCK + 1
    waves, apart = source.normal(size=(n, TURN_WAVES)), source.normal(size=n)
    v, loss = 1.0 + 0.3 * source.normal(size=n).clip(-2.0, 2.0), source.normal(size=n)
    root = source.normal(size=(TURN_WAVES, TURN_WAVES)) + 3.0 * np.eye(TURN_WAVES)
    covariance = root @ root.T
    parts = source.normal(size=(4, TURN_WAVES))
    turn = Turn(*map(tuple, parts), tuple(covariance[np.tril_indices(TURN_WAVES)]), 1.0)
    found, square = turn_waves(turn, np.full(n, 1e-3), apart, np.ones(n), v, loss, waves)
    rest = apart - np.einsum("nk,nk->n", waves, np.column_stack((np.ones(n), loss, v, v * v)) @ parts)
    expected = plain(waves[::EVERY], rest[::EVERY])
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(
        square, np.einsum("nk,nk->n", expected @ np.linalg.inv(covariance), expected), rtol=1e-9
    )


def test_waves_of_another_shape_are_refused() -> None:
    ones = np.ones(5)
    with pytest.raises(ValueError, match=r"expected \(5, 6\)"):
        turn_waves(TURN, ones, ones, ones, ones, ones, np.ones((5, 4)))


# ---- files


def mapping_of(joint: Joint, path: str, value: Any) -> dict[str, Any]:
    """The joint file with another value at a path below `fused`."""
    mapping = joint.to_mapping()
    *parents, last = path.split(".")
    inner = mapping["fused"]
    for parent in parents:
        inner = inner[parent]
    inner[last] = value
    return mapping


@pytest.mark.parametrize(
    "joint", [USUAL, LEARNING, joint_of(own(2, "loss_share"))], ids=["agreement", "zeros", "turn"]
)
def test_a_section_survives_a_file(joint: Joint) -> None:
    assert Joint.from_mapping(joint.to_mapping(), "a.yaml") == joint
    assert "turn" not in joint_of(None).to_mapping()["fused"]["agreement"]


TURNING = joint_of()


@pytest.mark.parametrize(
    ("joint", "path", "value", "words"),
    [
        (USUAL, "agreement.slow_nm", 0.0, "found 0.0"),
        (USUAL, "agreement.fast_nm", -1.0, "found -1.0"),
        (USUAL, "agreement.gain", -0.1, "found -0.1"),
        (USUAL, "agreement.zero_nm", math.nan, "found nan"),
        (USUAL, "agreement.zero_factor", 0.9, "found 0.9"),
        (USUAL, "agreement.gain_sigmas", -0.1, "found -0.1"),
        (TURNING, "agreement.turn.limit_nm", 3.0, "unknown key"),
        (TURNING, "agreement.turn.viscous_nms_per_rad", [math.nan] * 6, "found [nan"),
        (TURNING, "agreement.turn.constant_nm", [0.0] * 5, "found 5 numbers"),
        (TURNING, "agreement.turn.quadratic_nms2_per_rad2", [0.0] * 7, "found 7 numbers"),
        (TURNING, "agreement.turn.covariance_nm2", list(DIAGONAL[:-1]), "found 20 numbers"),
        (TURNING, "agreement.turn.covariance_nm2", [-1.0, *DIAGONAL[1:]], "positive definite"),
        (TURNING, "agreement.turn.limit", 0.0, "found 0.0"),
        (LEARNING, "zeros.early", 0.9, "found 0.9, expected a number from 1"),
        (LEARNING, "zeros.spread_nm", 0.36, "found 0.36, expected less than sigma.torsion_nm (0.35 Nm)"),
    ],
)
def test_values_that_cannot_be_are_refused(joint: Joint, path: str, value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Joint.from_mapping(mapping_of(joint, path, value), "a.yaml")
    assert str(caught.value).startswith(f"a.yaml: key 'fused.{path}': ")
    assert words in str(caught.value)


# ---- the state continues in another estimator

EFFECT = Effect("viscous_friction", {"viscous_nms_per_rad": 1.0})


def learned(joint: Joint = NARROW, settings: EstimatorSettings = ON) -> Estimator:
    """An estimator that has found a zero of 200 µrad."""
    estimator = make_estimator(joint, settings)
    estimator.run(*driven(link_zero_rad=2e-4)[0])
    return estimator


def test_the_layout_of_the_past_is_the_one_of_its_number() -> None:
    """Where this fails, what logs hold means something else: count `PAST_LAYOUT` up, then change the size here."""
    size = len(FusedEstimator(NARROW, ON).past)
    assert (PAST_LAYOUT, size) == (16, 2544)
    assert size <= 8 * PAST_WORDS, "snapshot and log have room for it"


def test_where_limits_and_sigmas_differ_the_state_is_valid_and_the_estimate_continues() -> None:
    old = learned()
    new = make_estimator(with_section(sigma=replace(SIGMA, torsion_nm=0.3)), replace(ON, torque_limit=2.0))
    assert same_past(old, new)
    assert isinstance(old, FusedEstimator)
    assert isinstance(new, FusedEstimator)
    new.past = old.past
    assert new.zeros is not None
    assert old.zeros is not None
    assert new.zeros.link_rad == old.zeros.link_rad
    row = [float(each[-1]) for each in driven(link_zero_rad=2e-4)[0]]
    assert new.step(*row).physics_nm == pytest.approx(old.step(*row).physics_nm, abs=0.05)


def test_with_the_same_parameters_it_continues_bit_by_bit() -> None:
    old, new = learned(), FusedEstimator(NARROW, ON)
    assert same_past(old, new)
    new.past = old.past  # type: ignore[attr-defined]
    columns = driven(link_zero_rad=2e-4)[0]
    assert new.run(*columns).torque_nm.tobytes() == old.run(*columns).torque_nm.tobytes()


def changed(name: str) -> tuple[Joint, EstimatorSettings]:
    fused = NARROW.fused
    assert fused is not None
    assert fused.torsion is not None
    return {
        "stiffness": (replace(NARROW, fused=replace(fused, torsion=replace(fused.torsion, stiffness_nm_per_rad=1.1e4))), ON),
        "zero": (replace(NARROW, fused=replace(fused, torsion=replace(fused.torsion, zero_rad=1e-4))), ON),
        "loss": (replace(NARROW, fused=replace(fused, loss=replace(fused.loss, viscous_per_k=0.003))), ON),
        "torque constant": (replace(NARROW, torque_constant_nm_per_a=0.063), ON),
        "bandwidth": (NARROW, replace(ON, bandwidth_rad_s=150.0)),
        "effects": (replace(NARROW, effects=(EFFECT,)), ON),
        "not tracked": (NARROW, replace(ON, track_zeros=False)),
        "another method": (NARROW, EstimatorSettings(method="tob")),
    }[name]  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["stiffness", "zero", "loss", "torque constant", "bandwidth", "effects", "not tracked", "another method"],
)
def test_where_the_parameters_of_the_learning_differ_the_state_is_not_valid(name: str) -> None:
    assert not same_past(learned(), make_estimator(*changed(name)))
    assert not same_past(make_estimator(*changed(name)), learned())


def test_a_past_of_another_length_is_refused() -> None:
    estimator = FusedEstimator(NARROW, ON)
    with pytest.raises(ValueError, match="found a block of 8 bytes"):
        estimator.past = bytes(8)


def test_zeros_in_words() -> None:
    zeros = Zeros(1.02e-4, 9e-6, 9.8e-5, 0.01, 0.02, 0.0, 2e-3, TRACKED | LEARNED, 1)
    assert zeros.text == "link +102 µrad, sigma 9 µrad, +98 µrad taken off; jumped once"
    assert (
        zeros._replace(flags=TRACKED, jumps=0).text == "link not learned yet: the joint has to move both ways"
    )
    assert zeros._replace(flags=0).text == ""
    assert zeros._replace(flags=0).content() is None
    estimator = FusedEstimator(NARROW, replace(ON, track_zeros=False))
    assert estimator.zeros is None
    assert np.isfinite(estimator.run(*driven(0.5)[0]).torque_nm[-1])
