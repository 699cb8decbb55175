"""Plans: Fourier series, files, smooth set-points, limits, marks, and the partial runs of a run."""

import copy
import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

from jtqd.estimator.decoder import decode
from jtqd.estimator.errors import ConfigError
from jtqd.estimator.joint import MotionLimits
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.motion.setpoints import Limits, path
from jtqd.sysid.planner.campaigns import efficiency_runs, plateau_run, range_of
from jtqd.sysid.planner.campaigns import joint_plateau_run as alone_run
from jtqd.sysid.planner.plan import (
    DEFAULT_LIMITS,
    RAMP_SHARE,
    Fourier,
    FourierSeries,
    FourierTrajectory,
    Plan,
    Plateau,
    Rest,
    Run,
    check_plan,
    check_run,
    expand,
    load_plan,
    marks_of,
    partial_runs,
    smooth_step,
    travel_rad,
)

PLAN: dict[str, Any] = yaml.safe_load("""
schema: jtq.plan/1
name: mixed
limits: {current_a: 8.0, velocity_rad_s: 3.0, torque_nm: 50.0, travel_rad: 20.0, temperature_c: 60.0}
runs:
  - name: one
    velocity_joint: 2
    segments:
      - {kind: plateau, velocity_rad_s: -1.5, current_a: 2.0, hold_s: 1.0, ramp_s: 0.5}
      - {kind: rest, hold_s: 0.5, ramp_s: 0.4}
      - kind: fourier
        duration_s: 4.0
        velocity: {omega_rad_s: 1.5, a: [0.4, -0.1], b: [0.2, 0.3]}
        current: {omega_rad_s: 1.1, a: [1.0], b: [0.5], offset_a: 0.5}
      - {kind: rest, hold_s: 0.5, ramp_s: 0.0}
  - name: two
    velocity_joint: 1
    segments: [{kind: rest, hold_s: 1.0, ramp_s: 0.5}, {kind: power_off, hold_s: 2.0}]
""")


def changed(change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    plan = copy.deepcopy(PLAN)
    change(plan)
    return plan


def run_of(*segments: Any) -> Run:
    return Run("r", 1, tuple(segments))


def test_a_plan_is_the_same_after_yaml(tmp_path):
    plan = Plan.from_mapping(PLAN, "p.yaml")
    assert plan.to_mapping() == PLAN
    path = tmp_path / "plan.yaml"
    path.write_text(plan.to_yaml())
    again = load_plan(path)
    assert again == plan
    assert again.sha256 == plan.sha256
    assert plan.duration_s == pytest.approx(1.5 + 0.9 + 4.0 + 0.5 + 1.5 + 2.0)


def test_every_number_of_a_plan_counts_for_its_hash():
    rng = random.Random(1)
    plan = Plan.from_mapping(PLAN, "p.yaml")
    seen = {plan.sha256}
    for _ in range(50):
        mapping = copy.deepcopy(PLAN)
        segment = rng.choice(mapping["runs"][0]["segments"][:2])
        key = rng.choice([key for key in segment if key != "kind"])
        segment[key] = segment[key] + rng.uniform(1e-6, 0.3)
        seen.add(Plan.from_mapping(mapping, "p.yaml").sha256)
    assert len(seen) == 51
    mapping = copy.deepcopy(PLAN)
    mapping["runs"].reverse()
    assert Plan.from_mapping(mapping, "p.yaml").sha256 not in seen
    dumped = yaml.safe_load(yaml.safe_dump(PLAN, sort_keys=True))  # another order of keys is the same plan
    assert Plan.from_mapping(dumped, "q.yaml").sha256 == plan.sha256


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p.update(schema="jtq.plan/2"), ["'schema'", "jtq.plan/2"]),
        (lambda p: p.update(runs=[]), ["'runs'", "at least one run"]),
        (lambda p: p["limits"].update(curent_a=1.0), ["limits.curent_a", "did you mean 'current_a'"]),
        (lambda p: p["limits"].update(torque_nm=0.0), ["limits.torque_nm", "> 0"]),
        (lambda p: p["runs"][1].update(name="one"), ["runs[1].name", "a unique name"]),
        (lambda p: p["runs"][1].update(name="../up"), ["runs[1].name", "letters"]),
        (lambda p: p["runs"][1].update(name="plan"), ["runs[1].name", "'plan'"]),
        (lambda p: p["runs"][1].update(velocity_joint=5), ["velocity_joint", "5"]),
        (lambda p: p["runs"][1].update(velocity_joint=3), ["runs[1].current_joint", "missing"]),
        (lambda p: p["runs"][1].update(current_joint=p["runs"][1]["velocity_joint"]), ["current_joint"]),
        (lambda p: p["runs"][1].update(segments=[]), ["segments", "at least one"]),
        (lambda p: p["runs"][0]["segments"][0].update(kind="platform"), ["segments[0].kind", "platform"]),
        (lambda p: p["runs"][0]["segments"][0].update(hold_s=-1), ["segments[0].hold_s", "-1"]),
        (lambda p: p["runs"][0]["segments"][0].update(hold_s="1e0x"), ["hold_s", "1e0x"]),
        (lambda p: p["runs"][0]["segments"][1].update(current_a=1.0), ["segments[1].current_a", "unknown"]),
        (lambda p: p["runs"][0]["segments"].pop(1), ["segments[1].kind", "a rest before it"]),
        (
            lambda p: p["runs"][0]["segments"].insert(1, {"kind": "power_off", "hold_s": 2.0}),
            ["segments[1].kind", "power_off", "a rest before it"],
        ),
        (lambda p: p["runs"][1]["segments"][1].update(hold_s=0.5), ["segments[1].hold_s", "1.5"]),
        (lambda p: p["runs"][0]["segments"][2]["velocity"].update(b=[1.0]), ["velocity.b", "as many"]),
        (lambda p: p["runs"][0]["segments"][2]["current"].pop("omega_rad_s"), ["current.omega_rad_s"]),
        (lambda p: p["runs"][0]["segments"][2].pop("duration_s"), ["duration_s", "missing"]),
    ],
)
def test_errors_in_a_plan_are_one_line(change, words):
    with pytest.raises(ConfigError) as caught:
        Plan.from_mapping(changed(change), "my.plan.yaml")
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    for word in ["my.plan.yaml", *words]:
        assert word in message


