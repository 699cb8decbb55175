"""Losses that depend on the load: the simulation's law, the sensor's zero in it, and effects beside a table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.effects.effect import State
from jtqd.estimator.joint import Effect
from jtqd.estimator.losses import LossModel
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.losses import JointFriction, LossTable
from jtqd.sim_can.plant_file import plant_of_joint
from jtqd.sysid.diagnosis.diagnose import with_effects_applied
from jtqd.sysid.diagnosis.signals import BaseLoss, JointSignals, about_zero
from jtqd.sysid.runs.time_base import on_even_steps
from tests.sysid.diagnosis.diagnose_helpers import bench_run

JOINT = load_joint(shipped("joint1.yaml"))
BASE = BaseLoss(JOINT)


def signals(true_nm: np.ndarray, velocity: np.ndarray, zero_nm: float) -> JointSignals:
    """A run whose only error is the sensor's zero."""
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
        "run", 1, JOINT, np.arange(n) * 1e-3, state, residual, None, np.ones(n, bool), measured
    )


def test_the_law_is_the_emulated_plants_of_the_same_file() -> None:
    side = plant_of_joint(JOINT).joints[0]
    table = LossTable(
        LossModel(JOINT).loss_many,
        JOINT.gear_ratio,
        JOINT.torque_constant_nm_per_a,
        side.drive.current_limit_a,
    )
    d = side.deviations
    friction = JointFriction(
        table, stribeck_nm=d.stribeck_nm, stribeck_velocity_rad_s=d.stribeck_velocity_rad_s
    )
    rng = np.random.default_rng(1)
    torque, velocity = rng.uniform(-30.0, 30.0, 200), rng.uniform(-3.0, 3.0, 200)
    velocity[:50] *= 0.03
    expected = [friction(t, v) for t, v in zip(torque, velocity, strict=True)]
    assert d.stribeck_nm == JOINT.friction.stribeck_nm
    assert np.abs(BASE.loss(torque, velocity)) == pytest.approx(expected, abs=1e-6)


def test_a_zero_of_the_sensor_is_one_column_whatever_the_load() -> None:
    t = np.arange(0.0, 12.0, 1e-3)
    true, velocity = 18.0 * np.sin(0.9 * t), 1.5 * np.sin(2.1 * t + 0.4)
    plain = signals(true, velocity, 0.3)
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
    run = signals(np.ones(50), np.ones(50), 0.2)
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
