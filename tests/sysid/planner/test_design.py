"""Designed excitation: limits at every set-point, information by closed forms, equal budgets, `jtq excitation`."""

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml

from jtqd.estimator.errors import ConfigError
from jtqd.estimator.losses import LossModel
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import JointCommand, emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.planner import command as excitation_command
from jtqd.sysid.planner.design import (
    GOLDEN,
    POLISHING,
    POPULATION,
    STARTS,
    Bench,
    Candidates,
    CoupledJoints,
    ExcitationLimits,
    Information,
    design,
    log_det,
    loss_regressor,
    minimise,
)
from jtqd.sysid.planner.plan import FourierSeries, FourierTrajectory, Plan, load_plan, segment_mapping

JOINTS = (load_joint(shipped("joint1.yaml")), load_joint(shipped("joint2.yaml")))
LIMITS = ExcitationLimits()


def draw(limits, **options):
    """Trajectories with drawn coefficients, not optimised."""
    return design(limits, evaluations=1, **options)


def setpoints(one):
    segment = one.segment
    time_s = np.arange(round(segment.duration_s * 1000) + 1) * 1e-3
    return (time_s, *segment.velocity.motion(time_s), segment.current.value(time_s))


# --- limits ---------------------------------------------------------------------------------------------------


def own_current(joint, torque, velocity, acceleration):
    """Current the velocity joint needs: the loss model's scalar form, inverted by bisection."""
    losses = LossModel(joint)
    joint_torque = torque + joint.link_inertia_kgm2 * acceleration
    low, high = -50.0, 50.0
    for _ in range(45):
        i = 0.5 * (low + high)
        if losses.torque_per_ampere * i - losses.loss(i, velocity) < joint_torque:
            low = i
        else:
            high = i
    return low + joint.gear_ratio * joint.rotor_inertia_kgm2 * acceleration / joint.torque_constant_nm_per_a


def between_joints(joint, current, velocity, acceleration):
    """Torque by the driving joint's scalar loss; velocity and acceleration are those of the velocity joint."""
    losses = LossModel(joint)
    rotor = joint.gear_ratio**2 * joint.rotor_inertia_kgm2
    effective = current + rotor * acceleration / losses.torque_per_ampere
    raw = losses.torque_per_ampere * effective
    return raw - losses.loss(effective, -velocity) + joint.link_inertia_kgm2 * acceleration


@pytest.mark.parametrize(
    ("change", "active"),
    [
        ({}, "velocity_rad_s"),
        ({"acceleration_rad_s2": 1.0}, "acceleration_rad_s2"),
        ({"travel_rad": 1.5}, "travel_rad"),
        ({"velocity_rad_s": 0.3}, "velocity_rad_s"),
        ({"joint_current_a": 5.0}, "velocity_rad_s"),
        ({"torque_nm": 15.0}, "velocity_rad_s"),
    ],
)
def test_every_setpoint_keeps_every_limit_and_one_is_reached(change, active):
    limits = replace(LIMITS, **change)
    for one in draw(limits, count=4, duration_s=12.0, seed=4):
        _, position, velocity, acceleration, current = setpoints(one)
        peaks = {
            "velocity_rad_s": np.abs(velocity).max(),
            "acceleration_rad_s2": np.abs(acceleration).max(),
            "travel_rad": np.abs(position).max(),
            "current_a": np.abs(current).max(),
        }
        for name, peak in peaks.items():
            assert peak <= getattr(limits, name) * (1 + 1e-9), name
        assert peaks[active] == pytest.approx(getattr(limits, active), rel=1e-9)
        for k in range(0, len(velocity), 60):
            torque = between_joints(JOINTS[1], current[k], velocity[k], acceleration[k])
            assert abs(torque) <= limits.torque_nm * (1 + 1e-9)
            own = own_current(JOINTS[0], torque, velocity[k], acceleration[k])
            assert abs(own) <= limits.joint_current_a * (1 + 1e-9)


