"""Set-points, limits and what a plan may ask for: every refusal names joint, quantity, found and limit."""

import math

import numpy as np
import pytest

from jtqd.sysid.motion.commander import StopRamp
from jtqd.sysid.motion.setpoints import (
    JointSample,
    Limits,
    Mark,
    Monitor,
    MotionError,
    Sample,
    Setpoints,
    Timing,
    check_setpoints,
)

LIMITS = Limits(current_a=9.0, velocity_rad_s=3.3, torque_nm=60.0, travel_rad=50.0, temperature_c=70.0)
STILL = JointSample(0.0, 0.0, 0.0, 25.0)
FIELDS = {
    "current_a": ("current", 9.0, "A"),
    "velocity_rad_s": ("velocity", 3.3, "rad/s"),
    "travel_rad": ("travel", 50.0, "rad"),
}


def sample(joint: int, **values: float) -> Sample:
    changed = STILL._replace(**values)
    return Sample((changed, STILL) if joint == 1 else (STILL, changed), (0.0,))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("joint", [1, 2])
@pytest.mark.parametrize("field", FIELDS)
def test_a_value_at_its_limit_passes_and_one_beyond_names_itself(field, joint, sign):
    name, limit, unit = FIELDS[field]
    monitor = Monitor(LIMITS)
    assert monitor.check(sample(joint, **{field: sign * limit})) is None
    beyond = sign * limit * 1.01
    expected = f"joint {joint}: {name} {beyond:.3f} {unit}, limit {limit:g} {unit}"
    assert monitor.check(sample(joint, **{field: beyond})) == expected
    assert str(monitor.check(sample(joint, **{field: math.nan}))).startswith(f"joint {joint}: {name} nan")


@pytest.mark.parametrize("joint", [1, 2])
def test_temperature_has_one_side_and_may_be_unknown(joint):
    monitor = Monitor(LIMITS)
    assert monitor.check(sample(joint, temperature_c=70.0)) is None
    assert monitor.check(sample(joint, temperature_c=-40.0)) is None
    assert monitor.check(sample(joint, temperature_c=math.nan)) is None
    found = monitor.check(sample(joint, temperature_c=70.1))
    assert found == f"joint {joint}: temperature 70.1 °C, limit 70 °C"


@pytest.mark.parametrize("torque", [60.01, -60.01, math.nan])
def test_torque_is_that_of_both_joints_with_one_sensor_and_of_one_with_two(torque):
    monitor = Monitor(LIMITS)
    assert monitor.check(Sample((STILL, STILL), (60.0,))) is None
    found = monitor.check(Sample((STILL, STILL), (torque,)))
    assert found == f"joints 1 and 2: torque at the sensor {torque:.2f} Nm, limit 60 Nm"
    assert str(monitor.check(Sample((STILL, STILL), (0.0, torque)))).startswith("joint 2: torque")
    assert monitor.check(Sample((STILL, STILL), ())) is None


@pytest.mark.parametrize("name", ["current_a", "velocity_rad_s", "torque_nm", "travel_rad", "temperature_c"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, "9", True, None])
def test_a_limit_is_a_positive_number(name, value):
    values = {"current_a": 9.0, "velocity_rad_s": 3.3, "torque_nm": 60.0, "travel_rad": 50.0}
    with pytest.raises(ValueError, match=rf"limits\.{name}: found .* expected a positive number"):
        Limits(**{**values, name: value})  # type: ignore[arg-type]
    assert Limits(**values).temperature_c == math.inf
    if name != "temperature_c":
        with pytest.raises(ValueError, match=rf"limits\.{name}"):
            Limits(**{**values, name: math.inf})


# Plans ------------------------------------------------------------------------------------------------------


def ramp(to: float, n: int) -> np.ndarray:
    return np.linspace(to / n, to, n)


def test_a_plan_within_all_limits_passes():
    shape = np.concatenate([ramp(1.0, 300), np.ones(1000), 1.0 - ramp(1.0, 300)])
    check_setpoints(Setpoints(1, 3.3 * shape, -9.0 * shape), LIMITS)


REST = np.zeros(8)
LONG = np.r_[ramp(-2.0, 1000), np.full(25000, -2.0)]


