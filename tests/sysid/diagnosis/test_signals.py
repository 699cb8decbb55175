"""Signals of a joint in a run: residuals, losses that depend on the load, what effects leave in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.corrections import with_effects_applied
from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.effects.effect import State
from jtqd.estimator.joint import Effect, Joint
from jtqd.estimator.losses import DRIVING_CURRENT_MAX_A, FrictionModel, LossModel
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant import JointFriction, LossTable
from jtqd.sim_can.plant_file import plant_of_joint
from jtqd.sysid.diagnosis.entries import set_state
from jtqd.sysid.diagnosis.findings import Present
from jtqd.sysid.diagnosis.regressors import contribution, run_data
from jtqd.sysid.diagnosis.signals import (
    BaseLoss,
    Channel,
    JointSignals,
    SignalsError,
    about_zero,
    joint_signals,
)
from jtqd.sysid.diagnosis.smoothing import below, first_difference, known_below_hz, second_difference
from jtqd.sysid.runs.checks import on_even_steps
from tests.estimator.effects.effect_signals import PEAKED, PLAIN
from tests.sysid.diagnosis.diagnose_core_helpers import rigid_run
from tests.sysid.diagnosis.diagnose_helpers import bench_run

WITH_EFFICIENCY = load_joint(shipped("joint1.yaml"))


def signals(table: RunTable, joint: Joint = PLAIN) -> JointSignals:
    return joint_signals("run", table, 1, joint, BaseLoss(joint))


def rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def test_a_difference_of_two_tables_is_not_one_of_filters() -> None:
    """Noise of ten times the size asks for a slower filter, which would take motion with it."""
    clean = rigid_run(PLAIN)
    rng = np.random.default_rng(2)
    columns = clean.joints[1]
    assert columns.motor_position_rad is not None
    noise = 1e-2 * rng.normal(size=len(clean.time_s))
    noisy = replace(
        clean, joints={1: replace(columns, motor_position_rad=columns.motor_position_rad + noise)}
    )
    first = signals(clean)
    again = joint_signals("run", noisy, 1, PLAIN, BaseLoss(PLAIN), first)
    assert (again.visible, again.of_position) == (first.visible, first.of_position)
    assert signals(noisy).visible != first.visible


def test_differences_are_of_eighth_order() -> None:
    t = np.arange(0.0, 2.0, 0.05)
    assert first_difference(t**8, t)[4:-4] == pytest.approx(8.0 * t[4:-4] ** 7, abs=1e-8)
    assert second_difference(t**9, t)[4:-4] == pytest.approx(72.0 * t[4:-4] ** 7, abs=1e-8)


def test_a_ripple_of_a_sixth_of_the_sampling_rate_keeps_its_size() -> None:
    t = np.arange(0.0, 1.0, 1e-3)
    w = 2.0 * np.pi * 1000.0 / 6.0
    wave = np.sin(w * t + 0.3)
    assert rms(second_difference(wave, t)[4:-4]) / (w**2 * rms(wave[4:-4])) == pytest.approx(1.0, abs=2e-3)
    assert rms(first_difference(wave, t)[4:-4]) / (w * rms(wave[4:-4])) == pytest.approx(1.0, abs=5e-3)


def test_uneven_steps_take_plain_differences() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 500))
    assert second_difference(3.0 * t**2, t)[3:-3] == pytest.approx(np.full(494, 6.0), abs=1e-4)
    assert second_difference(t[:4] ** 2, t[:4]).shape == (4,)


@pytest.mark.parametrize("highest_hz", [3.0, 30.0, 90.0])
def test_a_cutoff_leaves_what_is_above_the_noise_of_a_signal(highest_hz: float) -> None:
    """White noise of 0.02 over 1000 Hz, and waves of 0.2 up to a highest frequency."""
    rng = np.random.default_rng(3)
    t = np.arange(20_000) / 1000.0
    waves = [
        0.2 * np.sin(2.0 * np.pi * hz * t + rng.uniform(0.0, 6.0)) for hz in (0.6 * highest_hz, highest_hz)
    ]
    noise = 0.02 * rng.normal(size=len(t))
    cutoff = known_below_hz(2.0 * np.sin(0.9 * t) + sum(waves) + noise, 1e-3)
    assert 2.0 * highest_hz <= cutoff <= 2.0 * highest_hz + 12.0
    assert rms(below(sum(waves), 1e-3, cutoff) - sum(waves)) < 0.02 * rms(sum(waves))
    assert rms(below(noise, 1e-3, cutoff)) < rms(noise)


@pytest.mark.parametrize("step_s", [0.05, 1.0, 5.0])
def test_a_cutoff_of_slow_recordings_is_one_that_their_samples_have(step_s: float) -> None:
    x = np.cumsum(np.random.default_rng(4).normal(size=100))
    assert 0.0 <= known_below_hz(x, step_s) <= 1.0 / step_s
    assert 0.0 <= known_below_hz(x[:5], step_s) <= 1.0 / step_s


def shaken(hz: float) -> RunTable:
    """A motor with counts of 0.02 rad that swings slowly and at a frequency, both with 400 rad/s2, on a stiff gear."""
    t = np.arange(0.0, 6.0, 1e-3)
    swing = 100.0 * np.sin(2.0 * t) + 400.0 / (2.0 * np.pi * hz) ** 2 * np.sin(2.0 * np.pi * hz * t)
    columns = JointColumns(
        current_a=np.zeros(len(t)),
        motor_position_rad=0.02 * np.round(swing / 0.02),
        link_position_rad=swing / PLAIN.gear_ratio,
        torque_nm=np.zeros(len(t)),
    )
    return RunTable(t, {1: columns})


def test_what_a_wrong_inertia_leaves_is_in_its_regressor_as_far_as_the_balance_is_judged() -> None:
    table = shaken(0.5 * signals(shaken(20.0)).visible.slowest_hz)
    heavier = replace(PLAIN, rotor_inertia_kgm2=1.3 * PLAIN.rotor_inertia_kgm2)
    s = signals(table)
    assert 10.0 < s.visible.slowest_hz < 80.0
    left = s.visible(s.motor_nm - joint_signals("run", table, 1, heavier, BaseLoss(heavier), s).motor_nm)
    value = {"rotor_inertia_kgm2": heavier.rotor_inertia_kgm2}
    column = s.visible(contribution(EFFECTS["rotor_inertia"], value, s)["motor"])
    assert rms((left - column)[500:-500]) < 0.05 * rms(left[500:-500])


def test_both_balances_are_judged_below_the_same_cutoff() -> None:
    """The link's acceleration is that of the motor, so what is quicker in the spring has nothing to be compared with."""
    s = signals(shaken(20.0))
    quick = np.sin(2.0 * np.pi * 4.0 * s.visible.slowest_hz * s.time_s)
    with_it = replace(s, torsion_nm=s.torsion_nm + quick)
    [found] = [x.channels[Channel(1, "torsion")] for x in [run_data([with_it], [], 5.0)]]
    [plain] = [x.channels[Channel(1, "torsion")] for x in [run_data([s], [], 5.0)]]
    assert rms((found.residual - plain.residual)[100:-100]) < 0.02


