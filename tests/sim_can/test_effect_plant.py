"""The plant with effects: the plain plant where they are zero, the deviations of a plant file where these say the
same, no energy from nothing, and what is refused."""

import math
from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest

from jtqd.estimator.effects import EFFECTS
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import Effect
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.drives import demo_current, demo_velocity
from jtqd.sim_can.effect_plant import EffectFriction, EffectPlant, JointEffects
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant import Plant, joint_friction
from jtqd.sim_can.plant_file import (
    Day,
    Deviations,
    Hysteresis,
    JointPlant,
    KinematicError,
    PlantParameters,
    Ripple,
    Stribeck,
    Thermal,
    load_plant,
    plant_of_joint,
)
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY

JOINT = load_joint(shipped("joint1.yaml"))
G, KT, K = JOINT.gear_ratio, JOINT.torque_constant_nm_per_a, JOINT.stiffness_nm_per_rad
JM, JL, FV = JOINT.rotor_inertia_kgm2, JOINT.link_inertia_kgm2, JOINT.friction.viscous_nms_per_rad


def nothing(joint):
    """Every effect of the library, of size zero for this joint."""
    every = {}
    for name, effect in EFFECTS.items():
        every[name] = values = dict(effect.terms(joint)[0].basis[0])
        for p in effect.parameters:
            if p.key:
                values[p.name] = attrgetter(p.key)(joint)
            elif p.neutral is not None and p.neutral >= p.low:  # a travel of 0 is none
                values[p.name] = p.neutral
    return every


def with_effects(joint, effects):
    return replace(joint, effects=tuple(Effect(name, values) for name, values in effects.items()))


def drive(each, t):
    each.command(0, VELOCITY, G * demo_velocity(t))
    each.command(1, CURRENT, demo_current(t))


def state(plant):
    where = (*plant.motor_position, *plant.motor_velocity, plant.link_position, plant.link_velocity)
    return (*where, *plant.slip, *(drive.current_a for drive in plant.drives))


@pytest.mark.parametrize("name", ["plant.yaml", "campaign_plant.yaml"])
def test_effects_of_size_zero_are_the_plain_plant_bit_by_bit(name):
    """Readings with their noise and rounding included; the shipped benches' own deviations too."""
    plain = load_plant(shipped(name))
    sides = [replace(side, joint=with_effects(side.joint, nothing(side.joint))) for side in plain.joints]
    one, two = PlantSource(plain, 7), PlantSource(replace(plain, joints=tuple(sides)), 7)
    assert type(one.plant) is Plant
    assert type(two.plant) is EffectPlant
    for source in (one, two):
        source.advance(0.0)
    for k in range(1500):
        for source in (one, two):
            drive(source, 1.0 + 0.001 * k)
            source.advance(0.001)
        if k % 10 == 0 or k < 20:
            assert state(one.plant) == state(two.plant), k
            for a, b in zip(one.drives, two.drives, strict=True):
                assert (a.current_a, a.motor_position_rad) == (b.current_a, b.motor_position_rad)
                assert a.link_position_rad == b.link_position_rad
            # θ/G here, θ (1/G) in the loop and there: the last bit
            assert one.channels[0].torque_nm == pytest.approx(two.channels[0].torque_nm, rel=1e-12, abs=1e-12)
    assert max(abs(w) for w in one.plant.motor_velocity) > 10.0


SAME = [
    ({"viscous_scale": 1.3}, {"viscous_friction": {"viscous_nms_per_rad": 1.3 * FV}}),
    ({"torque_constant_scale": 1.06}, {"torque_constant": {"torque_constant_nm_per_a": 1.06 * KT}}),
    ({"stiffness_scale": 1.2}, {"nonlinear_stiffness": {"stiffness_nm_per_rad": 1.2 * K}}),
    ({"rotor_inertia_scale": 1.3}, {"rotor_inertia": {"rotor_inertia_kgm2": 1.3 * JM}}),
    (
        {"ripple": Ripple(0.5, 4.0, 0.3)},
        {"torque_ripple": {"amplitude_nm": 0.5, "order_per_motor_rev": 4.0, "phase_rad": 0.3}},
    ),
    (
        {"kinematic_error": KinematicError(3e-4, phase_rad=0.9)},
        {"kinematic_error": {"amplitude_rad": 3e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.9}},
    ),
    (
        {"hysteresis": Hysteresis(2.0, 2e-4)},
        {"hysteresis": {"torque_nm": 2.0, "travel_rad": 2e-4}},
    ),
    (
        {"stribeck": Stribeck(1.7)},
        {"stribeck_friction": {"stribeck_nm": 2.5, "stribeck_velocity_rad_s": 0.05}},  # the file's 0.8 more
    ),
]


