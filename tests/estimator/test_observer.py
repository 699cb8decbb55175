"""Both observers against closed forms and an ODE solver: no transient, lag 1/g, torsion, exact ripple and direction."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.estimator import JointEstimator
from jtqd.estimator.joint import Friction, Torsion
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import FusedObservedSample, FusedObserver, first_order_hold
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.estimator_helpers import joint1
from tests.estimator.fused_helpers import TORSION, twisted

G, KT, J = 100.0, 0.062, 7e-5
RATE = 200.0


def test_coefficients() -> None:
    for x in (1e-15, 1e-9, 1e-3, 0.2, 3.0, 100.0):
        a, b0, b1 = first_order_hold(1.0, x)
        assert a == pytest.approx(math.exp(-x), rel=1e-12, abs=1e-16)
        assert a + b0 + b1 == pytest.approx(1.0, abs=1e-15)  # a constant passes unchanged
        if x < 1e-2:  # series: b0 = x/2 - x^2/6, b1 = x/2 - x^2/3
            assert b0 == pytest.approx(x / 2 - x * x / 6, rel=1e-4, abs=3e-16)
            assert b1 == pytest.approx(x / 2 - x * x / 3, rel=1e-4, abs=3e-16)


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


@pytest.mark.parametrize("link_rate", [RATE, 37.0])
def test_both_observers_see_the_same_motor_torque_and_link_velocity(link_rate: float) -> None:
    m = twisted(5, 1500)
    found = fused_outputs(fused_observer(TORSION, link_rate), m.rows())
    free = replace(joint1(), friction=Friction(0.0, 0.0))
    settings = EstimatorSettings(method="tob", bandwidth_rad_s=RATE, link_bandwidth_rad_s=link_rate)
    paper = JointEstimator(free, settings).run(*m.arrays())
    assert np.max(np.abs(column(found, "raw_nm") - paper.tob_nm)[1:]) < 1e-9
    assert np.max(np.abs(column(found, "link_velocity_rad_s") - paper.features[:, 4])[1:]) < 1e-9


PLAIN = Torsion(12000.0, 0.0, 0.0, (2.0, 4.0), (0.0, 0.0), (0.0, 0.0))


def fused_observer(torsion: Torsion | None = PLAIN, link_rate: float = RATE) -> FusedObserver:
    return FusedObserver(joint1(), torsion, RATE, link_rate)


def fused_outputs(o: FusedObserver, rows: Iterable[tuple[float, ...]]) -> FloatArray:
    """Outputs [n, 10] over rows of (dt, current, motor position, motor velocity, link position)."""
    first, *rest = rows
    return np.array([o.start(*first[1:]), *(o.step(*row) for row in rest)])


def column(found: FloatArray, name: str) -> FloatArray:
    values: FloatArray = found[:, FusedObservedSample._fields.index(name)]
    return values


def uneven(count: int, seed: int = 1) -> FloatArray:
    return np.random.default_rng(seed).uniform(0.0004, 0.0021, count)


def spinning(v: FloatArray, dt: FloatArray, current: FloatArray) -> list[tuple[float, ...]]:
    """Rows of a rigid joint that turns at v [rad/s, joint side]."""
    link = np.cumsum(v * dt)
    return list(zip(*(a.tolist() for a in (dt, current, G * link, G * v, link)), strict=True))


@pytest.mark.parametrize("v", [0.0, 0.005, 0.3, -2.0])
def test_constant_speed_has_no_transient(v: float) -> None:
    dt = uneven(300)
    rows = spinning(np.full(300, v), dt, np.full(300, 2.5))
    twist = 3e-4
    found = fused_outputs(fused_observer(), [(a, i, q + G * twist, *rest) for a, i, q, *rest in rows])
    for name, expected in (
        ("raw_nm", G * KT * 2.5),
        ("joint_velocity_rad_s", v),
        ("link_velocity_rad_s", v),
        ("torsion_nm", 12000.0 * twist),
        ("direction", math.tanh(v / 0.02)),
    ):
        assert np.max(np.abs(column(found, name) - expected)) < 1e-9, name


@pytest.mark.parametrize("uneven_steps", [False, True])
def test_constant_acceleration_is_exact(uneven_steps: bool) -> None:
    """i = 0, w = alpha t: tau_raw = -G J alpha (1 - exp(-g t)), at every sample, for any steps."""
    dt = np.random.default_rng(4).uniform(1e-5, 8e-3, 300) if uneven_steps else np.full(300, 1e-3)
    t, alpha = np.cumsum(dt) - dt[0], 900.0
    rows = zip(dt, 0.0 * t, 0.0 * t, alpha * t, 0.0 * t, strict=True)
    raw = column(fused_outputs(fused_observer(None), rows), "raw_nm")
    assert raw == pytest.approx(-G * J * alpha * (1 - np.exp(-RATE * t)), abs=1e-9)


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_a_ramp_lags_by_exactly_one_over_g(rate: float) -> None:
    """Group delay at DC is 1/g for torque and velocity alike, uneven steps included."""
    dt = np.random.default_rng(5).uniform(2e-4, 2e-3, int(40.0 / rate / 1e-3))
    t, slope, zero = np.cumsum(dt) - dt[0], 7.0, np.zeros(len(dt))
    for name, unit, inputs in (
        ("raw_nm", G * KT, (slope * t, zero)),
        ("joint_velocity_rad_s", 1.0 / G, (zero, slope * t)),
    ):
        observer = FusedObserver(joint1(), None, rate, RATE)
        rows = zip(dt, inputs[0], zero, inputs[1], zero, strict=True)
        last = column(fused_outputs(observer, rows), name)[-1]
        assert t[-1] - last / (unit * slope) == pytest.approx(1.0 / rate, rel=1e-6)


def test_a_ramp_is_followed_with_a_lag_of_one_over_g() -> None:
    """Current, torsion and speed rise in a straight line; after 0.2 s, e^-40 of the start is left."""
    dt = uneven(400)
    t = np.cumsum(dt)
    a = 1.2  # rad/s^2, joint side
    twist = 2e-4 * t
    link = 0.5 * a * t**2
    rows = zip(dt, 0.8 * t, G * (link + twist), G * a * t, link, strict=True)
    found = fused_outputs(fused_observer(), rows)
    old = t > 0.25
    delayed = (t - 1.0 / RATE)[old]
    for name, expected in (
        (
            "raw_nm",
            G * KT * 0.8 * delayed - G * J * G * a,
        ),  # the rotor takes its part without lag: it is constant
        ("joint_velocity_rad_s", a * delayed),
        ("torsion_nm", 12000.0 * 2e-4 * delayed),
    ):
        assert np.max(np.abs(column(found, name)[old] - expected)) < 1e-9, name


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
    z, filtered = d[0], [d[0]]
    for k in range(1, len(d)):
        a, b0, b1 = first_order_hold(RATE, m.dt_s[k])
        z = a * z + b0 * d[k] + b1 * d[k - 1]
        filtered.append(z)
    expected = 9000.0 * np.array(filtered) + 3e8 * np.array(filtered) ** 3
    assert (
        np.max(np.abs(column(fused_outputs(fused_observer(torsion), m.rows()), "torsion_nm") - expected))
        < 1e-8
    )


def test_without_torsion_its_torque_is_zero() -> None:
    assert not np.any(column(fused_outputs(fused_observer(None), twisted(8, 700).rows()), "torsion_nm"))


@pytest.mark.parametrize(("order", "wave"), [(2, ("cos2", "sin2")), (4, ("cos4", "sin4"))])
def test_a_torque_ripple_is_linear_in_the_waves_at_every_speed(order: int, wave: tuple[str, str]) -> None:
    """A cos(n theta + p) at the motor, in the current: raw less the ripple is raw without it, in every sample."""
    amplitude, phase = 0.004, 0.7
    m = twisted(9, 1500)
    ripple = amplitude * np.cos(order * m.motor_position_rad + phase)
    clean = fused_outputs(fused_observer(), m.rows())
    rippled = fused_outputs(fused_observer(), replace(m, current_a=m.current_a + ripple / KT).rows())
    c, s = (column(clean, name) for name in wave)
    recovered = column(rippled, "raw_nm") - G * amplitude * (math.cos(phase) * c - math.sin(phase) * s)
    assert np.max(np.abs(column(rippled, "raw_nm") - column(clean, "raw_nm"))) > 0.1
    assert np.max(np.abs(recovered - column(clean, "raw_nm"))) < 1e-9


def test_waves_of_a_turning_motor_have_the_filters_gain_and_phase() -> None:
    """At constant speed: cos(n theta) through g/(s+g), hence smaller by g/|g + j n w| and later by its angle."""
    dt = np.full(2000, 0.0002)
    v = 0.7
    found = fused_outputs(fused_observer(), spinning(np.full(2000, v), dt, np.zeros(2000)))
    angle = G * v * np.cumsum(dt)
    for order, name in ((2, "cos2"), (4, "cos4")):
        response = RATE / (RATE + 1j * order * G * v)
        expected = np.real(response * np.exp(1j * order * angle))
        assert np.max(np.abs(column(found, name) - expected)[1000:]) < 1e-3


def test_friction_that_turns_with_the_motion_is_linear_in_direction() -> None:
    """Reversals of any quickness: current for F tanh(v/w0) at the joint shows up as F direction, in every sample."""
    m = twisted(4, 2000)
    friction = 6.0
    turning = friction * np.tanh(m.motor_velocity_rad_s / G / 0.02)
    clean = fused_outputs(fused_observer(), m.rows())
    loaded = fused_outputs(fused_observer(), replace(m, current_a=m.current_a + turning / (G * KT)).rows())
    s = column(clean, "direction")
    assert np.max(np.abs(column(loaded, "raw_nm") - friction * s - column(clean, "raw_nm"))) < 1e-9
    assert s.min() < -0.99
    assert s.max() > 0.99


def test_no_finite_angle_raises() -> None:
    """Multiples of the largest numbers are infinite, and cos(inf) is an error: such torsion is not a number."""
    torsion = replace(TORSION, orders_per_motor_rev=(2.0, 5.5))
    for angle in (1e300, -1.7e308):
        for o in (fused_observer(torsion), fused_observer(TORSION), fused_observer(None)):
            o.start(1.0, 0.0, 0.0, 0.0)
            seen = o.step(0.001, 1.0, angle, 0.0, 0.0)
            assert all(-1.0 <= wave <= 1.0 for wave in seen[4:9])
    o = fused_observer(TORSION)
    o.start(1.0, 0.0, 0.0, 0.0)
    assert math.isnan(o.step(0.001, 1.0, 1e6, 0.0, 0.0).raw_nm)  # impossible torsion: the guard starts again


def test_hysteresis_loop_of_the_torsion() -> None:
    """Slow triangle of the torsion angle: K d on the way up and down, H above it on the way up, H below on the way down."""
    loop = replace(PLAIN, hysteresis_nm=0.6, hysteresis_travel_rad=1e-4)
    o = FusedObserver(joint1(), loop, 200.0, 200.0)
    angle = 1e-3 * np.concatenate(
        (np.linspace(0, 1, 2000), np.linspace(1, -1, 4000), np.linspace(-1, 0, 2000))
    )
    o.start(0.0, 0.0, 0.0, 0.0)
    seen = np.array([o.step(1e-3, 0.0, 0.0, 0.0, -d).torsion_nm for d in angle.tolist()])
    plain = loop.stiffness_nm_per_rad * angle
    lag = loop.stiffness_nm_per_rad * 5e-7 / 1e-3 * 5e-3  # a ramp of 0.5 urad per ms, 1/g late
    assert seen[1500] - plain[1500] == pytest.approx(0.6 - lag, abs=2e-3)
    assert seen[4000] - plain[4000] == pytest.approx(-0.6 + lag, abs=2e-3)
    assert seen[7500] - plain[7500] == pytest.approx(0.6 - lag, abs=2e-3)


def test_damping_of_the_torsion_follows_its_rate() -> None:
    """A torsion that rises at 2 mrad/s: K d as late as ever, and D d' whatever the steps; none at the start."""
    o = fused_observer(replace(PLAIN, damping_nms_per_rad=8.0))
    dt = uneven(400)
    twist = 2e-3 * np.cumsum(dt)
    rows = [(step, 0.0, G * d, 0.0, 0.0) for step, d in zip(dt.tolist(), twist.tolist(), strict=True)]
    found = column(fused_outputs(o, rows), "torsion_nm")
    assert found[0] == pytest.approx(12000.0 * twist[0], abs=1e-9)
    late = np.cumsum(dt) > 0.25
    assert found[late] == pytest.approx(12000.0 * (twist[late] - 2e-3 / RATE) + 8.0 * 2e-3, abs=1e-9)


