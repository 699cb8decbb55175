"""Two filters in one estimate: its age is that of the torsion, whatever the weights; with one bandwidth nothing changes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import AdditiveLoss, Fused, FusedSigma, Joint, LossSide, Torsion
from jtqd.estimator.observer import low_pass, reference_of
from jtqd.estimator.settings import EstimatorSettings, age_ms, bandwidth_of
from tests.estimator.estimator_helpers import joint1
from tests.estimator.fused_helpers import TORSION, fused_joint, twisted

OWN = EstimatorSettings(method="fused", torsion_bandwidth_rad_s=800.0)
ONE = EstimatorSettings(method="fused")
SPRING = Torsion(12000.0, 0.0, 0.0, (2.0, 4.0), (0.0, 0.0), (0.0, 0.0))
SPEED = 0.5
SLIPPING = replace(TORSION, hysteresis_nm=0.7, hysteresis_travel_rad=8e-5, damping_nms_per_rad=9.0)


def lossless(current_nm: float, torsion_nm: float) -> Joint:
    """A joint without losses whose two paths weigh as these standard deviations say."""
    none = LossSide((0.0, 0.0), (0.0, 0.0), (0.0, 0.0), 0.0)
    loss = AdditiveLoss((-30.0, 30.0), none, none, 0.05, 3.0, 25.0, 1.0, 0.0)
    sigma = FusedSigma(current_nm, 0.0, 0.0, torsion_nm, 0.0, 0.01, (1.0, 1.0, 1.0, 1.0))
    return replace(joint1(), fused=Fused(loss, SPRING, sigma))


def estimated(joint: Joint, settings: EstimatorSettings, torque: FloatArray, dt: FloatArray) -> FloatArray:
    """Return the estimates of a joint at constant speed whose both paths see this torque exactly."""
    gain = joint.gear_ratio * joint.torque_constant_nm_per_a
    link = np.cumsum(SPEED * dt)
    motor = joint.gear_ratio * (link + torque / 12000.0)
    estimator = FusedEstimator(joint, settings)
    rows = zip(dt, torque / gain, motor, np.full(len(dt), joint.gear_ratio * SPEED), link, strict=True)
    return np.array([estimator.step(*row).torque_nm for row in rows])


WEIGHTS = pytest.mark.parametrize(("current_nm", "torsion_nm"), [(0.1, 10.0), (0.3, 0.3), (10.0, 0.1)])


@WEIGHTS
@pytest.mark.parametrize("rate", [200.0, 400.0, 800.0, 1600.0])
def test_a_ramp_is_as_old_as_the_torsion_whatever_the_weights(
    rate: float, current_nm: float, torsion_nm: float
) -> None:
    dt = np.random.default_rng(3).uniform(0.0004, 0.0021, 500)
    t = np.cumsum(dt)
    joint, settings = lossless(current_nm, torsion_nm), replace(ONE, torsion_bandwidth_rad_s=rate)
    found = estimated(joint, settings, 20.0 * t, dt)
    late = t > 0.3
    assert found[late] == pytest.approx(20.0 * (t - 1e-3 * age_ms(joint, settings))[late], abs=1e-6)
    assert age_ms(joint, settings) == pytest.approx(1e3 / rate)


@WEIGHTS
def test_a_step_is_seen_through_the_filter_of_the_torsion(current_nm: float, torsion_nm: float) -> None:
    """Within 1 % of the step: the rest of the motor path's filter is exact for lines between samples only."""
    dt = np.full(400, 0.001)
    torque = np.where(np.arange(400) < 150, 0.0, 10.0)
    joint = lossless(current_nm, torsion_nm)
    found = estimated(joint, OWN, torque, dt)[1:]
    assert found == pytest.approx(low_pass(torque, dt, bandwidth_of(joint, OWN))[1:], abs=0.1)
    assert np.max(np.abs(found - low_pass(torque, dt, 200.0)[1:])) > 3.0


