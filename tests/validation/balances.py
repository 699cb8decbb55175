"""Balances of motor and torsion for tests of the benches: residuals from columns, and what each effect must leave in them.

Written from the table of effects, as formulas over the signals of a run without noise; nothing of a bench is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray


@dataclass
class Signals:
    """One joint of one run, arrays [n]; motor_nm, torsion_nm: residuals of the two balances with the joint file."""

    current_a: Array
    motor_rad: Array
    link_rad: Array
    coupling_rad: Array
    v: Array
    side: Array
    alpha: Array
    link_alpha: Array
    tau: Array
    sensor_nm: Array
    twist_rad: Array
    temperature_c: Array
    time_s: Array
    moving: Array
    motor_nm: Array
    torsion_nm: Array


def signals(columns: Mapping[str, Array], number: int, joint: Mapping[str, Any]) -> Signals:
    """Return what the balances of a joint leave over in one run."""
    t = columns["time_s"]
    c = {k.removeprefix(f"j{number}."): x for k, x in columns.items() if k.startswith(f"j{number}.")}
    G, K = joint["gear_ratio"], joint["stiffness_nm_per_rad"]
    v = slope(c["motor_position_rad"], t) / G
    alpha = slope(v, t)
    link = c["link_position_rad"]
    link_alpha = slope(slope(link, t), t)
    tau = c["torque_nm"] + joint["link_inertia_kgm2"] * link_alpha
    twist = c["motor_position_rad"] / G - link
    side = np.sign(v)
    loss = joint["friction"]["coulomb_nm"] * side + joint["friction"]["viscous_nms_per_rad"] * v
    motor = (
        G * joint["torque_constant_nm_per_a"] * c["current_a"] - joint["rotor_inertia_kgm2"] * G**2 * alpha
    )
    near = np.convolve(np.abs(v) < 0.03, np.ones(61), "same") > 0.5
    return Signals(
        c["current_a"],
        c["motor_position_rad"],
        link,
        columns["j1.link_position_rad"],
        v,
        side,
        alpha,
        link_alpha,
        tau,
        c["torque_nm"],
        twist,
        c["temperature_c"],
        t,
        ~near,
        motor - loss - tau,
        K * twist + joint["damping_nms_per_rad"] * slope(twist, t) - tau,
    )


def rms(x: Array) -> float:
    """Return the root mean square, without what is not a number."""
    return float(np.sqrt(np.nanmean(np.square(x))))


def slope(x: Array, t: Array) -> Array:
    """Return the derivative, of sixth order: the motor's orders reach a tenth of the sampling rate."""
    padded = np.concatenate((2 * x[0] - x[3:0:-1], x, 2 * x[-1] - x[-2:-5:-1]))
    n = len(x)
    parts = [padded[3 + k : 3 + k + n] - padded[3 - k : 3 - k + n] for k in (1, 2, 3)]
    rate: Array = (45.0 * parts[0] - 9.0 * parts[1] + parts[2]) / (60.0 * (t[1] - t[0]))
    return rate


def slow_enough(name: str, p: Mapping[str, float], s: Signals) -> Array:
    """Return where samples resolve what turns with the motor: at most 0.5 rad of it per sample."""
    order = p.get("order_per_motor_rev", p.get("motor_side", 0.0))
    turning: Array = order * np.abs(slope(s.motor_rad, s.time_s)) * (s.time_s[1] - s.time_s[0])
    calm: Array = np.convolve(turning > 0.5, np.ones(21), "same") < 0.5
    return calm


def binned(x: Array, moving: Array, size: int = 10) -> Array:
    n = len(x) // size * size
    full = moving[:n].reshape(-1, size).all(axis=1)
    means: Array = x[:n].reshape(-1, size).mean(axis=1)[full]
    return means


