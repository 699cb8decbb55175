"""Every effect of the library in the emulated plant: its hooks, asked on the true signals, say what both balances of
estimator/effects/effect.py leave over; and files with it load."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml

from jtqd.estimator.effects import EFFECTS, checked_parameters
from jtqd.estimator.effects.effect import ArrayFunctions, State
from jtqd.estimator.joint import Effect
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can import bench
from jtqd.sim_can.command import main
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import (
    DriveParameters,
    JointPlant,
    MeasurementParameters,
    PlantParameters,
    Thermal,
    load_plant,
)
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import CURRENT, VELOCITY

JOINT = replace(load_joint(shipped("joint1.yaml")), efficiency=None)  # Table I loses nothing in places
G, KT, K, D = JOINT.gear_ratio, JOINT.torque_constant_nm_per_a, JOINT.stiffness_nm_per_rad, 8.0

# name -> parameters, and which balances it must show in: m motor, t torsion
CASES = [
    ("coulomb_friction", {"coulomb_nm": 4.5}, "m"),
    ("viscous_friction", {"viscous_nms_per_rad": 3.5}, "m"),
    ("stribeck_friction", {"stribeck_nm": 3.0, "stribeck_velocity_rad_s": 0.15}, "m"),
    ("load_dependent_friction", {"load_coefficient": 0.1}, "m"),
    ("friction_asymmetry", {"asymmetry_nm": 0.8}, "m"),
    (
        "temperature_dependent_friction",
        {"viscous_per_k": 0.03, "coulomb_per_k": 0.01, "reference_c": 10.0},
        "m",
    ),
    ("torque_ripple", {"amplitude_nm": 0.6, "order_per_motor_rev": 2.0, "phase_rad": 0.4}, "m"),
    ("kinematic_error", {"amplitude_rad": 1e-4, "order_per_motor_rev": 2.0, "phase_rad": 0.9}, "mt"),
    ("nonlinear_stiffness", {"stiffness_nm_per_rad": 1.1 * K, "cubic_nm_per_rad3": 3e8}, "t"),
    ("hysteresis", {"torque_nm": 2.0, "travel_rad": 1.5e-4}, "t"),
    ("lost_motion", {"width_rad": 2e-4}, "t"),
    ("torque_constant", {"torque_constant_nm_per_a": 1.05 * KT}, "m"),
    ("torque_constant_saturation", {"saturation_per_a": 0.02}, "m"),
    ("torque_constant_temperature", {"per_k": -0.002, "reference_c": 10.0}, "m"),
    ("cogging", {"amplitude_nm": 0.5, "order_per_motor_rev": 12.0, "phase_rad": 1.0}, "m"),
    ("current_offset", {"offset_a": 0.08}, "m"),
    ("rotor_inertia", {"rotor_inertia_kgm2": 1.2 * JOINT.rotor_inertia_kgm2}, "m"),
    ("sensor_offset", {"offset_nm": 0.7}, "mt"),
    ("sensor_gain", {"gain": 1.08}, "mt"),
    ("sensor_drift", {"rate_nm_per_s": 0.5, "per_k_nm": 0.05, "reference_c": 10.0}, "mt"),
    ("sensor_crosstalk", {"amplitude_nm": 0.4, "share": 0.05, "phase_rad": 0.6}, "mt"),
    ("encoder_eccentricity", {"amplitude_rad": 1e-4, "phase_rad": 0.7}, "t"),
    ("encoder_eccentricity", {"amplitude_rad": 5e-3, "phase_rad": 0.7, "motor_side": 1.0}, "t"),
    ("link_inertia", {"link_inertia_kgm2": 2.5 * JOINT.link_inertia_kgm2}, "mt"),
    ("gear_damping", {"damping_nms_per_rad": 3.0 * D}, "t"),
    ("unbalance", {"moment_nm": 1.5, "phase_rad": 0.5}, "mt"),
    ("channel_delay", {"delay_s": 0.002, "channel": 0.0}, "mt"),
    ("channel_delay", {"delay_s": 0.002, "channel": 1.0}, "m"),
    ("channel_delay", {"delay_s": 0.002, "channel": 2.0}, "t"),
]


def test_cases_are_the_whole_library():
    assert {name for name, _, _ in CASES} == set(EFFECTS)


def bench_with(name, parameters, joint):
    """Noise-free bench of which one joint has the effect; encoders so fine that they do not round."""
    fine = MeasurementParameters(1 << 24, 1 << 26, velocity_filter_s=0.0)
    sides = [
        JointPlant(
            replace(JOINT, effects=(Effect(name, parameters),) if number == joint else ()),
            measurement=fine,
            drive=DriveParameters(velocity_bandwidth_rad_s=100.0),
            thermal=Thermal(ambient_c=22.0),
        )
        for number in (1, 2)
    ]
    return PlantParameters(tuple(sides))


def targets(t):
    """Velocity [rad/s, joint side] and current [A] over time: all signs of both within 1.5 s."""
    velocity = 1.2 * np.sin(2 * np.pi * t / 1.1) + 0.3 * np.sin(2 * np.pi * t / 0.31)
    return velocity, 3.0 * np.sin(2 * np.pi * t / 0.71 + 0.4) + 0.6


def record(parameters, joint, seconds=0.6):
    """Step [s], and true state and readings of one joint at each step, with the plant's friction of its file."""
    source = PlantSource(parameters)
    plant = source.plant
    h = plant.substep_s
    sign, k = (1.0, 0) if joint == 1 else (-1.0, 1)
    source.advance(0.0)
    rows = []
    for n in range(round(seconds / h)):
        velocity, current = targets(n * h)
        source.command(0, VELOCITY, G * float(velocity))
        source.command(1, CURRENT, float(current))
        truth = plant.sensor_torque()
        tau = plant.effects[k].state.torque_nm
        v = plant.motor_velocity[k] / G
        before = (
            plant.motor_position[k],
            plant.motor_velocity[k],
            sign * plant.link_position,
            sign * plant.link_velocity,
            tau,
            plant.friction[k](tau, v) * np.sign(v),
            truth,
            plant.drives[k].current_a,
        )
        drive = source.drives[k]
        read = (
            drive.motor_position_rad,
            drive.link_position_rad,
            drive.current_a,
            source.channels[0].torque_nm,
        )
        rows.append((*before, *read, n * h))
        source.advance(h)
    return h, np.array(rows).T


