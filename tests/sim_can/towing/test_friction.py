"""Bristle friction: what it is while sliding, and that it holds like a spring at rest."""

import math
from dataclasses import replace

import pytest

from jtqd.sim_can.source import CURRENT, VELOCITY
from jtqd.sim_can.towing.plant import BristleFriction
from tests.sim_can.towing.benches import PLAIN, plant_of

LAW = PLAIN.joints[0].friction


def steady(law, torque_nm: float, velocity_rad_s: float) -> float:
    """g + c |v|^n by the equations of docs/testing.md."""
    speed = abs(velocity_rad_s)
    peak = math.exp(-((speed / law.stribeck_velocity_rad_s) ** law.stribeck_exponent))
    level = law.coulomb_nm * (1.0 + (law.static_ratio - 1.0) * peak)
    level += law.load_nm * abs(torque_nm / 40.0) ** law.load_exponent
    level *= 1.0 + math.copysign(law.direction_share, velocity_rad_s)
    return level + law.viscous_nm * speed**law.viscous_exponent


@pytest.mark.parametrize("velocity", [-2.0, -0.3, 0.02, 0.1, 1.0, 2.5])
@pytest.mark.parametrize("current", [-3.0, 0.0, 2.0])
def test_motor_carries_load_and_friction_at_constant_velocity(velocity: float, current: float) -> None:
    plant = plant_of(PLAIN)
    plant.command(0, VELOCITY, velocity * 100.0)
    plant.command(1, CURRENT, current)
    plant.step(1.5)
    side = PLAIN.joints[0]
    torque = plant.joint_torques()[0]
    motor = 100.0 * side.motor.torque_constant_nm_per_a * plant.drives[0].current_a
    expected = math.copysign(steady(side.friction, torque, velocity), velocity)
    assert plant.one.velocity / 100.0 == pytest.approx(velocity, abs=2e-3)
    assert motor - torque == pytest.approx(expected, abs=0.03)


def test_at_rest_the_bristles_give_way_like_a_spring_and_come_back() -> None:
    plant = plant_of(PLAIN)
    plant.command(0, CURRENT, 0.2)  # 1.2 Nm, below Coulomb friction
    plant.command(1, CURRENT, 0.0)
    plant.step(2.0)
    held = plant.one.angle / 100.0
    borne = 0.2 * 100.0 * PLAIN.joints[0].motor.torque_constant_nm_per_a - plant.joint_torques()[0]
    deflection = borne * LAW.bristle_rad / LAW.coulomb_nm
    assert plant.one.friction.deflection == pytest.approx(deflection, rel=0.01)
    assert deflection < held < 1.6 * deflection
    plant.command(0, CURRENT, 0.0)
    plant.step(2.0)
    assert abs(plant.one.angle / 100.0) < 0.5 * held


def test_sliding_level_has_load_direction_and_waves() -> None:
    friction = BristleFriction(LAW, 40.0, 0.7)
    fast = 3.0
    assert friction.sliding(40.0, fast, 0.0) - friction.sliding(0.0, fast, 0.0) == pytest.approx(
        LAW.load_nm * (1.0 + LAW.direction_share)
    )
    assert friction.sliding(40.0, -fast, 0.0) / friction.sliding(40.0, fast, 0.0) == pytest.approx(
        (1.0 - LAW.direction_share) / (1.0 + LAW.direction_share)
    )
    friction.warm(0.5, 0.25)
    assert friction.viscous_at(1.0) == pytest.approx(0.25 * LAW.viscous_nm)
    assert friction.sliding(0.0, fast, 0.0) == pytest.approx(
        0.5 * LAW.coulomb_nm * (1.0 + LAW.direction_share), rel=1e-3
    )


def test_a_large_step_does_not_make_friction_unstable() -> None:
    stiff = replace(LAW, bristle_rad=1e-6)
    one, two = PLAIN.joints
    plant = plant_of(replace(PLAIN, joints=(replace(one, friction=stiff), two), substep_s=500e-6))
    plant.command(0, CURRENT, 0.4)
    plant.command(1, CURRENT, 0.0)
    plant.step(1.0)
    assert abs(plant.one.velocity) < 1e-3