def test_current_stops_where_velocity_joint_or_torque_is_at_its_limit():
    """Bisection ends at the limit, not far below it: just a little more current would break it."""
    for change in ({"joint_current_a": 5.0}, {"torque_nm": 20.0}):
        limits = replace(LIMITS, current_a=8.0, **change)
        for one in draw(limits, count=4, duration_s=12.0, seed=1):
            _, _, velocity, acceleration, current = setpoints(one)
            assert 0.3 < np.abs(current).max() < 0.99 * limits.current_a
            # at a reversal the overshoot keeps a fifth free, elsewhere nothing
            near = []
            for k in range(0, len(velocity), 20):
                torque = between_joints(JOINTS[1], 1.001 * current[k], velocity[k], acceleration[k])
                near.append(
                    abs(torque) / limits.torque_nm
                    if "torque_nm" in change
                    else abs(own_current(JOINTS[0], torque, velocity[k], acceleration[k]))
                    / limits.joint_current_a
                )
            assert 0.8 < max(near) <= 1.01


def test_only_the_direction_of_a_genome_counts():
    bench = Bench(*JOINTS)
    candidates = Candidates(bench, LIMITS, duration_s=10.0, harmonics=3, rate_hz=20.0)
    rng = np.random.default_rng(0)
    genomes = rng.normal(size=(5, candidates.dimension))
    scaled = genomes.copy()
    scaled[:, :6] *= rng.uniform(0.01, 100.0, (5, 1))
    scaled[:, 6:] *= rng.uniform(0.01, 100.0, (5, 1))
    one, two = candidates.motion(genomes), candidates.motion(scaled)
    assert one.velocity == pytest.approx(two.velocity, abs=1e-9)
    assert one.torque == pytest.approx(two.torque, abs=0.02)  # bisection ends at another place


def test_matrices_are_the_series():
    candidates = Candidates(Bench(*JOINTS), LIMITS, duration_s=10.0, harmonics=3, rate_hz=20.0)
    genome = np.random.default_rng(0).normal(size=candidates.dimension)
    segment, motion = candidates.segment(genome)
    time_s = np.linspace(0.0, 10.0, 201)
    _, velocity, acceleration = segment.velocity.motion(time_s)
    assert motion.velocity[0] == pytest.approx(velocity, abs=1e-9)
    assert motion.acceleration[0] == pytest.approx(acceleration, abs=1e-9)
    assert motion.current[0] == pytest.approx(segment.current.value(time_s), abs=1e-9)


def test_genome_of_zeros_stays_at_rest():
    candidates = Candidates(Bench(*JOINTS), LIMITS, duration_s=10.0, harmonics=2, rate_hz=20.0)
    motion = candidates.motion(np.zeros((1, candidates.dimension)))
    assert np.all(np.isfinite(motion.torque))
    assert np.all(motion.velocity == 0.0)


@pytest.mark.parametrize("change", [{"joint_current_a": 0.5}, {"torque_nm": 2.0}])
def test_limits_that_leave_no_motion_are_refused(change):
    with pytest.raises(
        ConfigError, match=r"^limits: found joint_current_a .* turning the idle driving joint takes"
    ):
        draw(replace(LIMITS, **change), count=1, duration_s=10.0)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_limits_are_positive_numbers(value):
    with pytest.raises(ConfigError, match=r"^limits: travel_rad: found .* expected a finite number > 0$"):
        ExcitationLimits(travel_rad=value)


def test_emulated_bench_stays_within_the_limits_of_a_loaded_design():
    """The static model and its allowance at reversals hold on the bench with its springs and control loops."""
    (one,) = design(LIMITS, count=1, duration_s=10.0, seed=1, evaluations=600, starts=1)
    time_s, _, velocity, acceleration, current = setpoints(one)
    v, i = (dict(zip(np.round(time_s, 3).tolist(), a.tolist(), strict=True)) for a in (velocity, current))
    table = emulate_run(
        load_plant(shipped("plant.yaml")),
        (JointCommand.velocity(lambda t: v[round(t, 3)]), JointCommand.current(lambda t: i[round(t, 3)])),
        10.0,
    )
    predicted = Bench(*JOINTS).torque(current[:-1], velocity[:-1], acceleration[:-1])
    steady = np.abs(velocity[:-1]) > 0.5
    error = (table.joints[1].torque_nm - predicted)[steady]
    assert np.sqrt(np.mean(error**2)) < 1.5
    assert 0.7 < np.abs(table.joints[1].current_a).max() / LIMITS.joint_current_a < 1.1
    assert np.abs(table.joints[1].torque_nm).max() < LIMITS.torque_nm


