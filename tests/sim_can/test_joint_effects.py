"""Every effect of the library in the emulated plant leaves in both balances of estimator/effects/effect.py what its law
gives on the true signals; and files with it load."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import yaml

from jtqd.estimator.effects import EFFECTS, checked_parameters
from jtqd.estimator.effects.effect import State
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
from tests.estimator.effects.laws import ALL, IDS, LAWS

JOINT = replace(load_joint(shipped("joint1.yaml")), efficiency=None)  # Table I loses nothing in places
G, KT, K, D = JOINT.gear_ratio, JOINT.torque_constant_nm_per_a, JOINT.stiffness_nm_per_rad, 8.0


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


def left_by(row, rows, number, h):
    """What the law leaves in both balances, on the true signals (readings where effect.py says "as measured")."""
    effect = EFFECTS[row.name]
    angle, speed, link, link_speed, tau, _, truth, *_ = rows[:, :-1]
    state = State(
        current_a=rows[7, 1:],
        current_rate_a_s=np.gradient(rows[7], h)[1:],
        velocity_rad_s=speed / G,
        direction=np.sign(speed),
        motor_position_rad=angle,
        motor_acceleration_rad_s2=np.diff(rows[1]) / h,
        link_position_rad=link,
        link_velocity_rad_s=link_speed,
        link_acceleration_rad_s2=np.diff(rows[3]) / h,
        coupling_position_rad=link if number == 1 else -link,
        torque_nm=rows[11, :-1] if effect.at_sensor else tau,
        torque_rate_nm_s=np.gradient(truth, h),
        torsion_rad=angle / G - link,
        torsion_rate_rad_s=speed / G - link_speed,
        temperature_c=np.full_like(tau, 22.0),
        time_s=rows[12, :-1],
    )
    motor, torsion = row.law(checked_parameters(row.name, row.parameters), state, JOINT)
    if effect.geometric:  # the spring's damping sees the twist's rate too
        torsion = torsion + D / K * np.gradient(torsion, h)
    return np.broadcast_to(motor, tau.shape), np.broadcast_to(torsion, tau.shape)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


AT_ONCE = [row for row in LAWS if row.name != "channel_delay"]


@pytest.mark.parametrize(
    ("row", "number"),
    [
        pytest.param(
            row, number, id=f"{row.name}-{number}", marks=[pytest.mark.campaign] * ((k + number) % 2)
        )
        for k, row in enumerate(AT_ONCE)
        for number in (1, 2)
    ],
)
def test_laws_explain_both_balances(row, number):
    h, rows = record(bench_with(row.name, row.parameters, number), number)
    moving = np.abs(rows[1, :-1]) / G > 0.05
    laws = left_by(row, rows, number, h)
    for balance, explained in zip(both_balances(rows, h), laws, strict=True):
        size, rest = rms(explained[moving]), rms((balance - explained)[moving])
        assert size > 0.02 or not np.any(explained)
        assert rest < 0.02 * size + 0.004, (size, rest)
    assert max(rms(each) for each in laws) > 0.02


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


@pytest.mark.parametrize("row", LAWS, ids=IDS)
def test_a_joint_file_with_it_is_a_plant(tmp_path, row):
    path = tmp_path / "extended.joint.yaml"
    mapping = JOINT.to_mapping() | {"effects": [{"name": row.name, "parameters": row.parameters}]}
    path.write_text(yaml.safe_dump(mapping))
    source = PlantSource(load_plant(path))
    source.advance(0.0)
    source.command(0, VELOCITY, 0.5 * G)
    source.command(1, CURRENT, 2.0)
    assert all(source.advance(0.001) for _ in range(50))
    assert source.plant.motor_velocity[0] > 0.3 * G


def test_jtq_sim_takes_a_file_with_every_effect(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench, "measure", partial(bench.measure, cycles=50))
    path = tmp_path / "extended.joint.yaml"
    effects = [{"name": name, "parameters": parameters} for name, parameters in ALL.items()]
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
