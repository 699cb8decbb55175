"""Plateaus: found where a run had settled and nowhere else, averaged without ripple, with honest standard errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.run import JointColumns
from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import emulate_run
from jtqd.sim_can.plant_file import load_plant
from jtqd.sysid.fit.plateaus import (
    FitError,
    Mean,
    Plateau,
    PlateauError,
    cut_cells,
    effective_samples,
    find_plateaus,
    fit_no_load,
    means_between,
    no_load,
    standard_error,
    student_975,
)
from jtqd.sysid.runs.channels import integral
from tests.estimator.estimator_helpers import joint1
from tests.sysid.campaign_helpers import plateau_run
from tests.sysid.runs.spoiled_runs import drawn

JOINT = joint1()
NM_PER_A = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a
DT_S = 0.001


def coloured(rng: np.random.Generator, count: int, sigma: float, memory_s: float) -> FloatArray:
    """Noise of standard deviation sigma whose autocorrelation falls by e within memory_s; white for 0."""
    white = rng.normal(size=count + 3000)
    if memory_s == 0.0:
        return sigma * white[3000:]
    keep = math.exp(-DT_S / memory_s)
    noise: FloatArray = lfilter([math.sqrt(1.0 - keep * keep)], [1.0, -keep], white)[3000:]
    return sigma * noise


def staircase(
    steps: list[tuple[float, float, float]], *, hold_s: float = 2.0, settle_s: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Time, velocity [rad/s], current [A], torque [Nm]: a smooth ramp of 0.4 s to each (v, i, tau), then a hold.

    settle_s: the load approaches its value within the hold with this time constant, from 5 Nm away.
    """
    x = np.linspace(0.0, 1.0, 400, endpoint=False)
    rise = x**3 * (10.0 + x * (6.0 * x - 15.0))
    rows, last = [], np.zeros(3)
    for step in steps:
        share = np.concatenate((rise, np.ones(round(hold_s / DT_S))))[:, None]
        block = last + share * (np.array(step) - last)
        if settle_s:
            tail = 5.0 * np.exp(-np.arange(len(block) - 400) * DT_S / settle_s)
            block[400:, 2] += tail
            block[400:, 1] += tail / NM_PER_A
        rows.append(block)
        last = np.array(step)
    v, i, tau = np.concatenate(rows).T
    return DT_S * np.arange(len(v)), v, i, tau


def columns(v: FloatArray, i: FloatArray, tau: FloatArray) -> JointColumns:
    return JointColumns(current_a=i, motor_velocity_rad_s=100.0 * v, torque_nm=tau)


def with_ripple(time_s: FloatArray, v: FloatArray, tau: FloatArray, amplitude: float) -> FloatArray:
    return tau + amplitude * np.cos(2.0 * integral(time_s, 100.0 * v) + 0.4)


STEPS = [(0.2, 1.5, 4.0), (0.2, 3.0, 11.0), (1.0, 3.0, 10.0), (-1.8, -4.0, -15.0), (3.0, 6.0, 25.0)]


def check(found: list[Plateau], steps: list[tuple[float, float, float]], errors: float = 4.0) -> None:
    assert len(found) == len(steps)
    for plateau, (v, i, tau) in zip(found, steps, strict=True):
        for mean, truth, floor in (
            (plateau.velocity, v, 1e-4),
            (plateau.current, i, 1e-4),
            (plateau.torque, tau, 1e-3),
        ):
            assert abs(mean.value - truth) <= errors * mean.se + floor


@pytest.mark.parametrize("seed", range(4))
def test_all_holds_are_found_with_ripple_noise_and_quantisation(seed: int) -> None:
    print("seed", seed)
    rng = np.random.default_rng(seed)
    time_s, v, i, tau = staircase(STEPS)
    n = len(v)
    count = 2.0 * math.pi / 65536 / DT_S / 100.0
    run = columns(
        np.round((v + 0.002 * rng.normal(size=n)) / count) * count,
        np.round((i + 0.02 * rng.normal(size=n)) / 0.008) * 0.008,
        np.round((with_ripple(time_s, v, tau, 0.6) + coloured(rng, n, 0.1, 0.01)) / 0.001) * 0.001,
    )
    found = find_plateaus(time_s, run, JOINT, "run")
    check(found, STEPS)
    for k, plateau in enumerate(found):
        assert k * 2.4 + 0.25 < plateau.start_s < k * 2.4 + 0.65  # at the ramp's end or a cell later
        assert (k + 1) * 2.4 - 0.25 < plateau.end_s < (k + 1) * 2.4 + 0.15
        assert plateau.run == "run"
        assert math.isnan(plateau.temperature_c)


