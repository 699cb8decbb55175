"""Section `fused.standstill`: calibrated on runs left out, and an interval that holds stops, starts and pushes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator import status as st
from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.estimator import FusedEstimator
from jtqd.estimator.joint import Joint
from jtqd.estimator.observer import low_pass
from jtqd.estimator.settings import bandwidth_of, recommended
from jtqd.models.files import load_joint, shipped
from jtqd.sim_can.emulated_run import EmulatedRun, JointCommand, Push, emulate
from jtqd.sysid.fit.calibration import FEWEST_RUNS, Standing, beyond_normal, fit_standstill
from jtqd.sysid.fit.fused import fit_fused
from jtqd.sysid.fit.signals import run_signals
from tests.sysid.fit.fused_signals import FUSED, campaign_plant

Draw = Callable[[np.random.Generator], float]


def day(error_nm: float, source: np.random.Generator, count: int = 60) -> Standing:
    """One run at rest: an error that all its samples share, a bit of noise, sd 0.5 Nm."""
    errors = error_nm + 0.05 * source.normal(size=count)
    return Standing(errors, np.full(count, 0.5), np.zeros(count), np.ones(count, bool))


def sigmas(runs: list[Standing]) -> float:
    found = fit_standstill(runs)
    assert found is not None
    return found.sigmas


@pytest.mark.parametrize("runs", [FEWEST_RUNS, 11, 32])
@pytest.mark.parametrize(
    ("draw", "least"),
    [
        (lambda source: 0.5 * source.normal(), 0.94),
        (lambda source: 0.5 * source.standard_t(4), 0.92),
    ],
    ids=["normal", "heavy"],
)
def test_days_that_no_run_was_of_are_held(runs: int, draw: Draw, least: float) -> None:
    """Every run is one error: of few runs the factor is larger, and holds other days as often, or nearly."""
    source = np.random.default_rng(5)
    found = [sigmas([day(draw(source), source) for _ in range(runs)]) for _ in range(960 // (runs + 16))]
    others = np.abs([draw(source) for _ in range(4000)])
    held = np.mean([np.mean(others <= 0.5 * k) for k in found])
    assert least < held < 0.99


def test_few_normal_errors_ask_for_more_room() -> None:
    """Tables of Student's t and of normal tolerance factors, mean known (90 % of all with 95 % confidence)."""
    assert [beyond_normal(n) for n in (6, 11, 32)] == pytest.approx([3.15, 2.55, 2.077], rel=2e-3)
    assert beyond_normal(10_000) == pytest.approx(1.96, rel=1e-3)


def test_many_runs_need_no_room_for_their_number() -> None:
    source = np.random.default_rng(6)
    days = [day(0.5 * float(error), source) for error in np.linspace(-1.7, 1.7, 100)]  # uniform: RMS 0.99
    assert sigmas(days) == pytest.approx(1.98, rel=0.04)


def test_the_zero_of_the_sensor_is_no_error_of_the_joint_and_hides_none() -> None:
    """With a sensor whose zero is three times the joint's own error the factor is as without, but for what few runs tell."""
    source = np.random.default_rng(9)

    def campaign(own_nm: float, zero_nm: float, runs: int) -> float:
        days = [day(own_nm * source.normal() + zero_nm * source.normal(), source) for _ in range(runs)]
        found = fit_standstill(days, zero_nm)
        assert found is not None
        return found.sigmas

    assert 1.8 < np.mean([campaign(0.5, 1.5, 40) for _ in range(15)]) < 3.5
    assert np.mean([campaign(1.5, 1.5, 40) for _ in range(15)]) > 5.0
    assert np.mean([campaign(0.5, 1.5, 10) for _ in range(15)]) > 2.2


def test_what_is_left_open_is_no_deviation() -> None:
    source = np.random.default_rng(7)
    runs = [day(0.5 * source.normal(), source, 120) for _ in range(12)]
    beyond = [
        run._replace(error_nm=run.error_nm + 3.0 * np.sign(run.error_nm), bound_nm=run.bound_nm + 3.0)
        for run in runs
    ]
    assert sigmas(beyond) == pytest.approx(sigmas(runs))
    # samples whose slip is unknown count for nothing, whatever their error
    unknown = np.arange(120) < 60
    assert sigmas(
        [run._replace(known=~unknown, error_nm=np.where(unknown, 50.0, run.error_nm)) for run in runs]
    ) == pytest.approx(sigmas(runs), rel=0.05)


