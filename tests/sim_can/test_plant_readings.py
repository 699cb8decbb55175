"""What the instruments of a bench with effects read: one sensor, two encoders, the time that a drift counts from."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.joint import Effect
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import JointPlant, PlantParameters, plant_of_joint
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY

JOINT = load_joint(shipped("joint1.yaml"))


def with_effects(joint, effects):
    return replace(joint, effects=tuple(Effect(name, values) for name, values in effects.items()))


def still(joint_1, joint_2=JOINT, seconds=0.2):
    sides = (JointPlant(joint_1), JointPlant(joint_2))
    return emulate_run(PlantParameters(sides), (JointCommand.off(), JointCommand.off()), seconds)


def test_the_one_sensor_is_joint_ones():
    """Joint 2's file speaks for it only where joint 1's says nothing about the sensor."""
    a = with_effects(JOINT, {"sensor_offset": {"offset_nm": 1.0}})
    b = with_effects(JOINT, {"sensor_offset": {"offset_nm": -2.0}})
    ripple = with_effects(JOINT, {"torque_ripple": {"amplitude_nm": 0.1}})
    for joints, expected in (((a, b), 1.0), ((ripple, b), -2.0), ((a, a), 1.0), ((a, JOINT), 1.0)):
        run = still(*joints)
        assert run.joints[1].torque_nm == pytest.approx(np.full(200, expected), abs=1e-3)
        assert np.array_equal(run.joints[1].torque_nm, run.joints[2].torque_nm)


def test_sensor_effects_add_up_in_the_reading():
    """reading = (truth + offset) / (1 - (1 - 1/g)): gain and offset both speak of the reading."""
    effects = {"sensor_gain": {"gain": 1.25}, "sensor_offset": {"offset_nm": 0.8}}
    source = PlantSource(PlantParameters((JointPlant(with_effects(JOINT, effects)), JointPlant(JOINT))))
    source.command(0, VELOCITY, 0.0)
    source.command(1, CURRENT, 4.0)
    for _ in range(300):
        source.advance(0.001)
    truth = source.plant.sensor_torque()
    assert truth > 5.0
    assert source.channels[0].torque_nm == pytest.approx(1.25 * (truth + 0.8), rel=1e-12)


def test_an_eccentric_motor_encoder_is_the_motors():
    effects = {"encoder_eccentricity": {"amplitude_rad": 0.02, "phase_rad": 0.4, "motor_side": 1.0}}
    source = PlantSource(PlantParameters((JointPlant(JOINT), JointPlant(with_effects(JOINT, effects)))))
    source.advance(0.0)
    source.command(1, VELOCITY, 30.0)
    for _ in range(300):
        source.advance(0.001)
        angle = source.plant.motor_position[1]
        read = source.drives[1].motor_position_rad
        assert read - angle == pytest.approx(0.02 * math.sin(angle + 0.4), abs=1e-4)
        assert source.drives[1].link_position_rad == -source.plant.link_position
    assert abs(source.plant.motor_position[1]) > 5.0


def test_drift_begins_anew_when_the_drives_are_enabled():
    joint = with_effects(JOINT, {"sensor_drift": {"rate_nm_per_s": 1.0}})
    source = PlantSource(plant_of_joint(joint))
    for _ in range(300):
        source.advance(0.001)
    assert source.channels[0].torque_nm == pytest.approx(0.3, abs=1e-9)
    source.command(0, VELOCITY, 0.0)
    source.command(1, CURRENT, 0.0)
    for _ in range(100):
        source.advance(0.001)
    assert source.channels[0].torque_nm == pytest.approx(0.1, abs=1e-6)
    source.command(0, OFF, 0.0)
    source.command(0, VELOCITY, 0.0)  # joint 2 stayed on: the same run
    source.advance(0.001)
    assert source.channels[0].torque_nm == pytest.approx(0.101, abs=1e-6)


def test_hooks_see_each_joint_in_its_own_frame():
    joint = with_effects(JOINT, {"unbalance": {"moment_nm": 0.5}})
    plant = PlantSource(plant_of_joint(joint)).plant
    plant.link_position, plant.link_velocity = 0.3, 0.7
    plant.motor_position, plant.motor_velocity = [31.0, -29.0], [10.0, -20.0]
    torques = plant.joint_torques()
    for k, sign in ((0, 1.0), (1, -1.0)):
        state = plant.effects[k].state
        assert state.coupling_position_rad == 0.3
        assert (state.link_position_rad, state.link_velocity_rad_s) == (sign * 0.3, sign * 0.7)
        assert state.torsion_rad == pytest.approx(plant.motor_position[k] / 100.0 - sign * 0.3)
        assert state.velocity_rad_s == pytest.approx(plant.motor_velocity[k] / 100.0)
        assert (state.torque_nm, state.direction) == (torques[k], sign)


def test_a_joint_file_with_an_effect_of_temperature_warms_up():
    warm = {"temperature_dependent_friction": {"viscous_per_k": 0.03, "reference_c": 25.0}}
    drift, cold = {"sensor_drift": {"per_k_nm": 0.01}}, {"torque_ripple": {"amplitude_nm": 0.2}}
    sides = [plant_of_joint(with_effects(JOINT, effects)).joints[0] for effects in (warm, drift, cold)]
    assert [side.thermal.kelvin_per_w for side in sides] == [0.6, 0.6, 0.0]