def expected(
    name: str, p: Mapping[str, float], s: Signals, joint: Mapping[str, Any], first_c: Array
) -> tuple[Array, Array]:
    """Return what the effect leaves in the motor and in the torsion balance; first_c: temperature of joint 1."""
    zero = np.zeros_like(s.v)
    G, K, Kt = joint["gear_ratio"], joint["stiffness_nm_per_rad"], joint["torque_constant_nm_per_a"]
    loss, twist, load, current, link, sensor, damped = (zero for _ in range(7))
    friction = joint["friction"]
    if name == "coulomb_friction":
        loss = (p["coulomb_nm"] - friction["coulomb_nm"]) * s.side
    elif name == "viscous_friction":
        loss = (p["viscous_nms_per_rad"] - friction["viscous_nms_per_rad"]) * s.v
    elif name == "stribeck_friction":
        loss = p["stribeck_nm"] * np.exp(-((s.v / p["stribeck_velocity_rad_s"]) ** 2)) * s.side
    elif name == "load_dependent_friction":
        loss = p["load_coefficient"] * np.abs(s.tau) * s.side
    elif name == "friction_asymmetry":
        loss = p["asymmetry_nm"] * np.abs(s.side)
    elif name == "temperature_dependent_friction":
        above = s.temperature_c - p["reference_c"]
        loss = friction["viscous_nms_per_rad"] * s.v * np.expm1(-p.get("viscous_per_k", 0.0) * above)
        loss = loss + friction["coulomb_nm"] * s.side * np.expm1(-p.get("coulomb_per_k", 0.0) * above)
    elif name in ("torque_ripple", "cogging"):
        loss = p["amplitude_nm"] * np.cos(p["order_per_motor_rev"] * s.motor_rad + p["phase_rad"])
    elif name == "kinematic_error":
        angle = p["order_per_motor_rev"] * s.motor_rad + p["phase_rad"]
        twist = p["amplitude_rad"] * np.sin(angle)
        damped = joint["damping_nms_per_rad"] * slope(twist, s.time_s)  # the damper sees what the spring sees
        loss = s.tau * G * p["amplitude_rad"] * p["order_per_motor_rev"] * np.cos(angle)
    elif name == "nonlinear_stiffness":
        d = s.twist_rad
        twist = (p.get("stiffness_nm_per_rad", K) / K - 1.0) * d + p.get("cubic_nm_per_rad3", 0.0) / K * d**3
    elif name == "hysteresis":
        twist = p["torque_nm"] / K * _slip(s.twist_rad, p["travel_rad"])
    elif name == "lost_motion":
        twist = -np.clip(s.twist_rad, -p["width_rad"] / 2, p["width_rad"] / 2)
    elif name == "gear_damping":
        damped = (p["damping_nms_per_rad"] - joint["damping_nms_per_rad"]) * slope(s.twist_rad, s.time_s)
    elif name == "torque_constant":
        loss = -G * (p["torque_constant_nm_per_a"] - Kt) * s.current_a
    elif name == "torque_constant_saturation":
        loss = G * Kt * p["saturation_per_a"] * s.current_a * np.abs(s.current_a)
    elif name == "torque_constant_temperature":
        loss = -G * Kt * p["per_k"] * (s.temperature_c - p["reference_c"]) * s.current_a
    elif name == "current_offset":
        current = zero + p["offset_a"]
    elif name == "rotor_inertia":
        loss = G**2 * (p["rotor_inertia_kgm2"] - joint["rotor_inertia_kgm2"]) * s.alpha
    elif name == "sensor_offset":
        sensor = zero + p["offset_nm"]
    elif name == "sensor_gain":
        sensor = (1.0 - 1.0 / p["gain"]) * s.sensor_nm
    elif name == "sensor_drift":
        sensor = p.get("rate_nm_per_s", 0.0) * s.time_s
        sensor = sensor + p.get("per_k_nm", 0.0) * (first_c - p["reference_c"])
    elif name == "sensor_crosstalk":
        turn = np.cos(s.coupling_rad + p["phase_rad"])
        sensor = (p.get("amplitude_nm", 0.0) + p.get("share", 0.0) * s.sensor_nm) * turn
    elif name == "encoder_eccentricity":
        if p.get("motor_side", 0.0):
            error = p["amplitude_rad"] / G * np.sin(s.motor_rad + p["phase_rad"])
            link = -error
            damped = -joint["damping_nms_per_rad"] * slope(error, s.time_s)
            rate = slope(error, s.time_s)  # the motor's own speed and acceleration are misread too
            loss = -joint["rotor_inertia_kgm2"] * G**2 * slope(rate, s.time_s)
            loss = loss - friction["viscous_nms_per_rad"] * rate
        else:
            link = p["amplitude_rad"] * np.sin(s.link_rad + p["phase_rad"])
    elif name == "channel_delay":
        if p["channel"] == 0:
            sensor = _late(s.sensor_nm, s.time_s, p["delay_s"])
        elif p["channel"] == 1:
            current = _late(s.current_a, s.time_s, p["delay_s"])
        else:
            link = _late(s.link_rad, s.time_s, p["delay_s"])
    elif name == "link_inertia":
        load = (p["link_inertia_kgm2"] - joint["link_inertia_kgm2"]) * s.link_alpha
    elif name == "unbalance":
        load = p["moment_nm"] * np.sin(s.link_rad + p["phase_rad"])
    else:
        raise ValueError(f"no formula for {name}")
    return G * Kt * current + loss + load - sensor, -K * (twist + link) - damped + load - sensor


def _late(x: Array, t: Array, delay_s: float) -> Array:
    """Return reading less truth of a channel that is late: to first order -delay dx/dt."""
    late: Array = x - np.interp(t + delay_s, t, x)
    return late


def _slip(d: Array, travel: float) -> Array:
    """Return the Maxwell state along d, from 0."""
    z = np.zeros_like(d)
    for k in range(1, len(d)):
        z[k] = min(1.0, max(-1.0, z[k - 1] + (d[k] - d[k - 1]) / travel))
    return z
