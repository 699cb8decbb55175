"""The estimate of one joint: values, statuses, faults, and equality with the vectorised twin."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.estimator import Estimator, FusedEstimator, JointEstimator
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.losses import FrictionModel, LossModel
from jtqd.estimator.network import TorqueNetwork
from jtqd.estimator.settings import METHODS as ALL_METHODS
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import Estimate
from tests.estimator.estimator_helpers import (
    first_order_hold,
    joint1,
    motion,
    small_network,
    with_faults,
)
from tests.estimator.fused_helpers import PLAIN, K

METHODS = tuple(method for method in ALL_METHODS if method != "fused")  # FusedEstimator's own
NETWORK = TorqueNetwork(small_network().data)
# i, v, and Table I there: e.g. 0.2530 + 0.1493*3 - 0.0820 - 0.0117*9 + 0.0060*3 + 0.0066 = 0.5382
TABLE_POINTS = ((3.0, 1.0, 0.5382), (-3.0, 1.0, 1.1272), (-3.0, -1.0, 0.5512), (3.0, -1.0, 1.1110))
FIELDS = ("torque_nm", "sigma_nm", "status", "tob_nm", "physics_nm", "network_nm")


def estimator(method: str, joint: Joint | None = None, **settings: Any) -> JointEstimator:
    return JointEstimator(joint or joint1(), EstimatorSettings(method=method, **settings), NETWORK)


def steady(e: JointEstimator, i: float, v: float, count: int = 3, start: float = 0.0) -> Estimate:
    for k in range(count):
        last = e.step(0.001, i, 100.0 * (start + v * 0.001 * k), 100.0 * v, start + v * 0.001 * k)
    return last


class FakeNetwork:
    """A network that says what the test wants; the envelope is wide unless told."""

    joint, sigma_nm = "joint1", 0.25

    def __init__(self, answer: Any, low: float = -1e9, high: float = 1e9) -> None:
        self.answer = answer
        self.envelope_low, self.envelope_high = (low,) * 6, (high,) * 6

    def run_one(self, *x: float) -> float:
        return float(self.answer(*x))

    def run_many(self, features: FloatArray) -> FloatArray:
        return np.array([self.run_one(*row) for row in features.tolist()])


def faked(answer: Any, low: float = -1e9, high: float = 1e9) -> JointEstimator:
    return JointEstimator(joint1(), EstimatorSettings(method="network"), FakeNetwork(answer, low, high))


# ---- values


def test_steady_state_is_equation_7_with_the_table() -> None:
    """At 3 A and 1 rad/s in the four quadrants, against the printed polynomials."""
    for i, v, eta in (
        (3.0, 1.0, 0.53820),
        (-3.0, 1.0, 1.12690),
        (-3.0, -1.0, 0.55100 + 0.0003),
        (3.0, -1.0, 1.1105),
    ):
        got = steady(estimator("efficiency"), i, v)
        assert got.status == st.VALID
        assert got.torque_nm == got.physics_nm
        assert got.torque_nm == pytest.approx(eta * 6.2 * i, abs=1e-3 * 6.2 * 3)
        assert math.isnan(got.network_nm)
    got = steady(estimator("tob"), 3.0, 1.0)
    assert got.torque_nm == got.tob_nm == pytest.approx(18.6 - 5.0, abs=1e-9)
    assert math.isnan(got.physics_nm)


def test_efficiency_estimate_is_equation_7_at_every_sample_of_a_quadrant() -> None:
    """With acceleration, |i| >= 1 A, 0.2 <= v <= 3: tau = tau_raw eta(tau_raw/(G Kt), v of the same age)."""
    e = estimator("efficiency")
    losses = LossModel(joint1())
    z = u_last = v_last = z_v = 0.0
    a, b0, b1 = first_order_hold(200.0, 0.001)
    for k in range(2000):
        i = 3.5 + 1.2 * math.sin(0.013 * k)
        w = 100.0 * (1.2 + 0.7 * math.sin(0.009 * k))
        u, v = i * 0.062 + 7e-5 * 200.0 * w, w / 100.0
        z, z_v = (u, v) if k == 0 else (a * z + b0 * u + b1 * u_last, a * z_v + b0 * v + b1 * v_last)
        u_last, v_last = u, v
        got = e.step(0.001, i, 0.0, w, 0.0)
        if k:
            raw = 100.0 * (z - 7e-5 * 200.0 * w)
            assert got.physics_nm == pytest.approx(raw * losses.eta(raw / 6.2, z_v), abs=2e-3 * abs(raw))


def test_known_truth_with_reversals_is_recovered() -> None:
    """Torque G (Kt i - J dw) - loss exactly: away from reversals the estimate is the delayed truth."""
    joint = joint1()
    losses = LossModel(joint)
    t = np.arange(0.0, 8.0, 0.001)
    v, acceleration = 1.2 * np.sin(2.0 * t), 2.4 * np.cos(2.0 * t)
    i_eff = 3.0 + 1.0 * np.sin(1.3 * t)  # what is left after accelerating the rotor
    truth = 6.2 * i_eff - losses.loss_many(i_eff, v)
    current = i_eff + 7e-5 * 100.0 * acceleration / 0.062
    delayed = np.interp(t - 1 / 200.0, t, truth)
    got = [
        estimator_.step(0.001, a, 0.0, 100.0 * b, 0.0).physics_nm
        for estimator_ in [estimator("efficiency")]
        for a, b in zip(current.tolist(), v.tolist(), strict=True)
    ]
    away = (np.abs(v) > 0.25) & (t > 0.1)
    assert np.max(np.abs(np.array(got)[away] - delayed[away])) < 0.02


def test_network_is_used_inside_its_envelope() -> None:
    got = steady(estimator("network"), 2.0, 1.0, 50)
    assert got.status == st.VALID
    assert got.torque_nm == got.network_nm
    assert got.sigma_nm == 0.31
    features = [[2.0, 4.9, 100.0, 0.049, 1.0, got.physics_nm]]
    assert got.network_nm == pytest.approx(float(NETWORK.run_many(np.array(features))[0]), abs=1e-9)


def test_outside_the_envelope_physics_serves_and_the_border_has_no_jump() -> None:
    """Current swept through the upper border 6 A (margin 0.6 A): weight 1, fading, 0; never a jump."""
    e = JointEstimator(joint1(), EstimatorSettings(), NETWORK)
    torque, seen = [], []
    for k in range(8001):
        i = 5.0 + 2.0 * k / 8000
        got = e.step(0.001, i, 50.0, 100.0, 0.5)
        if k > 100:
            torque.append((got.torque_nm, got.sigma_nm))
            seen.append(got.status)
            if i > 6.61:
                assert got.status == st.DEGRADED
                assert got.torque_nm == got.physics_nm
            elif i < 6.59:
                assert got.status == st.VALID
    assert set(seen) == {st.VALID, st.DEGRADED}
    assert np.max(np.abs(np.diff(np.array(torque), axis=0))) < 0.02


def test_a_network_far_from_physics_is_refused_without_a_jump() -> None:
    """Limit 25 % of 40 Nm = 10 Nm, fading from 7.5 Nm."""
    for offset, status, weight in (
        (7.4, 2, 1.0),
        (8.75, 2, 0.5),
        (-8.75, 2, 0.5),
        (10.1, 3, 0.0),
        (-99, 3, 0.0),
    ):
        got = steady(faked(lambda *x, offset=offset: x[5] + offset), 2.0, 1.0)
        assert got.status == status
        assert got.torque_nm == pytest.approx(got.physics_nm + weight * offset)
    for nonsense in (math.nan, math.inf):
        got = steady(faked(lambda *x, answer=nonsense: answer), 2.0, 1.0)
        assert got.status == st.DEGRADED
        assert got.torque_nm == got.physics_nm


# ---- statuses


def of_method(method: str) -> Estimator:
    return (
        FusedEstimator(PLAIN, EstimatorSettings(method="fused")) if method == "fused" else estimator(method)
    )


@pytest.mark.parametrize("method", ALL_METHODS)
def test_first_sample_starts_and_publishes_nothing(method: str) -> None:
    e = of_method(method)
    for got in (e.step(0.001, 2.0, 0.0, 100.0, 0.0), e.step(0.0, 2.0, 0.0, 100.0, 0.0)):
        assert got.status == st.STARTING
        assert all(math.isnan(x) for n, x in enumerate(got) if n != 2)
    assert e.step(0.001, 2.0, 0.1, 100.0, 0.001, 25.0).status == st.VALID
    e.reset()
    assert e.step(0.001, 2.0, 0.0, 100.0, 0.0, 25.0).status == st.STARTING


def assert_as_fresh(e: Estimator, method: str, dt: float = 0.001) -> None:
    """From the next sample on, at a step of dt, nothing is known of the samples before."""
    fresh = of_method(method)
    rows = [
        (2.0 + 0.1 * k, 100.0 * (0.021 + 0.001 * k + 5 / K), 100.0, 0.021 + 0.001 * k, 25.0) for k in range(3)
    ]
    assert e.step(dt, *rows[0]).status == fresh.step(0.001, *rows[0]).status == st.STARTING
    for row in rows[1:]:
        got = e.step(0.001, *row)
        assert got == pytest.approx(fresh.step(0.001, *row), rel=0.0, abs=0.0, nan_ok=True)
        assert got.status == st.VALID


def moved(method: str) -> Estimator:
    e = of_method(method)
    for k in range(20):
        e.step(0.001, 2.0, 100.0 * (0.001 * k + 5 / K), 100.0, 0.001 * k, 25.0)
    return e


@pytest.mark.parametrize("method", ALL_METHODS)
@pytest.mark.parametrize("dt", [0.0, -0.001, 0.0501, 1.0, math.inf, -math.inf, math.nan])
def test_a_bad_step_starts_again_from_that_sample(dt: float, method: str) -> None:
    assert_as_fresh(moved(method), method, dt)


NOT_FINITE = [*product(range(4), (math.nan, math.inf, -math.inf))]
ABSURD = [*product((0, 2, 3), (1e300, -1e300, 1.7e308)), (0, -1e4), (2, -1e6), (3, -1e5)]
OF_TORSION = [(1, 1e300), (1, -1e300), (1, 1.7e308), (1, 1e6), (1, -5e3), (3, 40.0)]
"""A motor position alone is no torque of the paper's observer."""


