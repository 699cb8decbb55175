"""Fourier motions: Eq. (10) as printed, ends at rest, derivatives, and what is refused."""

import math

import numpy as np
import pytest
import yaml

from jtqd.estimator.decoder import decode
from jtqd.estimator.errors import ConfigError
from jtqd.sysid.planner.plan import RAMP_SHARE, FourierSeries, FourierTrajectory


def random_trajectory(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, int(rng.integers(1, 8))))
    return FourierTrajectory(rng.uniform(0.2, 2.0), tuple(a), tuple(b), rng.uniform(2.0, 30.0))


def equation_10(one, t):
    """Position, velocity and acceleration as printed in the paper; c_1..c_6 from six linear equations of the ends."""
    w, T = one.omega_rad_s, one.duration_s

    def series(t):
        position = velocity = acceleration = 0.0
        for i, (a, b) in enumerate(zip(one.a, one.b, strict=True), 1):
            position += a / (i * w) * math.sin(i * w * t) - b / (i * w) * math.cos(i * w * t)
            velocity += a * math.cos(i * w * t) + b * math.sin(i * w * t)
            acceleration += -i * w * a * math.sin(i * w * t) + i * w * b * math.cos(i * w * t)
        return np.array([position, velocity, acceleration])

    def rows(t):
        return np.array(
            [
                [t ** (j - 1) for j in range(1, 7)],
                [(j - 1) * t ** (j - 2) if j >= 2 else 0.0 for j in range(1, 7)],
                [(j - 1) * (j - 2) * t ** (j - 3) if j >= 3 else 0.0 for j in range(1, 7)],
            ]
        )

    wanted = np.concatenate([-series(0.0), -series(T)])
    c = np.linalg.solve(np.concatenate([rows(0.0), rows(T)]), wanted)
    return series(t) + rows(t) @ c


@pytest.mark.parametrize("seed", range(20))
def test_is_equation_10_and_rests_at_both_ends_and_beyond(seed):
    one = random_trajectory(seed)
    for t in np.linspace(0.0, one.duration_s, 11):
        assert one.motion(t) == pytest.approx(equation_10(one, t), rel=1e-7, abs=1e-7), f"seed {seed}, t {t}"
    for t in (-1.0, 0.0, one.duration_s, one.duration_s + 1.0):
        assert one.motion(t) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9), f"seed {seed}"


@pytest.mark.parametrize("seed", range(10))
def test_velocity_and_acceleration_are_the_derivatives(seed):
    one = random_trajectory(seed)
    t = np.linspace(0.1, 0.9, 50) * one.duration_s
    h = 1e-5
    _, velocity, acceleration = one.motion(t)
    before, after = one.motion(t - h), one.motion(t + h)
    assert velocity == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-6)
    assert acceleration == pytest.approx((after[1] - before[1]) / (2 * h), abs=1e-6)


def test_motion_is_linear_in_its_amplitudes():
    one = random_trajectory(5)
    double = FourierTrajectory(
        one.omega_rad_s, tuple(2 * x for x in one.a), tuple(2 * x for x in one.b), one.duration_s
    )
    t = np.linspace(0.0, one.duration_s, 40)
    for twice, once in zip(double.motion(t), one.motion(t), strict=True):
        assert twice == pytest.approx(2.0 * once, abs=1e-12)


def test_series_is_the_bare_series_inside_and_smooth_zero_at_its_ends():
    w, a, b, offset, T = 0.7, (0.4, -1.1), (0.9, 0.2), 1.5, 20.0
    one = FourierSeries(w, a, b, T, offset)
    t = np.linspace(RAMP_SHARE * T, (1 - RAMP_SHARE) * T, 50)
    bare = offset + sum(a[k] * np.cos((k + 1) * w * t) + b[k] * np.sin((k + 1) * w * t) for k in range(2))
    assert one.value(t) == pytest.approx(bare, abs=1e-12)
    for end, inwards in ((0.0, 1.0), (T, -1.0)):
        # zero value, slope and curvature: the start grows with the third power
        near, further = one.value(end + inwards * 0.01), one.value(end + inwards * 0.02)
        assert one.value(end) == 0.0
        assert abs(near) < 1e-5
        assert further / near == pytest.approx(8.0, rel=0.05)
        assert one.value(end - inwards) == 0.0


def test_offset_survives_the_ends():
    """The fifth-order polynomial of a trajectory would swallow it: this is why the current has a window instead."""
    t = np.linspace(0.0, 10.0, 101)
    with_offset = FourierSeries(1.0, (0.0,), (0.0,), 10.0, 2.0).value(t)
    assert with_offset[20:80] == pytest.approx(2.0)


def test_shapes_and_scalars():
    one, series = random_trajectory(1), FourierSeries(1.0, (1.0,), (0.5,), 4.0, 0.1)
    for f in (lambda t: one.motion(t)[1], series.value):
        assert f(1).shape == ()
        assert f(np.zeros((3, 2))).shape == (3, 2)
        assert f([1.0, 2.0])[1] == f(2.0)


@pytest.mark.parametrize(
    "series", [random_trajectory(7), FourierSeries(1.0, (1.0, 2.0), (0.5, 1e-7), 4.0, -0.25)]
)
def test_mapping_round_trip_through_yaml(series):
    text = yaml.safe_dump(series.to_mapping())
    assert decode(type(series), yaml.safe_load(text), "p", duration_s=series.duration_s) == series


GOOD = {"omega_rad_s": 1.0, "a": [1.0, 2.0], "b": [0.0, 1.0]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"a": [1.0]}, "key 'b': found [0.0, 1.0], expected as many numbers as in 'a', 1"),
        ({"a": []}, "key 'a': found [], expected a list of 1 to 50 finite numbers"),
        ({"a": [0.0] * 51}, "expected a list of 1 to 50 finite numbers"),
        ({"b": [0.0, math.nan]}, "key 'b': found nan, expected a list of 1 to 50 finite numbers"),
        ({"b": [0.0, True]}, "key 'b': found True"),
        ({"b": "1, 2"}, "key 'b': found '1, 2'"),
        ({"omega_rad_s": 0.0}, "key 'omega_rad_s': found 0.0, expected a number in rad/s > 0"),
        ({"offset_a": 1.0}, "key 'offset_a': unknown key"),
    ],
)
def test_mapping_errors_name_file_and_key(change, message):
    with pytest.raises(ConfigError) as refused:
        decode(FourierTrajectory, GOOD | change, "plan.yaml", duration_s=10.0)
    assert str(refused.value).startswith("plan.yaml: ")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "arguments",
    [
        (0.0, (1.0,), (1.0,), 1.0),
        (1.0, (1.0,), (1.0,), 0.0),
        (1.0, (1.0,), (1.0, 2.0), 1.0),
        (1.0, (), (), 1.0),
        (1.0, (math.inf,), (1.0,), 1.0),
        (math.nan, (1.0,), (1.0,), 1.0),
    ],
)
def test_values_without_sense_are_refused(arguments):
    for kind in (FourierTrajectory, FourierSeries):
        with pytest.raises(ConfigError, match=r"^fourier\.\w+: found"):
            kind(*arguments)