def test_balances_are_judged_up_to_a_third_of_where_the_link_swings_on_its_spring() -> None:
    """Where a sensor shows what is quicker; one encoder shows no spring."""
    heavy = replace(PLAIN, link_inertia_kgm2=0.2, stiffness_nm_per_rad=28000.0)
    table = rigid_run(heavy)
    columns = table.joints[1]
    quick = 0.5 * np.sin(2.0 * np.pi * 90.0 * table.time_s)
    both = RunTable(table.time_s, {1: replace(columns, torque_nm=columns.torque_nm + quick)})
    third = np.sqrt(28000.0 / 0.2) / (6.0 * np.pi)
    s = signals(both, heavy)
    assert third / 1.25 <= s.visible.slowest_hz == s.visible.highest_hz <= third
    assert "quicker than the spring follows" in s.coarse
    assert rms(s.visible(quick)) < 0.05 * rms(quick)
    assert not signals(both, replace(heavy, link_inertia_kgm2=0.0)).visible.parts
    one = RunTable(table.time_s, {1: replace(both.joints[1], link_position_rad=None)})
    assert not signals(one, heavy).visible.parts


def test_a_gain_of_the_sensor_is_in_both_balances_with_what_the_link_lags_by() -> None:
    """The reading times a gain: what it changes in the residuals is its column, with a heavy link at 8 Hz, too."""
    heavy = replace(PLAIN, link_inertia_kgm2=1.0, stiffness_nm_per_rad=28000.0)
    table = rigid_run(heavy)
    columns = table.joints[1]
    swing = 5.0 * np.sin(2.0 * np.pi * 8.0 * table.time_s)
    true = replace(columns, torque_nm=columns.torque_nm + swing)
    read = replace(true, torque_nm=1.02 * true.torque_nm)
    seen = joint_signals("run", RunTable(table.time_s, {1: read}), 1, heavy, BaseLoss(heavy))
    plain = joint_signals("run", RunTable(table.time_s, {1: true}), 1, heavy, BaseLoss(heavy), seen)
    found = contribution(EFFECTS["sensor_gain"], {"gain": 1.02}, seen)
    inside = slice(500, -500)
    for balance, left in (
        ("motor", seen.motor_nm - plain.motor_nm),
        ("torsion", seen.torsion_nm - plain.torsion_nm),
    ):
        rest, whole = (seen.visible(x)[inside] for x in (left - found[balance], left))
        assert np.std(rest) < 0.02 * np.std(whole)  # the torsion has any zero