@pytest.mark.parametrize("method", ALL_METHODS)
def test_absurd_numbers_are_invalid_for_one_sample_and_leave_nothing(method: str) -> None:
    for place, absurd in (*NOT_FINITE, *ABSURD, *(OF_TORSION if method == "fused" else ())):
        e = moved(method)
        inputs = [2.0, 2.0 + 100 * 5 / K, 100.0, 0.02]
        inputs[place] = absurd
        got = e.step(0.001, *inputs, 25.0)
        assert got.status == st.INVALID, (place, absurd)
        assert math.isnan(got.torque_nm)
        assert math.isnan(got.sigma_nm)
        assert_as_fresh(e, method)


def test_the_longest_step_still_counts() -> None:
    e = estimator("tob")
    e.step(0.001, 2.0, 0.0, 100.0, 0.0)
    assert e.step(0.05, 2.0, 0.0, 100.0, 0.0).status == st.VALID


def test_more_than_three_times_rated_is_invalid() -> None:
    e = estimator("tob")
    limit_current = (120.0 + 5.0) / 6.2  # friction at 1 rad/s is 5 Nm
    assert steady(e, limit_current - 0.01, 1.0).status == st.VALID
    e.reset()
    got = steady(e, limit_current + 0.01, 1.0)
    assert got.status == st.INVALID
    assert math.isnan(got.torque_nm)
    assert got.tob_nm > 120.0  # kept for the record