@pytest.mark.parametrize(
    ("velocity", "current", "line"),
    [
        (np.full(8, 0.06), REST, "velocity of joint 2 starts with a jump of 0.060 rad/s, limit 0.05 rad/s per ms"),
        (REST, np.full(8, -0.6), "current of joint 1 starts with a jump of -0.600 A, limit 0.5 A per ms"),
        (np.r_[np.zeros(7), 1.0], REST, "velocity of joint 2 jumps at 0.007 s of 1.000 rad/s, limit 0.05 rad/s per ms"),
        (REST, np.r_[np.zeros(5), 0.4, -0.4, 0.0], "current of joint 1 jumps at 0.006 s of -0.800 A, limit 0.5 A per ms"),
        (ramp(3.4, 340), np.zeros(340), "velocity of joint 2 3.310 rad/s at 0.330 s, limit 3.3 rad/s"),
        (np.zeros(910), ramp(-9.1, 910), "current of joint 1 -9.010 A at 0.900 s, limit 9 A"),
        (LONG, np.zeros(26000), "travel of joint 2 -50.001 rad at 25.499 s, limit 50 rad"),
    ],
)  # fmt: skip
def test_a_plan_that_jumps_or_exceeds_a_limit_is_refused_before_anything_moves(velocity, current, line):
    with pytest.raises(MotionError) as refused:
        check_setpoints(Setpoints(2, velocity, current), LIMITS)
    assert str(refused.value) == f"plan: {line}"


# Set-points -------------------------------------------------------------------------------------------------


def test_setpoints_are_copied_read_only_and_know_their_times():
    velocity = np.linspace(0.0, 1.0, 5)
    mark = Mark("plateau", 0.0, 0.005, 1.0, 2.0)
    setpoints = Setpoints(2, velocity, [0, 1, 2, 1, 0], (mark,))  # type: ignore[arg-type]
    velocity[0] = 9.0
    assert setpoints.velocity_rad_s[0] == 0.0
    assert (len(setpoints), setpoints.duration_s, setpoints.current_joint) == (5, 0.005, 1)
    assert setpoints.time_s.tolist() == pytest.approx([0.0, 0.001, 0.002, 0.003, 0.004])
    with pytest.raises(ValueError, match="read-only"):
        setpoints.current_a[0] = 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((5, [0.0], [0.0]), "velocity_joint 5, expected 1 to 4"),
        ((3, [0.0], [0.0]), "no current_joint beside velocity_joint 3"),
        ((3, [0.0], [0.0], (), (), 3), "current_joint 3, expected another joint than 3"),
        ((3, [0.0], [0.1], (), (), None), "a current and no joint to follow it"),
        ((1, [], []), "velocity_rad_s has shape"),
        ((1, [[0.0]], [0.0]), "velocity_rad_s has shape"),
        ((1, [0.0, math.nan], [0.0, 0.0]), "velocity_rad_s is nan at 0.001 s"),
        ((1, [0.0], [math.inf]), "current_a is inf at 0.000 s"),
        ((1, [0.0, 0.0], [0.0]), "2 velocities and 1 currents"),
        ((1, [0.0], [0.0], ("rest",)), "'rest' is no Mark"),
    ],
)
def test_setpoints_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Setpoints(*arguments)


# Stop ramp and timing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("velocity", "current"), [(2.0, 4.0), (-3.3, 9.0), (0.5, -1.0), (0.0, -3.0), (0.0, 0.0)]
)
def test_the_stop_ramp_is_ten_rad_per_second_squared_and_a_tenth_of_a_second(velocity, current):
    ramp = StopRamp(velocity, current)
    assert ramp.at(0.0) == (velocity, current)
    assert ramp.duration_s == pytest.approx(max(abs(velocity) / 10.0, 0.1 if current else 0.0))
    assert ramp.at(ramp.duration_s) == pytest.approx((0.0, 0.0), abs=1e-12)
    for t in np.linspace(0.0, 0.5, 26):
        v, i = ramp.at(float(t))
        assert v == pytest.approx(math.copysign(max(0.0, abs(velocity) - 10.0 * t), velocity), abs=1e-12)
        assert i == pytest.approx(current * max(0.0, 1.0 - t / 0.1))


def test_times_of_the_supervision_are_positive():
    with pytest.raises(ValueError, match="sync_lost_s is 0"):
        Timing(sync_lost_s=0)
