"""The effect library: every hook against its equation written again here, and terms that give back what they are given."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects.effect import Effect, State
from jtqd.estimator.effects.library import EFFECTS, GROUPS, NAMES, checked_parameters
from jtqd.estimator.effects.scalar import Scalar
from jtqd.estimator.effects.whole import Whole
from jtqd.estimator.joint import Friction, Joint
from tests.estimator.effects.effect_signals import HOOKS, PEAKED, PLAIN, at, balances, state

SEED = 4711
G, KT, K = 100.0, 0.08, 12000.0


def exp(a: Any) -> Any:
    return np.exp(a)


def slipped(d: FloatArray, travel: float) -> FloatArray:
    """Maxwell slip by its definition: the spring's end stays within `travel` of the deflection."""
    out, anchor = [], d[0]
    for now in d:
        anchor = min(max(anchor, now - travel), now + travel)
        out.append((now - anchor) / travel)
    return np.array(out)


# name, parameters, (motor balance, torsion balance) by the equations of design and balances
Law = Callable[[State], tuple[Any, Any]]
LAWS: list[tuple[str, dict[str, float], Law]] = [
    ("coulomb_friction", {"coulomb_nm": 5.5}, lambda s: (1.5 * s.direction, 0)),
    ("viscous_friction", {"viscous_nms_per_rad": 2.0}, lambda s: (-s.velocity_rad_s, 0)),
    (
        "stribeck_friction",
        {"stribeck_nm": 1.2, "stribeck_velocity_rad_s": 0.1},
        lambda s: (1.2 * exp(-((s.velocity_rad_s / 0.1) ** 2)) * s.direction, 0),
    ),
    (
        "load_dependent_friction",
        {"load_coefficient": 0.1},
        lambda s: (0.1 * np.abs(s.torque_nm) * s.direction, 0),
    ),
    ("friction_asymmetry", {"asymmetry_nm": 0.3}, lambda s: (0.3 * np.abs(s.direction), 0)),
    (
        "temperature_dependent_friction",
        {"viscous_per_k": 0.02, "coulomb_per_k": 0.004, "reference_c": 27.0},
        lambda s: (
            3.0 * s.velocity_rad_s * (exp(-0.02 * (s.temperature_c - 27.0)) - 1.0)
            + 4.0 * s.direction * (exp(-0.004 * (s.temperature_c - 27.0)) - 1.0),
            0,
        ),
    ),
    (
        "torque_ripple",
        {"amplitude_nm": 0.4, "order_per_motor_rev": 2.0, "phase_rad": 0.7},
        lambda s: (0.4 * np.cos(2.0 * s.motor_position_rad + 0.7), 0),
    ),
    (
        "cogging",
        {"amplitude_nm": 0.2, "order_per_motor_rev": 12.0, "phase_rad": -0.7},
        lambda s: (0.2 * np.cos(12.0 * s.motor_position_rad - 0.7), 0),
    ),
    (
        "kinematic_error",
        {"amplitude_rad": 1e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.4},
        lambda s: (
            s.torque_nm * G * 2e-4 * np.cos(2.0 * s.motor_position_rad + 0.4),
            -K * 1e-4 * np.sin(2.0 * s.motor_position_rad + 0.4),
        ),
    ),
    (
        "nonlinear_stiffness",
        {"stiffness_nm_per_rad": 13000.0, "cubic_nm_per_rad3": 2e9},
        lambda s: (0, K * s.torsion_rad - (13000.0 * s.torsion_rad + 2e9 * s.torsion_rad**3)),
    ),
    (
        "hysteresis",
        {"torque_nm": 1.5, "travel_rad": 2e-4},
        lambda s: (0, -1.5 * slipped(s.torsion_rad, 2e-4)),
    ),
    (
        "lost_motion",
        {"width_rad": 4e-4},
        lambda s: (
            0,
            np.where(np.abs(s.torsion_rad) < 2e-4, K * s.torsion_rad, K * 2e-4 * np.sign(s.torsion_rad)),
        ),
    ),
    ("torque_constant", {"torque_constant_nm_per_a": 0.076}, lambda s: (G * 0.004 * s.current_a, 0)),
    (
        "torque_constant_saturation",
        {"saturation_per_a": 0.02},
        lambda s: (G * KT * s.current_a - G * KT * s.current_a * (1 - 0.02 * np.abs(s.current_a)), 0),
    ),
    (
        "torque_constant_temperature",
        {"per_k": -0.002, "reference_c": 25.0},
        lambda s: (G * KT * 0.002 * (s.temperature_c - 25.0) * s.current_a, 0),
    ),
    ("current_offset", {"offset_a": 0.05}, lambda s: (np.full(len(s.time_s), G * KT * 0.05), 0)),
    (
        "rotor_inertia",
        {"rotor_inertia_kgm2": 9e-5},
        lambda s: (G * 3e-5 * s.motor_acceleration_rad_s2, 0),
    ),
    ("sensor_offset", {"offset_nm": 0.6}, lambda s: (-0.6, -0.6)),
    (
        "sensor_gain",
        {"gain": 1.04},
        lambda s: (-(s.torque_nm - s.torque_nm / 1.04), -(s.torque_nm - s.torque_nm / 1.04)),
    ),
    (
        "sensor_drift",
        {"rate_nm_per_s": 0.01, "per_k_nm": 0.05, "reference_c": 20.0},
        lambda s: (-(0.01 * s.time_s + 0.05 * (s.temperature_c - 20.0)),) * 2,
    ),
    (
        "sensor_crosstalk",
        {"amplitude_nm": 0.4, "share": 0.02, "phase_rad": 1.1},
        lambda s: (-(0.4 + 0.02 * s.torque_nm) * np.cos(s.coupling_position_rad + 1.1),) * 2,
    ),
    (
        "encoder_eccentricity",
        {"amplitude_rad": 5e-5, "phase_rad": 0.3, "motor_side": 0.0},
        lambda s: (0, -K * 5e-5 * np.sin(s.link_position_rad + 0.3)),
    ),
    (
        "encoder_eccentricity",  # the motor's encoder reads A too much, so that theta_m/G does by A/G
        {"amplitude_rad": 5e-3, "phase_rad": 0.3, "motor_side": 1.0},
        lambda s: (0, K * 5e-3 / G * np.sin(s.motor_position_rad + 0.3)),
    ),
    (
        "channel_delay",
        {"delay_s": 2e-3, "channel": 0.0},
        lambda s: (2e-3 * s.torque_rate_nm_s, 2e-3 * s.torque_rate_nm_s),
    ),
    ("channel_delay", {"delay_s": 2e-3, "channel": 1.0}, lambda s: (-G * KT * 2e-3 * s.current_rate_a_s, 0)),
    ("channel_delay", {"delay_s": 2e-3, "channel": 2.0}, lambda s: (0, K * 2e-3 * s.link_velocity_rad_s)),
    (
        "gear_damping",
        {"damping_nms_per_rad": 20.0},
        lambda s: (0, -12.0 * s.torsion_rate_rad_s),
    ),
    (
        "link_inertia",
        {"link_inertia_kgm2": 0.04},
        lambda s: (0.03 * s.link_acceleration_rad_s2, 0.03 * s.link_acceleration_rad_s2),
    ),
    (
        "unbalance",
        {"moment_nm": 1.1, "phase_rad": -0.4},
        lambda s: (1.1 * np.sin(s.link_position_rad - 0.4), 1.1 * np.sin(s.link_position_rad - 0.4)),
    ),
]
CASES = [pytest.param(*law, id=f"{law[0]}-{n}") for n, law in enumerate(LAWS)]