def test_what_is_left_of_the_settling_is_cut_off() -> None:
    time_s, v, i, tau = staircase(STEPS, settle_s=0.12)
    found = find_plateaus(time_s, columns(v, i, tau), JOINT)
    check(found, STEPS, errors=6.0)
    assert all(abs(p.torque.value - tau) < 0.02 for p, (_, _, tau) in zip(found, STEPS, strict=True))
    # The whole holds would be wrong by 5 Nm * 0.12 s / 2 s on average.
    assert np.mean(tau[:2400][400:]) > 4.2


@pytest.mark.parametrize("speed", [0.07, 0.2, 0.6, 1.37, 3.0, -0.2, -2.6])
def test_a_mean_over_cells_does_not_contain_the_ripple(speed: float) -> None:
    rng = np.random.default_rng(3)
    steps = rng.uniform(0.0005, 0.0015, 4000)  # uneven time
    time_s = np.cumsum(steps)
    omega = np.full(4000, 100.0 * speed)
    ripple = np.cos(2.0 * integral(time_s, omega) + rng.uniform(0.0, 6.0))
    cells = cut_cells(time_s, (ripple,), omega)
    assert cells.usable.all() or not cells.usable[-1]
    # what is left is the edges' interpolation within a sample: far below the mean over the same time cut anywhere
    assert np.max(np.abs(cells.means[cells.usable, 0])) < 0.01
    assert np.all(cells.end_s[cells.usable] - cells.start_s[cells.usable] >= 0.1 - 1e-9)
    if abs(speed) <= 0.2:
        starts = np.linspace(0.3, 2.3, 40)
        assert np.max(np.abs(means_between(time_s, ripple, starts, starts + 0.1))) > 0.15


TIME = DT_S * np.arange(6000)
FLAT, SWING = np.ones(6000), np.sin(2.0 * math.pi * 0.5 * TIME)
CREEP = 0.001 * np.random.default_rng(0).normal(size=6000)


@pytest.mark.parametrize(
    ("v", "i", "tau", "words"),
    [
        (
            FLAT,
            3.0 + SWING,
            15.0 + 10.0 * SWING,
            r"x: found no settled plateau \(longest settled stretch 0.\d+ s\)",
        ),
        (FLAT, 2.0 + 0.5 * TIME, 12.0 * FLAT, "no settled plateau"),  # beside a stuck torque
        (1.0 + 0.3 * SWING, 3.0 * FLAT, 12.0 * FLAT, "no settled plateau"),
        *((speed + CREEP, FLAT, 3.0 * FLAT, r"moves at 0.05 rad/s") for speed in (0.0, 0.01, 0.03)),
        (FLAT[:50], FLAT[:50], FLAT[:50], r"longest settled stretch 0.00 s"),
    ],
    ids=["load", "current", "velocity", "still", "0.01", "creeping", "shorter than a cell"],
)
def test_what_moves_and_what_hardly_moves_is_no_plateau(
    v: FloatArray, i: FloatArray, tau: FloatArray, words: str
) -> None:
    with pytest.raises(PlateauError, match=words):
        find_plateaus(TIME[: len(v)], columns(v, i, tau), JOINT, "x")


@pytest.mark.parametrize("seed", range(3))
def test_swings_of_any_size_and_period_under_noise_are_no_plateaus(seed: int) -> None:
    """A swing may not be taken for noise that widens the band: whatever is found moved by little more than the band."""
    print("seed", seed)
    rng = np.random.default_rng(seed)
    time_s = DT_S * np.arange(10000)
    for _ in range(8):
        period_s, amplitude = rng.uniform(1.5, 8.0), rng.uniform(3.0, 15.0)
        tau = 18.0 + amplitude * np.sin(2.0 * math.pi * time_s / period_s)
        run = columns(np.full(10000, rng.uniform(0.2, 3.0)), tau / 4.0, tau + 0.05 * rng.normal(size=10000))
        try:
            found = find_plateaus(time_s, run, JOINT)
        except PlateauError:
            continue
        for plateau in found:
            inside = (time_s >= plateau.start_s) & (time_s <= plateau.end_s)
            assert np.ptp(tau[inside]) < 0.02 * JOINT.rated_torque_nm


