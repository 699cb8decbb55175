"""Gear and coupling: spring, slips, energy, convergence, instruments, days."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.errors import ConfigError
from jtqd.models.files import load_joint, load_yaml
from jtqd.sim_can.emulated_run import JointCommand, emulate, emulate_run
from jtqd.sim_can.source import CURRENT, VELOCITY, Day
from jtqd.sim_can.towing.bench_file import DayWidths, bench_from_mapping
from jtqd.sim_can.towing.plant import UPDATE_S, Gear, Warmth
from tests.sim_can.towing.benches import BAD_DAY, FOLDER, PLAIN, TYPICAL, plant_of


def commands(amplitude_rad_s: float = 1.0, current_a: float = 3.0) -> tuple[JointCommand, JointCommand]:
    return (
        JointCommand.velocity(lambda t: amplitude_rad_s * math.sin(2.0 * math.pi * 0.5 * t)),
        JointCommand.current(lambda t: current_a * math.sin(2.0 * math.pi * 0.13 * t)),
    )


# Gear -----------------------------------------------------------------------------------------------------------------


def test_spring_hardens_in_three_parts_through_both_corners() -> None:
    law = TYPICAL.joints[0].gear
    gear = Gear(law, 100.0)
    first = law.corners_nm[0] / law.stiffness_nm_per_rad[0]
    second = first + (law.corners_nm[1] - law.corners_nm[0]) / law.stiffness_nm_per_rad[1]
    assert gear.spring(first) == pytest.approx(law.corners_nm[0])
    assert gear.spring(second) == pytest.approx(law.corners_nm[1])
    assert gear.spring(second + 1e-3) - gear.spring(second) == pytest.approx(16.8)
    assert gear.spring(-second) == -gear.spring(second)


def test_slips_lose_energy_by_their_travel_in_a_slow_cycle() -> None:
    """A closed cycle of torsion amplitude a costs 4 H (a - travel) for each slip with travel < a."""
    law = replace(TYPICAL.joints[0].gear, errors=())
    plant = plant_of(
        replace(
            PLAIN,
            joints=tuple(replace(side, gear=replace(law, damping_nms_per_rad=0.0)) for side in PLAIN.joints),
        )
    )
    gear = plant.one.gear
    a = 6e-4
    torsion = a * np.sin(np.linspace(0.0, 4.0 * np.pi, 40001))
    torque = np.empty_like(torsion)
    for k, value in enumerate(torsion):
        # the link goes while the motor stays: δ = -φ
        torque[k] = _torque_at(plant, -float(value))
    half = len(torsion) // 2
    work = (
        np.trapezoid(torque[half:], torsion[half:])
        if hasattr(np, "trapezoid")
        else np.trapz(torque[half:], torsion[half:])
    )
    expected = sum(4.0 * slip.torque_nm * (a - slip.travel_rad) for slip in law.slips if slip.travel_rad < a)
    assert gear.torsion == pytest.approx(torsion[-1])
    assert work == pytest.approx(expected, rel=2e-3)


def _torque_at(plant, link_rad: float) -> float:
    plant.one.gear.turn(0.0, link_rad)
    return plant.joint_torques()[0]


# Both joints ----------------------------------------------------------------------------------------------------------


def energy(plant) -> float:
    """Kinetic energy and that of spring and bristles, J (plain bench: no slips, no waves)."""
    total = 0.5 * sum(side.link_inertia_kgm2 for side in plant.parameters.joints) * plant.link_velocity**2
    for joint, side in zip(plant.joints, plant.parameters.joints, strict=True):
        total += 0.5 * side.motor.rotor_inertia_kgm2 * joint.velocity**2
        grid = np.linspace(0.0, joint.gear.torsion, 2001)
        torque = np.array([joint.gear.spring(float(x)) for x in grid])
        total += float(np.sum(0.5 * (torque[1:] + torque[:-1]) * np.diff(grid)))
        total += 0.5 * side.friction.coulomb_nm / side.friction.bristle_rad * joint.friction.deflection**2
    return total


def test_without_current_energy_falls_and_the_bench_comes_to_rest() -> None:
    plant = plant_of(PLAIN)
    plant.one.velocity, plant.link_velocity = 150.0, -0.5
    last = energy(plant)
    start = last
    for _ in range(400):
        plant.step(0.001)
        now = energy(plant)
        assert now <= last + 1e-3 * start
        last = now
    assert last < 0.02 * start
    assert abs(plant.one.velocity) < 1.0


def test_both_joints_see_one_torque_in_steady_motion() -> None:
    plant = plant_of(PLAIN)
    plant.command(0, VELOCITY, 60.0)
    plant.command(1, CURRENT, -2.5)
    plant.step(1.5)
    one, two = plant.joint_torques()
    assert one == pytest.approx(two, abs=0.02)
    assert plant.sensor_torque() == pytest.approx(one, abs=0.02)


def test_steps_of_125_us_are_within_a_twentieth_of_a_newton_metre_of_the_limit() -> None:
    coarse, fine = (
        emulate_run(replace(TYPICAL, substep_s=step), commands(2.0, 4.0), 2.0, seed=3)
        for step in (125e-6, 10e-6)
    )
    difference = coarse.joints[1].torque_nm - fine.joints[1].torque_nm
    assert np.sqrt(np.mean(difference**2)) < 0.05


def test_typical_efficiency_at_rated_torque_is_the_catalogues() -> None:
    plant = plant_of(PLAIN)
    plant.command(0, VELOCITY, 100.0)
    plant.command(1, CURRENT, 5.1)
    plant.step(1.5)
    torque = plant.joint_torques()[0]
    motor = 100.0 * PLAIN.joints[0].motor.torque_constant_nm_per_a * plant.drives[0].current_a
    assert 35.0 < torque < 45.0
    assert 0.7 < torque / motor < 0.82


# Instruments and days -------------------------------------------------------------------------------------------------


def test_errors_of_both_encoders_are_over_their_own_turns() -> None:
    """With everything else taken away, the difference to a bench without errors is the file's waves."""
    law = TYPICAL.joints[0].measurement
    one, two = PLAIN.joints
    with_errors = replace(
        one,
        measurement=replace(one.measurement, link_errors=law.link_errors, motor_errors=law.motor_errors),
    )
    bench = replace(PLAIN, joints=(with_errors, two))
    clean, wrong = (emulate_run(each, commands(2.0, 1.0), 2.0, seed=3) for each in (PLAIN, bench))
    for key, errors, resolution in (
        ("link_position_rad", law.link_errors, 2.0 * math.pi / 524288),
        ("motor_position_rad", law.motor_errors, 2.0 * math.pi / 65536),
    ):
        truth = getattr(clean.joints[1], key)
        read = getattr(wrong.joints[1], key)
        expected = sum(e.amplitude_rad * np.cos(e.order * truth + e.phase_rad) for e in errors)
        assert np.max(np.abs(expected)) > 2.0 * resolution
        assert np.max(np.abs(read - truth - expected)) < 1.6 * resolution


