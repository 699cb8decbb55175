"""The rebuilt worlds obey their equations and are as stated; hand-written findings get the score that they deserve."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.estimator.joint import Joint
from jtqd.sysid.runs.column_map import GRAVITY_M_S2
from tests.validation.balances import rms, slope
from validation.diagnosis.open_questions import (
    GRAVITY,
    LOAD,
    QUESTIONS,
    VALUES,
    Outcome,
    Rig,
    Setup,
    column_map,
    drawn,
    integrate,
    joint_file,
    report,
    scored,
    write,
)

SEED = 3
Answer = dict[str, Any]


@pytest.fixture(scope="module", autouse=True)
def _mujoco() -> None:
    pytest.importorskip(
        "mujoco", reason="mujoco is not installed: pip install -e '.[dev]'; the worlds were NOT tested"
    )


def short(setup: Setup, seconds: float) -> Setup:
    """Two runs, the ends of their motions: what begins softly is in full swing."""
    n = round(1e3 * seconds)
    return replace(setup, rigs=setup.rigs[:2], motions=[m[-n:] for m in setup.motions[:2]])


@pytest.mark.parametrize("name", QUESTIONS)
@pytest.mark.parametrize("number", [0, 1])
def test_a_world_obeys_its_balances(name: str, number: int) -> None:
    """tau = G Kt i - G^2 Jm a - loss = K d + D d' = Jl a_l + J a_l + m g l sin q, and loss = C + mu |tau| against motion."""
    setup = short(drawn(name, SEED, number)[0], 5.0)
    for rig, motion in zip(setup.rigs, setup.motions, strict=True):
        x = integrate(rig, motion)
        t, q = x["time_s"], x["link_rad"]
        v = slope(x["motor_rad"], t)
        link_alpha = slope(slope(q, t), t)
        load = rig.load_inertia * link_alpha + rig.mass_kg * GRAVITY * rig.lever_m * np.sin(q)
        tau = load + rig.link_inertia * link_alpha
        loss = (rig.coulomb + rig.load_coefficient * np.abs(tau)) * np.sign(v) + rig.viscous * v
        motor = rig.ratio * rig.torque_constant * x["current_a"] - rig.reflected * slope(v, t) - loss - tau
        twist = x["motor_rad"] - q
        torsion = rig.stiffness * twist + rig.damping * slope(twist, t) - tau
        inner = slice(500, -20)  # the controller settles
        moving = np.convolve(np.abs(v) < 0.02, np.ones(61), "same")[inner] < 0.5
        assert moving.mean() > 0.1
        assert rms(motor[inner][moving]) < 3e-4 * rig.rated
        assert rms(torsion[inner][moving]) < 1e-3 * rig.rated
        assert rms((x["load_nm"] - load)[inner]) < 3e-4 * rig.rated


def test_power_goes_both_ways_through_the_gear() -> None:
    for number in (0, 1):
        setup, _ = drawn("load_friction", SEED, number)
        x = integrate(setup.rigs[0], setup.motions[0])
        power = x["load_nm"] * slope(x["link_rad"], x["time_s"])
        assert 0.2 < np.mean(power > 0.0) < 0.8
        assert setup.sensor is (number == 0)
    heavy, light = (setup.mass_kg for setup in drawn("load_friction", SEED, 0)[0].rigs[:2])
    assert light == pytest.approx(0.6 * heavy)


def test_a_compliant_link_rings_at_5_to_15_hz() -> None:
    for number in range(10):
        rig = drawn("compliant_gear", SEED, number)[0].mean
        assert 4.9 < np.sqrt(rig.stiffness / rig.load_inertia) / (2.0 * np.pi) < 15.1
        assert rig.stiffness > 100.0, "below what the library has"


def test_without_a_load_friction_under_load_is_below_what_counts() -> None:
    for number in range(3):
        setup, _ = drawn("no_load", SEED, number)
        rig, x = setup.rigs[0], integrate(setup.rigs[0], setup.motions[0])
        alpha = slope(slope(x["link_rad"], x["time_s"]), x["time_s"])[20:-20]
        tau = (rig.load_inertia + rig.link_inertia) * alpha
        assert rms(rig.load_coefficient * tau) < 1.2e-3 * rig.rated


