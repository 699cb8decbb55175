"""Entries: what competes on which runs, priors that scale with the joint, bounds of what is possible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.dataset import library_candidates, usable_signals
from jtqd.sysid.diagnosis.diagnose import diagnose
from jtqd.sysid.diagnosis.entries import Entry, entries_of, entry_of, lead_of, usage
from jtqd.sysid.diagnosis.findings import EVERYTHING, Scope
from jtqd.sysid.diagnosis.limits import PRIORS, Usage
from jtqd.sysid.diagnosis.model import recorded
from tests.sysid.diagnosis.pendulums import ARM, Rig, Runs, runs_of

TEMPERED = {"temperature_dependent_friction", "torque_constant_temperature"}


def warmed(runs: Runs, last_c: float) -> Runs:
    """With a temperature that goes from 25 °C to this one in each run."""
    out = []
    for name, table in runs:
        t = table.time_s
        warm = 25.0 + (last_c - 25.0) * t / t[-1]
        out.append((name, RunTable(t, {1: replace(table.joints[1], temperature_c=warm)})))
    return out


def entries(runs: Runs, joint: Joint = ARM, scope: Scope = EVERYTHING) -> list[Entry]:
    signals, _ = usable_signals(runs, {1: joint}, (1,))
    return entries_of(library_candidates(signals, {1: joint}, scope), signals)


def one(found: list[Entry], kind: str) -> Entry:
    return next(e for e in found if e.kind == kind)


@pytest.fixture(scope="module")
def plain() -> Runs:
    return runs_of(ARM, 1, 2)


def test_a_temperature_that_does_not_vary_has_no_entries(plain: Runs) -> None:
    constant, varied = entries(warmed(plain, 25.05)), entries(warmed(plain, 45.0))
    assert not {e.effect.name for e in constant} & TEMPERED
    assert {e.effect.name for e in varied} >= TEMPERED
    assert not any("per_k_nm" in e.kind for e in constant)
    assert {e.key for e in varied} - {e.key for e in constant} == {(name, 1) for name in TEMPERED}


def test_a_recorder_makes_delays_within_its_step_and_nothing_else(plain: Runs) -> None:
    """Uniform over a step: a deviation of its twelfth part, squared; by the prior of 3 ms."""
    found = entries(plain)
    variance = recorded(found, 0.002)
    first = np.cumsum([0, *(e.size for e in found)])
    for k, e in enumerate(found):
        expected = (0.002 / 0.003) ** 2 / 12.0 if e.effect.name == "channel_delay" else 0.0
        assert variance[first[k] : first[k + 1]] == pytest.approx(expected, rel=1e-6), e.kind


@pytest.mark.parametrize("last_c", [25.05, None], ids=["constant", "not recorded"])
def test_what_needs_a_temperature_cannot_be_told_without_its_change(
    plain: Runs, last_c: float | None
) -> None:
    found = diagnose(plain if last_c is None else warmed(plain, last_c), {1: ARM})
    lost = {u.name: u for u in found.cannot_be_told}
    assert lost.keys() >= TEMPERED
    motion = "" if last_c is None else "warm_up"  # no motion tells what no channel records
    assert all(lost[name].experiment == motion for name in TEMPERED)
    assert not {c.name for c in (*found.causes, *found.too_small)} & TEMPERED


def test_a_known_load_has_no_entries_of_a_sensor(plain: Runs) -> None:
    known = entries(plain, scope=Scope(known_references=frozenset({1})))
    assert "sensor" in {e.joint for e in entries(plain)}
    assert "sensor" not in {e.joint for e in known}
    assert {e.effect.name for e in known} >= {"torque_constant", "coulomb_friction", "current_offset"}


def test_one_encoder_has_no_entries_of_the_torsion(plain: Runs) -> None:
    assert not {"nonlinear_stiffness", "gear_damping"} & {e.effect.name for e in entries(plain)}


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("coulomb_friction", "coulomb_nm"),
        ("viscous_friction", "viscous_nms_per_rad"),
        ("load_dependent_friction", "load_coefficient"),
        ("rotor_inertia", "rotor_inertia_kgm2"),
    ],
)
def test_what_cannot_be_negative_is_bounded(plain: Runs, kind: str, name: str) -> None:
    e = one(entries(plain), kind)
    (parameter,) = (p for p in e.effect.parameters if p.name == name)
    ends = sorted(e.values(np.array([end]))[name] for end in (e.low, e.high))
    assert ends[0] == pytest.approx(max(parameter.low, 0.0), abs=1e-8)
    assert ends[1] <= parameter.high * (1.0 + 1e-9)
    assert e.low < 0.0 < e.high or kind == "load_dependent_friction"


def test_a_factor_of_the_balance_is_bounded_by_other_units(plain: Runs) -> None:
    found = entries(plain)
    kt = one(found, "torque_constant")
    ends = sorted(kt.values(np.array([end]))["torque_constant_nm_per_a"] for end in (kt.low, kt.high))
    assert ends[0] >= 0.4 * ARM.torque_constant_nm_per_a
    assert ends[1] <= 2.5 * ARM.torque_constant_nm_per_a
    gain = one(found, "sensor_gain")
    assert sorted(gain.values(np.array([end]))["gain"] for end in (gain.low, gain.high))[0] > 0.3


def test_friction_is_never_negative_in_findings() -> None:
    """The joint has none; the file has a little too much for what the runs' noise can tell from less than nothing."""
    true = replace(ARM, friction=Friction(0.0, 0.0))
    found = diagnose(runs_of(true, 4, 3, Rig(current_noise_a=0.2)), {1: ARM})
    for entry in (*found.causes, *found.too_small):
        for name in ("coulomb_nm", "viscous_nms_per_rad"):
            if name in entry.parameters:
                assert entry.parameters[name].value >= 0.0
                assert entry.parameters[name].ci95[0] >= 0.0
    for present in found.predicts:
        assert (
            min(present.values.get("coulomb_nm", 0.0), present.values.get("viscous_nms_per_rad", 0.0)) >= 0.0
        )