@pytest.mark.parametrize(("deviations", "effects"), SAME)
def test_an_effect_is_the_deviation_that_says_the_same(deviations, effects):
    one = Plant(PlantParameters((JointPlant(JOINT, Deviations(**deviations)), JointPlant(JOINT))))
    two = EffectPlant(PlantParameters((JointPlant(with_effects(JOINT, effects)), JointPlant(JOINT))))
    two.substep_s = one.substep_s
    plain = Plant(PlantParameters((JointPlant(JOINT), JointPlant(JOINT))))
    difference = 0.0
    for k in range(1500):
        for plant in (one, two, plain):
            drive(plant, 1.0 + 0.001 * k)
            plant.step(0.001)
        assert two.motor_position == pytest.approx(one.motor_position, rel=1e-6, abs=1e-6), k
        assert two.joint_torques() == pytest.approx(one.joint_torques(), rel=1e-5, abs=2e-4), k
        difference = max(difference, abs(plain.joint_torques()[0] - one.joint_torques()[0]))
    assert difference > 0.005


def conservative(damping=0.0, **more):
    """Unlike joints whose effects store energy and lose none; friction and damping only where wanted."""
    effects = {
        "nonlinear_stiffness": {"stiffness_nm_per_rad": 1.2 * K, "cubic_nm_per_rad3": 5e8},
        "lost_motion": {"width_rad": 3e-4},
        "kinematic_error": {"amplitude_rad": 4e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.9},
        "torque_ripple": {"amplitude_nm": 0.5, "order_per_motor_rev": 4.0, "phase_rad": 0.3},
        "cogging": {"amplitude_nm": 0.3, "order_per_motor_rev": 12.0, "phase_rad": 1.0},
        "unbalance": {"moment_nm": 1.5, "phase_rad": 0.5},
        "link_inertia": {"link_inertia_kgm2": 2.0 * JL},
        "rotor_inertia": {"rotor_inertia_kgm2": 1.3 * JM},
    }
    joint = with_effects(replace(JOINT, damping_nms_per_rad=damping, efficiency=None), effects | more)
    other = replace(joint, effects=joint.effects[3:])
    scale = Deviations(1.0 if more else 0.0)
    return EffectPlant(PlantParameters((JointPlant(joint, scale), JointPlant(other, scale)), substep_s=2e-5))


def energy(plant):
    """Kinetic energy and all potentials of `conservative`, in closed form."""
    sum_ = 0.5 * 4.0 * JL * plant.link_velocity**2
    for k, link in ((0, plant.link_position), (1, -plant.link_position)):
        motor = plant.motor_position[k]
        sum_ += 0.5 * 1.3 * JM * plant.motor_velocity[k] ** 2
        sum_ += 0.5 / (4 * G) * math.sin(4 * motor + 0.3) + 0.3 / (12 * G) * math.sin(12 * motor + 1.0)
        sum_ -= 1.5 * math.cos(link + 0.5)
        d = motor / G - link
        if k == 0:
            d += 4e-4 * math.sin(2 * motor + 0.9)
            inside = min(abs(d), 1.5e-4)
            lost = 0.5 * inside**2 + 1.5e-4 * (abs(d) - inside)
            sum_ += 0.6 * K * d * d + 0.25 * 5e8 * d**4 - K * lost
        else:
            sum_ += 0.5 * K * d * d
    return sum_


def thrown(plant, seed):
    rng = np.random.default_rng(seed)
    plant.motor_velocity = [float(v) for v in rng.uniform(-200, 200, 2)]
    plant.motor_position = [float(a) for a in rng.uniform(-0.3, 0.3, 2)]
    plant.link_velocity = float(rng.uniform(-2, 2))
    return plant


@pytest.mark.parametrize("seed", range(3))
def test_effects_together_neither_make_nor_take_energy(seed):
    plant = thrown(conservative(), seed)
    first = energy(plant)
    kinetic = 0.5 * 1.3 * JM * sum(w * w for w in plant.motor_velocity)
    for _ in range(400):
        plant.step(0.001)
        assert energy(plant) == pytest.approx(first, abs=4e-3 * kinetic)


@pytest.mark.parametrize("seed", range(3))
def test_with_friction_the_energy_only_falls(seed):
    """Even where effects take friction away."""
    less = {
        "coulomb_friction": {"coulomb_nm": 0.0},
        "friction_asymmetry": {"asymmetry_nm": 2.0},
        "viscous_friction": {"viscous_nms_per_rad": 0.0},
        "load_dependent_friction": {"load_coefficient": 0.1},
        "hysteresis": {"torque_nm": 0.0, "travel_rad": 1e-4},
    }
    plant = thrown(conservative(JOINT.damping_nms_per_rad, **less), seed)
    first = before = energy(plant)
    for _ in range(300):
        plant.step(0.001)
        now = energy(plant)
        assert now <= before + 2e-3 * abs(first)
        before = now
    assert before < first - 0.2


