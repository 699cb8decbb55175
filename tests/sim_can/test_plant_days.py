"""What changes from run to run: the sequence of days, the joints' temperature, and both in emulated runs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant import JointTemperature, Plant, joint_friction
from jtqd.sim_can.plant_file import Day, RunToRun, Thermal, load_plant
from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.source import CURRENT, OFF, VELOCITY

WIDTHS = RunToRun(viscous=0.15, sensor_zero_nm=0.3, temperature_k=4.0, link_zero_rad=1e-5)
CAMPAIGN = load_plant(shipped("campaign_plant.yaml"))
PLAIN = load_plant(shipped("joint1.yaml"))  # no noise, no deviation
JOINT = PLAIN.joints[0].joint
G, KT = JOINT.gear_ratio, JOINT.torque_constant_nm_per_a


def values(of_day):
    """The seven values of a day in units of their half widths."""
    pairs = zip(
        (of_day.viscous, of_day.temperature_k, of_day.link_zero_rad),
        (WIDTHS.viscous, WIDTHS.temperature_k, WIDTHS.link_zero_rad),
        strict=True,
    )
    flat = [value / width for pair, width in pairs for value in pair]
    return [*flat, of_day.sensor_zero_nm / WIDTHS.sensor_zero_nm]


@pytest.mark.parametrize("seed", range(8))
def test_days_are_spread_evenly_over_their_widths(seed):
    """Every 10 days in a row: values in each third, mean within 0.3; 60 days: uniform to 6 %."""
    table = np.array([values(WIDTHS.day(seed, n)) for n in range(60)])
    assert table.shape == (60, 7)
    assert np.max(np.abs(table)) <= 1.0
    for first in range(0, 51, 5):
        ten = table[first : first + 10]
        for third in (-1.0, -1 / 3, 1 / 3):
            assert np.all(np.any((ten >= third) & (ten <= third + 2 / 3), axis=0)), (seed, first)
        assert np.max(np.abs(np.mean(ten, axis=0))) < 0.3
    expected = (np.arange(60) + 0.5) / 30 - 1
    assert np.max(np.abs(np.sort(table, axis=0) - expected[:, None])) < 0.12
    assert np.max(np.abs(np.corrcoef(table.T) - np.eye(7))) < 0.4


@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_two_zeros_are_spread_evenly_together(joint, sign):
    """48 days show the 90 % of a sum of sensor's and link encoder's zero to 3 %; days drawn one by one to 4.3 %.

    With frac(sqrt(71)) and frac(sqrt(53)), of which 2 and -3 add up to 0.012, they did to 6 %.
    """
    whole = np.random.default_rng(0).uniform(-1.0, 1.0, (200_000, 2)) @ (1.0, 0.4)
    edge = np.quantile(np.abs(whole), 0.9)
    shares = []
    for seed in range(60):
        table = np.array([values(WIDTHS.day(seed, n)) for n in range(48)])
        shares.append(np.mean(np.abs(table[:, 6] + 0.4 * sign * table[:, 4 + joint]) <= edge))
    assert np.std(shares) < 0.036
    assert np.mean(shares) == pytest.approx(0.9, abs=0.01)


def test_days_belong_to_their_seed_and_number():
    assert WIDTHS.day(3, 5) == WIDTHS.day(3, 5)
    assert WIDTHS.day(3, 5) != WIDTHS.day(3, 6)
    assert WIDTHS.day(3, 5) != WIDTHS.day(4, 5)
    assert RunToRun().day(3, 5) == Day()
    only_zero = RunToRun(sensor_zero_nm=0.3).day(3, 5)
    assert only_zero == Day(sensor_zero_nm=WIDTHS.day(3, 5).sensor_zero_nm)


@pytest.mark.parametrize("step_s", [0.001, 0.05, 0.7])
def test_temperature_follows_its_closed_form(step_s):
    """Constant losses P: T = T_a + R P (1 - exp(-t/τ)); afterwards it falls back with the same τ."""
    joint = JointTemperature(Thermal(25.0, 0.03, 0.005, kelvin_per_w=0.6, time_constant_s=100.0))
    joint.start(-3.0)
    assert joint.celsius == 22.0
    for _ in range(round(70 / step_s)):
        joint.add(20.0, step_s)
    warm = 22.0 + 12.0 * (1 - math.exp(-0.7))
    assert joint.celsius == pytest.approx(warm, abs=0.02)
    assert joint.viscous == pytest.approx(math.exp(-0.03 * (joint.celsius - 25.0)))
    assert joint.coulomb == pytest.approx(math.exp(-0.005 * (joint.celsius - 25.0)))
    for _ in range(round(70 / step_s)):
        joint.add(0.0, step_s)
    assert joint.celsius == pytest.approx(22.0 + (warm - 22.0) * math.exp(-0.7), abs=0.02)


def test_joint_is_warmed_by_its_own_losses():
    """Joint 1 at 1.5 rad/s: warming over 8 s is that of P = (G Kt i - τ) v, per joint, with joint 2 idle."""
    thermal = Thermal(kelvin_per_w=2.0, time_constant_s=10.0)
    parameters = replace(PLAIN, joints=tuple(replace(side, thermal=thermal) for side in PLAIN.joints))
    plant = Plant(parameters)
    plant.command(0, VELOCITY, G * 1.5)
    plant.command(1, CURRENT, 1.0)
    expected = [25.0, 25.0]
    for _ in range(8000):
        plant.step(0.001)
        torques = plant.joint_torques()
        for k in (0, 1):
            v = plant.motor_velocity[k] / G
            power = (G * KT * plant.drives[k].current_a - torques[k]) * v
            expected[k] += 0.001 / 10.0 * (25.0 + 2.0 * power - expected[k])
    assert expected[0] > 30.0
    for k in (0, 1):
        assert plant.temperatures[k].celsius == pytest.approx(expected[k], abs=0.05 * (expected[k] - 25.0))


def extra_losses(parameters, of_day, speed=1.5, current=2.0):
    """Losses of both joints at constant speed, (G Kt i - τ) sign(v), less the file's at the same torque."""
    plant = Plant(parameters)
    plant.begin_day(of_day)
    plant.motor_velocity = [G * speed, -G * speed]
    plant.link_velocity = speed
    plant.command(0, VELOCITY, G * speed)
    plant.command(1, CURRENT, current)
    plant.step(1.5)
    extra = []
    for k, sign in ((0, 1.0), (1, -1.0)):
        torque = plant.joint_torques()[k]
        loss = sign * (G * KT * plant.drives[k].current_a - torque)
        extra.append(loss - joint_friction(PLAIN.joints[k])(torque, sign * speed))
    return extra


