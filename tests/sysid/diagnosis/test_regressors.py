"""Columns of the regression against the hooks of the effects, bins and nuisances against plain loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.diagnosis.dataset import usable_signals
from jtqd.sysid.diagnosis.regressors import (
    BIN_S,
    LONG_S,
    all_in_bin,
    bin_samples,
    binned,
    contribution,
    families,
    run_data,
)
from jtqd.sysid.diagnosis.signals import BaseLoss, Channel, JointSignals, Line, joint_signals, with_one_sensor
from jtqd.sysid.diagnosis.smoothing import Smoother, first_difference, second_difference
from tests.estimator.effects.effect_signals import PLAIN, balances, state
from tests.sysid.diagnosis.diagnose_core_helpers import MOTOR1, TORSION1, candidates, rigid_run

BARE = replace(PLAIN, damping_nms_per_rad=0.0, link_inertia_kgm2=0.0)


def made_up(joint: Joint, seed: int = 1, number: int = 1, both: bool = True) -> JointSignals:
    s = state(seed)
    nothing = np.zeros(len(s.time_s))
    return JointSignals(
        run="run",
        number=number,
        joint=joint,
        time_s=s.time_s,
        state=s,
        motor_nm=nothing,
        torsion_nm=nothing if both else None,
        moving=nothing == 0.0,
        sensor_nm=s.torque_nm,
        current_a=s.current_a,
        quick_nm=nothing,
    )


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_columns_are_the_hooks_in_the_balances_of_the_contract(name: str) -> None:
    """Of a gear without damping and a link without inertia; what these add is below."""
    effect = EFFECTS[name]
    s = made_up(BARE)
    for term in effect.terms(BARE):
        for p in term.basis:
            if effect.at_motor_of({"motor_side": 0.0, **p}):
                continue  # its acceleration is below
            motor, torsion = balances(effect, p, s.state_of(effect, p), BARE)
            if "loss_nm" in effect.hooks and "order_per_motor_rev" in p:
                motor = motor * s.visible_share(
                    p["order_per_motor_rev"] * BARE.gear_ratio * s.state.velocity_rad_s
                )
            found = contribution(effect, p, s)
            for balance, expected in (("motor", motor), ("torsion", torsion)):
                there = found.get(balance, np.zeros(len(s.time_s)))
                assert there == pytest.approx(np.broadcast_to(expected, there.shape), abs=1e-9)


def test_the_damper_feels_an_error_of_the_teeth_and_the_link_its_acceleration() -> None:
    """A kinematic error at constant speed: sines whose derivatives are known."""
    joint = replace(PLAIN, link_inertia_kgm2=0.5)
    s = made_up(joint)
    speed, E, k = 120.0, 1e-4, 2.0
    s.state.motor_position_rad = speed * s.time_s
    p = {"amplitude_rad": E, "order_per_motor_rev": k, "phase_rad": 0.4}
    full = contribution(EFFECTS["kinematic_error"], p, s)
    bare = contribution(EFFECTS["kinematic_error"], p, replace(s, joint=BARE))
    angle = k * s.state.motor_position_rad + 0.4
    damped = -joint.damping_nms_per_rad * E * k * speed * np.cos(angle)
    bent = -joint.link_inertia_kgm2 * E * (k * speed) ** 2 * np.sin(angle)
    inner = slice(4, -4)
    assert (full["motor"] - bare["motor"])[inner] == pytest.approx(bent[inner], abs=0.03 * np.ptp(bent))
    assert (full["torsion"] - bare["torsion"])[inner] == pytest.approx(
        (damped + bent)[inner], abs=0.03 * np.ptp(bent)
    )


def test_the_link_follows_the_spring_as_it_is_and_not_as_the_file_has_it() -> None:
    """A harder spring turns less, so the link's acceleration is less that of tau/K; with one encoder tau/K is in nothing."""
    joint = replace(PLAIN, link_inertia_kgm2=0.5)
    s = replace(made_up(joint), time_s=1e-3 * np.arange(2000), torque_hz=60.0)
    turn = 2.0 * np.pi * 3.0
    s.state.torsion_rad = 1e-3 * np.sin(turn * s.time_s)
    p = {"stiffness_nm_per_rad": 1.2 * joint.stiffness_nm_per_rad, "cubic_nm_per_rad3": 0.0}
    bent = -joint.link_inertia_kgm2 * 0.2 * turn**2 * s.state.torsion_rad
    for signals, expected in ((s, bent), (replace(s, torsion_nm=None), 0.0 * bent)):
        full = contribution(EFFECTS["nonlinear_stiffness"], p, signals)
        bare = contribution(EFFECTS["nonlinear_stiffness"], p, replace(signals, joint=BARE))
        more = full.get("motor", np.zeros(2000)) - bare.get("motor", np.zeros(2000))
        assert more[100:-100] == pytest.approx(expected[100:-100], abs=0.01 * np.max(np.abs(bent)))


