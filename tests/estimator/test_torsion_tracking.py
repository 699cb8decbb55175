"""The torsion's tracking filter: a Kalman filter of a ramp and a wave, an estimate of now; without the key as before."""

from __future__ import annotations

from dataclasses import replace
from math import inf, isnan

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.contact import link_loads
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Joint, Tracking
from jtqd.estimator.observer import TRACKED_FADE_S, low_pass, reference_of, tracked
from jtqd.estimator.settings import EstimatorSettings, age_ms, bandwidth_of, recommended
from jtqd.estimator.status import STANDSTILL
from jtqd.sysid.fit.torsion import TRACKING_RAD_S, WAVE_RAD_S
from tests.estimator.fused_helpers import fused_joint, twisted
from tests.estimator.test_torsion_bandwidth import OWN, SLIPPING, SPEED, WEIGHTS, estimated, lossless

TRACKED = replace(OWN, track_torsion=True)
TRACKING = Tracking(TRACKING_RAD_S, 0.06, 0.08, WAVE_RAD_S)
OLD = Tracking(220.0, 0.06, 0.08)
"""Of a filter that there no longer is: of the link encoder alone."""
FOLLOWED, OVERSHOOT = (0.45, 0.76, 0.96), 1.15
"""Of a step: after one, two, three samples, and most."""
MISSED = ((20.0, 0.03, 0.07), (50.0, 0.03, 0.37), (80.0, 0.03, 0.59))
"""Hz; part missed of a wave that is order 2 of the motor, and of one that is not."""


def following(joint: Joint, tracking: Tracking | None = TRACKING) -> Joint:
    assert joint.fused is not None
    return replace(joint, fused=replace(joint.fused, tracking=tracking))


def damped(joint: Joint, damping: float) -> Joint:
    assert joint.fused is not None
    assert joint.fused.torsion is not None
    spring = replace(joint.fused.torsion, damping_nms_per_rad=damping)
    return replace(joint, fused=replace(joint.fused, torsion=spring))


def textbook(
    d: FloatArray, angle: FloatArray, dt: FloatArray, rate: float, wave: float
) -> tuple[FloatArray, FloatArray]:
    """Return states [n, 4] and innovations of a Kalman filter in matrices."""
    h = np.array([1.0, 0.0, 1.0, 0.0])
    x, p = np.array([d[0], 0.0, 0.0, 0.0]), np.diag([1.0, rate**2, 1.0, 1.0])
    states = [x]
    for k in range(1, len(d)):
        turn = 2.0 * (angle[k] - angle[k - 1])
        fade = TRACKED_FADE_S / (TRACKED_FADE_S + dt[k])
        f = np.zeros((4, 4))
        f[:2, :2] = [[1.0, dt[k]], [0.0, 1.0]]
        f[2:, 2:] = fade * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        q = np.diag([0.0, rate**4 * dt[k] ** 2, (wave * dt[k]) ** 2, (wave * dt[k]) ** 2])
        x, p = f @ x, f @ p @ f.T + q
        gain = p @ h / (h @ p @ h + 1.0)
        x, p = x + gain * (d[k] - h @ x), p - np.outer(gain, h @ p)
        states.append(x)
    found = np.array(states)
    return found[:, 0] + found[:, 2], found


def test_it_is_the_kalman_filter_of_a_ramp_and_a_wave_at_uneven_steps() -> None:
    rng = np.random.default_rng(1)
    n = 500
    dt = rng.uniform(0.0004, 0.0021, n)
    velocity = 150.0 + 100.0 * np.sin(3.0 * np.cumsum(dt))
    angle = np.cumsum(velocity * dt)
    d = np.cumsum(rng.normal(0.0, 1e-5, n))
    found, rate = tracked(d, angle, velocity, dt, 380.0, 150.0)
    expected, states = textbook(d, angle, dt, 380.0, 150.0)
    assert found == pytest.approx(expected, abs=1e-13)
    assert rate == pytest.approx(states[:, 1] - 2.0 * velocity * states[:, 3], abs=1e-9)


