"""The plant against closed forms: Table I, resonances, energy, statics, stiction, kinematic error, hysteresis, step size."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.drives import demo_current, demo_velocity
from jtqd.sim_can.plant import Plant, joint_friction, loss_table
from jtqd.sim_can.plant_file import (
    Deviations,
    DriveParameters,
    Hysteresis,
    JointPlant,
    KinematicError,
    PlantParameters,
    Ripple,
    Stribeck,
    load_plant,
    plant_of_joint,
    substep_limit,
)
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY
from tests.sim_can.plant_twin import TwinPlant

JOINT = load_joint(shipped("joint1.yaml"))
G, KT, K = JOINT.gear_ratio, JOINT.torque_constant_nm_per_a, JOINT.stiffness_nm_per_rad
JM, JL = JOINT.rotor_inertia_kgm2, JOINT.link_inertia_kgm2

# Table I, literally: p00 p10 p01 p20 p11 p02 by (sign of i, sign of w)
TABLE_I = {
    (1, 1): (0.2530, 0.1493, -0.0820, -0.0117, 0.0060, 0.0066),
    (-1, -1): (0.2850, -0.1430, 0.0839, -0.0114, 0.0059, 0.0060),
    (-1, 1): (1.8830, 0.4870, 0.2602, 0.0658, 0.0435, -0.0168),
    (1, -1): (1.8660, -0.4769, -0.2342, 0.0645, 0.04295, -0.0101),
}


def table_i(i, w):
    p00, p10, p01, p20, p11, p02 = TABLE_I[int(math.copysign(1, i)), int(math.copysign(1, w))]
    return p00 + p10 * i + p01 * w + p20 * i * i + p11 * i * w + p02 * w * w


E, ORDER, PHASE = 4e-4, 2.0, 0.9  # ten times the campaign bench's, so that each term is seen
H, TRAVEL = 3.0, 2e-4
BEND, SLIP = KinematicError(E, ORDER, PHASE), Hysteresis(H, TRAVEL)


def ideal(joint=JOINT, **deviations):
    side = JointPlant(joint, Deviations(**deviations))
    return PlantParameters((side, side))


def frictionless(damping=0.0, **deviations):
    return Plant(ideal(replace(JOINT, damping_nms_per_rad=damping), friction_scale=0.0, **deviations))


def bent(damping=0.0, **more):
    return frictionless(damping, kinematic_error=BEND, **more)


def error_at(motor):
    return E * math.sin(ORDER * motor + PHASE)


def energy(plant):
    """Kinetic and elastic energy and the ripple's potential, J."""
    sides = plant.parameters.joints
    total = 0.5 * sum(side.true_joint.link_inertia_kgm2 for side in sides) * plant.link_velocity**2
    for k, link in ((0, plant.link_position), (1, -plant.link_position)):
        c, motor = sides[k].constants, plant.motor_position[k]
        torsion = motor / G + c.error_rad * math.sin(c.error_order * motor + c.error_phase) - link
        total += 0.5 * c.rotor_inertia * plant.motor_velocity[k] ** 2 + 0.5 * c.stiffness * torsion**2
        total += 0.5 * c.slip_nm / c.per_travel * plant.slip[k] ** 2
        total += c.ripple_nm / (G * c.ripple_order) * math.sin(c.ripple_order * motor + c.ripple_phase)
    return total


@pytest.mark.parametrize("velocity", [0.2, 1.4, 2.95])
@pytest.mark.parametrize("direction", [1, -1])
def test_steady_state_has_the_efficiencies_of_table_i_in_all_four_quadrants(velocity, direction):
    """τ/(G Kt i) of both joints within 1 % of Eq. (8): joint 2 driving and back-driven, joint 1 driving."""
    checked = set()
    for current in (-5.0, -3.0, -1.0, 1.0, 3.0, 5.0):
        plant = Plant(ideal())
        w = direction * velocity
        plant.motor_velocity = [G * w, -G * w]
        plant.link_velocity = w
        plant.command(0, VELOCITY, G * w)
        plant.command(1, CURRENT, current)
        plant.step(1.0)
        samples = []
        for _ in range(300):
            plant.step(0.001)
            currents = [drive.current_a for drive in plant.drives]
            samples.append([*currents, *plant.joint_torques(), *plant.motor_velocity])
        i1, i2, tau1, tau2, w1, w2 = np.mean(samples, axis=0)
        for i, tau, speed in ((i1, tau1, w1 / G), (i2, tau2, w2 / G)):
            if 0.99 <= abs(i) <= 5.0:
                assert tau / (G * KT * i) == pytest.approx(table_i(i, speed), rel=0.01), (current, i, speed)
                checked.add((i > 0, speed > 0))
    assert {pair[0] for pair in checked} == {True, False}
    assert len(checked) == 4