def both_balances(rows, h):
    """What both balances leave over from what is measured, at the steps k that end at k + 1."""
    _, speed, _, link_speed, _, loss, _, _, motor_read, link_read, current_read, sensor_read, _ = rows
    alpha, alpha_l = np.diff(speed) / h, np.diff(link_speed) / h
    sensor, current = sensor_read[:-1], current_read[1:]
    motor = G * (KT * current - JOINT.rotor_inertia_kgm2 * alpha) - loss[:-1] - sensor
    torsion = K * (motor_read / G - link_read)[:-1] + D * (speed / G - link_speed)[:-1] - sensor
    return motor - JOINT.link_inertia_kgm2 * alpha_l, torsion - JOINT.link_inertia_kgm2 * alpha_l


def hooks(name, parameters, rows, number, h):
    """Every hook of the effect, as arrays, on the true signals (readings where effect.py says "as measured")."""
    angle, speed, link, link_speed, tau, _, truth, *_ = rows[:, :-1]
    true_current = rows[7, 1:]
    state = State(
        current_a=true_current,
        current_rate_a_s=np.gradient(rows[7], h)[1:],
        velocity_rad_s=speed / G,
        direction=np.sign(speed),
        motor_position_rad=angle,
        motor_acceleration_rad_s2=np.diff(rows[1]) / h,
        link_position_rad=link,
        link_velocity_rad_s=link_speed,
        link_acceleration_rad_s2=np.diff(rows[3]) / h,
        coupling_position_rad=link if number == 1 else -link,
        torque_nm=tau,
        torque_rate_nm_s=np.gradient(truth, h),
        torsion_rad=angle / G - link,
        torsion_rate_rad_s=speed / G - link_speed,
        temperature_c=np.full_like(tau, 22.0),
        time_s=rows[12, :-1],
    )
    effect, values = EFFECTS[name], checked_parameters(name, parameters)
    out = {}
    for hook in effect.hooks:
        state.torque_nm = rows[11, :-1] if hook == "sensor_nm" else tau
        out[hook] = np.broadcast_to(getattr(effect, hook)(values, state, JOINT, ArrayFunctions()), tau.shape)
    return out


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize(
    ("name", "parameters", "shows"), [case for case in CASES if case[0] != "channel_delay"]
)
def test_hooks_explain_both_balances(name, parameters, shows, number):
    h, rows = record(bench_with(name, parameters, number), number)
    motor, torsion = both_balances(rows, h)
    told = hooks(name, parameters, rows, number, h)
    common = told.get("load_nm", 0.0) - told.get("sensor_nm", 0.0)
    twist = told.get("twist_rad", np.zeros_like(motor))
    told_motor = G * KT * told.get("current_a", 0.0) + told.get("loss_nm", 0.0) + common
    told_torsion = -K * (twist + told.get("link_rad", 0.0)) + common
    if name == "kinematic_error":  # the spring's damping sees the twist's rate too
        told_torsion = told_torsion - D * np.gradient(twist, h)
    told_motor, told_torsion = (np.broadcast_to(told, motor.shape) for told in (told_motor, told_torsion))
    moving = np.abs(rows[1, :-1]) / G > 0.05
    for balance, key, sum_ in ((motor, "m", told_motor), (torsion, "t", told_torsion)):
        size, rest = rms(sum_[moving]), rms((balance - sum_)[moving])
        assert size > 0.02 if key in shows else size == 0.0
        assert rest < 0.02 * size + 0.004, (key, size, rest)