def test_a_ramp_is_followed_without_lag_at_uneven_steps_and_a_gap_starts_again() -> None:
    dt = np.random.default_rng(2).uniform(0.0004, 0.0021, 600)
    t = np.cumsum(dt)
    still = np.zeros(600)
    found, rate = tracked(0.3 + 0.7 * t, still, still, dt, 400.0, 160.0)
    assert found[300:] == pytest.approx(0.3 + 0.7 * t[300:], abs=2e-4)
    assert rate[-1] == pytest.approx(0.7, abs=1e-2)
    dt[300] = 0.2
    found, rate = tracked(t, still, still, dt, 400.0, 160.0)
    assert (found[300], rate[300]) == (t[300], 0.0)
    assert rate[301] != 0.0
    with pytest.raises(ValueError, match="found 3, 3, 3, 2 deflections, positions, velocities and steps"):
        tracked(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(2), 400.0, 160.0)


def test_how_far_it_follows_steps_and_waves_as_docs_say() -> None:
    n = 4000
    dt, still = np.full(n, 0.001), np.zeros(n)
    step = np.where(np.arange(n) < 2000, 0.0, 1.0)
    followed, _ = tracked(step, still, still, dt, 400.0, 160.0)
    assert followed[2000:2003] == pytest.approx(FOLLOWED, abs=0.01)
    assert followed.max() == pytest.approx(OVERSHOOT, abs=0.01)
    time = 0.001 * np.arange(n)
    for hz, as_order, as_other in MISSED:
        wave = np.sin(2.0 * np.pi * hz * time)
        turns = np.pi * hz  # rad/s of a motor whose order 2 this is
        for speed, missed in ((turns, as_order), (0.3 * turns, as_other)):
            found, _ = tracked(wave, speed * time, np.full(n, speed), dt, 400.0, 160.0)
            left = np.sqrt(2.0 * np.mean((found - wave)[2000:] ** 2))
            assert left == pytest.approx(missed, abs=0.01), (hz, speed)


@WEIGHTS
def test_the_estimate_is_of_now_whatever_the_weights(current_nm: float, torsion_nm: float) -> None:
    dt = np.random.default_rng(3).uniform(0.0004, 0.0021, 1500)
    t = np.cumsum(dt)
    joint = following(lossless(current_nm, torsion_nm))
    found = estimated(joint, TRACKED, 20.0 * t, dt)
    assert found[t > 1.0] == pytest.approx(20.0 * t[t > 1.0], abs=1e-4)
    assert (bandwidth_of(joint, TRACKED), age_ms(joint, TRACKED)) == (inf, 0.0)
    assert np.array_equal(low_pass(t, dt, bandwidth_of(joint, TRACKED)), t)


def test_a_joint_that_moves_at_its_start_has_no_transient() -> None:
    torque, dt = np.full(100, 7.0), np.full(100, 0.001)
    assert estimated(following(lossless(0.3, 0.4)), TRACKED, torque, dt)[1:] == pytest.approx(
        torque[1:], abs=1e-6
    )


def test_a_torque_on_the_link_is_followed_within_milliseconds_and_white_noise_is_as_that_of_800() -> None:
    n, dt = 4000, np.full(4000, 0.001)
    noise = np.random.default_rng(4).normal(0.0, 6e-6, n)
    joint = following(lossless(10.0, 0.1))
    kicked = np.where(np.arange(n) < 2000, 0.0, 1e-4)  # the link springs by 0.1 mrad: -1.2 Nm

    def of(settings: EstimatorSettings, added: FloatArray, speed: float) -> FloatArray:
        estimator = FusedEstimator(joint, settings)
        link = speed * np.cumsum(dt)
        rows = zip(
            dt,
            np.zeros(n),
            joint.gear_ratio * link,
            np.full(n, joint.gear_ratio * speed),
            link + added,
            strict=True,
        )
        return np.array([estimator.step(*row).torque_nm for row in rows])

    for damping, most in ((9.0, 1.05), (0.0, 1.5)):
        joint = following(damped(lossless(10.0, 0.1), damping))
        quiet = [np.diff(of(settings, noise, 0.0)[500:], 2).std() for settings in (OWN, TRACKED)]
        assert 0.5 * quiet[0] < quiet[1] < most * quiet[0], damping
    found = of(TRACKED, kicked, SPEED)
    assert found[1999] == pytest.approx(0.0, abs=1e-6)
    assert found[2002] < -0.9
    assert np.max(np.abs(found[2060:] + 1.2)) < 0.1