def test_warm_joint_loses_less_by_its_viscous_and_coulomb_share():
    thermal = Thermal(viscous_per_k=0.03, coulomb_per_k=0.01)
    parameters = replace(PLAIN, joints=tuple(replace(side, thermal=thermal) for side in PLAIN.joints))
    assert extra_losses(parameters, Day()) == pytest.approx([0.0, 0.0], abs=5e-3)
    found = extra_losses(parameters, Day(temperature_k=(10.0, -5.0)))
    friction = JOINT.friction
    for k, above in enumerate((10.0, -5.0)):
        share = friction.viscous_nms_per_rad * 1.5 * (math.exp(-0.03 * above) - 1)
        share += friction.coulomb_nm * (math.exp(-0.01 * above) - 1)
        assert found[k] == pytest.approx(share, abs=5e-3), k


def test_viscous_friction_of_a_day_is_its_share_of_the_file():
    found = extra_losses(PLAIN, Day(viscous=(-0.1, 0.15)))
    share = JOINT.friction.viscous_nms_per_rad * 1.5
    assert found == pytest.approx([-0.1 * share, 0.15 * share], abs=5e-3)


REST = (JointCommand.off(), JointCommand.off())
MOTION = (
    JointCommand.velocity(lambda t: 0.8 * math.sin(3 * t)),
    JointCommand.current(lambda t: 2.0 * math.sin(2 * t)),
)


