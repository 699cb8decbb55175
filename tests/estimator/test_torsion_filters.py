"""The torsion's own filter in the fused estimate: a low pass, or a Kalman filter of a ramp and a wave without delay."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import AdditiveLoss, Fused, FusedSigma, Joint, LossSide, Torsion, Tracking
from jtqd.estimator.observer import low_pass, reference_of, tracked
from jtqd.estimator.run import EstimateRun
from jtqd.estimator.settings import EstimatorSettings, age_ms, bandwidth_of, recommended
from jtqd.estimator.status import STANDSTILL, VALID
from jtqd.sysid.fit.torsion import TRACKING_RAD_S, WAVE_RAD_S
from tests.estimator.estimator_helpers import joint1
from tests.estimator.fused_helpers import TORSION, fused_joint, twisted

ONE = EstimatorSettings(method="fused")
OWN = replace(ONE, torsion_bandwidth_rad_s=800.0)
TRACKED = replace(OWN, track_torsion=True)
TRACKING = Tracking(TRACKING_RAD_S, 0.06, 0.08, WAVE_RAD_S)
WITHOUT_WAVE = Tracking(220.0, 0.06, 0.08)
"""Of a joint file whose filter is not the product's: the torsion then has the low pass."""
SPRING = Torsion(12000.0, 0.0, 0.0, (2.0, 4.0), (0.0, 0.0), (0.0, 0.0))
SLIPPING = replace(TORSION, hysteresis_nm=0.7, hysteresis_travel_rad=8e-5, damping_nms_per_rad=9.0)
SPEED, FADE_S = 0.5, 0.2