def test_too_few_stops_tell_nothing_and_a_small_error_not_all() -> None:
    source = np.random.default_rng(8)
    few = [day(0.1, source) for _ in range(FEWEST_RUNS - 1)]
    assert fit_standstill(few) is None
    short = day(0.1, source, count=10)
    assert fit_standstill([*few, short]) is None
    assert sigmas([day(0.001, source) for _ in range(8)]) == 1.0


# ---- on the emulated bench: fitted to short runs that end in a stop, judged on other days


STOP_S = 3.0


def stopping(seed: int, number: int, pushes: tuple[Push, ...] = (), seconds: float = 4.2) -> EmulatedRun:
    """A run whose joints come to rest at STOP_S, one driven by velocity, the other by current."""
    source = np.random.default_rng([seed, number])
    speed, rate, load, other = source.uniform((0.8, 2.0, 1.0, 2.0), (2.2, 3.5, 4.0, 4.0)).tolist()

    def ending(t: float) -> float:
        return min(1.0, max(0.0, 3.0 * (STOP_S - t)))

    commands = (
        JointCommand.velocity(lambda t: ending(t) * speed * math.sin(rate * t)),
        JointCommand.current(lambda t: ending(t) * load * math.sin(other * t + 0.5)),
    )
    turned = commands if number % 2 == 0 else (commands[1], commands[0])
    return emulate(campaign_plant(), turned, seconds, seed, day=number, pushes=pushes)


@pytest.fixture(scope="module")
def joint() -> Joint:
    one = load_joint(shipped("joint1.yaml"))
    signals = []
    for number in range(10):
        table = stopping(7100, number).table
        signals.append(run_signals(f"run {number}", one, FUSED, table.time_s, table.joints[1]))
    return replace(one, fused=fit_fused(signals, one.friction, one.rated_torque_nm).fused)


def at_rest(joint: Joint, run: EmulatedRun, first: int = 0) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Estimate joint 1 from sample `first` on; half intervals, where they hold the torque, true torque: after the stop."""
    settings = recommended("fused")
    table, truth = run.table, np.ascontiguousarray(run.joint_torque_nm[first:, 0])
    inputs = [column[first:] for column in table.estimator_inputs(1, joint.gear_ratio)[1:]]
    temperature = table.joints[1].temperature_c
    dt = table.dt_s[first:]
    got = FusedEstimator(joint, settings).run(
        dt, *inputs, None if temperature is None else temperature[first:]
    )
    rest = (got.status == st.STANDSTILL) & (table.time_s[first:] > STOP_S + 0.3)
    error = got.torque_nm - low_pass(truth, dt, bandwidth_of(joint, settings))
    inside: BoolArray = np.abs(error) <= got.sigma_nm
    return got.sigma_nm[rest], inside[rest], truth[rest]


def test_the_fit_writes_the_section_and_stops_are_held_more_narrowly(joint: Joint) -> None:
    assert joint.fused is not None
    assert joint.fused.standstill is not None
    wide = replace(joint, fused=replace(joint.fused, standstill=replace(joint.fused.standstill, sigmas=6.0)))
    held, ratio = [], []
    for number in range(8):
        run = stopping(7101, number)
        half, inside, _ = at_rest(joint, run)
        assert len(half) > 500
        held.append(inside.mean())
        ratio.append(half.mean() / at_rest(wide, run)[0].mean())
    assert np.mean(held) > 0.93
    assert max(ratio) < 0.75


def test_a_start_at_rest_is_held_wherever_the_slip_stands(joint: Joint) -> None:
    """The estimator begins in the stop: what the hysteresis holds is unknown, and the interval larger by that."""
    held = []
    assert joint.fused is not None
    undoubted = replace(joint, fused=replace(joint.fused, agreement=None))
    for number in range(6):
        run = stopping(7102, number)
        start = round(1000 * STOP_S) + 150
        _, inside, _ = at_rest(joint, run, first=start)
        half, later = (at_rest(undoubted, run, first=first)[0] for first in (start, 0))
        assert half.mean() > later.mean()
        held.append(inside.mean())
    assert np.mean(held) > 0.93


def test_a_push_from_outside_is_held_though_the_current_does_not_see_it(joint: Joint) -> None:
    held = []
    for number in range(6):
        pushes = tuple(Push(STOP_S + 0.6 + 0.4 * k, torque) for k, torque in enumerate((4.0, -6.0, 9.0)))
        _, inside, torque = at_rest(joint, stopping(7103, number, pushes, 4.8))
        assert np.ptp(torque) > 3.0
        held.append(inside.mean())
    assert np.mean(held) > 0.93