def test_a_run_by_the_equations_leaves_nothing() -> None:
    s = signals(rigid_run(PLAIN))
    assert rms(s.motor_nm[s.moving]) < 2e-3
    assert s.torsion_nm is not None
    assert rms(s.torsion_nm[5:-5] - np.median(s.torsion_nm)) < 2e-2
    assert 0.7 < s.moving.mean() < 1.0


@pytest.mark.parametrize(
    ("change", "effect", "parameters"),
    [
        ({"torque_constant_nm_per_a": 0.084}, "torque_constant", {"torque_constant_nm_per_a": 0.084}),
        ({"rotor_inertia_kgm2": 9e-5}, "rotor_inertia", {"rotor_inertia_kgm2": 9e-5}),
        ({"link_inertia_kgm2": 0.4}, "link_inertia", {"link_inertia_kgm2": 0.4}),
        (
            {"stiffness_nm_per_rad": 10000.0},
            "nonlinear_stiffness",
            {"stiffness_nm_per_rad": 10000.0, "cubic_nm_per_rad3": 0.0},
        ),
        ({"damping_nms_per_rad": 80.0}, "gear_damping", {"damping_nms_per_rad": 80.0}),
        ({"friction": {"coulomb_nm": 5.0}}, "coulomb_friction", {"coulomb_nm": 5.0}),
        ({"friction": {"viscous_nms_per_rad": 4.0}}, "viscous_friction", {"viscous_nms_per_rad": 4.0}),
    ],
)
def test_what_is_wrong_in_the_file_is_what_its_effect_leaves(
    change: dict[str, float | dict[str, float]], effect: str, parameters: dict[str, float]
) -> None:
    """The truth differs in one value; residuals with the nominal file are the columns of the effect of that name."""
    values = {k: replace(PLAIN.friction, **v) if isinstance(v, dict) else v for k, v in change.items()}
    truth = replace(PLAIN, **values)  # type: ignore[arg-type]
    damping = truth.damping_nms_per_rad if effect == "gear_damping" else 0.0
    s = signals(rigid_run(truth, damping_nms_per_rad=damping))
    set_state(s, [Present(effect, 1, parameters)])
    made = contribution(EFFECTS[effect], parameters, s)
    assert s.torsion_nm is not None
    motor, torsion = s.motor_nm[s.moving], s.torsion_nm - np.median(s.torsion_nm)
    explained = made["motor"][s.moving] if "motor" in made else np.zeros_like(motor)
    assert rms(motor - explained) < 0.02 * rms(motor) + 3e-3
    bent = made["torsion"] - np.median(made["torsion"]) if "torsion" in made else np.zeros_like(torsion)
    assert rms((torsion - bent)[20:-20]) < 0.03 * rms(torsion) + 3e-2
    assert max(rms(motor), rms(torsion)) > 0.1, "the change is large enough to judge by"


