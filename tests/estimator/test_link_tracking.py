"""The link encoder's tracking filter: least squares with a fading past, an estimate of now; without the key as before."""

from __future__ import annotations

from dataclasses import replace
from math import inf, isnan

import numpy as np
import pytest

from jtqd.estimator.age import age_ms, aligned, bandwidth_of
from jtqd.estimator.checked import ConfigError
from jtqd.estimator.contact import link_loads
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Joint, Tracking
from jtqd.estimator.observer import reference_of, tracked
from jtqd.estimator.settings import EstimatorSettings, recommended
from tests.estimator.fused_helpers import fused_joint, twisted
from tests.estimator.test_torsion_bandwidth import OWN, SLIPPING, SPEED, WEIGHTS, estimated, lossless

TRACKED = replace(OWN, track_link=True)
TRACKING = Tracking(200.0, 0.06, 0.08)


def following(joint: Joint, tracking: Tracking | None = TRACKING) -> Joint:
    assert joint.fused is not None
    return replace(joint, fused=replace(joint.fused, tracking=tracking))


def test_it_is_least_squares_on_a_parabola_whose_past_fades() -> None:
    rng = np.random.default_rng(1)
    n, dt, rate = 600, 1e-3, 150.0
    q = np.cumsum(rng.normal(0.0, 1e-3, n))
    noise, velocity = tracked(q, np.full(n, dt), rate)
    age = np.arange(n)[::-1] * dt
    root = np.exp(-0.5 * rate * age)
    powers = np.column_stack((np.ones(n), -age, 0.5 * age**2))
    position, speed, _ = np.linalg.lstsq(powers * root[:, None], q * root, rcond=None)[0]
    assert q[-1] - noise[-1] == pytest.approx(position, abs=1e-9)
    assert velocity[-1] == pytest.approx(speed, abs=1e-6)


def test_a_constant_acceleration_is_followed_without_lag_at_uneven_steps_and_a_gap_starts_again() -> None:
    dt = np.random.default_rng(2).uniform(0.0004, 0.0021, 400)
    t = np.cumsum(dt)
    noise, velocity = tracked(0.3 + 0.7 * t - 15.0 * t * t, dt, 200.0)
    assert np.max(np.abs(noise[150:])) < 1e-8
    assert velocity[-1] == pytest.approx(0.7 - 30.0 * t[-1], abs=1e-5)
    dt[300] = 0.2
    noise, velocity = tracked(t, dt, 200.0)
    assert (noise[300], velocity[300]) == (0.0, 0.0)
    assert noise[301] != 0.0
    with pytest.raises(ValueError, match="found 3 positions and 2 steps"):
        tracked(np.zeros(3), np.zeros(2), 200.0)


def test_how_far_it_follows_steps_and_waves_as_docs_say() -> None:
    dt = np.full(4000, 0.001)
    step = np.where(np.arange(4000) < 100, 0.0, 1.0)
    followed = step - tracked(step, dt, 220.0)[0]
    assert followed[100:103] == pytest.approx([0.48, 0.79, 0.97], abs=0.01)
    assert followed.max() == pytest.approx(1.15, abs=0.01)
    for hz, missed in ((10.0, 0.015), (20.0, 0.09), (40.0, 0.30)):
        noise, _ = tracked(np.sin(2.0 * np.pi * hz * 0.001 * np.arange(4000)), dt, 220.0)
        assert np.sqrt(2.0 * np.mean(noise[2000:] ** 2)) == pytest.approx(missed, rel=0.05)