def test_limits_that_are_left_out_have_their_defaults_and_null_is_no_limit_of_temperature():
    assert Plan.from_mapping(changed(lambda p: p.pop("limits")), "p").limits == DEFAULT_LIMITS
    some = Plan.from_mapping(changed(lambda p: p.update(limits={"torque_nm": 20.0})), "p").limits
    assert (some.torque_nm, some.current_a, some.temperature_c) == (20.0, DEFAULT_LIMITS.current_a, 70.0)
    plan = Plan.from_mapping(changed(lambda p: p["limits"].update(temperature_c=None)), "p")
    assert plan.limits.temperature_c == float("inf")
    assert Plan.from_mapping(yaml.safe_load(plan.to_yaml()), "p") == plan


def test_smooth_step_has_no_slope_and_no_curvature_at_its_ends():
    h = 1e-4
    x = np.array([0.0, h, 2 * h, 0.5, 1.0 - 2 * h, 1.0 - h, 1.0])
    y = smooth_step(x)
    assert y[[0, 3, 6]] == pytest.approx([0.0, 0.5, 1.0])
    assert np.abs(np.diff(y[:3]) / h).max() < 1e-6
    assert abs(y[0] - 2 * y[1] + y[2]) / h**2 < 0.02  # its second derivative is 60 x there
    assert abs(y[4] - 2 * y[5] + y[6]) / h**2 < 0.02
    fine = smooth_step(np.linspace(0.0, 1.0, 10001))
    assert np.all(np.diff(fine) >= 0.0)
    assert np.diff(fine).max() * 10000 == pytest.approx(1.875, rel=1e-6)


