"""Balances of motor and torsion for tests of the benches: residuals from columns, and what each effect must leave in them.

From the table of laws (tests/estimator/effects/laws.py) over the signals of a run without noise; nothing of a bench is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jtqd.estimator.effects import EFFECTS, checked_parameters
from jtqd.estimator.effects.effect import State
from jtqd.estimator.joint import Joint
from tests.estimator.effects.laws import LAW_OF

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
    assert name in LAW_OF, (
        f"tests/estimator/effects/laws.py: found no row for {name}, expected one per effect"
    )
    effect, values, file = EFFECTS[name], checked_parameters(name, p), Joint.from_mapping(joint, "joint")
    age = effect.age_s(values)

    def rate(x: Array) -> Array:
        """Return the derivative; of a channel that is late the mean of the time in between."""
        late: Array = (np.interp(s.time_s + age, s.time_s, x) - x) / age if age else slope(x, s.time_s)
        return late

    state = State(
        coupling_position_rad=s.coupling_rad,
        current_a=s.current_a,
        current_rate_a_s=rate(s.current_a),
        direction=s.side,
        link_acceleration_rad_s2=s.link_alpha,
        link_position_rad=s.link_rad,
        link_velocity_rad_s=rate(s.link_rad),
        motor_acceleration_rad_s2=file.gear_ratio * s.alpha,
        motor_position_rad=s.motor_rad,
        temperature_c=first_c if effect.at_sensor else s.temperature_c,
        time_s=s.time_s,
        torque_nm=s.sensor_nm if effect.at_sensor else s.tau,
        torque_rate_nm_s=rate(s.sensor_nm),
        torsion_rad=s.twist_rad,
        torsion_rate_rad_s=slope(s.twist_rad, s.time_s),
        velocity_rad_s=s.v,
    )
    motor, torsion = (each + np.zeros_like(s.v) for each in LAW_OF[name](values, state, file))
    if effect.geometric or effect.at_motor_of(values):  # the damper sees what the spring sees
        error = slope(torsion / file.stiffness_nm_per_rad, s.time_s)
        torsion = torsion + file.damping_nms_per_rad * error
        if effect.at_motor_of(values):  # the motor's own speed and acceleration are misread too
            motor = motor - file.rotor_inertia_kgm2 * file.gear_ratio**2 * slope(error, s.time_s)
            motor = motor - file.friction.viscous_nms_per_rad * error
    return motor, torsion