def test_stribeck_is_there_at_standstill_and_gone_at_the_first_speed_of_table_i():
    plain = joint_friction(JointPlant(JOINT))
    peaked = joint_friction(JointPlant(JOINT, Deviations(stribeck=Stribeck(0.8))))
    for tau in (-20.0, 0.0, 15.0):
        assert peaked(tau, 0.0) - plain(tau, 0.0) == pytest.approx(0.8)
        assert peaked(tau, 0.05) - plain(tau, 0.05) == pytest.approx(0.8 / math.e)
        assert peaked(tau, -0.1) - plain(tau, -0.1) == pytest.approx(0.8 * math.exp(-4))
        for w in (0.2, -0.2, 1.0):
            assert abs(peaked(tau, w) - plain(tau, w)) < 1e-6


def test_friction_never_helps_the_motion():
    rng = np.random.default_rng(5)
    friction = joint_friction(JointPlant(JOINT, Deviations(viscous_scale=0.0)))
    for tau, w in zip(rng.uniform(-90, 90, 4000), rng.uniform(-5, 5, 4000), strict=True):
        assert friction(tau, w) >= 0.0


def crossings_hz(values, dt):
    """Frequency from the first and last upward zero crossing, interpolated."""
    v = np.asarray(values)
    k = np.flatnonzero((v[:-1] < 0) & (v[1:] >= 0))
    times = k + v[k] / (v[k] - v[k + 1])
    return (len(times) - 1) / ((times[-1] - times[0]) * dt)


def test_rotors_against_each_other_ring_at_the_closed_form():
    """Both rotors opposed, link at rest by symmetry: ω² = K / (Jm G²)."""
    plant = frictionless()
    plant.motor_position = [1e-3 * G, 1e-3 * G]  # own frames: the coupling is squeezed from both sides
    samples = []
    for _ in range(2000):
        plant.step(0.001)
        samples.append(plant.motor_velocity[0])
    assert plant.link_position == pytest.approx(0.0, abs=1e-12)
    expected = math.sqrt(K / (JM * G * G)) / (2 * math.pi)
    assert crossings_hz(samples, 0.001) == pytest.approx(expected, rel=1e-3)


def test_link_against_both_rotors_rings_at_the_closed_form():
    """Link between two rotors moving together: ω² = 2 K (1/(2 Jl) + 1/(2 Jm G²)); Jl of each link."""
    plant = frictionless()
    mass = 2 * JM * G * G
    plant.link_position = 1e-4
    plant.motor_position = [-1e-4 * 2 * JL / mass * G, +1e-4 * 2 * JL / mass * G]
    samples = []
    for _ in range(4000):
        plant._integrate(1, plant.substep_s)
        samples.append(plant.link_velocity)
    expected = math.sqrt(2 * K * (1 / (2 * JL) + 1 / mass)) / (2 * math.pi)
    assert crossings_hz(samples, plant.substep_s) == pytest.approx(expected, rel=3e-3)


def test_energy_balance_of_every_term():
    """ΔE = motor work - damping - friction, term by term summed outside the plant."""
    h = 5e-6
    plant = Plant(ideal(ripple=Ripple(0.5)))
    plant.motor_velocity = [120.0, -90.0]
    plant.motor_position = [0.2, 0.1]
    plant.link_velocity = 1.0
    plant.command(0, CURRENT, 4.0)
    plant.command(1, CURRENT, -2.5)
    for drive in plant.drives:
        drive.plan(1.0)
    before = energy(plant)
    balance = work = 0.0
    for _ in range(60_000):
        tau = plant.joint_torques()
        link = plant.link_velocity
        old = list(plant.motor_velocity)
        plant._integrate(1, h)
        for k, sign in ((0, 1.0), (1, -1.0)):
            w = 0.5 * (old[k] + plant.motor_velocity[k])
            slip = old[k] / G - sign * link
            power = KT * plant.drives[k].current_a * w
            friction = plant.friction[k](tau[k], old[k] / G) * abs(w) / G
            balance += h * (power - friction - JOINT.damping_nms_per_rad * slip * slip)
            work += h * abs(power)
    assert work > 1.0
    assert energy(plant) - before == pytest.approx(balance, abs=0.005 * work)