def test_the_link_does_not_follow_an_error_of_the_teeth_that_is_quicker_than_its_acceleration_is_known() -> (
    None
):
    """At 400 Hz, where the spring takes it; with one encoder the acceleration is the motor's alone and holds all of it."""
    joint = replace(PLAIN, link_inertia_kgm2=0.5, damping_nms_per_rad=0.0)
    s = replace(made_up(joint), time_s=1e-3 * np.arange(2000), torque_hz=60.0)
    s.state.motor_position_rad = 2.0 * np.pi * 100.0 * s.time_s
    p = {"amplitude_rad": 1e-4, "order_per_motor_rev": 4.0, "phase_rad": 0.4}
    whole = joint.link_inertia_kgm2 * 1e-4 * (2.0 * np.pi * 400.0) ** 2
    for signals, least, most in ((s, 0.0, 0.05), (replace(s, torsion_nm=None), 0.5, 1.0)):
        full = contribution(EFFECTS["kinematic_error"], p, signals)["motor"]
        bare = contribution(EFFECTS["kinematic_error"], p, replace(signals, joint=BARE))["motor"]
        assert least * whole <= np.max(np.abs(full - bare)[10:-10]) <= most * whole


@pytest.mark.parametrize("inertia", [0.0, 0.5])
def test_an_eccentric_encoder_of_the_motor_is_in_both_balances(inertia: float) -> None:
    """The same run with that encoder true and eccentric: the unexplained residual differs by the columns."""
    joint = replace(PLAIN, link_inertia_kgm2=inertia)
    table = rigid_run(joint)
    columns = table.joints[1]
    assert columns.motor_position_rad is not None
    p = {"amplitude_rad": 5e-3, "phase_rad": 0.4, "motor_side": 1.0}
    wrong = columns.motor_position_rad + 5e-3 * np.sin(columns.motor_position_rad + 0.4)
    eccentric = RunTable(table.time_s, {1: replace(columns, motor_position_rad=wrong)})
    true = joint_signals("run", table, 1, joint, BaseLoss(joint))
    seen = joint_signals("run", eccentric, 1, joint, BaseLoss(joint), true)
    found = contribution(EFFECTS["encoder_eccentricity"], p, true)
    assert true.torsion_nm is not None
    assert seen.torsion_nm is not None
    keep = true.moving.copy()  # Coulomb friction has another sign where the velocity is misread
    keep[:100] = keep[-100:] = False
    for balance, left in (
        ("motor", seen.motor_nm - true.motor_nm),
        ("torsion", seen.torsion_nm - true.torsion_nm),
    ):
        expected = (
            true.visible(left)[keep] - true.visible(left)[keep].mean()
        )  # a zero is taken out of the torsion
        column = true.visible(found[balance])
        assert np.ptp(expected) > 0.1
        assert (column[keep] - column[keep].mean()) == pytest.approx(expected, abs=0.03 * np.ptp(expected))


@pytest.mark.parametrize("of_position", [True, False])
def test_a_quick_torque_is_in_the_balance_as_far_as_samples_show_it(of_position: bool) -> None:
    """A torque that moves the rotor and nothing else, at rates up to beyond the sampling rate."""
    step, fine = 1e-3, 2000
    nothing = np.zeros(fine)
    s = replace(made_up(PLAIN), time_s=step * np.arange(fine), motor_nm=nothing, of_position=of_position)
    for hz in (1.0, 50.0, 120.0, 300.0, 490.0, 700.0, 995.0, 1000.0, 1350.0):
        w = 2.0 * np.pi * hz
        true = np.cos(w * s.time_s + 0.3)
        if of_position:
            found = second_difference(-true / w**2, s.time_s)
        else:
            found = first_difference(np.sin(w * s.time_s + 0.3) / w, s.time_s)
        share = s.visible_share(np.full(fine, w))
        assert found[5:-5] == pytest.approx((share * true)[5:-5], abs=1e-5), hz
    assert s.visible_share(np.zeros(1)) == pytest.approx([1.0], abs=1e-6)
    assert s.visible_share(np.array([2e3 * np.pi])) == pytest.approx([0.0], abs=1e-6)


