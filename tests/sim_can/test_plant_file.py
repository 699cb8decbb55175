"""Plant files: the campaign's bench, what its sections may hold, and what is refused."""

import json

import pytest
import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.plant_file import (
    Hysteresis,
    KinematicError,
    RunToRun,
    Thermal,
    load_plant,
    plant_from_mapping,
)

CAMPAIGN = "campaign_plant.yaml"


def mapping(name=CAMPAIGN):
    # through JSON: what the file shares by an anchor must not be shared here
    return json.loads(json.dumps(yaml.safe_load(shipped(name).read_text())))


def from_mapping(changed):
    return plant_from_mapping(changed, CAMPAIGN, lambda name: load_joint(shipped(name)))


def test_campaign_plant_is_the_hard_bench():
    plant = load_plant(shipped(CAMPAIGN))
    assert plant.run_to_run == RunToRun(0.15, 0.3, 2.0, 1e-5)
    assert plant.profile == "demo"
    for side, phase in zip(plant.joints, (0.9, 2.3), strict=True):
        d = side.deviations
        assert (d.ripple.amplitude_nm, d.ripple.order_per_motor_rev) == (0.25, 2.0)
        assert d.kinematic_error == KinematicError(4e-5, 2.0, phase)
        assert d.hysteresis == Hysteresis(0.4, 1e-4)
        assert side.thermal == Thermal(25.0, 0.025, 0.004, 0.6, 600.0)
    mild = load_plant(shipped("plant.yaml")).joints[0]
    assert d.stribeck == mild.deviations.stribeck


def test_new_sections_may_be_left_out():
    changed = mapping()
    del changed["run_to_run"]
    for joint in ("joint_1", "joint_2"):
        del changed[joint]["thermal"]
        del changed[joint]["deviations"]["hysteresis"]
        del changed[joint]["deviations"]["kinematic_error"]
    plant = from_mapping(changed)
    assert plant.run_to_run == RunToRun() == RunToRun(0.0, 0.0, 0.0, 0.0)
    assert plant.joints[0].thermal == Thermal()
    assert plant.joints[0].deviations.hysteresis.torque_nm == 0.0
    assert plant.joints[1].deviations.kinematic_error.amplitude_rad == 0.0


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (
            ("run_to_run", "viscous"),
            1.5,
            "'run_to_run.viscous': found 1.5, expected a number from 0 to 0.9",
        ),
        (("run_to_run", "sensor_zero"), 0.3, "'run_to_run.sensor_zero': unknown key, did you mean"),
        (("run_to_run", "temperature_k"), -4.0, "'run_to_run.temperature_k': found -4.0"),
        (("run_to_run",), 3, "'run_to_run': found 3, expected a mapping"),
        (("joint_1", "thermal", "time_constant_s"), 0.0, "'joint_1.thermal.time_constant_s': found 0.0"),
        (("joint_2", "thermal", "viscous_per_k"), "warm", "'joint_2.thermal.viscous_per_k': found 'warm'"),
        (("joint_1", "thermal", "kelvin_per_watt"), 1.0, "did you mean 'kelvin_per_w'?"),
        (("joint_1", "deviations", "hysteresis", "travel_rad"), 0.0, "hysteresis.travel_rad': found 0.0"),
        (("joint_1", "deviations", "hysteresis"), {"travel_rad": 1e-4}, "hysteresis.torque_nm': missing"),
        (("joint_1", "deviations", "kinematic_error", "amplitude_rad"), float("nan"), "found nan"),
        (
            ("joint_2", "deviations", "kinematic_error", "amplitude_rad"),
            5e-3,  # 5e-3 * 2 = 0.01 = 1/G: the link would stand still while the motor turns
            "'joint_2.deviations.kinematic_error': found 0.01, expected amplitude_rad times",
        ),
        (("joint_1", "deviation"), {}, "'joint_1.deviation': unknown key, did you mean 'deviations'"),
        (("joint_1", "deviations", "friction_scale"), "x", "'joint_1.deviations.friction_scale': found 'x'"),
        (("joint_1", "deviations", "stiffness_scale"), 0.0, "expected a number from 0.05 to 10"),
        (("joint_2", "measurement", "motor_counts_per_rev"), 1.5, "motor_counts_per_rev': found 1.5"),
        (("joint_2", "deviations", "ripple", "amplitude"), 1.0, "ripple.amplitude': unknown key"),
        (("joint_1", "deviations", "stribeck", "velocity_rad_s"), 0.2, "from 0.002 to 0.06"),
        (("sensor", "gain"), float("nan"), "'sensor.gain': found nan"),
        (("profile",), "dance", "'profile': found 'dance'"),
        (("substep_s",), 1.0, "'substep_s': found 1.0"),
        (("extra",), 1, "'extra': unknown key"),
        (("joint_2",), ..., "'joint_2': missing"),
    ],
)
def test_wrong_section_is_refused_by_name(path, value, message):
    changed = mapping()
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    if value is ...:
        del inner[path[-1]]
    with pytest.raises(ConfigError) as error:
        from_mapping(changed)
    assert message in str(error.value)
    assert str(error.value).startswith(CAMPAIGN)
    assert "\n" not in str(error.value)