LOOP = replace(PLAIN, hysteresis_nm=0.6, hysteresis_travel_rad=1e-4)


def at_rest(o: FusedObserver, twist_rad: FloatArray) -> FloatArray:
    """Outputs while the twist takes these values, 50 ms each: the filter has settled at every one."""
    o.start(0.0, G * twist_rad[0], 0.0, 0.0)
    return np.array(
        [[o.step(1e-3, 0.0, G * twist, 0.0, 0.0) for _ in range(50)][-1] for twist in twist_rad.tolist()]
    )


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slip_that_began_anywhere_lies_between_its_bounds(sign: float) -> None:
    """Nothing is known at first; what is left open shrinks with the largest swing, to nothing from twice the travel on."""
    twist = sign * np.array((2.0, 2.5, 2.0, 3.0, 2.8, 3.9, 4.0, 3.9, 2.1)) * 1e-4
    found = at_rest(fused_observer(LOOP), twist)
    expected = 0.6 * np.array((1.0, 0.75, 0.75, 0.5, 0.5, 0.05, 0.0, 0.0, 0.0))
    assert column(found, "open_nm") == pytest.approx(expected, abs=2e-4)
    middle = (column(found, "torsion_nm") - 12000.0 * twist) / 0.6
    for began in np.linspace(-1.0, 1.0, 21).tolist():
        z, true = began, []
        for step in np.diff(twist, prepend=twist[0]) / 1e-4:
            z = min(max(z + step, -1.0), 1.0)
            true.append(z)
        assert np.all(np.abs(middle - true) <= expected / 0.6 + 1e-3)
    assert middle[-3:] == pytest.approx((sign, 0.9 * sign, -0.9 * sign), abs=1e-3)


