"""Both observers against closed forms and an ODE solver: no transient, lag 1/g, torsion, exact ripple and direction."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import JointEstimator, observe_run
from jtqd.estimator.joint import Friction, Torsion
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import ObservedRun
from jtqd.estimator.settings import EstimatorSettings
from jtqd.estimator.status import INVALID
from tests.estimator.estimator_helpers import first_order_hold, joint1
from tests.estimator.fused_helpers import TORSION, twisted

G, KT, J = 100.0, 0.062, 7e-5
RATE = 200.0


@pytest.mark.parametrize("x", [1e-9, 1e-3, 0.2, 3.0, 100.0])
def test_the_filter_is_exact_for_lines_between_samples(x: float) -> None:
    a, b0, b1 = first_order_hold(1.0, x)
    values = np.array((0.0, 1.0, 1.0, -0.5))
    expected = (0.0, b0, a * b0 + b0 + b1)
    found = low_pass(values, np.full(4, x), 1.0)
    assert found == pytest.approx((*expected, a * expected[-1] - 0.5 * b0 + b1), rel=1e-6, abs=1e-15)
    assert (
        found[1] == pytest.approx(x / 2 - x * x / 6, rel=1e-4) or x > 1e-2
    )  # series, for steps however small


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


def test_equation_4_with_uneven_steps_against_an_ode_solver() -> None:
    """As written, integrated by an ODE solver between samples of piecewise linear i, w and f_m."""
    rng = np.random.default_rng(6)
    count, link_rate = 60, 130.0
    dt = rng.uniform(2e-4, 2e-2, count)
    t = np.cumsum(dt)
    i, w, q = (
        3 * rng.normal(size=count),
        3 * rng.normal(size=count).cumsum(),
        0.01 * rng.normal(size=count).cumsum(),
    )
    friction = FrictionModel(joint1().friction)
    f_m = np.array([friction.torque(x / G) for x in w]) / G
    settings = EstimatorSettings(method="tob", bandwidth_rad_s=RATE, link_bandwidth_rad_s=link_rate)
    run = JointEstimator(joint1(), settings).run(dt, i, np.zeros(count), w, q)
    state = np.array([i[0] * KT + J * RATE * w[0] - f_m[0], w[0] / G])
    for k in range(1, count):

        def rates(s: float, y: FloatArray, k: int = k) -> list[float]:
            share = (s - t[k - 1]) / dt[k]
            now, last = (i[k], w[k], f_m[k]), (i[k - 1], w[k - 1], f_m[k - 1])
            i_s, w_s, f_s = (a + share * (b - a) for a, b in zip(last, now, strict=True))
            u = i_s * KT + J * RATE * w_s
            return [RATE * (u - f_s - y[0]), link_rate * ((q[k] - q[k - 1]) / dt[k] - y[1])]

        state = solve_ivp(rates, (t[k - 1], t[k]), state, rtol=1e-11, atol=1e-12).y[:, -1]
        assert run.tob_nm[k] == pytest.approx((state[0] - J * RATE * w[k]) * G, rel=1e-7, abs=1e-7), k
        assert run.features[k, 4] == pytest.approx(state[1], rel=1e-7, abs=1e-7), k


PLAIN = Torsion(12000.0, 0.0, 0.0, (2.0, 4.0), (0.0, 0.0), (0.0, 0.0))
LOOP = replace(PLAIN, hysteresis_nm=0.6, hysteresis_travel_rad=1e-4)
ALL = slice(1, None)
"""The first sample starts the observer."""


def observed(
    columns: tuple[FloatArray, ...], torsion: Torsion | None = PLAIN, **settings: float
) -> ObservedRun:
    """Outputs over columns (dt, current, motor position, motor velocity, link position)."""
    values: dict[str, Any] = {"bandwidth_rad_s": RATE, "link_bandwidth_rad_s": RATE} | settings
    return observe_run(joint1(), EstimatorSettings(method="fused", **values), torsion, *columns)


def uneven(count: int, seed: int = 1) -> FloatArray:
    return np.random.default_rng(seed).uniform(0.0004, 0.0021, count)


def spinning(
    v: FloatArray, dt: FloatArray, current: FloatArray, twist: float = 0.0
) -> tuple[FloatArray, ...]:
    """Columns of a joint that turns at v [rad/s, joint side]."""
    link = np.cumsum(v * dt)
    return dt, current, G * (link + twist), G * v, link


def twisting(twist: FloatArray, dt: float | FloatArray = 1e-3) -> tuple[FloatArray, ...]:
    """Columns of a joint at rest whose torsion takes these angles [rad]."""
    zero = np.zeros(len(twist))
    return zero + dt, zero, G * twist, zero, zero


def test_both_observers_see_the_same_motor_torque() -> None:
    m = twisted(5, 1500)
    free = replace(joint1(), friction=Friction(0.0, 0.0))
    paper = JointEstimator(free, EstimatorSettings(method="tob", bandwidth_rad_s=RATE)).run(*m.arrays())
    assert np.max(np.abs(observed(m.arrays(), TORSION).raw_nm - paper.tob_nm)[ALL]) < 1e-9


@pytest.mark.parametrize("v", [0.0, 0.005, 0.3, -2.0])
def test_constant_speed_has_no_transient(v: float) -> None:
    twist = 3e-4
    found = observed(spinning(np.full(300, v), uneven(300), np.full(300, 2.5), twist))
    for got, expected in (
        (found.raw_nm, G * KT * 2.5),
        (found.velocity_rad_s, v),
        (found.torsion_nm, 12000.0 * twist),
        (found.direction, math.tanh(v / 0.02)),
    ):
        assert np.max(np.abs(got - expected)[ALL]) < 1e-9


@pytest.mark.parametrize("uneven_steps", [False, True])
def test_constant_acceleration_is_exact(uneven_steps: bool) -> None:
    """i = 0, w = alpha t: tau_raw = -G J alpha (1 - exp(-g t)), at every sample, for any steps."""
    dt = np.random.default_rng(4).uniform(1e-5, 8e-3, 300) if uneven_steps else np.full(300, 1e-3)
    t, alpha = np.cumsum(dt) - dt[0], 900.0
    raw = observed((dt, 0.0 * t, 0.0 * t, alpha * t, 0.0 * t), None).raw_nm
    assert raw[ALL] == pytest.approx(-G * J * alpha * (1 - np.exp(-RATE * t))[ALL], abs=1e-9)


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_a_ramp_lags_by_exactly_one_over_g(rate: float) -> None:
    """Group delay at DC is 1/g for torque and velocity alike, uneven steps included."""
    dt = np.random.default_rng(5).uniform(2e-4, 2e-3, int(40.0 / rate / 1e-3))
    t, slope, zero = np.cumsum(dt) - dt[0], 7.0, np.zeros(len(dt))
    raw = observed((dt, slope * t, zero, zero, zero), None, bandwidth_rad_s=rate).raw_nm
    velocity = observed((dt, zero, zero, slope * t, zero), None, bandwidth_rad_s=rate).velocity_rad_s
    for last, unit in ((raw[-1], G * KT), (velocity[-1], 1.0 / G)):
        assert t[-1] - last / (unit * slope) == pytest.approx(1.0 / rate, rel=1e-6)


def test_current_torsion_and_speed_lag_alike() -> None:
    """They rise in a straight line; after 0.2 s, e^-40 of the start remains."""
    dt = uneven(400)
    t = np.cumsum(dt)
    a = 1.2  # rad/s^2, joint side
    twist = 2e-4 * t
    link = 0.5 * a * t**2
    found = observed((dt, 0.8 * t, G * (link + twist), G * a * t, link))
    late = t > 0.25
    delayed = (t - 1.0 / RATE)[late]
    for got, expected in (
        (found.raw_nm, G * KT * 0.8 * delayed - G * J * G * a),  # the rotor's part is constant: no lag
        (found.velocity_rad_s, a * delayed),
        (found.torsion_nm, 12000.0 * 2e-4 * delayed),
    ):
        assert np.max(np.abs(got[late] - expected)) < 1e-9


@pytest.mark.parametrize("orders", [(2.0, 4.0), (4.0,), (1.0, 2.0, 2.0, 5.5)])
def test_torsion_with_its_cubic_and_kinematic_error(orders: tuple[float, ...]) -> None:
    """The deflection through the filter, then the torque by the formula; orders other than 2 and 4 too."""
    rng = np.random.default_rng(len(orders))
    cos, sin = (tuple(rng.uniform(-5e-5, 5e-5, len(orders)).tolist()) for _ in range(2))
    torsion = Torsion(9000.0, 3e8, 7e-5, orders, cos, sin)
    m = twisted(8, 800)
    angle = m.motor_position_rad
    error = sum(
        c * np.cos(n * angle) + s * np.sin(n * angle) for n, c, s in zip(orders, cos, sin, strict=True)
    )
    d = angle / G - m.link_position_rad - 7e-5 - error
    assert np.max(np.abs(3e8 * d**3)) > 0.5
    filtered = low_pass(d, m.dt_s, RATE)
    expected = 9000.0 * filtered + 3e8 * filtered**3
    assert np.max(np.abs(observed(m.arrays(), torsion).torsion_nm - expected)[ALL]) < 1e-8
    assert not np.any(observed(m.arrays(), None).torsion_nm[ALL])


@pytest.mark.parametrize(("order", "wave"), [(2, (0, 1)), (4, (2, 3))])
def test_a_torque_ripple_is_linear_in_the_waves_at_every_speed(order: int, wave: tuple[int, int]) -> None:
    """A cos(n theta + p) at the motor, in the current: raw less the ripple is raw without it, in every sample."""
    amplitude, phase = 0.004, 0.7
    m = twisted(9, 1500)
    ripple = amplitude * np.cos(order * m.motor_position_rad + phase)
    clean = observed(m.arrays())
    rippled = observed(replace(m, current_a=m.current_a + ripple / KT).arrays()).raw_nm
    c, s = clean.waves[:, wave[0]], clean.waves[:, wave[1]]
    recovered = rippled - G * amplitude * (math.cos(phase) * c - math.sin(phase) * s)
    assert np.max(np.abs(rippled - clean.raw_nm)[ALL]) > 0.1
    assert np.max(np.abs(recovered - clean.raw_nm)[ALL]) < 1e-9


def test_waves_of_a_turning_motor_have_the_filters_gain_and_phase() -> None:
    """At constant speed: cos(n theta) through g/(s+g), hence smaller by g/|g + j n w| and later by its angle."""
    dt = np.full(2000, 0.0002)
    v = 0.7
    found = observed(spinning(np.full(2000, v), dt, np.zeros(2000)))
    angle = G * v * np.cumsum(dt)
    for order, wave in ((1, found.turn[:, 0]), (2, found.waves[:, 0]), (4, found.waves[:, 2])):
        response = RATE / (RATE + 1j * order * G * v)
        expected = np.real(response * np.exp(1j * order * angle))
        assert np.max(np.abs(wave - expected)[1000:]) < 1e-3


def test_friction_that_turns_with_the_motion_is_linear_in_direction() -> None:
    """Reversals of any speed: current for F tanh(v/w0) at the joint shows up as F direction, in every sample."""
    m = twisted(4, 2000)
    friction = 6.0
    turning = friction * np.tanh(m.motor_velocity_rad_s / G / 0.02)
    clean = observed(m.arrays())
    loaded = observed(replace(m, current_a=m.current_a + turning / (G * KT)).arrays())
    assert np.max(np.abs(loaded.raw_nm - friction * clean.direction - clean.raw_nm)[ALL]) < 1e-9
    assert np.nanmin(clean.direction) < -0.99
    assert np.nanmax(clean.direction) > 0.99


@pytest.mark.parametrize("angle", [1e6, 1e300, -1.7e308])
@pytest.mark.parametrize("torsion", [replace(TORSION, orders_per_motor_rev=(2.0, 5.5)), TORSION, None])
def test_no_finite_angle_raises(angle: float, torsion: Torsion | None) -> None:
    """Multiples of the largest numbers are infinite, and cos(inf) is an error; an impossible torsion is invalid."""
    zero = np.zeros(3)
    found = observed((zero + 0.001, zero + 1.0, np.array((0.0, 0.0, angle)), zero, zero), torsion)
    assert (found.status[2] == INVALID) == (torsion is not None)
    assert torsion is not None or np.all(np.abs(found.waves[2]) <= 1.0)


def test_hysteresis_loop_of_the_torsion() -> None:
    """Slow triangle of the torsion angle: K d on the way up and down, H above it on the way up, H below on the way down."""
    angle = 1e-3 * np.concatenate(
        (np.linspace(0, 1, 2000), np.linspace(1, -1, 4000), np.linspace(-1, 0, 2000))
    )
    off = observed(twisting(angle), LOOP).torsion_nm - 12000.0 * angle
    lag = 12000.0 * 5e-7 / 1e-3 * 5e-3  # a ramp of 0.5 urad per ms, 1/g late
    assert off[[1500, 4000, 7500]] == pytest.approx((0.6 - lag, -0.6 + lag, 0.6 - lag), abs=2e-3)


def test_damping_of_the_torsion_follows_its_rate() -> None:
    """A torsion that rises at 2 mrad/s: K d delayed by 1/g, and D d' whatever the steps."""
    dt = uneven(400)
    twist = 2e-3 * np.cumsum(dt)
    found = observed(twisting(twist, dt), replace(PLAIN, damping_nms_per_rad=8.0)).torsion_nm
    late = np.cumsum(dt) > 0.25
    assert found[late] == pytest.approx(12000.0 * (twist[late] - 2e-3 / RATE) + 8.0 * 2e-3, abs=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slip_that_began_anywhere_lies_between_its_bounds(sign: float) -> None:
    """Unknown at first; its bounds meet after a swing of twice the travel. Each twist lasts 50 ms."""
    twist = sign * np.array((2.0, 2.5, 2.0, 3.0, 2.8, 3.9, 4.0, 3.9, 2.1)) * 1e-4
    found = observed(twisting(np.repeat(twist, 50)), LOOP)
    settled = slice(49, None, 50)
    expected = 0.6 * np.array((1.0, 0.75, 0.75, 0.5, 0.5, 0.05, 0.0, 0.0, 0.0))
    assert found.open_nm[settled] == pytest.approx(expected, abs=2e-4)
    middle = (found.torsion_nm[settled] - 12000.0 * twist) / 0.6
    for start in np.linspace(-1.0, 1.0, 21).tolist():
        z, true = start, []
        for step in np.diff(twist, prepend=twist[0]) / 1e-4:
            z = min(max(z + step, -1.0), 1.0)
            true.append(z)
        assert np.all(np.abs(middle - true) <= expected / 0.6 + 1e-3)
    assert middle[-3:] == pytest.approx((sign, 0.9 * sign, -0.9 * sign), abs=1e-3)


def test_after_a_restart_the_slip_is_unknown() -> None:
    twist = np.repeat((0.0, 5e-4), 50)
    dt = np.full(100, 1e-3)
    dt[98] = 1.0  # a gap
    found = observed(twisting(twist, dt), LOOP)
    assert found.open_nm[[97, 99]] == pytest.approx((0.0, 0.6))
    assert found.torsion_nm[99] == pytest.approx(6.0, abs=1e-9)
    assert not np.any(observed(twisting(twist)).open_nm[ALL])


def test_noise_of_the_encoder_does_not_make_the_slip_creep() -> None:
    """A rising torsion with 6 urad of noise: an element that followed every sample would stay 0.1 Nm below its torque."""
    twist = np.linspace(0.0, 1e-3, 8000)
    dt, current, motor, velocity, link = twisting(twist)
    noise = np.random.default_rng(3).normal(0.0, 6e-6, 8000)
    found = observed((dt, current, motor, velocity, link + noise), LOOP).torsion_nm
    off = found - 12000.0 * (twist - twist[1] / 1e-3 / RATE)
    assert np.mean(off[4000:]) == pytest.approx(0.6, abs=0.025)
