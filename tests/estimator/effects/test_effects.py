"""The effect library: every hook against its law written again in laws.py, and terms that give back what they are given."""

from __future__ import annotations

import inspect
import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jtqd.estimator import effects
from jtqd.estimator.effects import EFFECTS, checked_parameters, discover
from jtqd.estimator.effects import effect as effect_module
from jtqd.estimator.effects.effect import ArrayFunctions, Effect, ScalarFunctions, State, Term
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Effect as Entry
from jtqd.estimator.joint import Friction, Joint
from tests.estimator.effects.effect_signals import PEAKED, PLAIN, at, balances, state
from tests.estimator.effects.laws import ALL, IDS, LAW_OF, LAWS, Law

SEED = 4711
K = PLAIN.stiffness_nm_per_rad


@pytest.mark.parametrize("joint", [PLAIN, PEAKED], ids=["plain", "with a Stribeck peak"])
@pytest.mark.parametrize(("name", "p", "law"), LAWS, ids=IDS)
def test_hooks_leave_in_the_balances_what_the_law_is(
    name: str, p: dict[str, float], law: Law, joint: Joint
) -> None:
    s = state(SEED)
    p = checked_parameters(name, p)
    for found, expected, balance in zip(
        balances(EFFECTS[name], p, s, joint), law(p, s, joint), ("motor", "torsion"), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=f"{name}: {balance}")


@pytest.mark.parametrize(("name", "p", "law"), LAWS, ids=IDS)
def test_one_sample_and_whole_runs_agree(name: str, p: dict[str, float], law: Law) -> None:
    s, effect, x = state(SEED + 1, 400), EFFECTS[name], ScalarFunctions()
    p = checked_parameters(name, p)
    whole = balances(effect, p, s, PLAIN)
    for k in range(400):
        for one, many in zip(balances(effect, p, at(s, k), PLAIN, x), whole, strict=True):
            assert one == pytest.approx(np.broadcast_to(many, 400)[k], rel=1e-12, abs=1e-12)


def test_every_effect_has_a_law_and_every_law_an_effect() -> None:
    """Names of the library, which joint files and findings rely on, are those of the rows of laws.py."""
    without, gone = sorted(set(EFFECTS) - set(LAW_OF)), sorted(set(LAW_OF) - set(EFFECTS))
    assert not without, (
        f"tests/estimator/effects/laws.py: found no row for {without}, expected one per effect"
    )
    assert not gone, f"estimator/effects: found no effect {gone}, expected those of joint files and findings"


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda e: e.name)
def test_what_an_effect_says_of_itself_is_consistent(effect: Effect) -> None:
    for other in (*effect.confused_with, *effect.by_hand):
        assert other in set(EFFECTS) - {effect.name}
        assert effect.name not in EFFECTS[other].confused_with, "a pair stands in one of both files"
    assert set(effect.needs) <= set(State.__slots__)
    for text in (effect.equation, effect.source, effect.tell_tale, effect.experiment):
        assert text
        assert "\n" not in text
    assert not effect.dissipative or effect.hooks == ("loss_nm",)
    assert not effect.changes_joint or all(p.key for p in effect.parameters)
    source = inspect.getsource(type(effect))
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


@pytest.mark.parametrize("rated_nm", [0.1, 4e3])
def test_ranges_hold_what_small_and_large_joints_have(rated_nm: float) -> None:
    """Of parts of the rated torque: friction and waves a quarter, at 0.3 rad/s; a spring that gives by 0.5 to 50 mrad; a
    rotor that the torque accelerates by 1 to 1000 rad/s2.
    """
    quarter = 0.25 * rated_nm
    sizes = {
        "Nm": (0.0, quarter),
        "Nms/rad": (0.0, quarter / 0.3),
        "Nm/s": (0.0, 1e-3 * rated_nm),
        "Nm/K": (0.0, 0.02 * rated_nm),
        "Nm/rad": (20.0 * rated_nm, 2000.0 * rated_nm),
        "kg m2": (1e-7 * rated_nm, 1e-2 * rated_nm),  # behind a gear of 100 and without one
    }
    for effect in EFFECTS.values():
        for p in effect.parameters:
            low, high = sizes.get(p.unit, (p.low, p.high))
            assert p.low <= low < high <= p.high, (effect.name, p)


def test_an_unknown_temperature_changes_nothing() -> None:
    s = state(SEED + 5, 50)
    s.temperature_c = np.where(np.arange(50) % 2 == 0, np.nan, s.temperature_c)
    for name, given, _ in LAWS:
        if "reference_c" not in given:
            continue
        p = {**given, **({"rate_nm_per_s": 0.0} if name == "sensor_drift" else {})}
        motor = balances(EFFECTS[name], p, s, PLAIN)[0]
        assert np.all(motor[::2] == 0.0)
        assert np.all(motor[1::2] != 0.0)
        assert balances(EFFECTS[name], p, at(s, 0), PLAIN, ScalarFunctions())[0] == 0.0