@pytest.mark.parametrize("more", [{}, {"kinematic_error": BEND, "hysteresis": SLIP}])
@pytest.mark.parametrize("seed", range(4))
def test_without_current_the_energy_only_falls(seed, more):
    rng = np.random.default_rng(seed)
    plant = Plant(ideal(ripple=Ripple(0.4), stribeck=Stribeck(0.8), **more))
    plant.motor_velocity = list(rng.uniform(-250, 250, 2))
    plant.link_velocity = float(rng.uniform(-2, 2))
    plant.motor_position = list(rng.uniform(-0.3, 0.3, 2))
    first = before = energy(plant)
    for _ in range(600):
        plant.step(0.001)
        # 1e-3 of the start: semi-implicit Euler exchanges that much with its shadow energy in a period
        assert energy(plant) <= before + 1e-3 * first
        before = energy(plant)
    assert before < 0.5 * first


def test_torsion_at_rest_is_torque_over_stiffness():
    plant = Plant(ideal())
    plant.command(0, VELOCITY, 0.0)
    plant.command(1, CURRENT, 4.0)
    plant.step(3.0)
    tau1, tau2 = plant.joint_torques()
    assert plant.motor_velocity == [0.0, 0.0]
    assert tau1 > 5.0
    assert tau1 == pytest.approx(tau2, rel=1e-6)
    assert plant.motor_position[0] / G - plant.link_position == pytest.approx(tau1 / K, rel=1e-6)
    assert plant.sensor_torque() == pytest.approx(tau1, rel=1e-6)


@pytest.mark.parametrize("joint", [0, 1])
def test_positive_current_gives_positive_torque_in_the_sensor(joint):
    plant = Plant(ideal())
    plant.command(1 - joint, VELOCITY, 0.0)
    plant.command(joint, CURRENT, 3.0)
    plant.step(1.0)
    assert plant.sensor_torque() > 3.0
    assert plant.motor_position[joint] > 0.0
    assert plant.link_position * (1 if joint == 0 else -1) > 0.0


def test_sensor_sees_each_joint_less_its_own_link_inertia():
    """τ1 - Jl1 a1 = τ2 - Jl2 a2 while the link accelerates, with unequal links."""
    light = replace(JOINT, link_inertia_kgm2=0.004)
    plant = Plant(PlantParameters((JointPlant(JOINT), JointPlant(light))))
    plant.motor_position = [0.3, -0.1]
    tau1, tau2 = plant.joint_torques()
    acceleration = (tau1 - tau2) / (0.004 + JL)
    assert abs(acceleration) > 100.0
    assert plant.sensor_torque() == pytest.approx(tau1 - JL * acceleration)
    assert plant.sensor_torque() == pytest.approx(tau2 + 0.004 * acceleration)


def test_friction_of_each_joint_acts_at_its_own_torque_and_velocity():
    plant = Plant(ideal())
    plant.motor_position, plant.motor_velocity = [0.3, -0.1], [40.0, -25.0]
    torques, velocities = plant.joint_torques(), list(plant.motor_velocity)
    friction = [plant.friction[k](torques[k], velocities[k] / G) for k in (0, 1)]
    assert friction[0] > 1.2 * friction[1] > 0.0
    h = 1e-9
    plant._integrate(1, h)
    for k in (0, 1):
        load = torques[k] + math.copysign(friction[k], velocities[k])
        change = plant.motor_velocity[k] - velocities[k]
        assert change == pytest.approx(-h / JM * load / G, rel=1e-6)


def test_load_held_by_friction_does_not_creep():
    """5 s with a load below breakaway: velocities are exactly zero and no angle changes by one bit."""
    plant = Plant(ideal(ripple=Ripple(0.4), stribeck=Stribeck(0.8)))
    plant.command(1, CURRENT, 0.35)
    plant.motor_position = [0.0, 0.02]
    plant.step(1.0)
    angles = list(plant.motor_position)
    for _ in range(100):
        plant.step(0.05)
        assert plant.motor_velocity == [0.0, 0.0]
    assert plant.motor_position == angles