def test_set_points_are_those_of_the_segments_at_the_times_of_the_marks():
    points = expand(Plan.from_mapping(PLAN, "p").runs[0])
    assert len(points) == 6900
    assert (points.velocity_joint, points.current_joint) == (2, 1)
    assert [mark.kind for mark in points.marks] == ["ramp", "plateau", "ramp", "rest", "fourier", "rest"]
    assert points.marks[0].start_s == 0.0
    for before, after in zip(points.marks[:-1], points.marks[1:], strict=True):
        assert before.end_s == after.start_s
    assert points.marks[-1].end_s == pytest.approx(6.9)
    for mark in points.marks:
        held = slice(round(mark.start_s * 1e3), round(mark.end_s * 1e3))
        if mark.velocity_rad_s is not None:
            assert np.all(points.velocity_rad_s[held] == mark.velocity_rad_s)
            assert np.all(points.current_a[held] == mark.current_a)
    plateau = points.marks[1]
    assert (plateau.velocity_rad_s, plateau.current_a) == (-1.5, 2.0)
    assert plateau.end_s - plateau.start_s == pytest.approx(1.0)
    fourier = points.marks[4]
    held = slice(round(fourier.start_s * 1e3), round(fourier.end_s * 1e3))
    t = np.arange(4000) * 1e-3
    assert np.array_equal(
        points.velocity_rad_s[held], FourierTrajectory(1.5, (0.4, -0.1), (0.2, 0.3), 4.0).motion(t)[1]
    )
    assert np.array_equal(points.current_a[held], FourierSeries(1.1, (1.0,), (0.5,), 4.0, 0.5).value(t))


def test_random_runs_never_jump_and_end_at_rest():
    """Velocity and acceleration are continuous over every segment: differences stay below what the ramps explain."""
    for seed in range(30):
        rng = random.Random(seed)
        segments: list[Any] = []
        for _ in range(6):
            ramp = rng.uniform(0.3, 1.0)
            segments.append(
                Plateau(rng.uniform(-2.5, 2.5), rng.uniform(-5, 5), rng.uniform(0.0, 0.5), ramp)
                if rng.random() < 0.6
                else Rest(rng.uniform(0.0, 0.5), ramp)
            )
        segments.append(Rest(0.2, 0.5))
        points = expand(run_of(*segments))
        for series, largest in ((points.velocity_rad_s, 5.0), (points.current_a, 10.0)):
            first = np.diff(series, prepend=0.0) / 1e-3
            second = np.diff(first, prepend=0.0) / 1e-3
            assert np.abs(first).max() < 1.9 * largest / 0.3, f"seed {seed}"
            assert np.abs(second).max() < 5.9 * largest / 0.3**2, f"seed {seed}"
            assert np.all(series[-200:] == 0.0), f"seed {seed}"


def test_travel_is_the_largest_distance_and_directions_cancel():
    out = Plateau(1.0, 0.0, 2.0, 0.5)
    back = Plateau(-1.0, 0.0, 2.0, 0.5)
    # ramp 0 -> 1 within 0.5 s covers 0.25 rad, then 2 rad
    assert travel_rad(expand(run_of(out, Rest(0.5, 0.5)))) == pytest.approx(2.5, abs=1e-9)
    both = expand(run_of(out, back, Rest(0.5, 0.5)))
    # half of the reversal: 0.5 s times the integral of 1 - 2 s(x) over 0..1/2, s = 10 x^3 - 15 x^4 + 6 x^5
    reversal = 0.5 * (0.5 - 2.0 * (2.5 / 16 - 3 / 32 + 1 / 64))
    assert travel_rad(both) == pytest.approx(2.25 + reversal, abs=1e-4)
    assert np.cumsum(both.velocity_rad_s)[-1] * 1e-3 == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(
    ("segments", "words"),
    [
        ([Plateau(3.1, 0.0, 1.0), Rest(0.5)], ["velocity", "3.0", "limit 3 rad/s"]),
        ([Plateau(0.1, -5.5, 1.0), Rest(0.5)], ["current", "5", "limit 5 A"]),
        ([Plateau(2.0, 0.0, 6.0), Rest(0.5)], ["travel", "limit 10 rad"]),
        ([Plateau(1.0, 0.0, 1.0, 0.0), Rest(0.5)], ["jump"]),
        ([Plateau(1.0, 0.0, 1.0)], ["end at rest"]),
        ([Rest(0.0, 0.0)], ["no duration"]),
    ],
)
def test_a_run_beyond_its_limits_is_refused_before_anything_moves(segments, words):
    limits = Limits(current_a=5.0, velocity_rad_s=3.0, torque_nm=50.0, travel_rad=10.0)
    with pytest.raises(ConfigError) as caught:
        check_run(run_of(*segments), limits)
    for word in ["run 'r'", *words]:
        assert word in str(caught.value)


def test_a_run_at_its_limits_is_allowed():
    limits = Limits(current_a=5.0, velocity_rad_s=3.0, torque_nm=50.0, travel_rad=10.0)
    plan = Plan("p", limits, (run_of(Plateau(3.0, -5.0, 1.0, 1.0), Rest(0.5)),))
    assert list(check_plan(plan)) == ["r"]


