"""The effect library against an independent bench: `validation.generator` has equations and an integrator of its own.

A quiet bench (no noise, no drift) with one effect hidden leaves in the balances what the library's hooks say, and the
estimator of the extended joint is as good as that of a bench with nothing hidden. The seed is printed on failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS, checked_parameters
from jtqd.estimator.effects.effect import ArrayFunctions, State
from jtqd.estimator.estimator import estimate_columns
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings
from tests.estimator.effects.effect_signals import balances
from validation.diagnosis.entries import Hidden
from validation.generator.draw import Case, Order, draw_many

SEED = 8
DURATION_S = 6.0
FIXED: dict[str, tuple[dict[str, float], ...]] = {
    "channel_delay": ({"channel": 0.0}, {"channel": 1.0}, {"channel": 2.0}),
    "encoder_eccentricity": ({"motor_side": 0.0}, {"motor_side": 1.0}),
}
HIDDEN = [
    Hidden(name, "sensor" if EFFECTS[name].at_sensor_of(fixed) else 1, None, fixed)
    for name in sorted(EFFECTS)
    for fixed in FIXED.get(name, ({},))
]
# what the hooks may leave of what the effect adds: derivatives by differences; the spring's damping acts on the twist too
LEFT = {"kinematic_error": 0.15}
USUAL = 0.05
NOISE_NM = 0.005
WAVES_LEFT = 0.4
"""Of a wave at up to 20 Hz: the velocity channel is 1.5 ms late, and with it the rotor's share of the wave."""
FASTEST_RAD_S = 2.0 * np.pi * 20.0


@cache
def cases() -> list[Case]:
    """One bench with nothing hidden, then one per entry of HIDDEN; all the same but for that."""
    orders = [Order(SEED, each, "mixed", 1, DURATION_S, True) for each in ((), *((h,) for h in HIDDEN))]
    return draw_many(orders)


def columns_of(case: Case) -> tuple[Joint, FloatArray, JointColumns]:
    """Joint 1 of the only run."""
    run = case.runs[0]
    own = {key.removeprefix("j1."): x for key, x in run.items() if key.startswith("j1.")}
    return Joint.from_mapping(case.joints[1], "joint1"), run["time_s"], JointColumns(**own)


def slope(x: FloatArray, t: FloatArray) -> FloatArray:
    result: FloatArray = np.gradient(x, t)
    return result


def seen(case: Case) -> tuple[State, FloatArray, FloatArray, FloatArray]:
    """State, motor balance, torsion balance and weight [n] (0 near rest, where friction is no function of velocity)."""
    joint, t, c = columns_of(case)
    assert c.current_a is not None
    assert c.motor_position_rad is not None
    assert c.link_position_rad is not None
    assert c.torque_nm is not None
    g, k = joint.gear_ratio, joint.stiffness_nm_per_rad
    v = slope(c.motor_position_rad, t) / g
    link_speed = slope(c.link_position_rad, t)
    acceleration = slope(v, t)
    torque = c.torque_nm + joint.link_inertia_kgm2 * acceleration
    torsion = c.motor_position_rad / g - c.link_position_rad
    friction = joint.friction
    loss = friction.coulomb_nm * np.sign(v) + friction.viscous_nms_per_rad * v
    motor = g * (joint.torque_constant_nm_per_a * c.current_a - joint.rotor_inertia_kgm2 * g * acceleration)
    state = State(
        coupling_position_rad=c.link_position_rad,
        current_a=c.current_a,
        current_rate_a_s=slope(c.current_a, t),
        direction=np.sign(v),
        link_acceleration_rad_s2=acceleration,
        link_position_rad=c.link_position_rad,
        link_velocity_rad_s=v,
        motor_acceleration_rad_s2=acceleration * g,
        motor_position_rad=c.motor_position_rad,
        temperature_c=c.temperature_c,
        time_s=t - t[0],
        torque_nm=torque,
        torque_rate_nm_s=slope(c.torque_nm, t),
        torsion_rad=torsion,
        torsion_rate_rad_s=v - link_speed,
        velocity_rad_s=v,
    )
    weight = (np.convolve(np.abs(v) < 0.05, np.ones(101), "same") < 0.5).astype(float)
    rest = k * torsion + joint.damping_nms_per_rad * (v - link_speed) - torque
    return state, motor - loss - torque, rest, weight