def test_a_joint_in_a_warm_room_is_the_same_by_effect_and_by_thermal_behaviour():
    """exp(-b (T - T0)) of the viscous and the Coulomb share: `thermal` of a plant file, or the effect, at 40 °C."""
    rates = {"viscous_per_k": 0.03, "coulomb_per_k": 0.01, "reference_c": 25.0}
    thermal = Thermal(ambient_c=40.0, kelvin_per_w=5.0, time_constant_s=10.0, **rates)
    warm = with_effects(JOINT, {"temperature_dependent_friction": rates})
    only = replace(thermal, viscous_per_k=0.0, coulomb_per_k=0.0)
    one = Plant(PlantParameters((JointPlant(JOINT, thermal=thermal), JointPlant(JOINT))))
    two = EffectPlant(PlantParameters((JointPlant(warm, thermal=only), JointPlant(JOINT))))
    for plant in (one, two):
        plant.begin_day(Day())
    for k in range(1500):
        for plant in (one, two):
            drive(plant, 1.0 + 0.001 * k)
            plant.step(0.001)
    assert two.motor_position == pytest.approx(one.motor_position, rel=1e-6)
    assert two.drives[0].current_a == pytest.approx(one.drives[0].current_a, abs=1e-4)
    assert two.temperatures[0].celsius > 40.5


def test_friction_stops_at_nothing_and_never_pushes():
    """Coulomb and viscous friction taken away, 2 Nm more forward and less backward: 2 |s| forward, 0 backward."""
    away = {"coulomb_friction": {"coulomb_nm": 0.0}, "viscous_friction": {"viscous_nms_per_rad": 0.0}}
    joint = replace(JOINT, efficiency=None, friction=replace(JOINT.friction, stribeck_nm=0.0))
    joint = with_effects(joint, away | {"friction_asymmetry": {"asymmetry_nm": 2.0}})
    effects = JointEffects(joint)
    law = EffectFriction(joint_friction(JointPlant(joint)), effects)
    assert [law(5.0, v) for v in (0.0, 1.0, 2.5)] == pytest.approx([2.0, 2.0, 2.0])
    assert [law(5.0, v) for v in (-0.1, -1.0, -2.5)] == [0.0, 0.0, 0.0]


def test_a_loaded_joint_sticks_at_exactly_zero():
    """Pushed slowly joint 2 gives G Kt i - Fc, less mu |tau| with the effect, and stands when the push stops."""

    def pushed(effects):
        joint = with_effects(replace(JOINT, efficiency=None), effects)
        parameters = PlantParameters((JointPlant(JOINT), JointPlant(joint)))
        plant = EffectPlant(parameters) if effects else Plant(parameters)
        plant.command(0, VELOCITY, 0.0)
        for k in range(150):
            plant.command(1, CURRENT, 0.02 * k)
            plant.step(0.01)
        plant.step(0.2)
        assert plant.motor_velocity[1] == 0.0
        return plant.joint_torques()[1]

    coefficient = 0.3
    plain, more = pushed({}), pushed({"load_dependent_friction": {"load_coefficient": coefficient}})
    assert more * (1.0 + coefficient) == pytest.approx(plain, rel=0.02)


@pytest.mark.parametrize(
    ("effect", "same"),
    [
        ({"hysteresis": {"torque_nm": 10.0, "travel_rad": 1e-5}}, {"stiffness_nm_per_rad": K + 1e6}),
        ({"link_inertia": {"link_inertia_kgm2": 0.1 * JL}}, {"link_inertia_kgm2": 0.1 * JL}),
    ],
)
def test_step_is_shortened_for_what_is_stiff_or_light(effect, same):
    plant, other = (
        EffectPlant(plant_of_joint(with_effects(JOINT, effect))),
        Plant(plant_of_joint(replace(JOINT, **same))),
    )
    assert plant.substep_s == pytest.approx(other.substep_s, rel=0.02)
    assert plant.substep_s < 1e-4


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        (
            {"kinematic_error": {"amplitude_rad": 4.9e-3, "order_per_motor_rev": 2.0}},
            "joint joint1: effects: the kinematic error changes the gear's transmission by 0.98 of itself, "
            "expected at most 0.5",
        ),
        (
            {"nonlinear_stiffness": {"cubic_nm_per_rad3": -2e9}},
            "joint joint1: effects: the torque falls with torsion from 0.0014 rad on, "
            "expected it to rise up to rated_torque_nm (40 Nm)",
        ),
    ],
)
def test_a_joint_that_could_not_be_is_refused(effects, message):
    with pytest.raises(ConfigError) as caught:
        PlantSource(plant_of_joint(with_effects(JOINT, effects)))
    assert str(caught.value) == message


def test_the_plain_plant_refuses_what_it_has_no_equations_for():
    with pytest.raises(ValueError, match="found joints with effects"):
        Plant(plant_of_joint(with_effects(JOINT, {"torque_ripple": {"amplitude_nm": 0.2}})))


# What instruments read


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


def test_drift_begins_again_when_the_drives_are_enabled():
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