def test_friction_has_no_direction_near_rest() -> None:
    t = np.arange(0.0, 2.0, 1e-3)
    velocity = np.where(t < 1.0, 0.5, 0.01)
    link = np.cumsum(velocity) * 1e-3
    columns = JointColumns(
        current_a=0.0 * t, motor_velocity_rad_s=100.0 * velocity, link_position_rad=link, torque_nm=0.0 * t
    )
    moving = signals(RunTable(t, {1: columns})).moving
    assert moving[:970].all()
    assert not moving[971:].any(), "from 30 ms before"


def test_one_encoder_gives_no_torsion_balance() -> None:
    table = rigid_run(PLAIN)
    columns = table.joints[1]
    alone = RunTable(table.time_s, {1: replace(columns, motor_position_rad=None)})
    assert signals(alone).torsion_nm is None
    assert columns.link_position_rad is not None
    same = replace(columns, motor_position_rad=PLAIN.gear_ratio * columns.link_position_rad)
    assert signals(RunTable(table.time_s, {1: same})).torsion_nm is None


def test_a_column_that_is_missing_is_one_line() -> None:
    table = rigid_run(PLAIN)
    for name in ("current_a", "torque_nm"):
        less = RunTable(table.time_s, {1: replace(table.joints[1], **{name: None})})
        with pytest.raises(SignalsError, match=rf"run: j1\.{name}: missing"):
            signals(less)


def test_losses_without_an_efficiency_are_the_friction_law_of_the_file() -> None:
    rng = np.random.default_rng(2)
    v = rng.uniform(0.11, 2.0, 500) * rng.choice([-1.0, 1.0], 500)
    torque = rng.uniform(-40.0, 40.0, 500)
    for joint in (PLAIN, PEAKED):
        law = FrictionModel(joint.friction).torque_many(v)
        assert BaseLoss(joint).loss(torque, v) == pytest.approx(law, rel=1e-3)


@pytest.mark.parametrize("stribeck_nm", [0.0, 0.8])
def test_losses_with_an_efficiency_are_those_of_the_emulated_plant(stribeck_nm: float) -> None:
    friction = replace(WITH_EFFICIENCY.friction, stribeck_nm=stribeck_nm, stribeck_velocity_rad_s=0.05)
    joint = replace(WITH_EFFICIENCY, friction=friction)
    table = LossTable(
        LossModel(joint).loss,
        joint.gear_ratio,
        joint.torque_constant_nm_per_a,
        max(DRIVING_CURRENT_MAX_A, 9.0),
    )
    plant = JointFriction(table, stribeck_nm=stribeck_nm, stribeck_velocity_rad_s=0.05)
    rng = np.random.default_rng(3)
    v = rng.uniform(-4.0, 4.0, 2000)  # beyond the table at both ends
    torque = rng.uniform(-1.3, 1.3, 2000) * table.torque_limit
    found = BaseLoss(joint).loss(torque, v)
    emulated = [plant(float(a), float(b)) for a, b in zip(torque, v, strict=True)]
    assert np.abs(found) == pytest.approx(emulated, abs=1e-6)
    assert (found * v >= 0.0).all(), "a loss opposes the motion"
    if not stribeck_nm:
        bare = [table.magnitude(float(a), float(b)) for a, b in zip(torque, v, strict=True)]
        assert np.abs(found) == pytest.approx(bare, abs=1e-9)


JOINT = load_joint(shipped("joint1.yaml"))
BASE = BaseLoss(JOINT)


def zero_signals(true_nm: np.ndarray, velocity: np.ndarray, zero_nm: float) -> JointSignals:
    measured = true_nm + zero_nm
    n = len(true_nm)
    state = State(
        torque_nm=measured,
        velocity_rad_s=velocity,
        direction=np.sign(velocity),
        current_a=(true_nm + BASE.loss(true_nm, velocity)) / 6.2,
        motor_acceleration_rad_s2=np.zeros(n),
    )
    residual = BASE.loss(true_nm, velocity) + true_nm - BASE.loss(measured, velocity) - measured
    return JointSignals(
        run="run",
        number=1,
        joint=JOINT,
        time_s=np.arange(n) * 1e-3,
        state=state,
        motor_nm=residual,
        torsion_nm=None,
        moving=np.ones(n, bool),
        sensor_nm=measured,
        current_a=state.current_a,
        quick_nm=np.zeros(n),
    )