def lossless(current_nm: float, torsion_nm: float, damping: float = 0.0) -> Joint:
    """A joint without losses whose two paths have these standard deviations; with a section `tracking`."""
    none = LossSide((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0.0)
    loss = AdditiveLoss((-30.0, 30.0), none, none, 0.05, 3.0, 25.0, 1.0, 0.0)
    sigma = FusedSigma(current_nm, 0.0, 0.0, torsion_nm, 0.0, 0.01, (1.0, 1.0, 1.0, 1.0))
    spring = replace(SPRING, damping_nms_per_rad=damping)
    return following(replace(joint1(), fused=Fused(loss, spring, sigma)))


def following(joint: Joint, tracking: Tracking | None = TRACKING) -> Joint:
    assert joint.fused is not None
    return replace(joint, fused=replace(joint.fused, tracking=tracking))


def moving(joint: Joint, torque: FloatArray, link: FloatArray, speed: float = SPEED) -> list[FloatArray]:
    """Current, motor position and velocity, and link position of a joint whose two paths measure this torque exactly."""
    gain = joint.gear_ratio * joint.torque_constant_nm_per_a
    motor = joint.gear_ratio * (link + torque / 12000.0)
    return [torque / gain, motor, np.full(len(link), joint.gear_ratio * speed), link]


def estimated(joint: Joint, settings: EstimatorSettings, torque: FloatArray, dt: FloatArray) -> FloatArray:
    """Estimates of a joint at constant speed."""
    columns = moving(joint, torque, np.cumsum(SPEED * dt))
    return FusedEstimator(joint, settings).run(dt, *columns).torque_nm


def assert_same_bits(one: EstimateRun, other: EstimateRun) -> None:
    for name in ("torque_nm", "sigma_nm", "status", "tob_nm", "physics_nm", "network_nm"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


UNEVEN = np.random.default_rng(3).uniform(0.0004, 0.0021, 1500)
WEIGHTS = pytest.mark.parametrize(("current_nm", "torsion_nm"), [(0.1, 10.0), (0.3, 0.3), (10.0, 0.1)])


# ---- delay of the estimate, whatever the weights


@WEIGHTS
@pytest.mark.parametrize("rate", [200.0, 400.0, 800.0, 1600.0, inf])
def test_a_ramp_has_the_delay_of_the_torsion(rate: float, current_nm: float, torsion_nm: float) -> None:
    t = np.cumsum(UNEVEN)
    joint = lossless(current_nm, torsion_nm)
    settings = TRACKED if rate == inf else replace(ONE, torsion_bandwidth_rad_s=rate)
    found = estimated(joint, settings, 20.0 * t, UNEVEN)
    late = t > (1.0 if rate == inf else 0.3)
    assert found[late] == pytest.approx(20.0 * (t - 1.0 / rate)[late], abs=1e-4 if rate == inf else 1e-6)
    assert (bandwidth_of(joint, settings), age_ms(joint, settings)) == (rate, pytest.approx(1e3 / rate))


@WEIGHTS
def test_a_step_passes_the_filter_of_the_torsion(current_nm: float, torsion_nm: float) -> None:
    """Within 1 % of the step: the rest of the motor path's filter is exact for lines between samples only."""
    dt = np.full(400, 0.001)
    torque = np.where(np.arange(400) < 150, 0.0, 10.0)
    found = estimated(lossless(current_nm, torsion_nm), OWN, torque, dt)[1:]
    assert found == pytest.approx(low_pass(torque, dt, 800.0)[1:], abs=0.1)
    assert np.max(np.abs(found - low_pass(torque, dt, 200.0)[1:])) > 3.0


@pytest.mark.parametrize("settings", [ONE, OWN, TRACKED], ids=["one", "own", "tracked"])
def test_slow_errors_of_the_paths_count_with_the_weights(settings: EstimatorSettings) -> None:
    """The motor path is 1 Nm off: its share of that remains."""
    dt = np.full(600, 0.001)
    torque = 5.0 + np.sin(np.arange(600) * 0.002)
    joint = lossless(0.3, 0.4)
    current, *others = moving(joint, torque, np.cumsum(SPEED * dt))
    current += 1.0 / (joint.gear_ratio * joint.torque_constant_nm_per_a)
    found = FusedEstimator(joint, settings).run(dt, current, *others).torque_nm
    error = (found - low_pass(torque, dt, bandwidth_of(joint, settings)))[300:]
    assert error == pytest.approx(np.full(300, 0.4**2 / (0.3**2 + 0.4**2)), abs=1e-4)


def test_a_joint_that_moves_at_its_start_has_no_transient() -> None:
    torque, dt = np.full(100, 7.0), np.full(100, 0.001)
    assert estimated(lossless(0.3, 0.4), TRACKED, torque, dt)[1:] == pytest.approx(torque[1:], abs=1e-6)


@pytest.mark.parametrize(
    ("torsion", "tracking", "settings", "expected"),
    [
        (SLIPPING, None, replace(ONE, torsion_bandwidth_rad_s=200.0), ONE),
        (None, None, replace(ONE, torsion_bandwidth_rad_s=200.0), ONE),
        (None, None, OWN, ONE),
        (SLIPPING, TRACKING, OWN, OWN),
        (SLIPPING, None, TRACKED, OWN),
        (None, TRACKING, TRACKED, ONE),
        (SLIPPING, WITHOUT_WAVE, TRACKED, OWN),
    ],
)
def test_what_has_no_effect_changes_no_bit(
    torsion: Torsion | None,
    tracking: Tracking | None,
    settings: EstimatorSettings,
    expected: EstimatorSettings,
) -> None:
    m, joint = twisted(11), fused_joint(3, torsion)
    with_section = following(joint, tracking)
    found = FusedEstimator(with_section, settings).run(*m.arrays())
    assert_same_bits(found, FusedEstimator(joint, expected).run(*m.arrays()))
    assert bandwidth_of(with_section, settings) == bandwidth_of(joint, expected)
    assert bandwidth_of(joint1(), replace(settings, method="tob")) == 200.0


# ---- the tracking filter


def textbook(
    d: FloatArray, angle: FloatArray, dt: FloatArray, rate: float, wave: float
) -> tuple[FloatArray, FloatArray]:
    """Output [n] and states [n, 4] of the Kalman filter in matrices."""
    h = np.array([1.0, 0.0, 1.0, 0.0])
    x, p = np.array([d[0], 0.0, 0.0, 0.0]), np.diag([1.0, rate**2, 1.0, 1.0])
    states = [x]
    for k in range(1, len(d)):
        turn = 2.0 * (angle[k] - angle[k - 1])
        fade = FADE_S / (FADE_S + dt[k])
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
    rng, dt = np.random.default_rng(1), UNEVEN[:500]
    velocity = 150.0 + 100.0 * np.sin(3.0 * np.cumsum(dt))
    angle = np.cumsum(velocity * dt)
    d = np.cumsum(rng.normal(0.0, 1e-5, 500))
    found, rate = tracked(d, angle, velocity, dt, 380.0, 150.0)
    expected, states = textbook(d, angle, dt, 380.0, 150.0)
    assert found == pytest.approx(expected, abs=1e-13)
    assert rate == pytest.approx(states[:, 1] - 2.0 * velocity * states[:, 3], abs=1e-9)


def test_a_ramp_has_no_lag_and_a_gap_restarts() -> None:
    dt = UNEVEN[:600].copy()
    t, still = np.cumsum(dt), np.zeros(600)
    found, rate = tracked(0.3 + 0.7 * t, still, still, dt, 400.0, 160.0)
    assert found[300:] == pytest.approx(0.3 + 0.7 * t[300:], abs=2e-4)
    assert rate[-1] == pytest.approx(0.7, abs=1e-2)
    dt[300] = 0.2
    found, rate = tracked(t, still, still, dt, 400.0, 160.0)
    assert (found[300], rate[300]) == (t[300], 0.0)
    assert rate[301] != 0.0
    with pytest.raises(ValueError, match="found 3, 3, 3, 2 deflections, positions, velocities and steps"):
        tracked(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(2), 400.0, 160.0)


def test_response_to_a_step() -> None:
    """Docs: after one, two, three samples, and the overshoot."""
    n, still = 2000, np.zeros(2000)
    step = np.where(np.arange(n) < 1000, 0.0, 1.0)
    found, _ = tracked(step, still, still, np.full(n, 0.001), 400.0, 160.0)
    assert found[1000:1003] == pytest.approx((0.45, 0.76, 0.96), abs=0.01)
    assert found.max() == pytest.approx(1.15, abs=0.01)


@pytest.mark.parametrize(
    ("hz", "turns", "missed"),
    [
        *((hz, 1.0, 0.03) for hz in (20.0, 50.0, 80.0)),
        *((hz, 0.3, missed) for hz, missed in ((20.0, 0.07), (50.0, 0.37), (80.0, 0.59))),
    ],
)
def test_part_missed_of_a_wave(hz: float, turns: float, missed: float) -> None:
    """Docs: of a wave that is order 2 of the motor (turns 1), and of one that is not."""
    n, time = 4000, 0.001 * np.arange(4000)
    wave, speed = np.sin(2.0 * np.pi * hz * time), turns * np.pi * hz
    found, _ = tracked(wave, speed * time, np.full(n, speed), np.full(n, 0.001), 400.0, 160.0)
    assert np.sqrt(2.0 * np.mean((found - wave)[2000:] ** 2)) == pytest.approx(missed, abs=0.01)


def test_a_torque_on_the_link_is_followed_and_noise_is_about_that_of_the_low_pass() -> None:
    n, dt = 4000, np.full(4000, 0.001)
    noise = np.random.default_rng(4).normal(0.0, 6e-6, n)
    kick = np.where(np.arange(n) < 2000, 0.0, 1e-4)  # the link springs by 0.1 mrad: -1.2 Nm

    def of(settings: EstimatorSettings, added: FloatArray, speed: float, damping: float) -> FloatArray:
        joint = lossless(10.0, 0.1, damping)
        *columns, link = moving(joint, np.zeros(n), speed * np.cumsum(dt), speed)
        return FusedEstimator(joint, settings).run(dt, *columns, link + added).torque_nm

    for damping, most in ((9.0, 1.05), (0.0, 1.5)):
        low, kalman = (
            np.diff(of(settings, noise, 0.0, damping)[500:], 2).std() for settings in (OWN, TRACKED)
        )
        assert 0.5 * low < kalman < most * low, damping
    found = of(TRACKED, kick, SPEED, 0.0)
    assert found[1999] == pytest.approx(0.0, abs=1e-6)
    assert found[2002] < -0.9
    assert np.max(np.abs(found[2060:] + 1.2)) < 0.1


def test_errors_of_the_time_stamps_nearly_cancel() -> None:
    """100 us at 3 rad/s are 300 urad of each angle, 3.6 Nm at 12 000 Nm/rad; their difference has none of it."""
    n, speed = 3000, 3.0
    joint, dt = lossless(0.3, 0.3), np.full(n, 0.001)
    late = np.random.default_rng(7).normal(0.0, 100e-6, n)
    torque = 10.0 + 2.0 * np.sin(20.0 * 1e-3 * np.arange(n))
    exact, shifted = (
        FusedEstimator(joint, TRACKED)
        .run(dt, *moving(joint, torque, speed * (1e-3 * np.arange(n) + error), speed))
        .torque_nm
        for error in (np.zeros(n), late)
    )
    assert np.max(np.abs(exact - shifted)[10:]) < 0.01


def test_it_continues_from_its_state_bit_for_bit_and_restarts_after_a_gap() -> None:
    rows = [list(row) for row in twisted(15).rows()]
    joint = following(fused_joint(3, SLIPPING))
    whole, part, gapped, fresh = (FusedEstimator(joint, TRACKED) for _ in range(4))
    assert len({whole.step(*row).status for row in rows[:200]}) > 1
    part.past = gapped.past = whole.past
    assert [repr(part.step(*row)) for row in rows[200:]] == [repr(whole.step(*row)) for row in rows[200:]]
    gap = [[1.0, *rows[200][1:]], *rows[201:250]]
    assert [repr(gapped.step(*row)) for row in gap] == [repr(fresh.step(*row)) for row in gap]


def test_sigma_covers_what_is_faster_than_the_motor_path() -> None:
    """In motion; sigma^2 grows by sigma_nm^2 and by the viscous part, which saturates with speed."""
    m, joint = twisted(12), fused_joint(3, SLIPPING)
    bare, wide, viscous, bent = (
        FusedEstimator(following(joint, replace(TRACKING, **changes)), TRACKED).run(*m.arrays())
        for changes in (
            {"sigma_nm": 4.0, "viscous_nms_per_rad": 0.0},
            {"sigma_nm": 5.0, "viscous_nms_per_rad": 0.0},
            {"sigma_nm": 4.0, "viscous_nms_per_rad": 0.5},
            {"sigma_nm": 4.0, "viscous_nms_per_rad": 0.5, "saturation_rad_s": 0.4},
        )
    )
    for other in (wide, viscous, bent):
        np.testing.assert_array_equal(other.torque_nm, bare.torque_nm)
    moves, rests = bare.status == VALID, bare.status == STANDSTILL
    assert min(np.count_nonzero(moves), np.count_nonzero(rests)) > 100
    np.testing.assert_array_equal(wide.sigma_nm[rests], bare.sigma_nm[rests])
    added = [(run.sigma_nm**2 - bare.sigma_nm**2)[moves] for run in (wide, viscous, bent)]
    np.testing.assert_allclose(added[0], 9.0, atol=1e-9)
    square = added[1] / 0.25
    assert square.max() > 0.2
    np.testing.assert_allclose(added[2], 0.25 * square / (1.0 + square / 0.16), atol=1e-9)


def test_the_load_of_the_link_does_not_depend_on_the_filter_of_the_torsion() -> None:
    joint = lossless(0.3, 0.4, damping=9.0)
    columns = list(twisted(14).arrays())
    columns[0] = np.full(len(columns[0]), 0.001)  # uneven steps give no acceleration
    low, kalman = (FusedEstimator(joint, settings).run(*columns) for settings in (OWN, TRACKED))
    one, other = low.load_nm, kalman.load_nm
    assert min(np.isfinite(one).sum(), np.isfinite(kalman.torque_rate_nm_s).sum()) > 200
    np.testing.assert_allclose(other, one, atol=1e-6)


def test_the_torque_rate_is_that_of_the_torsion() -> None:
    dt = np.full(500, 0.001)
    t = np.cumsum(dt)
    joint = lossless(0.3, 0.4)
    run = FusedEstimator(joint, TRACKED).run(dt, *moving(joint, 20.0 * t, SPEED * t))
    assert run.torque_rate_nm_s[300:] == pytest.approx(np.full(200, 20.0), abs=0.05)


# ---- configuration


def test_new_configurations_track_the_torsion() -> None:
    assert recommended("fused").track_torsion


def test_a_torsion_with_more_delay_than_the_motor_path_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"torsion_bandwidth_rad_s: found 150.0?, expected at least .* \(200 rad/s\)"
    ):
        EstimatorSettings(method="fused", torsion_bandwidth_rad_s=150.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [("rate_rad_s", 5.0), ("sigma_nm", -1.0), ("saturation_rad_s", 0.0), ("wave_rad_s", -1.0)],
)
def test_a_parameter_of_the_filter_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"fused\.tracking.*{name}: found {value:g}"):
        replace(TRACKING, **{name: value})