def test_emulated_run_of_a_day_has_its_zeros_and_temperature():
    of_day = CAMPAIGN.run_to_run.day(7, 3)
    table = emulate_run(CAMPAIGN, REST, 2.0, 7, day=3)
    # 2000 rows of noise: 0.02 Nm / sqrt(2000), 6 urad / sqrt(2000) and the rounding to 12 urad
    assert np.mean(table.joints[1].torque_nm) == pytest.approx(of_day.sensor_zero_nm, abs=0.002)
    for k in (0, 1):
        joint = table.joints[k + 1]
        start = np.mean(emulate_run(CAMPAIGN, REST, 2.0, 7).joints[k + 1].link_position_rad)
        zero = np.mean(joint.link_position_rad) - start
        assert zero == pytest.approx(of_day.link_zero_rad[k], abs=1e-6)
        assert joint.temperature_c == pytest.approx(25.0 + of_day.temperature_k[k], abs=0.0501)
        assert np.max(np.abs(10 * joint.temperature_c - np.round(10 * joint.temperature_c))) < 1e-9


def columns(table):
    return np.array(
        [
            getattr(joint, name)
            for joint in table.joints.values()
            for name in ("current_a", "motor_position_rad", "link_position_rad", "torque_nm", "temperature_c")
        ]
    )


def test_emulated_runs_are_reproducible_and_each_day_has_its_own_noise():
    first, again = (columns(emulate_run(CAMPAIGN, MOTION, 0.6, 5, day=2)) for _ in range(2))
    assert np.array_equal(first, again)
    others = [emulate_run(CAMPAIGN, REST, 0.6, 5, day=n).joints[1].torque_nm for n in (0, 1, None)]
    noises = [each - np.mean(each) for each in others]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(noises[a], noises[b])[0, 1]) < 0.2
    given = emulate_run(CAMPAIGN, MOTION, 0.6, 5, day=Day(temperature_k=(15.0, 15.0)))
    assert np.min(given.joints[2].temperature_c) > 39.9


def test_nominal_day_of_a_plain_plant_is_every_day():
    plain = load_plant(shipped("plant.yaml"))
    runs = [columns(emulate_run(plain, MOTION, 0.3, 4, day=given)) for given in (None, Day())]
    assert np.array_equal(*runs)
    assert np.all(runs[0][4] == 25.0)


def test_another_day_begins_when_a_drive_is_enabled_after_both_were_off():
    source = PlantSource(CAMPAIGN, seed=9)
    days = [CAMPAIGN.run_to_run.day(9, n).sensor_zero_nm for n in range(4)]
    source.advance(0.0)
    assert source._instruments.day_zero_nm == days[0]  # the first run's day, before it is enabled, too
    for drive, mode, number in (
        (0, VELOCITY, 0),
        (1, CURRENT, 0),
        (0, OFF, 0),
        (0, VELOCITY, 0),  # the other one was still on
        (1, OFF, 0),
        (0, OFF, 0),
        (0, OFF, 0),  # both off: still that day
        (1, CURRENT, 1),
        (0, CURRENT, 1),
        (0, VELOCITY, 1),
        (0, OFF, 1),
        (1, OFF, 1),
        (0, VELOCITY, 2),
    ):
        source.command(drive, mode, 0.0)
        source.advance(0.001)
        assert source.day_number == number, (drive, mode)
        assert source._instruments.day_zero_nm == days[number]


def test_without_run_to_run_a_joint_stays_warm_when_it_is_enabled_again():
    source = PlantSource(replace(CAMPAIGN, run_to_run=RunToRun()), seed=9)
    source.plant.temperatures[0].celsius = 40.0
    for mode in (CURRENT, OFF, CURRENT):
        source.command(0, mode, 0.0)
    source.advance(0.001)
    assert source.day_number == 0
    assert source.drives[0].temperature_c == 40.0
