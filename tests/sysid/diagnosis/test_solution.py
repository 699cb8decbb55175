"""Torsion and current of a simulation with effects, and what effects leave of the runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.dataset import build_dataset, usable_signals
from jtqd.sysid.diagnosis.entries import set_state
from jtqd.sysid.diagnosis.findings import Present
from jtqd.sysid.diagnosis.model import _Work
from jtqd.sysid.diagnosis.regressors import contribution
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, held_by_spring, joint_signals
from jtqd.sysid.diagnosis.unexplained import remaining
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, candidates, rigid_run
from tests.sysid.diagnosis.pendulums import ARM, Rig, runs_of


def signals(table: RunTable, joint: Joint = PLAIN, name: str = "run") -> JointSignals:
    return joint_signals(name, table, 1, joint, BaseLoss(joint))


def test_the_torsion_of_a_spring_that_hardens_by_its_own_stiffness_is_solved_for() -> None:
    """Iterated, K d = tau - K3 d^3 swings out where 3 K3 d^2 is more than K."""
    s = signals(rigid_run(PLAIN, 0.3))
    stiffness = PLAIN.stiffness_nm_per_rad
    twist = PLAIN.rated_torque_nm / stiffness
    s.state.torque_nm = np.linspace(-1.3, 1.3, len(s.time_s)) * PLAIN.rated_torque_nm
    for cubic in (1.5, 0.02, -0.05):
        values = {"stiffness_nm_per_rad": 0.9 * stiffness, "cubic_nm_per_rad3": cubic * stiffness / twist**2}
        set_state(s, [Present("nonlinear_stiffness", 1, values)])
        d = s.state.torsion_rad
        spring = values["stiffness_nm_per_rad"] * d + values["cubic_nm_per_rad3"] * d**3
        damper = PLAIN.damping_nms_per_rad * np.gradient(d, s.time_s)
        inner = slice(100, -100)  # a filter knows nothing beyond the ends
        expected = s.state.torque_nm[inner]
        assert (spring + damper)[inner] == pytest.approx(expected, abs=2e-3 * PLAIN.rated_torque_nm)
    set_state(s, ())
    d = s.state.torsion_rad
    damper = PLAIN.damping_nms_per_rad * np.gradient(d, s.time_s)
    assert stiffness * d + damper == pytest.approx(s.state.torque_nm, abs=1e-6 * PLAIN.rated_torque_nm)


@pytest.mark.parametrize("times", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("name", ["lost_motion", "hysteresis"])
def test_play_and_slip_are_beside_a_spring_of_another_stiffness(name: str, times: float) -> None:
    """K' (twist - w/2) = tau with the true width, and K' twist + H z = tau with the true torque."""
    joint = replace(PLAIN, damping_nms_per_rad=0.0)
    table, stiffness = rigid_run(joint, stiffness=times), times * joint.stiffness_nm_per_rad
    c, usual = table.joints[1], joint.rated_torque_nm / joint.stiffness_nm_per_rad
    through = signals(table, joint).state.torque_nm
    assert c.motor_position_rad is not None
    width, force, travel = 0.1 * usual, 0.05 * joint.rated_torque_nm, 0.02 * usual
    slip = np.zeros(len(through))
    for k in range(1, len(slip)):  # both springs bend until the slip is at its end
        bend = (through[k] - through[k - 1]) / (stiffness + force / travel)
        slip[k] = np.clip(slip[k - 1] + bend / travel, -1.0, 1.0)
    more, values = {
        "lost_motion": (0.5 * width * np.sign(through), {"width_rad": width}),
        "hysteresis": (-force / stiffness * slip, {"torque_nm": force, "travel_rad": travel}),
    }[name]
    position = c.motor_position_rad + joint.gear_ratio * more
    s = signals(RunTable(table.time_s, {1: replace(c, motor_position_rad=position)}), joint)
    present = [
        Present(name, 1, values),
        Present("nonlinear_stiffness", 1, {"stiffness_nm_per_rad": stiffness, "cubic_nm_per_rad3": 0.0}),
    ]
    set_state(s, present)
    assert s.torsion_nm is not None
    left = s.torsion_nm - sum(contribution(p.effect, p.values, s)["torsion"] for p in present)
    loaded = np.abs(through) > 0.1 * joint.rated_torque_nm  # in the play nothing is known
    loaded[:100] = loaded[-100:] = False
    part = contribution(present[0].effect, values, s)["torsion"]
    assert np.std(left[loaded]) < 0.05 * np.std(part[loaded])


@pytest.mark.parametrize("times", [0.5, 1.5, 3.0])
def test_the_torsion_of_another_stiffness_does_not_grow_where_the_torque_is_quicker_than_the_link(
    times: float,
) -> None:
    """What the twist accelerates of a heavy link twists the spring again: repeated, that grew without end."""
    link = PLAIN.stiffness_nm_per_rad / (2.0 * np.pi * 10.0) ** 2
    heavy = replace(PLAIN, link_inertia_kgm2=link, damping_nms_per_rad=0.0)
    s = replace(signals(rigid_run(heavy, 0.3), heavy), torque_hz=100.0)
    s.state.torque_nm = 0.3 * PLAIN.rated_torque_nm * np.sin(2.0 * np.pi * 40.0 * s.time_s)
    stiffness = times * PLAIN.stiffness_nm_per_rad
    set_state(
        s,
        [Present("nonlinear_stiffness", 1, {"stiffness_nm_per_rad": stiffness, "cubic_nm_per_rad3": 0.0})],
    )
    assert stiffness * s.state.torsion_rad == pytest.approx(
        s.state.torque_nm, abs=0.01 * PLAIN.rated_torque_nm
    )


@pytest.mark.parametrize("name", ["sensor_offset", "link_inertia", "unbalance"])
def test_a_torque_that_loads_the_gear_is_in_its_losses_too(name: str) -> None:
    """Losses of 0.25 |tau|: what a zero or a further load is worth in the motor balance is 1 +- 0.25 of it."""
    zero, link, moment = (
        0.02 * PLAIN.rated_torque_nm,
        2.0 * PLAIN.link_inertia_kgm2,
        0.03 * PLAIN.rated_torque_nm,
    )
    truth = replace(PLAIN, link_inertia_kgm2=link) if name == "link_inertia" else PLAIN
    table = rigid_run(truth)
    c, seen = table.joints[1], signals(table, truth)
    assert c.current_a is not None
    assert c.torque_nm is not None
    weight = moment * np.sin(seen.state.link_position_rad) if name == "unbalance" else 0.0 * c.torque_nm
    through = seen.state.torque_nm + weight
    current = c.current_a + (weight + 0.25 * np.abs(through) * seen.state.direction) / seen.nm_per_a
    reading = c.torque_nm + (zero if name == "sensor_offset" else 0.0)
    s = signals(RunTable(table.time_s, {1: replace(c, current_a=current, torque_nm=reading)}))
    own = {
        "sensor_offset": ("sensor", {"offset_nm": zero}),
        "link_inertia": (1, {"link_inertia_kgm2": link}),
        "unbalance": (1, {"moment_nm": moment, "phase_rad": 0.0}),
    }[name]
    present = [Present(name, *own), Present("load_dependent_friction", 1, {"load_coefficient": 0.25})]
    set_state(s, present)
    explained = sum(contribution(p.effect, p.values, s)["motor"] for p in present)
    left = (s.motor_nm - explained)[s.moving]
    part = contribution(present[0].effect, present[0].values, s)["motor"][s.moving]
    assert np.std(left) < 0.2 * 0.25 * np.sqrt(np.mean(part**2))


@pytest.mark.filterwarnings("error")
def test_the_torsion_of_a_spring_that_cannot_hold_the_torque_stays_finite() -> None:
    """A softening spring holds no more than its peak; the search tries such values, and steps to them overflowed."""
    s = signals(rigid_run(PLAIN, 0.3))
    stiffness = PLAIN.stiffness_nm_per_rad
    twist = PLAIN.rated_torque_nm / stiffness
    for stiff, cubic in ((0.9, -2.0), (2.4, -40.0), (0.1, -1e4), (1.0, -1e9)):
        values = {
            "stiffness_nm_per_rad": stiff * stiffness,
            "cubic_nm_per_rad3": cubic * stiffness / twist**2,
        }
        set_state(s, [Present("nonlinear_stiffness", 1, values)])
        assert np.max(np.abs(s.state.torsion_rad)) < 15.0 * twist


def test_coefficients_of_the_two_columns_of_a_wave_are_the_wave() -> None:
    (one,) = candidates(PLAIN, ("torque_ripple", 1, 1))
    s = signals(rigid_run(PLAIN))
    columns = [contribution(one.effect, p, s)["motor"] for p in one.term.basis]
    whole = contribution(one.effect, one.term.combine([0.7, -1.1]), s)["motor"]
    assert whole == pytest.approx(0.7 * columns[0] - 1.1 * columns[1], abs=1e-9)


def test_the_current_is_that_which_a_simulation_with_these_effects_needs() -> None:
    """i = demand / (G Kt'), whatever current was measured; more friction is more demand; without effects as in the file."""
    s = signals(rigid_run(PLAIN, 0.3, noise=2.0))
    per_a = PLAIN.gear_ratio * PLAIN.torque_constant_nm_per_a
    set_state(s, ())
    assert s.state.current_a == pytest.approx(s.demand_nm / per_a)
    assert np.std(s.state.current_a - s.current_a) > 1.0 / per_a, "the noise of the measured one is not in it"
    kt = {"torque_constant_nm_per_a": 0.85 * PLAIN.torque_constant_nm_per_a}
    set_state(s, [Present("torque_constant", 1, kt)])
    assert s.state.current_a == pytest.approx(s.demand_nm / (0.85 * per_a), rel=1e-4, abs=1e-6)
    set_state(s, [Present("torque_constant", 1, kt), Present("current_offset", 1, {"offset_a": 0.3})])
    assert s.state.current_a == pytest.approx(s.demand_nm / (0.85 * per_a), rel=1e-4, abs=1e-6), (
        "what the sensor reads too much drives no motor"
    )
    more = {"coulomb_nm": PLAIN.friction.coulomb_nm + 1.5}
    both = [
        Present("torque_constant", 1, kt),
        Present("coulomb_friction", 1, more),
    ]
    set_state(s, both)
    wanted = (s.demand_nm + 1.5 * s.state.direction) / (0.85 * per_a)
    assert s.state.current_a == pytest.approx(wanted, rel=1e-4, abs=1e-6)
    set_state(s, [each._replace(joint=2) for each in both])
    assert s.state.current_a == pytest.approx(s.demand_nm / per_a), (
        "effects of another joint are none of this one"
    )


def test_the_torsion_is_that_of_the_changed_spring() -> None:
    s = signals(rigid_run(PLAIN, 0.3))
    softer = {"stiffness_nm_per_rad": 0.8 * PLAIN.stiffness_nm_per_rad, "cubic_nm_per_rad3": 0.0}
    set_state(s, [Present("nonlinear_stiffness", 1, softer)])
    held = held_by_spring(PLAIN, s.state.torque_nm, s.time_s)
    assert s.state.torsion_rad == pytest.approx(held / softer["stiffness_nm_per_rad"], rel=1e-3)


def test_what_the_true_effects_leave_is_the_noise() -> None:
    true = {"torque_constant_nm_per_a": 0.9 * ARM.torque_constant_nm_per_a}
    friction = {"coulomb_nm": ARM.friction.coulomb_nm + 2.0}
    joint = replace(
        ARM,
        torque_constant_nm_per_a=true["torque_constant_nm_per_a"],
        friction=replace(ARM.friction, coulomb_nm=friction["coulomb_nm"]),
    )
    rig = Rig(sensor_noise_nm=0.1, current_noise_a=0.01, counts=2.0**22)
    usable, _ = usable_signals(runs_of(joint, 1, 2, rig), {1: ARM}, (1,))
    dataset = build_dataset(usable, {1: ARM})
    present = [
        Present("torque_constant", 1, true),
        Present("coulomb_friction", 1, friction),
    ]
    left = remaining(dataset, present, np.zeros((2, len(dataset.families))))
    for d, after in zip(dataset.of(MOTOR1), left.residual[MOTOR1], strict=True):
        assert float(np.std(after[d.valid])) < 0.12
        assert float(np.std(d.residual[d.valid])) > 2.0
    s = dataset.signals[0][0]
    friction_nm = np.asarray(contribution(present[1].effect, present[1].values, s)["motor"])
    assert np.abs(friction_nm[s.usable("motor")]) == pytest.approx(2.0, rel=1e-2)


def test_the_zero_of_a_run_is_worth_what_the_losses_of_the_set_make_of_it() -> None:
    usable, _ = usable_signals([("a", rigid_run(PLAIN)), ("b", rigid_run(PLAIN, 0.3))], {1: PLAIN}, (1,))
    dataset = build_dataset(usable, {1: PLAIN})
    work = _Work(dataset)
    k = next(k for k, e in enumerate(work.entries) if e.effect.name == "load_dependent_friction")
    zero = next(k for k, family in enumerate(dataset.families) if family.name == "zero")

    def column() -> FloatArray:
        d = work.runs[0].channels[MOTOR1]
        return np.asarray(d.nuisances[d.valid, int(np.flatnonzero(d.families == zero)[0])])

    assert column() == pytest.approx(-1.0)
    scaled = np.array([2.5])
    mu = work.entries[k].values(scaled)["load_coefficient"]
    work.move(frozenset({k}), scaled, frozenset({"loss_per_torque"}), None)
    assert set(np.round(np.abs(column()), 3)) >= {round(1.0 - mu, 3), round(1.0 + mu, 3)}