@pytest.mark.parametrize(("name", "p", "law"), CASES)
def test_hooks_leave_in_the_balances_what_the_equation_says(name: str, p: dict[str, float], law: Law) -> None:
    s = state(SEED)
    p = checked_parameters(name, p)
    for found, expected, balance in zip(
        balances(EFFECTS[name], p, s, PLAIN), law(s), ("motor", "torsion"), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=f"{name}: {balance}")


@pytest.mark.parametrize(("name", "p", "law"), CASES)
def test_one_sample_and_whole_runs_agree(name: str, p: dict[str, float], law: Law) -> None:
    s, effect, x = state(SEED + 1, 400), EFFECTS[name], Scalar()
    p = checked_parameters(name, p)
    whole = balances(effect, p, s, PLAIN)
    for k in range(400):
        for one, many in zip(balances(effect, p, at(s, k), PLAIN, x), whole, strict=True):
            assert one == pytest.approx(np.broadcast_to(many, 400)[k], rel=1e-12, abs=1e-12)


def test_every_effect_has_a_law_here_and_every_name_is_there() -> None:
    assert set(EFFECTS) == {name for name, *_ in LAWS}, "a new effect needs its law in LAWS"
    assert set(EFFECTS) >= set(NAMES)
    assert len(NAMES) == len(set(NAMES)) == 26


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda e: e.name)
def test_what_an_effect_says_of_itself_is_consistent(effect: Effect) -> None:
    own = type(effect)
    assert {h for h in HOOKS if getattr(own, h) is not getattr(Effect, h)} == set(effect.hooks)
    assert (own.joint is not Effect.joint) == effect.changes_joint
    assert effect.group in GROUPS
    assert set(effect.confused_with) <= set(EFFECTS) - {effect.name}
    assert set(effect.needs) <= set(State.__slots__)
    for text in (effect.equation, effect.source, effect.tell_tale, effect.experiment):
        assert text
        assert "\n" not in text
    assert not effect.dissipative or effect.hooks == ("loss_nm",)
    source = inspect.getsource(own)
    for name in (p.name for p in effect.parameters):
        assert f'"{name}"' in source
    for p in effect.parameters:
        assert p.low < p.high
        assert p.default is None or math.isnan(p.default) or p.low <= p.default <= p.high