def slow(p: Mapping[str, float], state: State, weight: FloatArray) -> FloatArray:
    """The weight without samples at which a wave is too fast for differences at 1 kHz."""
    rate = (
        np.abs(p.get("order_per_motor_rev", 0.0) * state.velocity_rad_s) * 100.0
    )  # gear ratios are about that
    result: FloatArray = weight * (rate < FASTEST_RAD_S)
    return result


def filtered(x: FloatArray, rate_rad_s: float) -> FloatArray:
    """The observer's filter at 1 kHz: the reference then has the estimate's age."""
    return low_pass(x, np.full(len(x), 1e-3), rate_rad_s)


def rms(x: Any, weight: FloatArray) -> float:
    return float(np.sqrt(np.sum(weight * np.square(x)) / np.sum(weight)))


@pytest.mark.parametrize("k", range(len(HIDDEN)), ids=[f"{h.name}{list(h.fixed.values())}" for h in HIDDEN])
def test_the_hooks_say_what_the_hidden_effect_leaves(k: int) -> None:
    hidden, case = HIDDEN[k], cases()[k + 1]
    joint, *_ = columns_of(case)
    effect, p = EFFECTS[hidden.name], checked_parameters(hidden.name, case.truth[0]["parameters"])
    state, *before, weight = seen(case)
    _, *floor, _ = seen(cases()[0])
    weight = slow(p, state, weight)
    explained = balances(effect, p, state, joint, ArrayFunctions())
    added = [rms(left - np.mean(left), weight) for left in before]
    for left, none, hook, name in zip(before, floor, explained, ("motor", "torsion"), strict=True):
        rest = left - hook
        if name == "torsion":  # the spring's zero is nobody's
            none, rest = none - np.mean(none), rest - np.mean(rest)  # noqa: PLW2901
        here = added[name == "torsion"] if np.any(hook) else max(added)
        shown = f"seed {SEED}, {hidden.name} {p}, {name}: {here:.4f} Nm, rest {rms(rest, weight):.4f}"
        limit = 1.5 * rms(none, weight) + LEFT.get(hidden.name, USUAL) * here + NOISE_NM
        assert rms(rest, weight) <= limit, shown


AT_MOTOR = [
    k
    for k, h in enumerate(HIDDEN)
    if EFFECTS[h.name].group in ("friction", "actuator")
    or h.name in ("kinematic_error", "torque_ripple")
    or h.fixed.get("channel") == 1.0
]


@pytest.mark.parametrize("k", AT_MOTOR, ids=[HIDDEN[k].name for k in AT_MOTOR])
def test_the_extended_estimate_is_as_good_as_with_nothing_hidden(k: int) -> None:
    hidden, case = HIDDEN[k], cases()[k + 1]
    joint, t, _ = columns_of(case)
    extended = replace(joint, effects=(Effect(hidden.name, case.truth[0]["parameters"]),))
    settings = EstimatorSettings(method="tob")

    def error(of: Joint, which: Case) -> float:
        state, *_, weight = seen(which)
        weight = slow(extended.effects[0].parameters, state, weight)
        torque = estimate_columns(of, settings, None, t, columns_of(which)[2]).torque_nm
        reference = filtered(state.torque_nm, settings.bandwidth_rad_s)
        return rms(np.nan_to_num(torque - reference), weight)

    none, before, after = error(joint, cases()[0]), error(joint, case), error(extended, case)
    shown = f"seed {SEED}, {hidden.name}: {before:.4f} Nm, extended {after:.4f}, nothing hidden {none:.4f}"
    limit = WAVES_LEFT if EFFECTS[hidden.name].term_of_order(2.0) is not None else 0.1
    assert after <= 1.3 * none + limit * before, shown
