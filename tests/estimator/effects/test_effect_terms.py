"""Terms of the effect library: parameters combined from coefficients give back what the columns add up to."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.effects.effect import Effect, Term
from jtqd.estimator.effects.library import EFFECTS
from jtqd.estimator.joint import Joint
from tests.estimator.effects.effect_signals import PEAKED, PLAIN, balances, state

SEED = 4711


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
    assert {e.name for e in EFFECTS.values() if e.term_of_order(5.0) is not None} == {
        "torque_ripple",
        "cogging",
        "kinematic_error",
    }
    for name in ("torque_ripple", "cogging", "kinematic_error"):
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
            {"viscous_per_k": 0.03, "coulomb_per_k": 0.0, "reference_c": 33.0},
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