def test_a_day_sets_zeros_and_gains_of_the_instruments() -> None:
    widths = DayWidths(link_zero_rad=1e-3, current_gain=0.2, sensor_zero_nm=2.0)
    bench = replace(PLAIN, run_to_run=widths)
    usual = emulate_run(bench, commands(), 1.0, seed=5)
    other = emulate_run(bench, commands(), 1.0, seed=5, day=3)
    day = widths.day(5, 3)
    one, read = usual.joints[1], other.joints[1]
    assert np.mean(read.torque_nm - one.torque_nm) == pytest.approx(day.sensor_zero_nm, abs=1e-3)
    assert np.mean(read.link_position_rad - one.link_position_rad) == pytest.approx(
        day.link_zero_rad[0], abs=2e-6
    )
    gain = float(np.dot(read.current_a, one.current_a) / np.dot(one.current_a, one.current_a))
    assert gain == pytest.approx(1.0 + day.current_gain[0], abs=1e-3)


def test_days_are_drawn_within_their_widths_and_repeat() -> None:
    widths = BAD_DAY.run_to_run
    days = [widths.day(7, n) for n in range(200)]
    assert days[3] == widths.day(7, 3)
    assert days[3] != widths.day(8, 3)
    for name in set(Day._fields) - {"sensor_zero_nm"}:
        drawn = np.array([getattr(day, name) for day in days])
        width = getattr(widths, name)
        assert np.max(np.abs(drawn)) <= width
        assert np.max(np.abs(drawn)) > 0.95 * width
        assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.25
    assert DayWidths().day(7, 3) == Day()