@WEIGHTS
def test_the_estimate_is_of_now_whatever_the_weights(current_nm: float, torsion_nm: float) -> None:
    """A ramp without lag, and a step of the motor's side in the sample that shows it."""
    dt = np.random.default_rng(3).uniform(0.0004, 0.0021, 500)
    t = np.cumsum(dt)
    joint = following(lossless(current_nm, torsion_nm))
    found = estimated(joint, TRACKED, 20.0 * t, dt)
    assert found[t > 0.3] == pytest.approx(20.0 * t[t > 0.3], abs=1e-6)
    even = np.full(300, 0.001)
    step = np.where(np.arange(300) < 150, 0.0, 10.0)
    assert estimated(joint, TRACKED, step, even)[1:] == pytest.approx(step[1:], abs=0.1)
    assert (bandwidth_of(joint, TRACKED), age_ms(joint, TRACKED)) == (inf, 0.0)
    assert np.array_equal(aligned(step, even, joint, TRACKED), step)


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
    link = SPEED * np.cumsum(dt)

    def of(settings: EstimatorSettings, added: np.ndarray) -> np.ndarray:
        estimator = FusedEstimator(joint, settings)
        speed = joint.gear_ratio * SPEED
        rows = zip(dt, np.zeros(n), joint.gear_ratio * link, np.full(n, speed), link + added, strict=True)
        return np.array([estimator.step(*row).torque_nm for row in rows])

    quiet = [float(np.std(of(settings, noise)[500:])) for settings in (OWN, TRACKED)]
    assert quiet[1] == pytest.approx(quiet[0], rel=0.15)
    found = of(TRACKED, kicked)
    assert found[1999] == pytest.approx(0.0, abs=1e-6)
    assert found[2002] < -0.9
    assert np.max(np.abs(found[2030:] + 1.2)) < 0.05


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


@pytest.mark.parametrize("missing", ["key", "section", "torsion"])
def test_without_key_section_or_torsion_it_is_the_low_pass_to_the_bit(missing: str) -> None:
    m = twisted(11)
    joint = fused_joint(3, None if missing == "torsion" else SLIPPING)
    settings = OWN if missing == "key" else TRACKED
    other = joint if missing == "section" else following(joint)
    one, same = FusedEstimator(joint, OWN), FusedEstimator(other, settings)
    assert all(repr(one.step(*row)) == repr(same.step(*row)) for row in m.rows())
    assert bandwidth_of(other, settings) == (200.0 if missing == "torsion" else 800.0)


def test_sigma_holds_what_is_quicker_than_the_motor_path() -> None:
    m = twisted(12)
    joint = following(fused_joint(3, SLIPPING))
    wider = following(joint, Tracking(200.0, 3.0, 0.5))
    one, other = (
        FusedEstimator(each, TRACKED) for each in (following(joint, Tracking(200.0, 0.0, 0.0)), wider)
    )
    pairs = [(one.step(*row), other.step(*row)) for row in m.rows()]
    moving = [(a, b) for a, b in pairs if a.status in (2, 3) and a.status == b.status]
    assert len(moving) > 200
    for a, b in moving:
        assert a.torque_nm == b.torque_nm
        assert b.sigma_nm**2 - a.sigma_nm**2 >= 9.0 - 1e-9
    assert max(b.sigma_nm**2 - a.sigma_nm**2 for a, b in moving) > 9.05


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
    assert joint.fused is not None
    assert joint.fused.torsion is not None
    spring = replace(joint.fused.torsion, damping_nms_per_rad=9.0)
    joint = replace(joint, fused=replace(joint.fused, torsion=spring))
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
    assert rate[300:] == pytest.approx(np.full(200, 20.0), abs=1e-3)


def test_a_reference_of_now_is_the_sensor_itself() -> None:
    sensor = np.random.default_rng(5).normal(size=50)
    found = reference_of(sensor, np.full(50, 1e-3), inf)
    assert isnan(found[0])
    assert np.array_equal(found[1:], sensor[1:])


def test_it_is_an_option_and_a_section_of_nonsense_is_refused() -> None:
    assert not recommended("fused").track_link
    with pytest.raises(ConfigError, match=r"fused\.tracking.*rate_rad_s: found 5"):
        Tracking(5.0, 0.1, 0.1)
    with pytest.raises(ConfigError, match=r"fused\.tracking.*sigma_nm: found -1"):
        Tracking(200.0, -1.0, 0.1)
    joint = following(fused_joint())
    assert Joint.from_mapping(joint.to_mapping(), "file") == joint


def test_stamps_that_are_not_of_the_encoders_instant_cost_speed_times_their_error() -> None:
    """Why it is no default: 50 us at 3 rad/s are 150 urad of the link; the torsion of both encoders has none of it."""
    n, late = 3000, np.random.default_rng(7).uniform(-50e-6, 50e-6, 3000)
    read = 3.0 * (1e-3 * np.arange(n) + late)
    noise, _ = tracked(read, np.full(n, 1e-3), 220.0)
    error = np.std(noise[500:])
    assert 0.4 < error / (3.0 * np.std(late)) < 1.0
    assert 12_000.0 * error > 0.4, "newton metres at 12 000 Nm/rad"