def test_a_new_start_knows_nothing_of_the_slip() -> None:
    o = fused_observer(LOOP)
    at_rest(o, np.array((0.0, 5e-4)))
    assert o.step(1e-3, 0.0, G * 5e-4, 0.0, 0.0).open_nm == 0.0
    assert o.start(0.0, G * 5e-4, 0.0, 0.0).open_nm == 0.6
    assert o.step(1e-3, 0.0, G * 5e-4, 0.0, 0.0)[3] == pytest.approx(6.0, abs=1e-9)
    assert fused_observer(PLAIN).start(0.0, G * 5e-4, 0.0, 0.0).open_nm == 0.0


def test_noise_of_the_encoder_does_not_make_the_slip_creep() -> None:
    """A rising torsion with 6 urad of noise: an element that followed every sample would stay 0.1 Nm below its hold."""
    rng = np.random.default_rng(3)
    twist = np.linspace(0.0, 1e-3, 8000)
    o = fused_observer(LOOP)
    o.start(0.0, 0.0, 0.0, 0.0)
    seen = [o.step(1e-3, 0.0, G * d, 0.0, e) for d, e in zip(twist, rng.normal(0.0, 6e-6, 8000), strict=True)]
    off = column(np.array(seen), "torsion_nm") - 12000.0 * (twist - twist[1] / 1e-3 / RATE)
    assert np.mean(off[4000:]) == pytest.approx(0.6, abs=0.025)