def test_standstill_with_hysteresis() -> None:
    """Entered below 0.01 rad/s, left above 0.02: between the two the last state stays."""
    e = estimator("efficiency")
    speeds = (0.05, 0.015, 0.011, 0.0099, 0.015, 0.0199, 0.0201, 0.015, 0.0, -0.015, -0.0199, -0.0201)
    statuses = [steady(e, 2.0, v, 60).status for v in speeds]
    assert statuses == [2, 2, 2, 6, 6, 6, 2, 2, 6, 6, 6, 2]


def test_a_joint_that_starts_at_rest_stands() -> None:
    """The second sample, 40 ms later, is between the thresholds: only the start says that it stood."""
    e = estimator("tob")
    e.step(0.001, 2.0, 0.0, 0.0, 0.0)
    assert e.step(0.04, 2.0, 0.0, 1.7, 0.0).status == st.STANDSTILL


def test_standstill_value_and_sigma() -> None:
    got = steady(estimator("tob"), 1.0, 0.0)
    assert (got.status, got.torque_nm, got.sigma_nm) == (
        st.STANDSTILL,
        pytest.approx(6.2),
        pytest.approx(1.15 * 3.8 + 0.2),
    )
    got = steady(estimator("network"), 0.0, 0.0)
    assert (got.status, got.torque_nm, got.sigma_nm) == (
        st.STANDSTILL,
        pytest.approx(0.0),
        pytest.approx(1.15 * 3.8 + 0.2),
    )