def test_dissipative_friction_opposes_motion_and_vanishes_at_rest() -> None:
    s = state(SEED + 6)
    for name, p, _ in LAWS:
        effect = EFFECTS[name]
        if not effect.dissipative or effect.name == "temperature_dependent_friction":
            continue
        weak = replace(PLAIN, friction=Friction(coulomb_nm=0.1, viscous_nms_per_rad=0.1))
        loss = effect.loss_nm(p, s, weak, ArrayFunctions())
        if effect.name != "friction_asymmetry":  # of which one direction has more, the other less
            assert np.all(loss * s.velocity_rad_s >= 0.0), effect.name
        rest = State(velocity_rad_s=0.0, direction=0.0, torque_nm=9.0, temperature_c=30.0)
        assert effect.loss_nm(p, rest, weak, ScalarFunctions()) == 0.0


def test_what_belongs_to_the_sensor() -> None:
    for effect in EFFECTS.values():
        assert effect.at_sensor == (effect.hooks == ("sensor_nm",)) == effect.name.startswith("sensor_")
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
    x = ScalarFunctions()
    one = [x.slip(v, 2.0) for v in d]
    np.testing.assert_allclose(one, ArrayFunctions().slip(d, 2.0), atol=0)
    np.testing.assert_allclose(one, [0, 0.5, 0.5, 1.0, 0.75, 0.75, 0.75, -0.5, -1.0, -0.75])
    assert ScalarFunctions.exp(1000.0) == math.inf


# ---- entries of a joint file's list `effects`


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("magic", {}, f"found 'magic', expected one of {', '.join(EFFECTS)}"),
        ("cogging", {"amplitude_nm": 0.1}, "order_per_motor_rev: missing, expected a number in 1/rev"),
        (
            "cogging",
            {"amplitude_nm": -0.1, "order_per_motor_rev": 6},
            "found -0.1, expected a number in Nm from 0",
        ),
        ("sensor_gain", {"gain": 1.0, "offset_nm": 0.0}, "offset_nm: unknown key"),
        ("sensor_gain", {"gain": math.nan}, "gain: found nan"),
        ("sensor_gain", {"gain": True}, "gain: found True"),
        (
            "channel_delay",
            {"delay_s": 1e-3, "channel": 0.5},
            "found 0.5, expected a whole number from 0 to 2",
        ),
    ],
)
def test_wrong_parameters_are_refused(name: str, given: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError) as error:
        Entry(name, given)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_defaults_are_filled_in_and_the_files_own_values_are_not() -> None:
    assert Entry("encoder_eccentricity", {"amplitude_rad": 1e-5}).parameters == {
        "amplitude_rad": 1e-5,
        "phase_rad": 0.0,
        "motor_side": 0.0,
    }
    assert Entry("stribeck_friction", {"stribeck_nm": 1.0}).parameters == {"stribeck_nm": 1.0}
    s = state(SEED + 7)
    for name, p, own in (
        ("stribeck_friction", {"stribeck_nm": 1.0}, {"stribeck_velocity_rad_s": 0.05}),
        ("nonlinear_stiffness", {"cubic_nm_per_rad3": 1e9}, {"stiffness_nm_per_rad": K}),
    ):
        for left, right in zip(
            balances(EFFECTS[name], p, s, PLAIN), balances(EFFECTS[name], p | own, s, PLAIN), strict=True
        ):
            np.testing.assert_array_equal(left, right)


def test_one_key_has_one_right_value() -> None:
    twice = (Entry("torque_constant", {"torque_constant_nm_per_a": 0.07}),) * 2
    with pytest.raises(ConfigError, match="found 'torque_constant' twice"):
        replace(PLAIN, effects=twice)
    waves = tuple(Entry("torque_ripple", {"amplitude_nm": 0.1, "order_per_motor_rev": n}) for n in (1, 2))
    assert len(replace(PLAIN, effects=waves).effects) == 2


NEW = """
from jtqd.estimator.effects.coulomb_friction import CoulombFriction
from jtqd.estimator.effects.effect import Effect
class Squeak({base}):
    group = "{group}"
"""


@pytest.mark.parametrize(
    ("base", "group", "message"),
    [
        ("CoulombFriction", "friction", None),
        ("CoulombFriction", "noise", "found group 'noise', expected one of"),
        ("Effect", "friction", "found no hook, expected one of"),
    ],
    ids=["right", "group", "hook"],
)
def test_a_new_effect_is_one_new_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, base: str, group: str, message: str | None
) -> None:
    name = f"squeak_{base}_{group}".lower()  # a module of its own per case
    (tmp_path / f"{name}.py").write_text(NEW.format(base=base, group=group))
    monkeypatch.setattr(effects, "__path__", [*effects.__path__, str(tmp_path)])
    monkeypatch.setattr(effect_module, "REGISTERED", dict(effect_module.REGISTERED))
    monkeypatch.setattr(effects, "REGISTERED", effect_module.REGISTERED)
    if message is None:
        assert set(discover()) == set(EFFECTS) | {name}
        return
    with pytest.raises(TypeError, match=f"effect {name}: {message}"):
        discover()


