"""The time base: uneven and jittering stamps, positions that roll over, channels that are late."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs import checks
from jtqd.sysid.runs.checks import on_even_steps, skew_s, unwrapped
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.runs.spoiled_runs import JOINTS, bench, checked, column, each_column, having


@pytest.fixture(scope="module")
def run():
    return bench()


def test_uneven_time_is_brought_to_equal_steps(run):
    """Straight lines survive a linear interpolation exactly, sines to their curvature."""
    kept = np.sort(np.random.default_rng(31).choice(len(run.time_s), 17000, replace=False))
    table = each_column(run, lambda x: x[kept])
    t = table.time_s
    line = RunTable(t, {1: JointColumns(current_a=3.0 * t - 1.0, torque_nm=np.sin(2.0 * t))})
    even, notes = on_even_steps(line, "r")
    assert np.ptp(np.diff(even.time_s)) < 1e-9
    assert "equal steps" in notes[0].text
    assert np.allclose(column(even, "current_a"), 3.0 * even.time_s - 1.0, atol=1e-9)
    curvature = 0.5 * 0.004**2 * 4.0
    assert np.max(np.abs(column(even, "torque_nm") - np.sin(2.0 * even.time_s))) < curvature
    result = checked(table)
    assert result.refused == ()
    assert len(result.notes) == 1


def swing(time_s: np.ndarray[tuple[int], np.dtype[np.float64]]) -> RunTable:
    """A joint that swings, with an encoder's rounding, sampled at these times."""
    position = np.round(80.0 * np.sin(2.0 * time_s) / 1e-4) * 1e-4
    return RunTable(time_s, {1: JointColumns(motor_position_rad=position, current_a=np.cos(2.0 * time_s))})


@pytest.mark.parametrize("jitter", [1e-4, 4e-4])
def test_jitter_of_the_samples_is_no_jitter_of_stamps(jitter):
    t = 1e-3 * np.arange(8000) + jitter * np.sin(np.arange(8000.0))
    table, notes = on_even_steps(swing(t), "r")
    if jitter < 2e-4:
        assert (table.time_s.tolist(), notes) == (t.tolist(), [])
    else:
        assert "resampled to equal steps" in notes[0].text


@pytest.mark.parametrize(
    ("spread", "digits"), [(8e-5, 9), (4e-4, 9), (5e-4, 3)], ids=["small", "large", "ms"]
)
def test_stamps_that_jitter_where_the_samples_do_not_are_corrected(spread, digits):
    """A computer's stamps, or rounded to milliseconds: by them a motor at 160 rad/s would jump by 0.1 rad."""
    rng = np.random.default_rng(4)
    step = 1e-3 if spread < 1e-4 else 4e-3
    true = step * np.arange(6000)
    kept = np.sort(rng.choice(6000, 5950, replace=False))  # and rows are missing
    stamps = np.round(true[kept] + spread * np.clip(rng.normal(size=len(kept)), -3.0, 3.0), digits)
    even, notes = on_even_steps(RunTable(stamps, swing(true[kept]).joints), "r")
    assert "the stamps jitter, not the samples; equal steps used" in notes[0].text
    position = column(even, "motor_position_rad")
    assert len(position) == pytest.approx(6000, abs=3)
    whole = 80.0 * np.sin(2.0 * (even.time_s - stamps[0] + true[kept][0]))
    assert np.sqrt(np.mean((position - whole) ** 2)) < 160.0 * 1e-3, "a fraction of a step"
    rough = float(np.std(np.diff(position, 4)))
    assert rough < 0.1 * float(np.std(np.diff(80.0 * np.sin(2.0 * stamps), 4))) + 2e-3


@pytest.mark.parametrize("name", ["link_position_rad", "motor_position_rad"])
def test_positions_that_roll_over_are_made_continuous(run, name):
    position = column(run, name)
    rolled = np.mod(position - np.mean(position), 2.0 * math.pi)
    table, notes = unwrapped(having(run, **{name: rolled}), "r")
    assert len(notes) == 1
    again = column(table, name)
    assert np.max(np.abs((again - again[0]) - (position - position[0]))) < 1e-9
    assert unwrapped(run, "r") == (run, [])


@pytest.mark.parametrize("speed", [40.0, 300.0])
def test_a_fast_motor_rolls_over_in_many_rows(speed):
    """At 250 Hz a motor at 300 rad/s has five rows to a turn: every fifth step is a jump."""
    t = 0.004 * np.arange(3000)
    position = speed * np.sin(t)
    table = RunTable(t, {1: JointColumns(motor_position_rad=np.mod(position, 2.0 * math.pi))})
    made, notes = unwrapped(table, "r")
    again = column(made, "motor_position_rad")
    assert np.allclose(again - again[0], position - position[0])
    assert "found it rolling over by 6.283 rad" in notes[0].text
    degrees = RunTable(t, {1: JointColumns(motor_position_rad=np.rad2deg(position))})
    assert unwrapped(degrees, "r")[1] == []


@pytest.mark.parametrize("late", [-300, -40, 25, 60, 250])
def test_skew_is_measured_against_current_and_motion(run, late):
    """late rows of 1 ms; rolled around the ends, which are 1.5 % of the run."""
    table = having(run, torque_nm=np.roll(column(run, "torque_nm"), late))
    assert skew_s(table, 1, JOINTS[1]) == pytest.approx(late / 1000, abs=0.006)
    result = checked(table)
    assert any("skew" in line for line in (result.refused if abs(late) >= 100 else result.notes))
    assert bool(result.refused) == (abs(late) >= 100)


def test_channels_in_step_have_no_skew(run):
    assert [skew_s(run, number, JOINTS[number]) for number in (1, 2)] == [0.0, 0.0]


@pytest.mark.parametrize(("least", "late_s"), [(0.02, 0.105), (0.031, None)])
def test_a_shift_counts_where_it_halves_the_residual(monkeypatch, least, late_s):
    """0.051 in step and 0.031 after 0.105 s come from slow motions with stiction, whose channels are in step."""
    t = np.arange(0.0, 20.0, 1e-3)
    velocity = np.sin(t)
    columns = JointColumns(current_a=velocity, motor_velocity_rad_s=100.0 * velocity, torque_nm=np.cos(t))

    def residual_shares(_q: object, _y: object, shifts: int) -> np.ndarray:
        curve = np.full(shifts, 0.051)
        curve[shifts // 2 + 21] = least
        return curve

    monkeypatch.setattr(checks, "_residual_shares", residual_shares)
    found = checks.skew_s(RunTable(t, {1: columns}), 1, PLAIN)
    assert found == (late_s if late_s is None else pytest.approx(late_s))
