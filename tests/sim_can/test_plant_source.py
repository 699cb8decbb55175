"""Measurement, built-in motion and emulated runs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import shipped
from jtqd.sim_can.bench import measure
from jtqd.sim_can.drives import PERIOD_S, demo_current, demo_velocity
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import CURRENT, VELOCITY

PLANT = load_plant(shipped("plant.yaml"))
G = PLANT.joints[0].joint.gear_ratio


def snapshot(source):
    drives = [
        (d.motor_position_rad, d.motor_velocity_rad_s, d.link_position_rad, d.current_a)
        for d in source.drives
    ]
    return [*drives, source.channels[0].torque_nm]


def run(source, steps=300):
    seen = []
    source.advance(0.0)
    for k in range(steps):
        seen.append(snapshot(source))
        source.command(0, VELOCITY, 60.0 * math.sin(0.02 * k))
        source.command(1, CURRENT, 2.0)
        source.advance(0.001)
    return seen


def test_same_seed_same_run_bit_by_bit():
    assert run(PlantSource(PLANT, 7)) == run(PlantSource(PLANT, 7))
    assert run(PlantSource(PLANT, 7)) != run(PlantSource(PLANT, 8))


def test_noise_and_rounding_are_those_of_the_plant_file():
    source = PlantSource(PLANT, 3)
    rows = []
    for _ in range(4000):
        source.advance(0.001)
        one = source.drives[0]
        torque = source.channels[0].torque_nm
        rows.append((one.current_a, one.link_position_rad, torque, one.motor_position_rad))
    current, link, torque, motor = np.array(rows).T
    assert np.std(current) == pytest.approx(0.010, rel=0.05)
    assert np.std(link) == pytest.approx(6e-6, rel=0.05)
    assert np.std(torque) == pytest.approx(0.020, rel=0.05)
    assert abs(np.mean(current)) < 0.001
    assert not motor.any()  # at rest the encoder does not move


def test_sensor_and_current_deviations_are_applied():
    one, two = PLANT.joints
    measurement = replace(one.measurement, current_offset_a=0.5, current_noise_a=0.0)
    sensor = replace(PLANT.sensor, noise_nm=0.0, offset_nm=3.0, gain=1.5)
    source = PlantSource(replace(PLANT, joints=(replace(one, measurement=measurement), two), sensor=sensor))
    source.advance(0.001)
    assert source.drives[0].current_a == 0.5
    assert source.channels[0].torque_nm == pytest.approx(3.0, abs=1e-9)
    source.command(0, VELOCITY, 0.0)
    source.command(1, CURRENT, 4.0)
    source.advance(1.0)
    assert source.channels[0].torque_nm == pytest.approx(3.0 + 1.5 * source.plant.sensor_torque())


def test_motor_velocity_is_the_filtered_difference_of_counts():
    """Constant speed: mean exact, ripple of at most one count per sample; ramp: lag half a sample + filter
    time.
    """
    source = PlantSource(PLANT)
    plant = source.plant
    count = 2 * math.pi / 65536
    for k in range(1000):
        plant.motor_position[0] = 12.34 * 0.001 * k
        source._instruments.read(plant, 0.001, 0.0)
        if k > 20:
            assert abs(source.drives[0].motor_velocity_rad_s - 12.34) <= count / 0.001
    for k in range(1000):
        t = 0.001 * k
        plant.motor_position[0] = 500.0 * t * t
        source._instruments.read(plant, 0.001, 0.0)
    late = (1000.0 * t - source.drives[0].motor_velocity_rad_s) / 1000.0
    # backward difference 0.5 ms; discrete low pass of 1 ms: h e/(1-e), e = exp(-h/tau)
    assert late == pytest.approx(0.0005 + 0.001 * math.exp(-1) / (1 - math.exp(-1)), abs=0.0002)


def test_demo_starts_from_rest_stays_in_travel_rests_and_fills_four_quadrants():
    assert demo_velocity(0.0) == demo_current(0.0) == 0.0
    assert abs(demo_velocity(1.01)) < 1e-3
    assert abs(demo_current(0.01)) < 1e-3
    t = np.arange(0, PERIOD_S, 0.001)
    v = np.array([demo_velocity(x) for x in t])
    i = np.array([demo_current(x) for x in np.arange(0, 60, 0.001)])
    position = np.cumsum(v) * 0.001
    assert abs(position[-1]) < 1e-3  # comes back
    assert np.max(np.abs(position)) < 2.1
    assert 1.7 < np.max(np.abs(v)) < 2.2
    assert np.max(np.abs(np.diff(v))) / 0.001 < 15.0  # no jump anywhere
    assert 3.0 < np.max(np.abs(i)) < 4.0
    resting = np.flatnonzero(np.diff(np.concatenate([[0], (v == 0).astype(int), [0]])))
    assert max(resting[1::2] - resting[::2]) >= 1000


def demo_run(seconds=20.0, seed=1):
    commands = (JointCommand.velocity(demo_velocity), JointCommand.current(demo_current))
    return emulate_run(PLANT, commands, seconds, seed)


@pytest.fixture(scope="module")
def demo():
    return demo_run()


def test_velocity_loop_follows_the_demo_motion(demo):
    one = demo.joints[1]
    wanted = np.array([demo_velocity(t) for t in demo.time_s])
    error = np.abs(one.motor_velocity_rad_s / G - wanted)
    # 2.5 ms of interpolation and measurement at up to 15 rad/s² are 0.04 rad/s: compare with the delayed
    # target
    delayed = np.abs(one.motor_velocity_rad_s[3:] / G - wanted[:-3])
    assert np.quantile(error, 0.5) < 0.01
    assert np.quantile(delayed, 0.99) < 0.015
    assert np.max(delayed) < 0.025


def test_demo_run_visits_all_quadrants_of_both_joints(demo):
    for joint in demo.joints.values():
        moving = np.abs(joint.motor_velocity_rad_s) > 0.2 * G
        loaded = np.abs(joint.current_a) > 0.5
        signs = [np.sign(each) for each in (joint.current_a, joint.motor_velocity_rad_s)]
        for si, sw in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            assert np.mean(moving & loaded & (signs[0] == si) & (signs[1] == sw)) > 0.005, (si, sw)


def test_emulated_run_holds_what_the_pdos_would_say(demo):
    one, two = demo.joints[1], demo.joints[2]
    assert len(demo.time_s) == 20_000
    assert demo.time_s[0] == 0.0
    assert demo.time_s[-1] == pytest.approx(19.999)
    for values, unit in (
        (one.current_a, 0.008),
        (one.motor_position_rad, 2 * math.pi / 65536),
        (one.motor_velocity_rad_s, 2 * math.pi / 65536),
        (two.link_position_rad, 2 * math.pi / 524288),
        (two.torque_nm, 0.001),
    ):
        counts = values / unit
        assert np.max(np.abs(counts - np.round(counts))) < 1e-4
    assert np.array_equal(one.torque_nm, two.torque_nm)
    # joints face each other: equal and opposite link angles but for noise (2 x 6 urad rms) and counts of 12
    # urad
    assert np.max(np.abs(one.link_position_rad + two.link_position_rad)) < 1e-4
    assert one.link_velocity_rad_s is None


def test_emulated_run_is_reproducible():
    a, b, c = demo_run(1.5), demo_run(1.5), demo_run(1.5, seed=2)
    assert np.array_equal(a.joints[1].current_a, b.joints[1].current_a)
    assert not np.array_equal(a.joints[1].current_a, c.joints[1].current_a)


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf")])
def test_emulated_run_refuses_a_senseless_duration(duration):
    with pytest.raises(ValueError, match="a run of"):
        emulate_run(PLANT, (JointCommand.off(), JointCommand.off()), duration)


def test_cost_is_measured():
    cost = measure(PLANT, cycles=200)
    assert 0 < cost.plant_step_us < cost.sync_us < 2000
    assert cost.substeps == 8