# ---- terms: parameters combined from coefficients give back the sum of the columns


def all_terms(joint: Joint) -> list[tuple[Effect, Term]]:
    """Every term of every effect, orders that nobody listed included."""
    terms = [(e, t) for e in EFFECTS.values() for t in e.terms(joint)]
    extra = [(e, e.term_of_order(7.0)) for e in EFFECTS.values()]
    return terms + [(e, t) for e, t in extra if t is not None]


NEAR_COEFFICIENTS = {"temperature_dependent_friction": (0.6, 0.4), "stribeck_friction": (0.5, 0.1)}
# hooks that are no linear functions of their parameters: how far the combination may be off, of its size
NEAR = {"temperature_dependent_friction": 0.05, "lost_motion": 0.2, "stribeck_friction": 0.3}


@pytest.mark.parametrize("joint", [PLAIN, PEAKED], ids=["plain", "with a Stribeck peak"])
def test_combined_parameters_give_the_sum_of_the_columns(joint: Joint) -> None:
    rng = np.random.default_rng(SEED + 3)
    s = state(SEED + 3)
    for effect, term in all_terms(joint):
        columns = [balances(effect, p, s, joint) for p in term.basis]
        for _ in range(5):
            c = rng.normal(0.0, 1.0, len(columns))
            if effect.name in NEAR:  # close to one exponential, one play, one peak
                c = np.array((1.0,) if len(c) == 1 else NEAR_COEFFICIENTS[effect.name]) + 0.015 * c
            found = balances(effect, term.combine(c), s, joint)
            for k, balance in enumerate(("motor", "torsion")):
                expected = sum(a * column[k] for a, column in zip(c, columns, strict=True))
                size = float(np.sqrt(np.mean(np.square(expected)))) or 1.0
                error = float(np.sqrt(np.mean(np.square(found[k] - expected))))
                limit = NEAR.get(effect.name, 1e-9)
                assert error <= limit * size, f"{effect.name} {term.basis} {balance} of {c}: {error / size}"


def test_single_parameters_come_back_from_their_own_columns() -> None:
    """Coefficients 1, 0, ... of a term are the parameters of its first column."""
    for joint in (PLAIN, PEAKED):
        for effect, term in all_terms(joint):
            for k, p in enumerate(term.basis):
                if effect.name == "stribeck_friction" and k == 1:
                    continue  # a second peak beside the file's merges with it
                found = term.combine([float(k == n) for n in range(len(term.basis))])
                assert set(found) == set(p)
                for name, value in p.items():
                    assert found[name] == pytest.approx(value, rel=1e-9, abs=1e-12), (effect.name, name)
            assert pickle.loads(pickle.dumps(term)).combine([0.3] * len(term.basis)) == term.combine(
                [0.3] * len(term.basis)
            )


def test_columns_of_waves_are_apart_and_their_order_is_the_one_asked_for() -> None:
    names = {name for name, p in ALL.items() if "order_per_motor_rev" in p}
    assert {name for name in ALL if EFFECTS[name].term_of_order(5.0) is not None} == names
    for name in names:
        term = EFFECTS[name].term_of_order(17.0)
        assert term is not None
        p = term.combine([-1.0, -0.0])
        assert p["order_per_motor_rev"] == 17.0
        assert p["phase_rad"] == math.pi
        assert next(v for k, v in p.items() if k.startswith("amplitude")) > 0.0


def test_a_temperature_term_gives_rate_and_reference() -> None:
    s = state(SEED + 4)
    rows = [
        ("torque_constant_temperature", {"per_k": -0.0017, "reference_c": 31.0}),
        ("sensor_drift", {"rate_nm_per_s": 0.0, "per_k_nm": -0.03, "reference_c": 33.0}),
        (
            "temperature_dependent_friction",
            {"viscous_per_k": 0.015, "coulomb_per_k": 0.0, "reference_c": 33.0},
        ),
    ]
    for name, truth in rows:
        effect = EFFECTS[name]
        y = balances(effect, truth, s, PLAIN)[0]
        best: dict[str, float] = {}
        error = math.inf
        for term in effect.terms(PLAIN):
            columns = np.column_stack([balances(effect, p, s, PLAIN)[0] for p in term.basis])
            c, *_ = np.linalg.lstsq(columns, y, rcond=None)
            left = float(np.linalg.norm(y - columns @ c))
            if left < error:
                best, error = term.combine(c), left
        assert best == pytest.approx(truth, rel=1e-6, abs=1e-9), name


def test_without_a_slope_the_reference_is_that_of_the_joint_file() -> None:
    for name in ("torque_constant_temperature", "sensor_drift", "temperature_dependent_friction"):
        for temperature, expected in (
            ({"temperature_c": 31.5}, 31.5),
            ({}, 25.0),
            ({"temperature_c": "?"}, 25.0),
        ):
            term = EFFECTS[name].terms(replace(PLAIN, provenance=temperature))[-1]
            assert term.combine([0.0, 0.0])["reference_c"] == expected
            assert term.basis[0]["reference_c"] == expected