def test_stamps_that_are_not_of_the_encoders_instant_cost_next_to_nothing() -> None:
    """100 us at 3 rad/s are 300 urad of each angle, 3.6 Nm at 12 000 Nm/rad; the torsion of both has none of it."""
    n, speed = 3000, 3.0
    joint = following(lossless(0.3, 0.3))
    late = np.random.default_rng(7).normal(0.0, 100e-6, n)
    torque = 10.0 + 2.0 * np.sin(20.0 * 1e-3 * np.arange(n))
    gain = joint.gear_ratio * joint.torque_constant_nm_per_a
    found = []
    for beside in (np.zeros(n), late):
        link = speed * (1e-3 * np.arange(n) + beside)
        motor = joint.gear_ratio * (link + torque / 12000.0)
        estimator = FusedEstimator(joint, TRACKED)
        found.append(
            [
                estimator.step(0.001, x / gain, m, joint.gear_ratio * speed, q).torque_nm
                for x, m, q in zip(torque, motor, link, strict=True)
            ]
        )
    assert np.max(np.abs(np.subtract(*found)[10:])) < 0.01


def test_it_continues_from_its_state_bit_for_bit_and_starts_again_after_a_gap() -> None:
    rows = [list(row) for row in twisted(15).rows()]
    joint = following(fused_joint(3, SLIPPING))
    whole = FusedEstimator(joint, TRACKED)
    first = [whole.step(*row) for row in rows[:200]]
    part = FusedEstimator(joint, TRACKED)
    part.past = whole.past
    assert [repr(part.step(*row)) for row in rows[200:]] == [repr(whole.step(*row)) for row in rows[200:]]
    assert len({each.status for each in first}) > 1
    gap = [[1.0, *rows[200][1:]], *rows[201:]]
    anew = FusedEstimator(joint, TRACKED)
    for row in rows[:200]:
        anew.step(*row)
    fresh = FusedEstimator(joint, TRACKED)
    assert [repr(anew.step(*row)) for row in gap][:50] == [repr(fresh.step(*row)) for row in gap][:50]


def test_slow_errors_of_the_paths_count_with_the_weights() -> None:
    dt = np.full(600, 0.001)
    torque = 5.0 + np.sin(np.arange(600) * 0.002)
    joint = following(lossless(0.3, 0.4))
    gain = joint.gear_ratio * joint.torque_constant_nm_per_a
    link = np.cumsum(SPEED * dt)
    motor = joint.gear_ratio * (link + torque / 12000.0)
    estimator = FusedEstimator(joint, TRACKED)
    speed = joint.gear_ratio * SPEED
    found = np.array(
        [
            estimator.step(a, (x + 1.0) / gain, m, speed, q).torque_nm
            for a, x, m, q in zip(dt, torque, motor, link, strict=True)
        ]
    )
    share = 0.4**2 / (0.3**2 + 0.4**2)
    assert (found - torque)[300:] == pytest.approx(np.full(300, share), abs=1e-4)


@pytest.mark.parametrize("missing", ["key", "section", "torsion", "wave"])
def test_without_key_section_or_torsion_it_is_the_low_pass_to_the_bit(missing: str) -> None:
    m = twisted(11)
    joint = fused_joint(3, None if missing == "torsion" else SLIPPING)
    settings = OWN if missing == "key" else TRACKED
    other = joint if missing == "section" else following(joint, OLD if missing == "wave" else TRACKING)
    one, same = FusedEstimator(joint, OWN), FusedEstimator(other, settings)
    assert all(repr(one.step(*row)) == repr(same.step(*row)) for row in m.rows())
    assert bandwidth_of(other, settings) == (200.0 if missing == "torsion" else 800.0)


def test_sigma_holds_what_is_quicker_than_the_motor_path() -> None:
    m = twisted(12)
    joint = following(fused_joint(3, SLIPPING))
    wider = following(joint, replace(TRACKING, sigma_nm=3.0, viscous_nms_per_rad=0.5))
    one, other = (
        FusedEstimator(each, TRACKED)
        for each in (following(joint, replace(TRACKING, sigma_nm=0.0, viscous_nms_per_rad=0.0)), wider)
    )
    pairs = [(one.step(*row), other.step(*row)) for row in m.rows()]
    moving = [(a, b) for a, b in pairs if a.status in (2, 3) and a.status == b.status]
    assert len(moving) > 200
    for a, b in moving:
        assert a.torque_nm == b.torque_nm
        assert b.sigma_nm**2 - a.sigma_nm**2 >= 9.0 - 1e-9
    assert max(b.sigma_nm**2 - a.sigma_nm**2 for a, b in moving) > 9.05
    resting = [(a, b) for a, b in pairs if a.status == b.status == STANDSTILL]
    assert len(resting) > 100
    assert all(a.sigma_nm == b.sigma_nm for a, b in resting), "measured in motion"