def test_neighbours_that_differ_little_are_two_plateaus() -> None:
    steps = [(1.0, 3.0, 10.0), (1.0, 3.1, 10.6), (1.03, 3.1, 10.6)]
    time_s, v, i, tau = staircase(steps)
    check(find_plateaus(time_s, columns(v, i, with_ripple(time_s, v, tau, 0.4)), JOINT), steps, errors=6.0)


def test_a_noisy_sensor_widens_the_band_and_the_standard_error() -> None:
    rng = np.random.default_rng(11)
    time_s, v, i, tau = staircase(STEPS)
    noisy = find_plateaus(time_s, columns(v, i, tau + coloured(rng, len(v), 1.0, 0.02)), JOINT)
    quiet = find_plateaus(time_s, columns(v, i, tau + coloured(rng, len(v), 0.01, 0.02)), JOINT)
    check(noisy, STEPS)
    check(quiet, STEPS)
    # 1 Nm with a memory of 20 ms over 2 s: n_eff = 2/(2 * 0.02) = 50
    assert np.mean([p.torque.se for p in noisy]) == pytest.approx(1.0 / math.sqrt(50.0), rel=0.4)
    assert np.mean([p.torque.se for p in quiet]) < 0.005


def test_a_short_hold_is_found_only_when_asked_for() -> None:
    steps = [(1.0, 3.0, 10.0), (1.0, 4.0, 15.0)]
    time_s, v, i, tau = staircase(steps, hold_s=0.42)
    with pytest.raises(PlateauError, match=r"constant for 0.5 s"):
        find_plateaus(time_s, columns(v, i, tau), JOINT)
    # the last cell of the first hold reaches into the ramp, so what is left of the hold is shorter
    check(find_plateaus(time_s, columns(v, i, tau), JOINT, shortest_s=0.3), steps, errors=6.0)


@pytest.mark.parametrize(
    ("memory_s", "samples", "highest"),
    [(0.0, 500, 1.15), (0.0, 2000, 1.15), (0.003, 500, 1.3), (0.02, 2000, 1.3), (0.05, 1000, 1.55)],
)
def test_standard_errors_hold_for_coloured_noise_under_ripple(
    memory_s: float, samples: int, highest: float
) -> None:
    """Error of the mean in units of its standard error: 1 is right; sqrt(n) would claim 2.5 to 10 of them."""
    rng = np.random.default_rng(5)
    errors, naive = [], []
    for _ in range(120):
        noise = coloured(rng, samples, 0.3, memory_s)
        angle = 100.0 * DT_S * np.arange(samples)
        seen = noise + 0.4 * np.cos(2.0 * angle + rng.uniform(0.0, 6.0))
        errors.append(noise.mean() / standard_error(seen, angle))
        naive.append(noise.mean() / (noise.std() / math.sqrt(samples)))
    assert 0.8 < np.std(errors) < highest
    if memory_s > 0.0:
        assert np.std(naive) > 2.2


def test_a_channel_that_does_not_dither_is_known_to_its_resolution() -> None:
    angle = np.linspace(0.0, 100.0, 1000)
    still = np.full(1000, 4.0)
    still[::100] = 4.008
    assert standard_error(still, angle) == pytest.approx(0.008 / math.sqrt(12.0))
    assert standard_error(np.full(1000, 4.0), angle) == 0.0


def test_missing_columns_are_named() -> None:
    time_s, v, i, tau = staircase(STEPS)
    run = replace(columns(v, i, tau), torque_nm=None, current_a=None)
    with pytest.raises(PlateauError, match=r"day1.csv: found no current_a, torque_nm, expected"):
        find_plateaus(time_s, run, JOINT, "day1.csv")


def test_emulated_holds_of_the_shipped_bench() -> None:
    """Noise, quantisation, ripple of both joints, elastic transmission: one plateau per hold, inside the hold."""
    points = [(v, i) for v in (0.2, 1.0, 3.0) for i in (0.0, 2.0, 4.0)]
    table = plateau_run(load_plant(shipped("plant.yaml")), points, hold_s=1.0, ramp_s=0.3)
    for number, sign in ((1, 1.0), (2, -1.0)):
        found = find_plateaus(table.time_s, table.joint(number, 100.0), JOINT)
        assert len(found) == len(points)
        for k, (plateau, (speed, _)) in enumerate(zip(found, points, strict=True)):
            assert plateau.velocity.value == pytest.approx(sign * speed, rel=2e-3)
            # a smooth ramp's last fifth moves by less than the band
            assert 1.3 * k + 0.2 < plateau.start_s < plateau.end_s < 1.3 * (k + 1) + 0.15
    currents = [p.current.value for p in find_plateaus(table.time_s, table.joint(2, 100.0), JOINT)]
    assert currents == pytest.approx([i for _, i in points], abs=5e-3)