@pytest.mark.parametrize("tracking", [TRACKING, WITHOUT_WAVE])
def test_the_section_is_written_as_it_was_read(tracking: Tracking) -> None:
    joint = following(fused_joint(), tracking)
    content = joint.to_mapping()
    assert Joint.from_mapping(content, "file") == joint
    assert ("wave_rad_s" in content["fused"]["tracking"]) == (tracking is TRACKING)


# ---- reference of a sensor


def test_a_reference_is_the_sensor_through_the_filter_and_bridges_missing_values() -> None:
    dt = np.random.default_rng(4).uniform(0.0004, 0.0021, 900)
    t = np.cumsum(dt)
    sensor = 3.0 + 20.0 * t
    expected = low_pass(sensor, dt, 800.0)
    whole = reference_of(sensor, dt, 800.0)
    settled = t - t[0] >= 5.0 / 800.0
    assert np.isnan(whole[~settled]).all()
    assert whole[settled] == pytest.approx(expected[settled], abs=1e-12)
    received = np.random.default_rng(5).random(900) > 0.2
    some = reference_of(np.where(received, sensor, np.nan), dt, 800.0)[100:]
    assert np.array_equal(np.isnan(some), ~received[100:])
    assert some[received[100:]] == pytest.approx(expected[100:][received[100:]], abs=1e-9)
    np.testing.assert_array_equal(reference_of(sensor, dt, inf), [np.nan, *sensor[1:]])


def test_a_reference_restarts_after_a_gap_and_not_at_a_cycle_without_inputs() -> None:
    dt = np.full(200, 0.001)
    dt[50] = np.nan  # no inputs: no estimate either, and the next step spans both
    dt[51] = 0.002
    dt[120] = 0.2
    found = reference_of(np.full(200, 7.0), dt, 1000.0)
    unknown = {*range(5), 50, *range(120, 125)}
    assert set(np.flatnonzero(np.isnan(found)).tolist()) == unknown
    with pytest.raises(ValueError, match="found 3 values and 2 steps"):
        reference_of(np.zeros(3), np.zeros(2), 800.0)