# --- information ----------------------------------------------------------------------------------------------


def test_regressor_by_hand():
    v, tau = 0.5, -8.0  # turning forwards, driven backwards; tanh(25) = 1, exp(-100) = 0
    row = loss_regressor(np.array([v]), np.array([tau]))[0]
    expected = [1, 0.5, 0.25, 0, 0, 0, 0, 8, 64, 4] + [0] * 10
    assert row == pytest.approx(expected, abs=1e-12)
    row = loss_regressor(np.array([-0.02]), np.array([-8.0]))[0]  # backwards, driving
    s, peak = -math.tanh(1.0), math.exp(-0.16)
    expected = [0] * 10 + [s, 0.02 * s, -0.0004, s * peak, 8 * s, 64 * s, 0.16 * s, 0, 0, 0]
    assert row == pytest.approx(expected, abs=2e-4)
    assert row[10] == pytest.approx(s)


def test_one_design_serves_both_joints():
    """The other joint sees (-v, tau): the columns change places and signs, the determinant does not."""
    rng = np.random.default_rng(2)
    v, tau = rng.normal(size=(2, 1, 400)) * [[[2.0]], [[15.0]]]
    information = Information(3.0, 50.0)
    value = log_det(information.of(v, tau))
    assert log_det(information.of(-v, tau)) == pytest.approx(value, abs=1e-6)
    assert log_det(information.of(v, -tau)) == pytest.approx(value, abs=1e-6)


def test_scale_shifts_every_log_det_alike():
    rng = np.random.default_rng(2)
    v, tau = rng.normal(size=(2, 2, 400)) * [[[2.0]], [[15.0]]]
    one, two = (log_det(Information(*box).of(v, tau)) for box in ((3.0, 50.0), (2.0, 40.0)))
    assert one[0] - one[1] == pytest.approx(two[0] - two[1], abs=1e-5)


def test_information_is_that_of_least_squares():
    """Its inverse, unscaled, is the covariance of the coefficients for unit noise: compared with repeated fits."""
    rng = np.random.default_rng(5)
    v, tau = rng.uniform(-3.0, 3.0, 500), rng.uniform(-30.0, 30.0, 500)
    X = loss_regressor(v, tau)
    fits = np.linalg.lstsq(X, rng.normal(size=(500, 2000)), rcond=None)[0]
    scale = np.sqrt(np.mean(np.square(X), axis=0))
    spread = np.cov(fits * scale[:, None])
    information = Information(3.0, 30.0)
    own_scale = information._scale  # the box is the range of the data: the two agree to sampling
    M = information.of(v[None], tau[None])[0] * 500
    expected = np.linalg.inv(M)
    kept = np.diag(expected) < 0.5  # the narrow columns have a few samples only
    ratio = (np.diag(spread) / scale**2) / (np.diag(expected) / own_scale**2)
    assert kept.sum() > 15
    assert ratio[kept] == pytest.approx(np.ones(kept.sum()), rel=0.15)


def test_missing_quadrant_is_bad_but_finite():
    rng = np.random.default_rng(1)
    v, tau = rng.uniform(0.1, 3.0, (1, 500)), rng.uniform(-30.0, 30.0, (1, 500))
    information = Information(3.0, 30.0)
    signs = np.sign(rng.normal(size=(1, 500)))
    assert np.isfinite(log_det(information.of(v, tau))[0])
    assert log_det(information.of(v, tau))[0] < log_det(information.of(v * signs, tau))[0] - 100.0


# --- searches -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "evaluations", [1, 2, POPULATION - 1, POPULATION, POPULATION + 1, 2 * POPULATION, 1000]
)
def test_search_stays_within_its_evaluations_and_returns_the_best_of_them(evaluations):
    seen = []

    def criterion(genomes):
        assert np.abs(genomes).max() <= 1.0
        values = np.sum((genomes - 0.3) ** 2, axis=1)
        seen.extend(values)
        return values

    found = minimise(criterion, 6, evaluations=evaluations, rng=np.random.default_rng(0))
    if evaluations < 2 * POPULATION:
        assert len(seen) == min(POPULATION, evaluations)
    else:  # whole generations in the first nine tenths; the walk in the last one ends early where nothing is left to gain
        assert (1.0 - POLISHING) * evaluations - POPULATION < len(seen) <= evaluations
    assert found.value == min(seen)
    assert np.sum((found.genome - 0.3) ** 2) == pytest.approx(found.value)