def test_a_random_motion_never_settles() -> None:
    table = emulate_run(load_plant(shipped("plant.yaml")), drawn(2, 20.0), 20.0, 2)
    with pytest.raises(PlateauError, match="no settled plateau"):
        find_plateaus(table.time_s, table.joint(1, 100.0), JOINT)


# Friction at no load ------------------------------------------------------------------------------------


def idle(friction: Friction, zero_nm: float, noise: float, velocities: list[float]) -> list[Plateau]:
    rng = np.random.default_rng(4)
    loss = FrictionModel(friction).torque_many(np.array(velocities))
    return [
        Plateau(
            "r", 0.0, 1.0, Mean(v, 0.0), Mean(0.0, 0.0), Mean(-f - zero_nm + noise * rng.normal(), 0.0), 9
        )
        for v, f in zip(velocities, loss.tolist(), strict=True)
    ]


BOTH = [s * v for v in (0.2, 0.6, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0) for s in (1.0, -1.0)]


def test_friction_at_no_load_is_separated_from_the_offset_of_the_sensor() -> None:
    truth = Friction(3.7, 1.4, stribeck_nm=0.8, stribeck_velocity_rad_s=0.05)
    fit = fit_no_load(idle(truth, 0.35, 0.05, BOTH), joint1())
    values = {term.name: term for term in fit.terms}
    for name, expected in (("coulomb_nm", 3.7), ("viscous_nms_per_rad", 1.4), ("zero_nm", 0.35)):
        assert abs(values[name].value - expected) < 1.5 * values[name].ci95
        assert values[name].ci95 < 0.1
    assert fit.rmse_nm < 0.08
    assert fit.warnings == ()
    assert fit.friction.stribeck_nm == joint1().friction.stribeck_nm


def test_one_direction_warns_and_what_drives_is_refused() -> None:
    fit = fit_no_load(idle(Friction(3.0, 2.0), 0.0, 0.0, BOTH[::2]), joint1())
    assert "one direction" in fit.warnings[0]
    assert [term.name for term in fit.terms] == ["coulomb_nm", "viscous_nms_per_rad"]
    with pytest.raises(FitError, match="found 2 velocities at no load"):
        fit_no_load(idle(Friction(3.0, 2.0), 0.0, 0.0, [0.2, -0.2, 1.0]), joint1())
    wrong = [replace(p, torque=Mean(-p.torque.value, 0.0)) for p in idle(Friction(3.0, 2.0), 0.0, 0.0, BOTH)]
    with pytest.raises(FitError, match="expected a friction >= 0: swapped sign"):
        fit_no_load(wrong, joint1())


def test_no_load_is_no_current_or_no_torque() -> None:
    def at(i: float, tau: float) -> Plateau:
        return Plateau("r", 0.0, 1.0, Mean(1.0, 0.0), Mean(i, 0.0), Mean(tau, 0.0), 9)

    plateaus = [at(0.0, -8.0), at(0.6, -6.0), at(0.9, 1.9), at(1.2, 3.0), at(5.0, 25.0)]
    assert no_load(plateaus, joint1(), 0.61) == plateaus[:3]


def test_effective_samples_of_white_and_of_correlated_noise() -> None:
    random_ = np.random.default_rng(1)
    white = random_.normal(size=20000)
    assert effective_samples(white) == pytest.approx(20000, rel=0.1)
    # rho = 0.9 from sample to sample: n (1 - rho)/(1 + rho) = n/19
    keep = -DT_S / math.log(0.9)
    noise = coloured(random_, 20000, 1.0, keep)
    assert effective_samples(noise) == pytest.approx(20000 / 19.0, rel=0.15)


@pytest.mark.parametrize(
    ("freedom", "value"), [(3, 3.182), (5, 2.571), (10, 2.228), (30, 2.042), (1000, 1.962)]
)
def test_student_quantile_against_the_table(freedom: float, value: float) -> None:
    assert student_975(freedom) == pytest.approx(value, rel=0.02)