# ---- refusals


def test_what_cannot_be_applied_is_refused() -> None:
    joint = replace(joint1(), effects=(Effect("torque_ripple", {"amplitude_nm": 0.3}),))
    for method in METHODS:
        with pytest.raises(ConfigError, match=r"joint1: found effects \(torque_ripple\)"):
            JointEstimator(joint, EstimatorSettings(method=method), NETWORK)
    with pytest.raises(ConfigError, match="found method 'fused', which FusedEstimator applies"):
        JointEstimator(joint1(), EstimatorSettings(method="fused"), NETWORK)
    bare = replace(joint1(), efficiency=None)
    with pytest.raises(ConfigError, match="found no efficiency"):
        JointEstimator(bare, EstimatorSettings(method="efficiency"))
    with pytest.raises(ConfigError, match="found no network"):
        JointEstimator(joint1(), EstimatorSettings(method="network"))
    with pytest.raises(ConfigError, match="found a network of joint 'joint1', expected one of 'joint9'"):
        JointEstimator(replace(joint1(), name="joint9"), EstimatorSettings(method="network"), NETWORK)
    with pytest.raises(ValueError, match="one length"):
        JointEstimator(joint1(), EstimatorSettings(method="tob"), None).run(*([np.zeros(3)] * 4), np.zeros(4))


def test_without_efficiency_the_network_stands_on_friction() -> None:
    got = steady(estimator("network", replace(joint1(), efficiency=None)), 2.0, 1.0)
    friction = FrictionModel(joint1().friction)
    assert got.physics_nm == pytest.approx(12.4 - friction.torque(1.0), abs=1e-9)


# ---- runs


def test_empty_run_and_read_only_arrays() -> None:
    empty = JointEstimator(joint1(), EstimatorSettings(), NETWORK).run(*([np.zeros(0)] * 5))
    assert all(len(getattr(empty, name)) == 0 for name in FIELDS)
    run = JointEstimator(joint1(), EstimatorSettings(method="tob"), None).run(*motion(1, 700).arrays())
    with pytest.raises(ValueError, match="read-only"):
        run.torque_nm[0] = 1.0


def test_results_depend_on_nothing_but_the_inputs() -> None:
    m = with_faults(motion(3), 3)
    runs = [JointEstimator(joint1(), EstimatorSettings(), NETWORK).run(*m.arrays()) for _ in range(2)]
    for name in FIELDS:
        assert getattr(runs[0], name).tobytes() == getattr(runs[1], name).tobytes()