def test_the_law_is_the_emulated_plants_of_the_same_file() -> None:
    side = plant_of_joint(JOINT).joints[0]
    table = LossTable(
        LossModel(JOINT).loss, JOINT.gear_ratio, JOINT.torque_constant_nm_per_a, side.drive.current_limit_a
    )
    peak = side.deviations.stribeck
    friction = JointFriction(table, stribeck_nm=peak.torque_nm, stribeck_velocity_rad_s=peak.velocity_rad_s)
    rng = np.random.default_rng(1)
    torque, velocity = rng.uniform(-30.0, 30.0, 200), rng.uniform(-3.0, 3.0, 200)
    velocity[:50] *= 0.03
    expected = [friction(t, v) for t, v in zip(torque, velocity, strict=True)]
    assert peak.torque_nm == JOINT.friction.stribeck_nm
    assert np.abs(BASE.loss(torque, velocity)) == pytest.approx(expected, abs=1e-6)


def test_a_zero_of_the_sensor_is_one_column_whatever_the_load() -> None:
    t = np.arange(0.0, 12.0, 1e-3)
    true, velocity = 18.0 * np.sin(0.9 * t), 1.5 * np.sin(2.1 * t + 0.4)
    plain = zero_signals(true, velocity, 0.3)
    (run,) = about_zero([plain], {1: BASE})
    left = run.motor_nm + 0.3 * run.per_torque
    assert np.std(plain.motor_nm) > 0.1, "a constant does not take it"
    assert np.sqrt(np.mean(left**2)) < 0.02
    assert np.sqrt(np.mean(left**2)) < 0.3 * np.sqrt(
        np.mean((plain.motor_nm + 0.3 * (1.0 + BASE.slope(true, velocity))) ** 2) + 1e-4
    )


def test_losses_without_load_leave_the_residual_alone() -> None:
    friction = replace(JOINT, efficiency=None)
    base = BaseLoss(friction)
    run = zero_signals(np.ones(50), np.ones(50), 0.2)
    assert not base.depends_on_load
    assert about_zero([run], {1: base}) == [run]
    assert not base.slope(np.ones(3), np.ones(3)).any()


def test_a_torque_constant_beside_a_table_stays_an_effect() -> None:
    constant = Effect("torque_constant", {"torque_constant_nm_per_a": 0.058})
    inertia = Effect("rotor_inertia", {"rotor_inertia_kgm2": 8.0e-5})
    table = with_effects_applied(replace(JOINT, effects=(constant, inertia)))
    assert table.effects == (constant,)
    assert table.torque_constant_nm_per_a == JOINT.torque_constant_nm_per_a
    assert table.rotor_inertia_kgm2 == 8.0e-5
    plain = with_effects_applied(replace(JOINT, efficiency=None, effects=(constant,)))
    assert plain.effects == ()
    assert plain.torque_constant_nm_per_a == 0.058


def test_missing_cycles_leave_no_blow_in_the_acceleration() -> None:
    whole = bench_run(seconds=4.0)
    keep = np.ones(len(whole.time_s), bool)
    keep[500:504] = keep[900:903] = False
    joints = {
        n: replace(
            c,
            **{
                k: getattr(c, k)[keep]
                for k in ("current_a", "motor_position_rad", "link_position_rad", "torque_nm")
            },
        )
        for n, c in whole.joints.items()
    }
    table, notes = on_even_steps(replace(whole, time_s=whole.time_s[keep], joints=joints), "run")
    assert notes
    position = table.joints[1].motor_position_rad
    assert position is not None
    count = min(len(position), len(whole.time_s))
    assert (
        np.abs(np.diff(position, 2)).max()
        < 1.5 * np.abs(np.diff(whole.joints[1].motor_position_rad, 2)).max()
    )
    assert np.abs(position[:count] - whole.joints[1].motor_position_rad[:count]).max() < 1e-3