@pytest.mark.parametrize("name", QUESTIONS)
def test_sets_are_as_stated(name: str) -> None:
    one, two, other = (drawn(name, seed, 1)[0] for seed in (SEED, SEED, SEED + 1))
    assert one.mean == two.mean != other.mean
    assert one.rigs == two.rigs
    assert all(np.array_equal(a, b) for a, b in zip(one.motions, two.motions, strict=True))
    for number in range(6):
        setup, _ = drawn(name, SEED, number)
        assert 4 <= len(setup.motions) <= 6
        assert all(15.0 <= len(m) / 1e3 <= 25.01 for m in setup.motions)
        assert 2 <= len(setup.differs) <= 4
        assert set(QUESTIONS[name].undecidable) <= set(setup.differs)
        Joint.from_mapping(joint_file(setup.sheet), "sheet")
    assert GRAVITY == GRAVITY_M_S2


def test_recordings_are_the_same_for_the_same_seed(tmp_path: Path) -> None:
    texts = []
    for place in ("a", "b"):
        setup, rng = drawn("another_unit", SEED, 0)
        (tmp_path / place).mkdir()
        write(tmp_path / place, short(setup, 1.0), rng)
        texts.append((tmp_path / place / "runs" / "rec_2.csv").read_text(encoding="utf-8"))
    assert texts[0] == texts[1]
    assert yaml.safe_load((tmp_path / "a" / "columns.yaml").read_text()) == column_map(setup)
    assert len(texts[0].splitlines()) == 1 + setup.rate_hz
    assert joint_file(setup.sheet)["effects"][0]["parameters"]["load_coefficient"] != 0.0


# Scores of hand-written findings.


def cause(setup: Setup, name: str, error: float = 0.0, width: float = 0.02, **more: Any) -> Answer:
    """A cause whose value is off by `error` of the truth and whose interval is `width` of it to either side."""
    parameter, attribute = VALUES[name]
    value = getattr(setup.mean, attribute) * (1.0 + error)
    found = {"value": value, "ci95": [value * (1.0 - width), value * (1.0 + width)], "unit": ""}
    return {"name": name, "joint": 1, "class": [name], "parameters": {parameter: found}, **more}


def findings(*causes: Answer, **more: Any) -> Answer:
    gain = {"rmse_before_nm": 1.0, "rmse_after_nm": 0.2}
    return {"verdict": "cause", "causes": list(causes), "gain": gain, "next_experiment": None, **more}


def asked(name: str, setup: Setup, *causes: Answer, **more: Any) -> Outcome:
    return scored(name, 0, setup, findings(*causes, **more))


def test_friction_under_load_must_be_the_largest_certain_and_inside() -> None:
    name, setup = "load_friction", drawn("load_friction", SEED, 0)[0]
    load, coulomb = cause(setup, LOAD), cause(setup, "coulomb_friction")
    good = asked(name, setup, load, coulomb)
    assert good.right
    assert (good.wrong, good.inside) == ((), {"coulomb_friction": True, LOAD: True})
    assert good.gain == pytest.approx(0.8)
    assert not asked(name, setup, coulomb, load).right
    assert not asked(name, setup, cause(setup, LOAD, 0.1), coulomb).right
    assert not asked(name, setup, {**load, "class": [LOAD, "torque_constant"]}).right
    assert not asked(name, setup, load, gain={"rmse_before_nm": 1.0, "rmse_after_nm": 1.1}).right
    assert not asked(name, setup, {**load, "grade": "effective"}).right
    no_limit = {"load_coefficient": {"value": setup.mean.load_coefficient, "ci95": [None, None]}}
    assert not asked(name, setup, {**load, "parameters": no_limit}).right