def test_without_a_second_encoder_there_is_no_torsion_to_explain() -> None:
    p = EFFECTS["sensor_gain"].terms(BARE)[0].basis[0]
    assert set(contribution(EFFECTS["sensor_gain"], p, made_up(BARE, both=False))) == {"motor"}
    eccentric = {"amplitude_rad": 1e-3, "phase_rad": 0.0, "motor_side": 1.0}
    assert contribution(EFFECTS["encoder_eccentricity"], eccentric, made_up(BARE, both=False)) == {}


def test_bins_are_means_of_whole_bins() -> None:
    x = np.arange(11.0)
    assert binned(x, 4).tolist() == [1.5, 5.5], "the rest at the end is left out"
    good = np.array([1, 1, 1, 1, 1, 0, 1, 1, 1, 1, 1], bool)
    assert all_in_bin(good, 4).tolist() == [True, False]


def test_a_bin_is_five_milliseconds_until_runs_are_long() -> None:
    s = made_up(PLAIN)
    seconds = float(s.time_s[-1])
    assert bin_samples([s]) == round(BIN_S / 2e-3)
    many = [s] * int(4 * LONG_S / seconds)
    assert bin_samples(many) == pytest.approx(4 * BIN_S / 2e-3, abs=1), "memory does not grow"


def test_a_run_holds_every_column_where_its_effect_shows() -> None:
    s = replace(joint_signals("run", rigid_run(PLAIN), 1, PLAIN, BaseLoss(PLAIN)), visible=Smoother(1e-3))
    found = candidates(
        PLAIN,
        ("viscous_friction", 1, 0),
        ("torque_ripple", 1, 1),
        ("sensor_gain", "sensor", 0),
        ("cogging", 2, 0),
    )
    run = run_data([s], found, 5)
    assert run.channels[MOTOR1].index.tolist() == [0, 1, 2, 3], "nothing of the joint that is absent"
    assert run.channels[TORSION1].index.tolist() == [3]
    for c in found[:3]:
        for column, p in zip(c.columns, c.term.basis, strict=True):
            whole = contribution(c.effect, p, s)["motor"]
            assert run.channels[MOTOR1].regressors[:, column] == pytest.approx(binned(whole, 5))
    assert run.channels[MOTOR1].residual == pytest.approx(binned(s.motor_nm, 5))
    assert run.channels[MOTOR1].valid[1:-1].tolist() == all_in_bin(s.moving, 5)[1:-1].tolist()
    assert run.channels[TORSION1].valid[1:-1].all()
    known = np.flatnonzero(s.known("torsion"))
    assert (known[0], known[-1]) == (4, len(s.time_s) - 5), "none within the reach of a difference"
    assert run.axes[1]["load"] == pytest.approx(binned(s.state.torque_nm, 5))


