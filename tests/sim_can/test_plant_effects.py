"""Kinematic error and hysteresis of the plant against closed forms, virtual work and energy; and that a plant
without them is the plant without them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.bench import demo_current, demo_velocity
from jtqd.sim_can.plant import Plant, joint_friction, loss_table
from jtqd.sim_can.plant_file import Deviations, JointPlant, PlantParameters, load_plant, substep_limit
from jtqd.sim_can.source import CURRENT, VELOCITY
from tests.sim_can.plant_twin import TwinPlant

JOINT = load_joint(shipped("joint1.yaml"))
G, KT, K = JOINT.gear_ratio, JOINT.torque_constant_nm_per_a, JOINT.stiffness_nm_per_rad
JM, JL = JOINT.rotor_inertia_kgm2, JOINT.link_inertia_kgm2
E, ORDER, PHASE = 4e-4, 2.0, 0.9  # ten times the campaign bench's, so that each term is seen
H, TRAVEL = 3.0, 2e-4


def plant_with(damping=0.0, **deviations):
    joint = replace(JOINT, damping_nms_per_rad=damping)
    side = JointPlant(joint, Deviations(**deviations))
    return Plant(PlantParameters((side, side)))


def bent(damping=0.0, **more):
    error = {"kinematic_error_rad": E, "kinematic_error_phase_rad": PHASE}
    return plant_with(damping, friction_scale=0.0, **error, **more)


def error_at(motor):
    return E * math.sin(ORDER * motor + PHASE)


@pytest.mark.parametrize("name", ["plant.yaml", "joint1.yaml"])
def test_a_plant_without_the_new_sections_is_the_old_plant_bit_by_bit(name):
    parameters = load_plant(shipped(name))
    plant, twin = Plant(parameters), TwinPlant(parameters)
    for k in range(2500):
        t = 1.0 + 0.001 * k
        for each in (plant, twin):
            each.command(0, VELOCITY, G * demo_velocity(t))
            each.command(1, CURRENT, demo_current(t))
        plant.step(0.001)
        twin.step()
        assert plant.motor_position == twin.motor_position
        assert plant.motor_velocity == twin.motor_velocity
        assert (plant.link_position, plant.link_velocity) == (twin.link_position, twin.link_velocity)
        assert plant.sensor_torque() == twin.sensor_torque()
    assert max(abs(w) for w in plant.motor_velocity) > 10.0


def test_friction_written_out_is_the_table():
    side = JointPlant(JOINT)
    table, friction = loss_table(side), joint_friction(side)
    rng = np.random.default_rng(2)
    for tau, v in zip(rng.uniform(-90, 90, 3000), rng.uniform(-5, 5, 3000), strict=True):
        assert friction(tau, v) == table.magnitude(tau, v)


def test_torque_is_that_of_torsion_its_rate_and_the_slip_everywhere():
    """τ = K δ + D δ' + H z, δ' = w (1/G + e') - wl: what the sensor is computed from, and what the loop integrates."""
    damping = 8.0
    plant = bent(damping=damping, hysteresis_nm=H, hysteresis_travel_rad=TRAVEL)
    motors, speeds, plant.slip = [3.7, -12.0], [150.0, -40.0], [0.3, -0.8]
    plant.motor_position, plant.motor_velocity = list(motors), list(speeds)
    plant.link_position, plant.link_velocity = 0.04, 0.7
    expected = []
    for k, sign in ((0, 1.0), (1, -1.0)):
        torsion = motors[k] / G + error_at(motors[k]) - sign * 0.04
        slope = E * ORDER * math.cos(ORDER * motors[k] + PHASE)
        rate = speeds[k] * (1 / G + slope) - sign * 0.7
        expected.append(K * torsion + damping * rate + H * plant.slip[k])
    assert plant.joint_torques() == pytest.approx(expected, rel=1e-12)
    asked = {}
    plant.friction = tuple(lambda tau, w, k=k: asked.update({k: tau}) or 0.0 for k in (0, 1))
    plant._integrate(1, 1e-12)
    assert [asked[0], asked[1]] == pytest.approx(expected, rel=1e-9)


def test_bench_begins_without_stress():
    plant = bent()
    assert plant.joint_torques() == pytest.approx((0.0, 0.0), abs=1e-9)
    assert plant.motor_position[0] == pytest.approx(-G * error_at(plant.motor_position[0]))
    assert abs(plant.motor_position[0]) > 0.01
    plant.step(0.5)
    assert plant.sensor_torque() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_forces_are_the_slope_of_the_energy(seed):
    """Virtual work: Jm dw/dt = -∂E/∂θm, J dwl/dt = -∂E/∂θl, the sticking element displaced with the torsion.

    Central differences over 1e-6 rad of the motor, 1e-9 rad of the link.
    """
    rng = np.random.default_rng(seed)
    plant = bent(ripple_nm=0.5, hysteresis_nm=H, hysteresis_travel_rad=TRAVEL)
    motors, link, slip = list(rng.uniform(-3, 3, 2)), float(rng.uniform(-0.01, 0.01)), [0.2, -0.4]

    def energy(d_motor, d_link):
        plant.motor_position = [m + d for m, d in zip(motors, d_motor, strict=True)]
        plant.link_position = link + d_link
        for k, sign in ((0, 1.0), (1, -1.0)):
            moved = plant.motor_position[k]
            change = (moved - motors[k]) / G + error_at(moved) - error_at(motors[k]) - sign * d_link
            plant.slip[k] = slip[k] + change / TRAVEL
        return plant.energy()

    e = 1e-6
    slopes = [
        (energy((e, 0), 0) - energy((-e, 0), 0)) / (2 * e),
        (energy((0, e), 0) - energy((0, -e), 0)) / (2 * e),
        (energy((0, 0), 1e-8) - energy((0, 0), -1e-8)) / 2e-8,
    ]
    energy((0, 0), 0)
    h = 1e-9
    plant._integrate(1, h)
    forces = [JM * plant.motor_velocity[k] / h for k in (0, 1)] + [2 * JL * plant.link_velocity / h]
    assert forces == pytest.approx([-s for s in slopes], rel=1e-5, abs=1e-5)


def test_a_bent_gear_alone_neither_makes_nor_takes_energy():
    """No friction, damping, hysteresis: energy stays within the 1e-3 of semi-implicit Euler over 200 turns."""
    plant = bent()
    plant.motor_velocity = [250.0, -250.0]
    plant.link_velocity = 2.5
    plant.motor_position[0] += 0.5
    first = plant.energy()
    for _ in range(5000):
        plant.step(0.001)
        assert plant.energy() == pytest.approx(first, rel=2e-3)
    assert plant.motor_position[0] > 1000.0


@pytest.mark.parametrize("seed", range(6))
def test_without_current_the_energy_only_falls(seed):
    rng = np.random.default_rng(seed)
    plant = plant_with(
        damping=JOINT.damping_nms_per_rad,
        ripple_nm=0.4,
        stribeck_nm=0.8,
        kinematic_error_rad=E,
        kinematic_error_phase_rad=PHASE,
        hysteresis_nm=H,
        hysteresis_travel_rad=TRAVEL,
    )
    plant.motor_velocity = list(rng.uniform(-250, 250, 2))
    plant.link_velocity = float(rng.uniform(-2, 2))
    plant.motor_position = list(rng.uniform(-0.3, 0.3, 2))
    first = energy = plant.energy()
    for _ in range(600):
        plant.step(0.001)
        # 1e-3 of the start: semi-implicit Euler exchanges that much with its shadow energy in a period
        assert plant.energy() <= energy + 1e-3 * first
        energy = plant.energy()
    assert energy < 0.5 * first


def squeeze(amplitude_rad, period_s, **deviations):
    """Both motors turn against each other, the link stays: torsion is θm/G. Rows (torsion, torque), 3 cycles."""
    plant = plant_with(friction_scale=0.0, **deviations)
    rows = []
    for k in range(round(3 * period_s / 0.001)):
        angle = 2 * math.pi * k * 0.001 / period_s
        speed = G * amplitude_rad * math.cos(angle) * 2 * math.pi / period_s
        for joint in (0, 1):
            plant.command(joint, VELOCITY, speed)
        plant.step(0.001)
        rows.append((plant.motor_position[0] / G, plant.joint_torques()[0]))
    assert plant.link_position == 0.0
    return np.array(rows)


@pytest.mark.parametrize("period_s", [0.6, 2.4])
def test_hysteresis_loop_has_its_area_whatever_the_rate(period_s):
    """∮τ dδ = 4 H (a - travel): the element slips for 2 (a - travel) each way; first loading is linear."""
    rows = squeeze(1.5e-3, period_s, hysteresis_nm=H, hysteresis_travel_rad=TRAVEL)
    torsion, torque = rows.T
    one = round(period_s / 0.001)
    loop_x, loop_y = torsion[one : 2 * one + 1], torque[one : 2 * one + 1]
    area = float(np.sum(0.5 * (loop_y[1:] + loop_y[:-1]) * np.diff(loop_x)))
    amplitude = 0.5 * np.ptp(loop_x)
    assert amplitude > 4 * TRAVEL
    assert area == pytest.approx(4 * H * (amplitude - TRAVEL), rel=0.02)
    extra = torque - K * torsion
    virgin = np.flatnonzero(torsion > TRAVEL)[0]
    assert extra[:virgin] == pytest.approx(H / TRAVEL * torsion[:virgin], abs=0.01 * H)
    assert np.max(np.abs(extra)) == pytest.approx(H, rel=1e-6)


def test_hysteresis_below_its_travel_is_a_spring():
    rows = squeeze(0.8 * TRAVEL, 0.8, hysteresis_nm=H, hysteresis_travel_rad=TRAVEL)
    torsion, torque = rows.T
    assert torque == pytest.approx((K + H / TRAVEL) * torsion, abs=1e-6)


def test_kinematic_error_shows_between_the_encoders():
    """Slow turning without load: θm/G - θl of joint 1 is -e(θm1), amplitude and phase at its order."""
    plant = Plant(
        PlantParameters(
            (
                JointPlant(JOINT, Deviations(0.0, kinematic_error_rad=E, kinematic_error_phase_rad=PHASE)),
                JointPlant(JOINT, Deviations(0.0)),
            )
        )
    )
    plant.command(0, VELOCITY, 2.0)
    plant.step(0.5)
    rows = []
    for _ in range(int(2 * math.pi / 2.0 * 1000)):
        plant.step(0.001)
        rows.append((plant.motor_position[0], plant.motor_position[0] / G - plant.link_position))
    angle, difference = np.array(rows).T
    basis = np.column_stack([np.sin(2 * angle), np.cos(2 * angle), np.ones_like(angle), angle])
    s, c, *_ = np.linalg.lstsq(basis, difference, rcond=None)[0]
    assert math.hypot(s, c) == pytest.approx(E, rel=0.02)
    assert math.atan2(-c, -s) == pytest.approx(PHASE, abs=0.05)


def test_step_is_shortened_for_a_stiff_hysteresis_element():
    plain = PlantParameters((JointPlant(JOINT),) * 2, substep_s=500e-6)
    stiff = JointPlant(JOINT, Deviations(hysteresis_nm=10.0, hysteresis_travel_rad=1e-5))
    spring = JointPlant(replace(JOINT, stiffness_nm_per_rad=K + 1e6))
    both = [substep_limit(replace(plain, joints=(side, side))) for side in (stiff, spring)]
    assert both[0] == pytest.approx(both[1])
    assert both[0] < 0.2 * substep_limit(plain)