def test_grease_is_warmed_first_and_viscosity_falls_by_vogels_law() -> None:
    law = replace(
        TYPICAL.joints[0].warmth, grease_kelvin_per_w=0.5, housing_kelvin_per_w=1.0, viscous_per_k=0.02
    )
    warmth = Warmth(law)
    for _ in range(round(60.0 / UPDATE_S)):
        warmth.add(20.0, UPDATE_S)
    assert warmth.grease_c > warmth.housing_c + 2.0 > law.ambient_c + 2.0
    for _ in range(round(20000.0 / UPDATE_S)):
        warmth.add(20.0, UPDATE_S)
    assert warmth.housing_c == pytest.approx(25.0 + 20.0, abs=0.1)
    assert warmth.grease_c == pytest.approx(25.0 + 20.0 + 10.0, abs=0.1)
    warmth.start(1.0)
    assert warmth.viscous == pytest.approx(1.0 - 0.02, abs=5e-4)
    warmth.start(-20.0)
    colder = warmth.viscous
    warmth.start(20.0)
    assert colder * warmth.viscous > 1.03  # steeper in the cold than an exponential


# Files ----------------------------------------------------------------------------------------------------------------


def loaded(change) -> None:
    mapping = load_yaml(FOLDER / "typical.yaml")
    change(mapping)
    bench_from_mapping(mapping, "b.yaml", lambda name: load_joint(FOLDER / name))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m.update(towing=3), "b.yaml: key 'towing': found 3, expected 2, the number of joints"),
        (lambda m: m["joint_1"]["gear"].update(stifness=1), "key 'joint_1.gear.stifness'"),
        (
            lambda m: m["joint_2"]["gear"].update(corners_nm=[25.0, 7.0]),
            "key 'joint_2.gear.corners_nm': found [25.0, 7.0], expected rising numbers in Nm > 0",
        ),
        (
            lambda m: m["joint_1"]["gear"].update(errors=[{"order": 100.0, "amplitude_rad": 1e-3}]),
            "key 'joint_1.gear.errors': found 0.1, expected the sum of amplitude_rad times order <= 0.005",
        ),
        (
            lambda m: m["joint_1"]["motor"].update(cogging=[{"order": 1.0, "amplitude_nm": 0.0}] * 9),
            "key 'joint_1.motor.cogging': found 9 entries, expected at most 8",
        ),
        (lambda m: m["joint_1"]["friction"].pop("load_nm"), "key 'joint_1.friction.load_nm': missing"),
        (
            lambda m: m["joint_1"]["friction"].update(static_ratio=0.5),
            "key 'joint_1.friction.static_ratio': found 0.5, expected a number",
        ),
    ],
)
def test_what_is_wrong_with_a_bench_file_is_named(change, expected: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(expected)):
        loaded(change)


def test_the_true_torques_stand_beside_what_was_measured() -> None:
    run = emulate(
        replace(PLAIN, sensor=replace(PLAIN.sensor, gain=2.0, offset_nm=1.0)),
        commands(),
        1.0,
        seed=5,
    )
    inertia = [side.link_inertia_kgm2 for side in PLAIN.joints]
    one, two = run.joint_torque_nm.T
    # the sensor is between the links: the mean of both torques, weighted by the other one's inertia
    sensor = (inertia[1] * one + inertia[0] * two) / sum(inertia)
    assert np.ptp(sensor) > 10.0
    assert np.max(np.abs(run.table.joints[1].torque_nm - 2.0 * sensor - 1.0)) < 1e-3
