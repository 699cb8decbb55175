"""The observer against closed forms and against an ODE solver; every identity is exact to rounding."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import Observer, first_order_hold
from tests.estimator.estimator_helpers import joint1

G, KT, J = 100.0, 0.062, 7e-5
RATE = 200.0


def observer(rate: float = RATE, link_rate: float = 200.0) -> Observer:
    return Observer(joint1(), rate, link_rate)


def test_coefficients() -> None:
    for x in (1e-15, 1e-9, 1e-3, 0.2, 3.0, 100.0):
        a, b0, b1 = first_order_hold(1.0, x)
        assert a == pytest.approx(math.exp(-x), rel=1e-12, abs=1e-16)
        assert a + b0 + b1 == pytest.approx(1.0, abs=1e-15)  # a constant passes unchanged
        if x < 1e-2:  # series: b0 = x/2 - x^2/6, b1 = x/2 - x^2/3
            assert b0 == pytest.approx(x / 2 - x * x / 6, rel=1e-4, abs=3e-16)
            assert b1 == pytest.approx(x / 2 - x * x / 3, rel=1e-4, abs=3e-16)


def test_no_start_transient() -> None:
    """At constant current and speed the first step already gives the final value, whatever the speed."""
    friction = FrictionModel(joint1().friction)
    for i, w in ((3.0, 150.0), (-1.0, 300.0), (0.0, 0.0), (2.0, -250.0)):
        o = observer()
        first = o.start(i, 0.0, w, 0.4)
        assert first.raw_nm == pytest.approx(G * KT * i, abs=1e-9)
        for k in range(1, 200):
            seen = o.step(0.001, i, 0.0, w, 0.4 + w / G * 0.001 * k)
            assert seen.raw_nm == pytest.approx(G * KT * i, abs=1e-9)
            assert seen.tob_nm == pytest.approx(G * KT * i - friction.torque(w / G), abs=1e-9)
            assert seen.joint_velocity_rad_s == pytest.approx(w / G, abs=1e-12)
            assert seen.link_velocity_rad_s == pytest.approx(w / G, abs=1e-9)


@pytest.mark.parametrize("uneven", [False, True])
def test_constant_acceleration_is_exact(uneven: bool) -> None:
    """i = 0, w = alpha t: tau_raw = -G J alpha (1 - exp(-g t)), at every sample, for any steps."""
    rng = np.random.default_rng(4)
    alpha = 900.0
    o = observer()
    o.start(0.0, 0.0, 0.0, 0.0)
    t = 0.0
    for _ in range(300):
        dt = rng.uniform(1e-5, 8e-3) if uneven else 1e-3
        t += dt
        seen = o.step(dt, 0.0, 0.0, alpha * t, 0.0)
        assert seen.raw_nm == pytest.approx(-G * J * alpha * (1 - math.exp(-RATE * t)), abs=1e-9)


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_a_ramp_lags_by_exactly_one_over_g(rate: float) -> None:
    """Group delay at DC is 1/g for torque and velocity alike, uneven steps included."""
    rng = np.random.default_rng(5)
    o = observer(rate)
    o.start(0.0, 0.0, 0.0, 0.0)
    t, slope = 0.0, 7.0
    while t < 40.0 / rate:
        dt = rng.uniform(2e-4, 2e-3)
        t += dt
        raw = o.step(dt, slope * t, 0.0, 0.0, 0.0).raw_nm
    assert t - raw / (G * KT * slope) == pytest.approx(1.0 / rate, rel=1e-9)
    o.start(0.0, 0.0, 0.0, 0.0)
    t = 0.0
    while t < 40.0 / rate:
        dt = rng.uniform(2e-4, 2e-3)
        t += dt
        v = o.step(dt, 0.0, 0.0, slope * t, 0.0).joint_velocity_rad_s
    assert t - v * G / slope == pytest.approx(1.0 / rate, rel=1e-9)


def test_frequency_response_has_the_delay_of_the_analogue_filter() -> None:
    """-d(phase)/d(omega) at 1 kHz sampling: 1/g at DC, g/(g^2+omega^2) within 1 % at 10 Hz."""
    a, b0, b1 = first_order_hold(RATE, 1e-3)

    def phase(omega: float) -> float:
        z = complex(math.cos(omega * 1e-3), -math.sin(omega * 1e-3))
        h = (b0 + b1 * z) / (1 - a * z)
        return math.atan2(h.imag, h.real)

    for omega, expected, tolerance in ((1e-3, 1 / RATE, 1e-6), (63.0, RATE / (RATE**2 + 63.0**2), 1e-2)):
        delay = -(phase(omega * 1.001) - phase(omega * 0.999)) / (0.002 * omega)
        assert delay == pytest.approx(expected, rel=tolerance)


def test_uneven_steps_against_an_ode_solver() -> None:
    """Eq. (4) as written, integrated by an ODE solver between samples of piecewise linear i, w and f_m."""
    rng = np.random.default_rng(6)
    count = 60
    dt = rng.uniform(2e-4, 2e-2, count)
    t = np.cumsum(dt)
    i, w, q = (
        3 * rng.normal(size=count),
        200 * rng.normal(size=count),
        np.cumsum(0.01 * rng.normal(size=count)),
    )
    friction = FrictionModel(joint1().friction)
    f_m = np.array([friction.torque(x / G) for x in w]) / G
    link_rate = 130.0
    o = observer(RATE, link_rate)
    o.start(i[0], 0.0, w[0], q[0])
    state = np.array([i[0] * KT + J * RATE * w[0] - f_m[0], i[0] * KT + J * RATE * w[0], w[0] / G, w[0] / G])
    for k in range(1, count):

        def rates(s: float, y: FloatArray, k: int = k) -> list[float]:
            share = (s - t[k - 1]) / dt[k]
            i_s = i[k - 1] + share * (i[k] - i[k - 1])
            w_s = w[k - 1] + share * (w[k] - w[k - 1])
            f_s = f_m[k - 1] + share * (f_m[k] - f_m[k - 1])
            slope = (q[k] - q[k - 1]) / dt[k]
            u = i_s * KT + J * RATE * w_s
            return [
                RATE * (u - f_s - y[0]),
                RATE * (u - y[1]),
                RATE * (w_s / G - y[2]),
                link_rate * (slope - y[3]),
            ]

        state = solve_ivp(rates, (t[k - 1], t[k]), state, rtol=1e-11, atol=1e-12).y[:, -1]
        seen = o.step(dt[k], i[k], 0.0, w[k], q[k])
        expected = [
            (state[1] - J * RATE * w[k]) * G,
            (state[0] - J * RATE * w[k]) * G,
            state[2],
            state[3],
        ]
        assert list(seen) == pytest.approx(expected, rel=1e-7, abs=1e-7), k


def test_a_long_run_is_fast_enough_for_replay() -> None:
    """60 000 samples (a minute of bus) in well under a second; generous for a loaded machine."""
    o = observer()
    o.start(0.0, 0.0, 0.0, 0.0)
    began = time.process_time()
    for _ in range(60_000):
        o.step(0.001, 1.0, 0.0, 10.0, 0.0)
    assert time.process_time() - began < 1.0