def test_joint_breaks_away_where_the_current_exceeds_friction():
    """Joint 2 is off and holds by its friction: joint 1 stands, then winds the spring up, then turns both."""
    static = joint_friction(JointPlant(JOINT))(0.0, 0.0)

    def after(factor):
        plant = Plant(ideal())
        plant.command(0, CURRENT, factor * static / (G * KT))
        plant.step(1.0)
        return plant

    assert after(0.95).motor_position == [0.0, 0.0]
    wound = after(1.5)
    assert wound.motor_velocity == [0.0, 0.0]
    assert 0.1 * static < wound.sensor_torque() < static
    turning = after(5.0)
    assert turning.motor_velocity[0] > 0.1 * G
    assert turning.motor_velocity[1] < -0.1 * G


def test_late_step_is_the_same_physics_as_steps_in_time():
    def run(dt, count):
        plant = Plant(load_plant(shipped("plant.yaml")))
        plant.command(0, VELOCITY, 80.0)
        plant.command(1, CURRENT, -2.0)
        for _ in range(count):
            plant.step(dt)
        return [*plant.motor_position, *plant.motor_velocity, plant.link_position, plant.sensor_torque()]

    assert run(0.05, 10) == pytest.approx(run(0.001, 500), rel=1e-9)
    assert run(0.00107, 467)[2] == pytest.approx(run(0.001, 500)[2], rel=2e-3)  # jitter: other substeps


def test_results_converge_with_the_step_size():
    """Halving the step halves the error (first order); at 125 us the torque is within 0.05 Nm rms."""

    def torque(substep):
        plant = Plant(replace(load_plant(shipped("plant.yaml")), substep_s=substep))
        out = []
        for k in range(800):
            plant.command(0, VELOCITY, 100.0 * math.sin(6.0 * k * 0.001))
            plant.command(1, CURRENT, 2.0 * math.sin(9.0 * k * 0.001))
            plant.step(0.001)
            out.append(plant.sensor_torque())
        return np.array(out)

    exact = torque(125e-6 / 16)
    coarse, fine = (float(np.sqrt(np.mean((torque(h) - exact) ** 2))) for h in (125e-6, 62.5e-6))
    assert coarse < 0.05
    assert 1.5 < coarse / fine < 3.0


def test_ripple_has_its_amplitude_and_order():
    """G Kt i - G Jm dw/dt - τ is the ripple alone when there is no friction: A cos(2 θm + φ)."""
    plant = Plant(ideal(friction_scale=0.0, ripple=Ripple(0.4, phase_rad=0.7)))
    plant.motor_velocity = [100.0, -100.0]
    plant.link_velocity = 1.0
    plant.command(0, VELOCITY, 100.0)
    plant.command(1, VELOCITY, -100.0)
    rows = []
    for k in range(4000):
        if k % 8 == 0:
            plant.drives[0].plan(0.001)
            plant.drives[1].plan(0.001)
        before = plant.motor_velocity[0]
        tau = plant.joint_torques()[0]
        angle = plant.motor_position[0]
        plant._integrate(1, 125e-6)
        acceleration = (plant.motor_velocity[0] - before) / 125e-6
        rows.append((angle, G * KT * plant.drives[0].current_a - G * JM * acceleration - tau))
    angle, ripple = np.array(rows).T
    assert ripple == pytest.approx(0.4 * np.cos(2.0 * angle + 0.7), abs=1e-6)
    assert np.ptp(angle) > 2 * math.pi


def test_step_is_shortened_for_a_stiff_light_joint():
    stiff = replace(JOINT, stiffness_nm_per_rad=200_000.0, link_inertia_kgm2=0.002)
    parameters = ideal(stiff)
    step = substep_limit(parameters)
    assert step < 30e-6
    plant = Plant(parameters)
    plant.motor_position = [0.05, 0.0]
    first = energy(plant)
    plant.step(0.05)
    assert energy(plant) < first  # an unstable step would have grown without bound


def test_joint_file_serves_as_a_plant():
    parameters = load_plant(shipped("joint1.yaml"))
    assert parameters.joints[0].joint.name == parameters.joints[1].joint.name == "joint1"
    assert parameters.joints[0].deviations.stribeck.torque_nm == JOINT.friction.stribeck_nm
    assert parameters == plant_of_joint(JOINT)