def test_fourier_segments_carry_their_series_unchanged():
    segment = Plan.from_mapping(PLAN, "p").runs[0].segments[2]
    assert isinstance(segment, Fourier)
    assert segment.duration_s == 4.0
    assert segment.current.offset_a == 0.5


# Partial runs ---------------------------------------------------------------------------------------------------

_SERIES = FourierSeries(1.0, (1.0,), (0.5,), 4.0)
TWO_TRAJECTORIES = run_of(
    Rest(1.0, 0.0),
    *(
        segment
        for b in (0.1, 0.2)
        for segment in (
            Fourier(FourierTrajectory(2.0 * np.pi / 4.0, (0.2,), (b,), 4.0), _SERIES),
            Rest(1.0, 0.0),
            Rest(1.0, 0.0),
        )
    ),
)
JOINT = replace(load_joint(shipped("joint1.yaml")), motion_limits=MotionLimits((-1.0, 2.0), 1.5, 6.0, 25.0))
RANGE = range_of(1, JOINT, DEFAULT_LIMITS)


def test_a_run_of_trajectories_is_cut_where_it_rests():
    run = TWO_TRAJECTORIES
    one, two = partial_runs(run)
    assert (one.name, two.name) == ("r~1", "r~2")
    assert one.duration_s + two.duration_s == run.duration_s
    whole = expand(run)
    parts = [expand(piece) for piece in (one, two)]
    for name in ("velocity_rad_s", "current_a"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        assert np.array_equal(joined, getattr(whole, name))
    assert all(part.velocity_rad_s[0] == part.velocity_rad_s[-1] == 0.0 for part in parts)


def test_plateaus_of_both_directions_and_a_single_trajectory_are_not_cut():
    for run in (
        plateau_run("r", 2, [(1.2, 1.0), (-1.2, 3.0)], 0.8),
        replace(TWO_TRAJECTORIES, segments=TWO_TRAJECTORIES.segments[:3]),
        run_of(Rest(1.0)),
    ):
        assert partial_runs(run) == (run,)


def test_marks_of_a_run():
    run = Run("r", 2, (Plateau(1.0, 2.0, 0.5, 0.25), Rest(0.5)))
    plan = Plan("p", DEFAULT_LIMITS, (run,))
    marks = marks_of(run, check_plan(plan)["r"])
    assert (marks["run"], marks["velocity_joint"]) == ("r", 2)
    assert [segment["kind"] for segment in marks["segments"]] == ["ramp", "plateau", "ramp", "rest"]
    assert marks["segments"][1] == {
        "kind": "plateau",
        "start_s": 0.25,
        "end_s": 0.75,
        "velocity_joint": 2,
        "velocity_rad_s": 1.0,
        "current_a": 2.0,
    }
    assert np.isclose(marks["segments"][-1]["end_s"], run.duration_s)


def test_plateaus_of_a_joint_alone_are_cut_by_velocity():
    run = alone_run(1, RANGE, "r", (0.1, 0.2, 0.5))
    parts = partial_runs(run)
    assert [part.name for part in parts] == ["r~1", "r~2", "r~3"]
    assert sum(part.duration_s for part in parts) == pytest.approx(run.duration_s, abs=0.01)
    for part in parts:
        points = check_run(part, RANGE.limits)
        assert path(points)[-1] == pytest.approx(0.0, abs=2e-3)


def test_a_run_of_one_direction_is_cut_by_plateau():
    (run, *_) = efficiency_runs((1.4,), 2.1, (1.0, 2.5, 4.0))
    parts = partial_runs(run)
    assert len(parts) == 3
    wanted = [each for each in run.segments if isinstance(each, Plateau)]
    for part, plateau in zip(parts, wanted, strict=True):
        (own,) = [each for each in part.segments if isinstance(each, Plateau)]
        assert (own.velocity_rad_s, own.current_a, own.hold_s) == (
            plateau.velocity_rad_s,
            plateau.current_a,
            plateau.hold_s,
        )
        assert own.ramp_s == wanted[0].ramp_s, "from rest, as the run's own first one"
        assert travel_rad(check_run(part, DEFAULT_LIMITS)) < travel_rad(expand(run))


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