@pytest.mark.parametrize("joint", [PLAIN, PEAKED], ids=["plain", "with a Stribeck peak"])
def test_an_effect_with_a_key_is_nothing_at_the_files_own_value(joint: Joint) -> None:
    s = state(SEED + 2)
    for effect in EFFECTS.values():
        keys = {p.name: p.key for p in effect.parameters if p.key}
        if not keys:
            continue
        p = {q.name: 0.0 for q in effect.parameters}
        for name, key in keys.items():
            value: Any = joint
            for part in key.split("."):
                value = getattr(value, part)
            p[name] = value
        for left in balances(effect, p, s, joint):
            np.testing.assert_allclose(left, 0.0, atol=1e-12, err_msg=effect.name)


def test_an_unknown_temperature_changes_nothing() -> None:
    s = state(SEED + 5, 50)
    s.temperature_c = np.where(np.arange(50) % 2 == 0, np.nan, s.temperature_c)
    for name, given, _ in LAWS:
        if "temperature" not in name and name != "sensor_drift":
            continue
        p = {**given, **({"rate_nm_per_s": 0.0} if name == "sensor_drift" else {})}
        motor = balances(EFFECTS[name], p, s, PLAIN)[0]
        assert np.all(motor[::2] == 0.0)
        assert np.all(motor[1::2] != 0.0)
        assert balances(EFFECTS[name], p, at(s, 0), PLAIN, Scalar())[0] == 0.0


def test_dissipative_friction_opposes_motion_and_vanishes_at_rest() -> None:
    s = state(SEED + 6)
    for name, p, _ in LAWS:
        effect = EFFECTS[name]
        if not effect.dissipative or effect.name == "temperature_dependent_friction":
            continue
        weak = replace(PLAIN, friction=Friction(coulomb_nm=0.1, viscous_nms_per_rad=0.1))
        loss = effect.loss_nm(p, s, weak, Whole())
        if effect.name != "friction_asymmetry":  # of which one direction has more, the other less
            assert np.all(loss * s.velocity_rad_s >= 0.0), effect.name
        rest = State(velocity_rad_s=0.0, direction=0.0, torque_nm=9.0, temperature_c=30.0)
        assert effect.loss_nm(p, rest, weak, Scalar()) == 0.0


def test_what_belongs_to_the_sensor() -> None:
    at_sensor = {e.name for e in EFFECTS.values() if e.at_sensor}
    assert at_sensor == {"sensor_offset", "sensor_gain", "sensor_drift", "sensor_crosstalk"}
    delay = EFFECTS["channel_delay"]
    assert [delay.at_sensor_of(t.basis[0]) for t in delay.terms(PLAIN)] == [True, False, False]
    assert EFFECTS["sensor_gain"].at_sensor_of({"gain": 1.1})


def test_inertias_and_the_damping_change_the_joint() -> None:
    for name, key, value in (
        ("rotor_inertia", "rotor_inertia_kgm2", 9e-5),
        ("link_inertia", "link_inertia_kgm2", 0.04),
        ("gear_damping", "damping_nms_per_rad", 20.0),
    ):
        assert getattr(EFFECTS[name].joint({key: value}, PLAIN), key) == value
    assert EFFECTS["torque_constant"].joint({"torque_constant_nm_per_a": 1.0}, PLAIN) is PLAIN


def test_the_slip_remembers_in_the_loop_and_bears_gaps() -> None:
    d = np.array([0.0, 1.0, np.nan, 3.0, 2.5, np.nan, np.nan, 0.0, -9.0, -8.5])
    x = Scalar()
    one = [x.slip(v, 2.0) for v in d]
    np.testing.assert_allclose(one, Whole.slip(d, 2.0), atol=0)
    np.testing.assert_allclose(one, [0, 0.5, 0.5, 1.0, 0.75, 0.75, 0.75, -0.5, -1.0, -0.75])
    assert Scalar.exp(1000.0) == math.inf