def delayed(truth, reading, rate, h):
    """A reading that is truth(t - 2 ms) exactly; and what hook says of it, smoothed over 20 ms, to first order."""
    time = h * np.arange(len(truth))
    assert reading == pytest.approx(np.interp(time - 0.002, time, truth), abs=1e-9)
    mean = np.full(160, 1.0 / 160.0)
    late, told = (np.convolve(v, mean, "valid")[400:] for v in (reading - truth, -0.002 * rate))
    assert rms(late - told) < 0.05 * rms(told)


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_what_is_late_reads_the_past_and_nothing_else_is_touched(channel, number):
    late = bench_with("channel_delay", {"delay_s": 0.002, "channel": channel}, number)
    h, rows = record(late, number, 0.5)
    _, _, link, link_speed, _, _, torque, current, _, link_read, current_read, torque_read, _ = rows
    signals = [(torque, torque_read), (current, current_read), (link, link_read)]
    rates = [np.gradient(torque, h), np.gradient(current, h), link_speed]
    for k, (truth, reading) in enumerate(signals):
        if k == channel:
            delayed(truth, reading, rates[k], h)
        else:
            assert reading == pytest.approx(truth, abs=2e-7)  # the link encoder's count


@pytest.mark.parametrize(("name", "parameters", "shows"), CASES)
def test_a_joint_file_with_it_is_a_plant(tmp_path, name, parameters, shows):
    path = tmp_path / "extended.joint.yaml"
    mapping = JOINT.to_mapping() | {"effects": [{"name": name, "parameters": parameters}]}
    path.write_text(yaml.safe_dump(mapping))
    source = PlantSource(load_plant(path))
    source.advance(0.0)
    source.command(0, VELOCITY, 0.5 * G)
    source.command(1, CURRENT, 2.0)
    assert all(source.advance(0.001) for _ in range(50))
    assert source.plant.motor_velocity[0] > 0.3 * G


def test_jtq_sim_takes_a_file_with_every_effect(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "measure", partial(bench.measure, cycles=50))
    every = {name: parameters for name, parameters, _ in CASES}
    path = tmp_path / "extended.joint.yaml"
    effects = [{"name": name, "parameters": parameters} for name, parameters in every.items()]
    path.write_text(yaml.safe_dump(JOINT.to_mapping() | {"effects": effects}))
    assert main(["--cost", "--json", "--plant", str(path)]) == 0
    cost = json.loads(capsys.readouterr().out)
    assert cost["substeps"] >= 8
    effects[0]["parameters"] = {"coulomb": 3.0}
    path.write_text(yaml.safe_dump(JOINT.to_mapping() | {"effects": effects}))
    assert main(["--cost", "--plant", str(path)]) == 1
    message = capsys.readouterr().err
    assert "coulomb" in message
    assert message.count("\n") == 1


def test_a_plant_file_may_name_extended_joint_files(tmp_path):
    offset = [{"name": "sensor_offset", "parameters": {"offset_nm": 2.5}}]
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(JOINT.to_mapping()))
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(JOINT.to_mapping() | {"effects": offset}))
    path = tmp_path / "plant.yaml"
    path.write_text("joint_1: {joint: one.yaml}\njoint_2: {joint: two.yaml}\n")
    still = (JointCommand.off(), JointCommand.off())
    run = emulate_run(load_plant(path), still, 0.05)
    assert run.joints[1].torque_nm == pytest.approx(np.full(50, 2.5), abs=1e-3)