def scaled_joint(scale: float) -> Joint:
    return replace(
        ARM,
        torque_constant_nm_per_a=scale * ARM.torque_constant_nm_per_a,
        rotor_inertia_kgm2=scale * ARM.rotor_inertia_kgm2,
        stiffness_nm_per_rad=scale * ARM.stiffness_nm_per_rad,
        damping_nms_per_rad=scale * 10.0,
        link_inertia_kgm2=scale * 0.05,
        rated_torque_nm=scale * ARM.rated_torque_nm,
        friction=Friction(scale * ARM.friction.coulomb_nm, scale * ARM.friction.viscous_nms_per_rad),
    )


USE = Usage(0.8, 20.0)
OF_TORQUE = ("_nm", "_nms_per_rad", "_kgm2", "_nm_per_a", "_nm_per_rad", "_nm_per_rad3", "_nm_per_s")
"""Ends of the names of parameters that are proportional to torque."""


@pytest.mark.parametrize("scale", [0.01, 20.0])
def test_priors_scale_with_the_joint(scale: float) -> None:
    small, large = scaled_joint(1.0), scaled_joint(scale)
    for kind, prior in PRIORS.items():
        one_size, other = prior.size(small, USE), prior.size(large, USE)
        assert one_size > 0.0, kind
        effect = EFFECTS.get("nonlinear_stiffness" if kind == "stiffness" else kind.split(".")[0])
        assert effect is not None, kind
        names = [p.name for p in effect.parameters]
        of_torque = other == pytest.approx(scale * one_size)
        free = other == pytest.approx(one_size)
        assert of_torque or free, kind
        if not kind.endswith((".share", ".motor")) and any(n.endswith(OF_TORQUE) for n in names[:1]):
            assert of_torque, kind


@pytest.mark.parametrize("scale", [0.01, 1.0, 20.0])
def test_a_scaled_coefficient_of_one_is_the_size_of_the_prior(scale: float) -> None:
    """Whatever the step of the library's columns."""
    joint = scaled_joint(scale)
    runs = runs_of(
        joint, 1, 1, Rig(moment_nm=25.0 * scale, inertia_kgm2=1.8 * scale, sensor_noise_nm=0.1 * scale)
    )
    signals, _ = usable_signals(runs, {1: joint}, (1,))
    use = usage([s for run in signals for s in run])
    single = [e for e in entries(runs, joint) if e.size == 1]
    assert len(single) > 8
    for e in single:
        lead = lead_of(e.candidate)
        changed, file = e.values(np.array([1.0]))[lead], e.values(np.array([0.0]))[lead]
        assert abs(changed - file) == pytest.approx(PRIORS[e.kind].size(joint, use), rel=1e-3), e.kind


def test_a_wave_that_turns_too_fast_to_be_seen_is_no_entry(plain: Runs) -> None:
    """In a twentieth of the motion it must be slower than what the runs resolve."""
    signals, _ = usable_signals(plain, {1: ARM}, (1,))
    mine = [s for run in signals for s in run]
    highest = usage(mine).order
    seen = [
        highest * ARM.gear_ratio * np.abs(s.state.velocity_rad_s)
        < 2.0 * np.pi * min(s.visible.highest_hz, 0.25 / s.step_s)
        for s in mine
    ]
    moving = np.concatenate([x[s.usable("motor")] for x, s in zip(seen, mine, strict=True)])
    assert np.mean(moving) == pytest.approx(0.05, abs=0.005)
    library = library_candidates(signals, {1: ARM}, EVERYTHING)
    [cogging] = [
        c for c in library if c.effect.name == "cogging" and c.term.basis[0]["order_per_motor_rev"] == 24.0
    ]
    assert entry_of(cogging, ARM, replace(USE, order=23.0), 1, {}) is None
    assert entry_of(cogging, ARM, replace(USE, order=25.0), 1, {}) is not None


def test_values_of_the_file_have_better_odds_than_structure(plain: Runs) -> None:
    found = entries(plain)
    file = {e.odds for e in found if e.prior.file}
    structure = {e.odds for e in found if not e.prior.file}
    assert min(file) > max(structure)
    waves = [e for e in found if e.effect.name == "torque_ripple"]
    assert len(waves) > 1
    alone = next(e for e in found if e.effect.name == "sensor_gain")
    assert waves[0].odds < alone.odds, "the ways to look for one effect share its odds"


def test_a_value_that_the_user_trusts_is_not_what_is_wrong() -> None:
    friction = replace(ARM.friction, coulomb_nm=1.5 * ARM.friction.coulomb_nm)
    runs = runs_of(replace(ARM, friction=friction), 1, 2)
    free, trusted = (diagnose(runs, {1: ARM}, trust=trust) for trust in ({}, {"coulomb_friction": 1e-4}))
    assert "coulomb_friction" in {c.name for c in free.causes}
    assert "coulomb_friction" not in {c.name for c in trusted.causes}