def test_slow_errors_of_the_paths_count_with_the_weights() -> None:
    """The motor path 1 Nm off: only its share of that is left, with two bandwidths as with one."""
    dt = np.full(600, 0.001)
    torque = 5.0 + np.sin(np.arange(600) * 0.002)
    for settings in (ONE, OWN):
        joint = lossless(0.3, 0.4)
        gain = joint.gear_ratio * joint.torque_constant_nm_per_a
        link = np.cumsum(SPEED * dt)
        motor = joint.gear_ratio * (link + torque / 12000.0)
        estimator = FusedEstimator(joint, settings)
        speed = joint.gear_ratio * SPEED
        found = [
            estimator.step(a, (x + 1.0) / gain, m, speed, q).torque_nm
            for a, x, m, q in zip(dt, torque, motor, link, strict=True)
        ]
        error = (np.array(found) - low_pass(torque, dt, bandwidth_of(joint, settings)))[300:]
        assert error == pytest.approx(np.full(300, 0.4**2 / (0.3**2 + 0.4**2)), abs=1e-4)


@pytest.mark.parametrize("torsion", [SLIPPING, None], ids=["slip", "rigid"])
def test_without_the_key_it_is_the_estimate_of_one_bandwidth_to_the_bit(torsion: Any) -> None:
    m, joint = twisted(11), fused_joint(3, torsion)
    one = FusedEstimator(joint, ONE)
    same = FusedEstimator(joint, replace(ONE, torsion_bandwidth_rad_s=ONE.bandwidth_rad_s))
    for row in m.rows():
        assert repr(one.step(*row)) == repr(same.step(*row))


def test_a_joint_without_torsion_keeps_the_age_of_the_motor_path() -> None:
    rigid = fused_joint(3, None)
    assert bandwidth_of(rigid, OWN) == 200.0 == bandwidth_of(joint1(), replace(OWN, method="tob"))
    assert bandwidth_of(fused_joint(), OWN) == 800.0
    m = twisted(12)
    young, old = FusedEstimator(rigid, OWN), FusedEstimator(rigid, ONE)
    assert all(repr(young.step(*row)) == repr(old.step(*row)) for row in m.rows())


def test_a_torsion_that_is_older_than_the_motor_path_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"torsion_bandwidth_rad_s: found 150.0?, expected at least .* \(200 rad/s\)"
    ):
        EstimatorSettings(method="fused", torsion_bandwidth_rad_s=150.0)


def test_a_reference_is_the_sensor_through_the_filter_and_bridges_what_was_not_heard() -> None:
    dt = np.random.default_rng(4).uniform(0.0004, 0.0021, 900)
    t = np.cumsum(dt)
    sensor = 3.0 + 20.0 * t
    expected = low_pass(sensor, dt, 800.0)
    whole = reference_of(sensor, dt, 800.0)
    settled = t - t[0] >= 5.0 / 800.0
    assert np.isnan(whole[~settled]).all()
    assert whole[settled] == pytest.approx(expected[settled], abs=1e-12)
    heard = np.random.default_rng(5).random(900) > 0.2
    some = reference_of(np.where(heard, sensor, np.nan), dt, 800.0)
    assert np.array_equal(np.isnan(some[100:]), ~heard[100:])
    assert some[100:][heard[100:]] == pytest.approx(expected[100:][heard[100:]], abs=1e-9)


def test_a_reference_starts_again_after_a_gap_and_not_at_a_cycle_without_inputs() -> None:
    dt = np.full(200, 0.001)
    dt[50] = np.nan  # no inputs: no estimate either, and the next step spans both
    dt[51] = 0.002
    dt[120] = 0.2
    found = reference_of(np.full(200, 7.0), dt, 1000.0)
    unknown = {*range(5), 50, *range(120, 125)}
    assert set(np.flatnonzero(np.isnan(found)).tolist()) == unknown
    with pytest.raises(ValueError, match="found 3 values and 2 steps"):
        reference_of(np.zeros(3), np.zeros(2), 800.0)