def test_current_loop_is_first_order_at_its_bandwidth_and_limited():
    plant = Plant(PlantParameters((JointPlant(JOINT, drive=DriveParameters(current_limit_a=6.0)),) * 2))
    drive = plant.drives[0]
    drive.command(CURRENT, 5.0, 0.0)
    drive.plan(0.001)
    tau = 1 / (2 * math.pi * 500.0)
    for k in range(1, 20):
        assert drive.step(1e-4, 0.0) == pytest.approx(5.0 * (1 - math.exp(-k * 1e-4 / tau)))
    drive.command(CURRENT, 50.0, 0.0)
    drive.plan(0.001)
    for _ in range(1000):
        current = drive.step(1e-4, 0.0)
    assert current == pytest.approx(6.0)
    drive.command(OFF, 0.0, 0.0)
    drive.plan(0.001)
    for _ in range(1000):
        current = drive.step(1e-4, 0.0)
    assert current == pytest.approx(0.0, abs=1e-9)


def test_a_joint_file_without_efficiency_has_the_friction_it_says():
    """Fc + Fv |v| + Fs exp(-(v/vs)²) at any torque, with a wide peak too."""
    friction = replace(JOINT.friction, stribeck_nm=1.5, stribeck_velocity_rad_s=0.15)
    joint = replace(JOINT, efficiency=None, friction=friction)
    law = Plant(plant_of_joint(joint)).friction[0]
    for v in (0.0, 0.01, -0.07, 0.15, -0.3, 0.61, 2.0):
        expected = 3.0 + 2.0 * abs(v) + 1.5 * math.exp(-((v / 0.15) ** 2))
        assert law(12.0, v) == pytest.approx(expected, abs=1e-6), v


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
    plant = bent(damping=damping, hysteresis=SLIP)
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
    accelerated = (expected[0] - expected[1]) / (2 * JL)
    h = 1e-9
    plant._integrate(1, h)
    assert plant.link_velocity - 0.7 == pytest.approx(h * accelerated, rel=1e-6)


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
    plant = bent(ripple=Ripple(0.5), hysteresis=SLIP)
    motors, link, slip = list(rng.uniform(-3, 3, 2)), float(rng.uniform(-0.01, 0.01)), [0.2, -0.4]

    def displaced(d_motor, d_link):
        plant.motor_position = [m + d for m, d in zip(motors, d_motor, strict=True)]
        plant.link_position = link + d_link
        for k, sign in ((0, 1.0), (1, -1.0)):
            moved = plant.motor_position[k]
            change = (moved - motors[k]) / G + error_at(moved) - error_at(motors[k]) - sign * d_link
            plant.slip[k] = slip[k] + change / TRAVEL
        return energy(plant)

    e = 1e-6
    slopes = [
        (displaced((e, 0), 0) - displaced((-e, 0), 0)) / (2 * e),
        (displaced((0, e), 0) - displaced((0, -e), 0)) / (2 * e),
        (displaced((0, 0), 1e-8) - displaced((0, 0), -1e-8)) / 2e-8,
    ]
    displaced((0, 0), 0)
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
    first = energy(plant)
    for _ in range(5000):
        plant.step(0.001)
        assert energy(plant) == pytest.approx(first, rel=2e-3)
    assert plant.motor_position[0] > 1000.0


def squeeze(amplitude_rad, period_s, **deviations):
    """Both motors turn against each other, the link stays: torsion is θm/G. Rows (torsion, torque), 3 cycles."""
    plant = frictionless(**deviations)
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
    rows = squeeze(1.5e-3, period_s, hysteresis=SLIP)
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
    rows = squeeze(0.8 * TRAVEL, 0.8, hysteresis=SLIP)
    torsion, torque = rows.T
    assert torque == pytest.approx((K + H / TRAVEL) * torsion, abs=1e-6)


def test_kinematic_error_shows_between_the_encoders():
    """Slow turning without load: θm/G - θl of joint 1 is -e(θm1), amplitude and phase at its order."""
    sides = (Deviations(0.0, kinematic_error=BEND), Deviations(0.0))
    plant = Plant(PlantParameters(tuple(JointPlant(JOINT, each) for each in sides)))
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
    stiff = JointPlant(JOINT, Deviations(hysteresis=Hysteresis(10.0, 1e-5)))
    spring = JointPlant(replace(JOINT, stiffness_nm_per_rad=K + 1e6))
    both = [substep_limit(replace(plain, joints=(side, side))) for side in (stiff, spring)]
    assert both[0] == pytest.approx(both[1])
    assert both[0] < 0.2 * substep_limit(plain)
