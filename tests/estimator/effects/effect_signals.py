"""A joint's state with everything in it, and what an effect leaves in the two balances: for tests of the effect library."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import HOOKS, ArrayFunctions, Effect, State, Values
from jtqd.estimator.joint import Effect as Entry
from jtqd.estimator.joint import Friction, Joint

PLAIN = Joint(
    name="j",
    gear_ratio=100.0,
    torque_constant_nm_per_a=0.08,
    rotor_inertia_kgm2=6e-5,
    stiffness_nm_per_rad=12000.0,
    damping_nms_per_rad=8.0,
    link_inertia_kgm2=0.01,
    rated_torque_nm=40.0,
    friction=Friction(coulomb_nm=4.0, viscous_nms_per_rad=3.0),
    provenance={"temperature_c": 28.0},
)

PEAKED = replace(PLAIN, friction=replace(PLAIN.friction, stribeck_nm=0.7, stribeck_velocity_rad_s=0.06))


def state(seed: int, count: int = 2000) -> State:
    """Return smooth signals [count] of a joint that moves both ways under both signs of load."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) * 2e-3

    def wave(size: float) -> FloatArray:
        rates, phases = rng.uniform(1.0, 9.0, 4), rng.uniform(0.0, 6.3, 4)
        result: FloatArray = size / 2.0 * np.sin(np.outer(t, rates) + phases).sum(axis=1)
        return result

    v, torque = wave(1.2), wave(25.0)
    link = np.cumsum(v) * 2e-3 + 0.3
    return State(
        coupling_position_rad=-link,
        current_a=wave(4.0),
        current_rate_a_s=wave(30.0),
        direction=np.tanh(v / 0.02),
        link_acceleration_rad_s2=wave(6.0),
        link_position_rad=link,
        link_velocity_rad_s=v * 1.001,
        motor_acceleration_rad_s2=wave(600.0),
        motor_position_rad=100.0 * link + 0.2,
        temperature_c=30.0 + 8.0 * t / t[-1],
        time_s=t,
        torque_nm=torque,
        torque_rate_nm_s=np.gradient(torque, t),
        torsion_rad=torque / 12000.0 + rng.normal(0.0, 2e-6, count),
        torsion_rate_rad_s=np.gradient(torque, t) / 12000.0,
        velocity_rad_s=v,
    )


def extended(joint: Joint, *effects: tuple[str, dict[str, float]]) -> Joint:
    return replace(joint, effects=tuple(Entry(name, p) for name, p in effects))


def at(s: State, k: int) -> State:
    """Return the floats of one sample."""
    return State(**{name: float(getattr(s, name)[k]) for name in State.__slots__})


def balances(effect: Effect, p: Values, s: State, joint: Joint, x: Any = None) -> tuple[Any, Any]:
    """Return what the effect leaves in the motor and in the torsion balance, Nm (docstring of effect.py)."""
    x = x or ArrayFunctions()
    value = {h: getattr(effect, h)(p, s, joint, x) if h in effect.hooks else 0.0 for h in HOOKS}
    both = value["load_nm"] - value["sensor_nm"]
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * value["current_a"] + value["loss_nm"] + both
    torsion = -joint.stiffness_nm_per_rad * (value["twist_rad"] + value["link_rad"]) + both
    return motor, torsion