def test_search_closes_in_on_a_minimum():
    """Of random points 2000 come to 1."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        found = minimise(lambda g: np.sum((g - 0.3) ** 2, axis=1), 12, evaluations=2000, rng=rng)
        assert found.value < 5e-4, f"seed {seed}"


def test_a_search_needs_scipy_and_a_draw_does_not(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert len(draw(LIMITS, count=1, duration_s=10.0)) == 1
    with pytest.raises(ConfigError, match="scipy is not installed: pip install"):
        design(LIMITS, **small())


def test_a_design_is_better_than_the_best_of_as_many_draws():
    problem = CoupledJoints(LIMITS, duration_s=10.0, harmonics=5)
    criterion = problem.criterion(np.zeros((1, 1)))
    rng = np.random.default_rng(0)
    drawn = min(criterion(rng.uniform(-1.0, 1.0, (200, problem.dimension))).min() for _ in range(5))
    found = minimise(criterion, problem.dimension, evaluations=1000, rng=np.random.default_rng(0))
    assert found.value < drawn - 4.0


def test_search_without_evaluations_is_refused():
    with pytest.raises(ValueError, match="0 evaluations"):
        minimise(lambda g: g[:, 0], 2, evaluations=0, rng=np.random.default_rng(0))


def small(**changes):
    whole = {"count": 2, "duration_s": 10.0, "harmonics": 3, "seed": 3, "evaluations": 120, "starts": 1}
    return whole | changes


def test_same_seed_same_runs_and_more_runs_begin_alike():
    once = design(LIMITS, **small())
    assert design(LIMITS, **small()) == once
    assert design(LIMITS, **small(count=3))[:2] == once
    assert design(LIMITS, **small(seed=4))[0] != once[0]
    assert once[0].segment != once[1].segment


def test_information_grows_with_every_run():
    runs = draw(LIMITS, count=4, duration_s=10.0, seed=1)
    values = [one.information_log_det for one in runs]
    assert values == sorted(values)
    assert values[0] < values[-1] - 10.0


def test_information_of_a_design_is_that_of_its_setpoints():
    runs = draw(LIMITS, count=2, duration_s=10.0, seed=1)
    total = 0.0
    for one in runs:
        _, _, velocity, acceleration, current = setpoints(one)
        torque = Bench(*JOINTS).torque(current, velocity, acceleration)
        box = Information(LIMITS.velocity_rad_s, LIMITS.torque_nm)
        total = total + box.of(velocity[None], torque[None])[0]
        assert one.information_log_det == pytest.approx(float(log_det(total)), abs=1e-6)


def test_later_runs_are_judged_with_those_before_them():
    problem = CoupledJoints(LIMITS, duration_s=10.0, harmonics=2)
    rng = np.random.default_rng(0)
    first, second = rng.uniform(-1.0, 1.0, (2, problem.dimension))
    before = problem.finish(first, np.zeros((1, 1)))[1]
    together = problem.finish(second, before)[1]
    value = problem.criterion(before)(second[None, :])[0]
    assert value == pytest.approx(-float(log_det(together)), abs=0.5)  # 20 Hz against 1 kHz
    assert value < problem.criterion(np.zeros((1, 1)))(second[None, :])[0] - 10.0


def test_search_beats_drawing_and_more_starts_do_not_lose():
    def found(seed, **options):
        (one,) = design(LIMITS, count=1, duration_s=10.0, seed=seed, **options)
        return -one.information_log_det

    drawn = [found(seed, evaluations=1) for seed in range(5)]
    one, three = (found(0, evaluations=400, starts=starts) for starts in (1, STARTS))
    assert three < one < np.median(drawn) - 10.0


def test_velocity_and_current_never_repeat_together():
    (one,) = draw(LIMITS, count=1, duration_s=20.0)
    assert one.segment.velocity.omega_rad_s / one.segment.current.omega_rad_s == pytest.approx(GOLDEN)
    assert one.segment.velocity.omega_rad_s * 20.0 / (2.0 * math.pi) == pytest.approx(2.0)  # whole periods


def test_progress_counts_every_evaluation():
    seen = []
    design(LIMITS, **small(starts=2), on_progress=seen.append)
    slope = 2 * 3 * 2 + 1 + 1  # the remaining evaluations are too few for one more: motions of 13 genes
    assert 2 * 2 * (120 - slope) < sum(seen) <= 2 * 2 * 120


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count: found 0, expected 1 to 1000"),
        ({"duration_s": 0.5}, "duration_s: found 0.5, expected 1 to 600"),
        ({"duration_s": math.nan}, "duration_s: found nan"),
        ({"harmonics": 51}, "harmonics: found 51, expected 1 to 50"),
        ({"evaluations": 0}, "evaluations: found 0"),
        ({"starts": 0}, "starts: found 0"),
    ],
)
def test_arguments_out_of_range_are_refused(change, message):
    with pytest.raises(ConfigError) as refused:
        design(LIMITS, **small(**change))
    assert str(refused.value).startswith(message)


def test_segment_mapping_is_what_a_plan_reads(tmp_path):
    (one,) = design(ExcitationLimits(), count=1, duration_s=10.0, seed=2, evaluations=1)
    mapping = segment_mapping(one.segment)
    assert mapping["kind"] == "fourier"
    assert mapping["duration_s"] == 10.0
    run = {"name": "one", "velocity_joint": 2, "segments": [yaml.safe_load(yaml.safe_dump(mapping))]}
    plan = Plan.from_mapping({"schema": "jtq.plan/1", "name": "test", "runs": [run]}, "test")
    assert plan.runs[0].segments == (one.segment,)


def test_command_writes_a_plan_of_what_it_prints(tmp_path, capsys):
    out = tmp_path / "new" / "excitation.plan.yaml"
    arguments = ["--count", "2", "--duration", "8", "--evaluations", "60", "--velocity-joint", "2"]
    assert excitation_command.main([*arguments, "--json", "--out", str(out)]) == 0
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert captured.err == f"jtq excitation: wrote {out}\n"
    plan = load_plan(out)
    assert [run.velocity_joint for run in plan.runs] == [2, 2]
    for run, printed in zip(plan.runs, result["runs"], strict=True):
        rest, motion, again = run.segments
        assert rest == again
        assert rest.hold_s == 1.0
        segment = printed["segment"]
        velocity, current = segment["velocity"], segment["current"]
        assert motion.velocity == FourierTrajectory(
            velocity["omega_rad_s"], tuple(velocity["a"]), tuple(velocity["b"]), 8.0
        )
        assert motion.current == FourierSeries(
            current["omega_rad_s"], tuple(current["a"]), tuple(current["b"]), 8.0, current["offset_a"]
        )
        assert printed["peaks"]["velocity_rad_s"] == pytest.approx(3.0)
    assert excitation_command.main(arguments) == 0
    assert len(capsys.readouterr().out.splitlines()) == 4


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--duration", "0.5"], 1, "duration_s: found 0.5, expected 1 to 600"),
        (["--velocity", "99", "--out", "plan.yaml"], 1, "--velocity: found 99, expected at most"),
        (["--joint-current", "99", "--out", "plan.yaml"], 1, "--joint-current: found 99, expected at most"),
        (["--joints", "none1.yaml", "none2.yaml"], 1, "none1.yaml: cannot be read"),
    ],
)
def test_command_refuses_in_one_line(arguments, status, message, capsys, tmp_path):
    arguments = [str(tmp_path / word) if word == "plan.yaml" else word for word in arguments]
    assert excitation_command.main(arguments) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith(f"jtq excitation: {message}")
    assert captured.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_command_without_scipy_refuses_in_one_line(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert excitation_command.main(["--count", "1", "--evaluations", "100"]) == 1
    assert capsys.readouterr().err == "jtq excitation: scipy is not installed: pip install 'jtqd[analysis]'\n"


@pytest.mark.parametrize("value", ["nan", "0", "-1", "many", "1e23"])
def test_numbers_without_sense_are_usage_errors(value, capsys):
    with pytest.raises(SystemExit) as refused:
        excitation_command.main([f"--torque={value}"])
    assert refused.value.code == 2
    assert f"argument --torque: found {value!r}, expected a number > 0" in capsys.readouterr().err