def test_a_compliant_gear_must_not_inflate_viscous_friction() -> None:
    name, setup = "compliant_gear", drawn("compliant_gear", SEED, 0)[0]
    gear = [cause(setup, "nonlinear_stiffness"), cause(setup, "gear_damping")]
    assert asked(name, setup, *gear).right
    assert asked(name, setup, *gear, cause(setup, "viscous_friction", 0.01)).right
    assert not asked(name, setup, *gear, cause(setup, "viscous_friction", 0.5)).right
    assert not asked(name, setup, gear[0]).right
    one = "compliant_gear_one_encoder"
    inflated = cause(setup, "viscous_friction", 0.5)
    assert asked(one, setup).right
    assert asked(one, setup, {**inflated, "grade": "one_of", "rivals": ["gear_damping"]}).right
    assert not asked(one, setup, inflated).right
    assert asked(one, setup, inflated).wrong == ("viscous_friction",)
    delay = {"name": "channel_delay", "joint": 1, "class": ["channel_delay"], "parameters": {}}
    assert asked(one, setup, delay).wrong == ("channel_delay",)


def test_of_another_unit_exactly_what_differs_must_be_certain() -> None:
    name, setup = "another_unit", drawn("another_unit", SEED, 0)[0]
    all_of = [cause(setup, n) for n in setup.differs]
    other = ({"torque_constant", "coulomb_friction", "viscous_friction", LOAD} - set(setup.differs)).pop()
    assert asked(name, setup, *all_of).right
    assert not asked(name, setup, *all_of[1:]).right
    assert asked(name, setup, *all_of, cause(setup, other, 0.1)).wrong == (other,)
    assert not asked(name, setup, *all_of, cause(setup, other, 0.1)).right
    nearer = asked(name, setup, cause(setup, setup.differs[0], 0.03, 0.01), *all_of[1:])
    assert (nearer.right, nearer.wrong, nearer.inside[setup.differs[0]]) == (False, (), False)


def test_what_runs_cannot_decide_must_be_listed_and_not_certain() -> None:
    name, setup = "inertials", drawn("inertials", SEED, 0)[0]
    both = ["rotor_inertia", "link_inertia"]
    assert asked(name, setup, cause(setup, both[0], 0.2, **{"class": both})).right
    assert asked(
        name, setup, cause(setup, both[0], grade="one_of", rivals=[{"name": both[1], "joint": 1}])
    ).right
    assert asked(name, setup, cannot_be_told=[{"name": n, "joint": 1} for n in both]).right
    assert not asked(name, setup).right
    assert not asked(name, setup, cannot_be_told=[{"name": both[0], "joint": 1}]).right
    certain = asked(name, setup, cause(setup, both[0]), cannot_be_told=[{"name": n} for n in both])
    assert (certain.right, certain.wrong) == (False, (both[0],))
    name, setup = "no_load", drawn("no_load", SEED, 0)[0]
    why = {"why": "Load-dependent friction would show in lifts.", "plan": None}
    assert asked(name, setup, cause(setup, "coulomb_friction"), next_experiment=why).right
    assert asked(name, setup, cannot_be_told=[{"name": LOAD, "joint": 1}]).right
    assert not asked(name, setup, next_experiment={"why": "Repeat the runs.", "plan": None}).right
    assert not asked(name, setup, cause(setup, LOAD), next_experiment=why).right


def test_a_refusal_is_not_right_and_a_reply_has_the_figures_of_the_sets() -> None:
    setup = drawn("compliant_gear_one_encoder", SEED, 0)[0]
    refused = scored("compliant_gear_one_encoder", 0, setup, {"refused": "found no torque"})
    assert (refused.right, refused.verdict, refused.gain) == (False, "found no torque", None)
    inflated = asked("compliant_gear_one_encoder", setup, cause(setup, "viscous_friction", 0.5))
    made = report([refused, inflated, inflated], SEED)
    assert list(made.tables[0].rows[0][:6]) == ["compliant_gear_one_encoder", "3", "0", "2", "0 of 0", "80 %"]
    assert made.notes[0].endswith("certain in 2 of 3 such joints (viscous_friction).")


def test_every_reply_fits_the_figures_and_names_its_thread() -> None:
    for name, question in QUESTIONS.items():
        setup = drawn(name, SEED, 0)[0]
        line = report([asked(name, setup)], SEED).notes[0]
        assert line.startswith("https://github.com/")
        assert "{" not in line
        assert question.thread in line


def test_a_rig_has_the_rating_of_its_current() -> None:
    rig: Rig = drawn("load_friction", SEED, 0)[0].mean
    assert rig.ratio * rig.torque_constant * rig.rated_a == pytest.approx(rig.rated)