def test_arrays_give_what_the_loop_gives() -> None:
    m = twisted(13)
    joint = following(fused_joint(3, SLIPPING))
    columns = [np.array(column) for column in zip(*m.rows(), strict=True)]
    run = FusedEstimator(joint, TRACKED).run(*columns)
    estimator = FusedEstimator(joint, TRACKED)
    one = np.array([estimator.step(*row).torque_nm for row in m.rows()])
    np.testing.assert_allclose(run.torque_nm, one, atol=1e-9)


def test_the_load_of_the_link_needs_no_filter_of_the_torsion() -> None:
    """Contacts are told by the unfiltered torsion: the same whichever filter the estimate has."""
    m = twisted(14)
    joint = following(lossless(0.3, 0.4))
    joint = damped(joint, 9.0)
    columns = [np.array(column) for column in zip(*m.rows(), strict=True)][:5]
    columns[0] = np.full(len(columns[0]), 0.001)  # uneven steps tell no acceleration
    (_, one), (rate, other) = (link_loads(joint, settings, *columns) for settings in (OWN, TRACKED))
    assert np.isfinite(one).sum() > 200
    np.testing.assert_allclose(other, one, atol=1e-6)
    assert np.isfinite(rate).sum() > 200


def test_the_torque_rate_is_that_of_the_torsion() -> None:
    dt = np.full(500, 0.001)
    t = np.cumsum(dt)
    joint = following(lossless(0.3, 0.4))
    link = SPEED * t
    motor = joint.gear_ratio * (link + 20.0 * t / 12000.0)
    rate, _ = link_loads(
        joint, TRACKED, dt, np.zeros(500), motor, np.full(500, joint.gear_ratio * SPEED), link
    )
    assert rate[300:] == pytest.approx(np.full(200, 20.0), abs=0.05)


def test_a_reference_of_now_is_the_sensor_itself() -> None:
    sensor = np.random.default_rng(5).normal(size=50)
    found = reference_of(sensor, np.full(50, 1e-3), inf)
    assert isnan(found[0])
    assert np.array_equal(found[1:], sensor[1:])


def test_what_is_missed_by_speed_grows_no_more_far_above_its_saturation() -> None:
    joint = fused_joint()
    bare, endless, bent = (
        FusedEstimator(following(joint, tracking), TRACKED)
        for tracking in (
            replace(TRACKING, sigma_nm=0.0, viscous_nms_per_rad=0.0),
            replace(TRACKING, sigma_nm=0.0, viscous_nms_per_rad=0.5),
            replace(TRACKING, sigma_nm=0.0, viscous_nms_per_rad=0.5, saturation_rad_s=0.4),
        )
    )
    rows = twisted(21).rows()
    seen = [[e.step(*row) for e in (bare, endless, bent)] for row in rows]
    moving = [[each.sigma_nm**2 for each in one] for one in seen if one[0].status == st.VALID]
    a, b, c = np.array(moving).T
    square = (b - a) / 0.25
    assert square.max() > 0.2
    np.testing.assert_allclose(c - a, 0.25 * square / (1.0 + square / 0.16), atol=1e-9)


def test_it_is_of_new_configurations_and_a_section_of_nonsense_is_refused() -> None:
    assert recommended("fused").track_torsion
    with pytest.raises(ConfigError, match=r"fused\.tracking.*rate_rad_s: found 5"):
        Tracking(5.0, 0.1, 0.1)
    with pytest.raises(ConfigError, match=r"fused\.tracking.*sigma_nm: found -1"):
        Tracking(200.0, -1.0, 0.1)
    with pytest.raises(ConfigError, match=r"fused\.tracking.*saturation_rad_s: found 0"):
        Tracking(200.0, 0.1, 0.1, 160.0, 0.0)
    with pytest.raises(ConfigError, match=r"fused\.tracking.*wave_rad_s: found -1"):
        Tracking(200.0, 0.1, 0.1, -1.0)
    joint = following(fused_joint())
    assert Joint.from_mapping(joint.to_mapping(), "file") == joint
    old = following(fused_joint(), OLD)
    assert "wave_rad_s" not in old.to_mapping()["fused"]["tracking"]
    assert Joint.from_mapping(old.to_mapping(), "file") == old