def test_what_may_differ_from_run_to_run() -> None:
    s = replace(joint_signals("run", rigid_run(PLAIN), 1, PLAIN, BaseLoss(PLAIN)), visible=Smoother(1e-3))
    lines = [Line(MOTOR1, 3.5, 0.4, 50.0), Line(TORSION1, 7.0, 0.2, 50.0, "Hz")]
    groups = families([[s, replace(s, number=2)]], lines)
    names = [(g.name, g.joint) for g in groups]
    assert names[0] == ("zero", 0)
    assert names.count(("viscous", 2)) == 1
    run = run_data([s], [], 1, groups)
    motor, torsion = run.channels[MOTOR1], run.channels[TORSION1]

    def column(channel: Channel, family: int) -> np.ndarray:
        d = run.channels[channel]
        values: np.ndarray = d.nuisances[:, d.families.tolist().index(family)]
        return values

    assert {groups[k].joint for k in motor.families} == {0, 1}, "no other joint's"
    assert {groups[k].name for k in torsion.families} == {"zero", "torsion_zero", "line"}
    assert column(MOTOR1, 0) == pytest.approx(-1.0), "a sensor that reads too high"
    assert column(TORSION1, 0) == pytest.approx(-1.0)
    v, d = s.state.velocity_rad_s, s.state.direction
    assert column(MOTOR1, names.index(("viscous", 1))) == pytest.approx(v)
    assert column(MOTOR1, names.index(("coulomb", 1))) == pytest.approx(d)
    sigma = {(g.name, g.joint): g.sigma for g in groups}
    assert sigma["viscous", 1] == pytest.approx(0.08 * 3.0), "shares of the file's friction"
    assert sigma["coulomb", 1] == pytest.approx(0.02 * 4.0)
    assert sigma["zero", 0] == pytest.approx(0.0025 * PLAIN.rated_torque_nm)
    order, hertz = names.index(("line", 1)), names.index(("line", 1)) + 2
    assert column(MOTOR1, order) == pytest.approx(np.cos(3.5 * s.state.motor_position_rad))
    assert column(MOTOR1, order + 1) == pytest.approx(np.sin(3.5 * s.state.motor_position_rad))
    assert column(TORSION1, hertz) == pytest.approx(np.cos(2.0 * np.pi * 7.0 * s.state.time_s))


@pytest.mark.parametrize("delay_s", [-0.004, 2e-5, 0.007, 0.015])
def test_a_late_current_is_compared_with_itself_later(delay_s: float) -> None:
    """A swing of 12 Hz: to first order in 15 ms it would be off by a third."""
    s = made_up(PLAIN)
    turn = 2.0 * np.pi * 12.0
    s.state.current_a = np.sin(turn * s.time_s)
    s.state.current_rate_a_s = turn * np.cos(turn * s.time_s)
    late = {"delay_s": delay_s, "channel": 1.0}
    found = contribution(EFFECTS["channel_delay"], late, s)["motor"]
    more = s.state.current_a - np.sin(turn * (s.time_s + delay_s))
    expected = PLAIN.gear_ratio * PLAIN.torque_constant_nm_per_a * more
    inner = (s.time_s > 0.02) & (s.time_s < s.time_s[-1] - 0.02)
    assert found[inner] == pytest.approx(expected[inner], abs=0.01 * np.max(np.abs(expected)))


def test_the_one_sensor_has_one_temperature() -> None:
    """That of the first joint, as the plant has it; a joint's own effects go by the joint's."""
    one, two = made_up(BARE), made_up(BARE, 2, number=2)
    one.state.temperature_c = np.full(len(one.time_s), 31.0)
    two.state.temperature_c = np.full(len(two.time_s), 20.0)
    drift, friction = EFFECTS["sensor_drift"], EFFECTS["temperature_dependent_friction"]
    p = {"rate_nm_per_s": 0.0, "per_k_nm": 0.1, "reference_c": 25.0}
    first, second = with_one_sensor([one, two])
    for s, alone in ((first, 0.6), (second, 0.6), (two, -0.5)):
        assert contribution(drift, p, s)["torsion"] == pytest.approx(-alone), s.number
    for term in friction.terms(BARE):
        assert contribution(friction, term.basis[0], second)["motor"] == pytest.approx(
            contribution(friction, term.basis[0], two)["motor"]
        )


def test_a_diagnosis_gives_the_sensor_the_temperature_of_the_first_joint() -> None:
    columns = rigid_run(PLAIN).joints[1]
    warm = [replace(columns, temperature_c=np.full(len(rigid_run(PLAIN).time_s), t)) for t in (31.0, 20.0)]
    table = RunTable(rigid_run(PLAIN).time_s, dict(zip((1, 2), warm, strict=True)))
    usable, why = usable_signals([("a", table), ("b", table)], {1: PLAIN, 2: PLAIN}, (1, 2))
    assert len(usable) == 2, why
    for run in usable:
        at_sensor = [s.state_of(EFFECTS["sensor_drift"], {}).temperature_c[0] for s in run]
        assert (at_sensor, [s.state.temperature_c[0] for s in run]) == ([31.0, 31.0], [31.0, 20.0])
