"""Channels before a diagnosis: contradictions left out, oddities noted, good runs untouched."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import emulate_run
from jtqd.sim_can.plant_file import load_plant, plant_of_joint
from jtqd.sysid.runs.bad_samples import outlier_rows, without_outliers
from jtqd.sysid.runs.checks import check_runs
from jtqd.sysid.runs.time_base import on_even_steps, skew_s, unwrapped
from tests.sysid.runs.spoiled_runs import (
    ANGLES,
    JOINTS,
    Change,
    bench,
    changed,
    checked,
    each_column,
    motion,
    times,
)


@pytest.fixture(scope="module")
def run() -> RunTable:
    return bench()


@pytest.mark.parametrize("seed", [11, 12])
def test_good_runs_pass_unchanged(seed: int) -> None:
    print("seed", seed)
    rng = np.random.default_rng(seed)
    plants = (load_plant(shipped("campaign_plant.yaml")), plant_of_joint(JOINTS[1]))
    for plant in plants:
        table = emulate_run(plant, motion(rng.uniform(0.3, 2.0)), 15.0, seed, day=seed)
        joints = JOINTS if plant is plants[0] else dict.fromkeys((1, 2), JOINTS[1])
        result = checked(table, joints)
        assert (result.refused, result.notes, result.lost) == ((), (), ())
        assert result.runs[0][1] is table or np.array_equal(result.runs[0][1].time_s, table.time_s)


@pytest.mark.parametrize("seed", [21])
def test_a_joint_file_that_is_wrong_by_a_half_is_the_diagnosis_matter(run: RunTable, seed: int) -> None:
    """What the library's effects are for must not be refused here."""
    print("seed", seed)
    rng = np.random.default_rng(seed)
    for key in (
        "torque_constant_nm_per_a",
        "stiffness_nm_per_rad",
        "rotor_inertia_kgm2",
        "link_inertia_kgm2",
    ):
        off = {key: getattr(JOINTS[1], key) * float(rng.choice([0.5, 2.0]))}
        assert checked(run, {1: replace(JOINTS[1], **off), 2: JOINTS[2]}).refused == ()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (times("torque_nm", -1.0), "swapped sign of torque_nm"),
        (times("current_a", -1.0), "swapped sign of current_a"),
        (times("motor_velocity_rad_s", -1.0), "swapped sign"),
        (times("link_position_rad", -1.0), "swapped sign"),
        (times(ANGLES, -1.0), "gained instead of lost"),
        (times("torque_nm", 0.0), "no valid torque sensor channel"),
        (times("motor_velocity_rad_s", 0.0), "dead channel"),
        (lambda c: replace(c, torque_nm=None), "no valid torque sensor channel"),
        (lambda c: replace(c, current_a=None), "j1.current_a"),
        (lambda c: JointColumns(current_a=c.current_a, torque_nm=c.torque_nm), "no position and no velocity"),
    ],
)
def test_contradictions_leave_the_joint_out(run: RunTable, change: Change, said: str) -> None:
    result = checked(changed(run, change))
    assert any(said in line for line in result.refused)
    assert list(result.runs[0][1].joints) == [2]


def test_a_joint_in_the_others_frame_is_left_out(run: RunTable) -> None:
    result = checked(changed(run, times(f"{ANGLES} current_a torque_nm", -1.0), 2))
    assert "frame of the other" in result.refused[0]
    assert list(result.runs[0][1].joints) == [1]


def test_a_joint_file_of_another_joint(run: RunTable) -> None:
    other = {1: replace(JOINTS[1], gear_ratio=80.0), 2: JOINTS[2]}
    assert "wrong gear ratio" in checked(run, other).refused[0]
    other[1] = replace(JOINTS[1], torque_constant_nm_per_a=0.0062)
    assert "joint file of another joint" in checked(run, other).refused[0]


def held(name: str, first: int, last: int, columns: JointColumns) -> JointColumns:
    values = getattr(columns, name).copy()
    values[first:last] = values[first]
    return replace(columns, **{name: values})


def test_stuck_channels_by_how_long(run: RunTable) -> None:
    current = run.joints[1].current_a
    assert current is not None
    # a stretch in which the motor's torque changes much: stuck, and not merely constant
    spread = [float(np.ptp(current[k : k + 300])) for k in range(2000, 15000, 100)]
    first = 2000 + 100 * int(np.argmax(spread))
    short = checked(changed(run, partial(held, "torque_nm", first, first + 300)))
    assert short.refused == ()
    assert any("stuck channel" in note and f"from {first / 1000:g} s" in note for note in short.notes)
    assert list(short.runs[0][1].joints) == [1, 2]
    long = checked(changed(run, partial(held, "torque_nm", 3000, 18000)))
    assert "stuck channel" in long.refused[0]


@pytest.mark.parametrize("name", ["link_position_rad", "motor_position_rad"])
def test_a_stuck_encoder_is_not_used_and_the_joint_stays(run: RunTable, name: str) -> None:
    result = checked(changed(run, partial(held, name, 0, len(run.time_s))))
    assert result.refused == ()
    assert f"j1.{name}" in result.notes[0]
    assert "stuck channel; not used" in result.notes[0]
    assert getattr(result.runs[0][1].joints[1], name) is None
    assert getattr(result.runs[0][1].joints[2], name) is not None


def test_a_clipped_sensor_is_refused_when_it_clips_most_of_the_time(run: RunTable) -> None:
    torque = run.joints[1].torque_nm
    assert torque is not None
    limit = float(np.quantile(np.abs(torque), 0.2))
    mostly = changed(run, lambda c: replace(c, torque_nm=np.clip(torque, -limit, limit)))
    assert "saturated or clipped channel" in checked(mostly).refused[0]
    limit = float(np.quantile(np.abs(torque), 0.8))
    often = checked(changed(run, lambda c: replace(c, torque_nm=np.clip(torque, -limit, limit))))
    assert often.refused == ()
    assert any("j1.torque_nm" in note and "saturated or clipped channel" in note for note in often.notes)
    limit = float(np.quantile(np.abs(torque), 0.999))
    seldom = checked(changed(run, lambda c: replace(c, torque_nm=np.clip(torque, -limit, limit))))
    assert seldom.refused == ()


def test_spikes_are_counted_and_kept(run: RunTable) -> None:
    torque = run.joints[1].torque_nm
    assert torque is not None
    spiky = torque.copy()
    spiky[[3000, 7000, 7500, 16000]] += 25.0
    result = checked(changed(run, lambda c: replace(c, torque_nm=spiky)))
    assert "found 8 jumps" in result.notes[0]
    kept = result.runs[0][1].joints[1].torque_nm
    assert kept is not None
    assert np.array_equal(kept, spiky)


def test_a_temperature_that_steps_is_not_used(run: RunTable) -> None:
    def stepped(by: float) -> RunTable:
        warm = np.where(run.time_s < 0.3, 25.0, 25.0 + by)
        return changed(run, lambda c: replace(c, temperature_c=warm))

    result = checked(stepped(3.7))
    assert "joint 1" in result.notes[0] or "j1.temperature_c" in result.notes[0]
    assert "found a step of 3.7 degC at 0.3" in result.notes[0]
    assert result.runs[0][1].joints[1].temperature_c is None
    assert checked(stepped(1.0)).runs[0][1].joints[1].temperature_c is not None, "a coarse thermometer"


def test_a_temperature_that_no_joint_has_is_not_used(run: RunTable) -> None:
    result = checked(changed(run, lambda c: replace(c, temperature_c=np.full(len(run.time_s), 298.1))))
    assert "kelvin" in result.notes[0]
    assert result.runs[0][1].joints[1].temperature_c is None
    assert result.runs[0][1].joints[2].temperature_c is not None


@pytest.mark.parametrize(("factor", "rate"), [(100, "10 Hz"), (25, "40 Hz")])
def test_slow_recordings_are_refused(run: RunTable, factor: int, rate: str) -> None:
    result = checked(each_column(run, lambda x: x[::factor]))
    assert rate in result.refused[0]
    assert result.runs == ()
    assert result.lost == (1, 2)


def test_time_in_milliseconds_is_suspected(run: RunTable) -> None:
    assert "milliseconds" in checked(RunTable(run.time_s * 1000.0, run.joints)).refused[0]


@pytest.mark.parametrize("seed", [31])
def test_uneven_time_is_brought_to_equal_steps(run: RunTable, seed: int) -> None:
    """Straight lines survive a linear interpolation exactly, sines to their curvature."""
    print("seed", seed)
    rng = np.random.default_rng(seed)
    kept = np.sort(rng.choice(len(run.time_s), 17000, replace=False))
    table = each_column(run, lambda x: x[kept])
    line = RunTable(
        table.time_s,
        {1: JointColumns(current_a=3.0 * table.time_s - 1.0, torque_nm=np.sin(2.0 * table.time_s))},
    )
    even, notes = on_even_steps(line, "r")
    assert np.ptp(np.diff(even.time_s)) < 1e-9
    assert "equal steps" in notes[0].text
    current, torque = even.joints[1].current_a, even.joints[1].torque_nm
    assert current is not None
    assert torque is not None
    assert np.allclose(current, 3.0 * even.time_s - 1.0, atol=1e-9)
    assert np.max(np.abs(torque - np.sin(2.0 * even.time_s))) < 0.5 * 0.004**2 * 4.0
    result = checked(table)
    assert result.refused == ()
    assert len(result.notes) == 1


@pytest.mark.parametrize("speed", [40.0, 300.0])
def test_a_fast_motor_rolls_over_in_many_rows(speed: float) -> None:
    """At 250 Hz a motor at 300 rad/s has five rows to a turn: every fifth step is a jump."""
    t = 0.004 * np.arange(3000)
    position = speed * np.sin(t)
    table = RunTable(t, {1: JointColumns(motor_position_rad=np.mod(position, 2.0 * math.pi))})
    made, notes = unwrapped(table, "r")
    again = made.joints[1].motor_position_rad
    assert again is not None
    assert np.allclose(again - again[0], position - position[0])
    assert "found it rolling over by 6.283 rad" in notes[0].text
    degrees = RunTable(t, {1: JointColumns(motor_position_rad=np.rad2deg(position))})
    assert unwrapped(degrees, "r")[1] == []


def swing(time_s: np.ndarray[tuple[int], np.dtype[np.float64]]) -> RunTable:
    """A joint that swings, with an encoder's rounding, sampled at these times."""
    position = np.round(80.0 * np.sin(2.0 * time_s) / 1e-4) * 1e-4
    return RunTable(time_s, {1: JointColumns(motor_position_rad=position, current_a=np.cos(2.0 * time_s))})


@pytest.mark.parametrize("jitter", [1e-4, 4e-4])
def test_jitter_of_the_samples_is_no_jitter_of_stamps(jitter: float) -> None:
    t = 1e-3 * np.arange(8000) + jitter * np.sin(np.arange(8000.0))
    table, notes = on_even_steps(swing(t), "r")
    if jitter < 2e-4:
        assert (table.time_s.tolist(), notes) == (t.tolist(), [])
    else:
        assert "resampled to equal steps" in notes[0].text


@pytest.mark.parametrize(
    ("spread", "digits"), [(8e-5, 9), (4e-4, 9), (5e-4, 3)], ids=["small", "large", "ms"]
)
def test_stamps_that_jitter_where_the_samples_do_not_are_not_believed(spread: float, digits: int) -> None:
    """As a computer gives them, or rounded to milliseconds: at their word a motor at 160 rad/s jumps by 0.1 rad."""
    rng = np.random.default_rng(4)
    step = 1e-3 if spread < 1e-4 else 4e-3
    true = step * np.arange(6000)
    kept = np.sort(rng.choice(6000, 5950, replace=False))  # and rows are missing
    table = swing(true[kept])
    stamps = np.round(true[kept] + spread * np.clip(rng.normal(size=len(kept)), -3.0, 3.0), digits)
    even, notes = on_even_steps(RunTable(stamps, table.joints), "r")
    assert "the stamps jitter, not the samples; equal steps used" in notes[0].text
    position = even.joints[1].motor_position_rad
    assert position is not None
    assert len(position) == pytest.approx(6000, abs=3)
    whole = 80.0 * np.sin(2.0 * (even.time_s - stamps[0] + true[kept][0]))
    assert np.sqrt(np.mean((position - whole) ** 2)) < 160.0 * 1e-3, (
        "the clock is known to a fraction of a step"
    )
    rough = float(np.std(np.diff(position, 4)))
    assert rough < 0.1 * float(np.std(np.diff(80.0 * np.sin(2.0 * stamps), 4))) + 2e-3


@pytest.mark.parametrize(
    ("name", "period"), [("link_position_rad", 2 * math.pi), ("motor_position_rad", 2 * math.pi)]
)
def test_positions_that_roll_over_are_made_continuous(run: RunTable, name: str, period: float) -> None:
    position = getattr(run.joints[1], name)
    shifted = position - np.mean(position)
    rolled = np.mod(shifted, period)
    table, notes = unwrapped(changed(run, lambda c: replace(c, **{name: rolled})), "r")
    assert len(notes) == 1
    again = getattr(table.joints[1], name)
    assert np.max(np.abs((again - again[0]) - (position - position[0]))) < 1e-9
    assert unwrapped(run, "r") == (run, [])


@pytest.mark.parametrize("late", [-300, -40, 25, 60, 250])
def test_skew_is_measured_against_current_and_motion(run: RunTable, late: int) -> None:
    """late rows of 1 ms; rolled around the ends, which are 1.5 % of the run."""
    torque = run.joints[1].torque_nm
    assert torque is not None
    table = changed(run, lambda c: replace(c, torque_nm=np.roll(torque, late)))
    found = skew_s(table, 1, JOINTS[1])
    assert found == pytest.approx(late / 1000, abs=0.006)
    result = checked(table)
    if abs(late) >= 100:
        assert any("skew" in line for line in result.refused)
    else:
        assert result.refused == ()
        assert any("skew" in line for line in result.notes)


def test_channels_in_step_have_no_skew(run: RunTable) -> None:
    for number in (1, 2):
        assert skew_s(run, number, JOINTS[number]) == 0.0


def test_every_run_is_judged_for_itself(run: RunTable) -> None:
    bad = changed(run, times("torque_nm", 1000.0))
    result = check_runs([("a", run), ("b", bad), ("c", each_column(run, lambda x: x[::100]))], JOINTS)
    assert [(name, list(table.joints)) for name, table in result.runs] == [("a", [1, 2]), ("b", [2])]
    assert result.lost == ()
    assert [line[0] for line in result.refused] == ["b", "c"]


def with_outlier(run: RunTable, name: str, value: float) -> RunTable:
    column = getattr(run.joints[1], name).copy()
    column[7000] = value
    return changed(run, lambda c: replace(c, **{name: column}))


@pytest.mark.parametrize("name", sorted(set(COLUMN_NAMES) - {"enabled", "link_velocity_rad_s"}))
@pytest.mark.parametrize("value", [1e30, -1e6, 4e3])
def test_a_row_with_an_outlier_sample_is_left_out_and_said(run: RunTable, name: str, value: float) -> None:
    kept, [note] = without_outliers(with_outlier(run, name, value), JOINTS, "r.csv")
    assert f"j1.{name}: found 1 outlier sample, {value:.4g} at 7 s" in note.text
    assert np.array_equal(kept.time_s, np.delete(run.time_s, 7000))
    for number, column in ((1, name), (2, "torque_nm")):
        before = getattr(run.joints[number], column)
        assert np.array_equal(getattr(kept.joints[number], column), np.delete(before, 7000))


def test_an_outlier_sample_is_interpolated_as_a_lost_row(run: RunTable) -> None:
    result = checked(with_outlier(run, "torque_nm", 1e30))
    outlier, uneven = result.notes
    assert "1 outlier sample" in outlier
    assert "found 1 of 19998 steps off" in uneven
    assert result.refused == ()
    kept, before = result.runs[0][1].joints[1].torque_nm, run.joints[1].torque_nm
    assert kept is not None
    assert before is not None
    assert kept == pytest.approx(before, abs=2.0)


def test_what_a_joint_can_do_is_no_outlier(run: RunTable) -> None:
    """A kick of twice the rating at the start, a blow, a channel that steps, one that is wrong for longer."""
    for rows, value in ((slice(1, 2), 80.0), (slice(7000, 7001), 18.0), (slice(7000, 8000), 1e3)):
        torque = np.array(run.joints[1].torque_nm)
        torque[rows] += value
        kicked = changed(run, lambda c, torque=torque: replace(c, torque_nm=torque))  # type: ignore[misc]
        assert without_outliers(kicked, JOINTS, "r.csv")[1] == []
    assert not outlier_rows(np.repeat([0.0, 50.0], 500), 1.0).any()
    assert not outlier_rows(np.append([0.0], np.sin(np.arange(0.0, 20.0, 0.01)) + 9.0), 1.0).any(), "an end"


@pytest.mark.parametrize("count", [2, 10, 900])
def test_a_run_that_is_too_short_says_so(run: RunTable, count: int) -> None:
    [line] = checked(each_column(run, lambda x: x[:count])).refused
    assert line == (f"r.csv: found {count} samples, {count * 1e-3:.3g} s, expected a run of at least 1 s")


def test_a_run_in_which_nothing_changes_is_not_used(run: RunTable) -> None:
    """As from a dead bus: position and current (of the duty) are one number, the torque of the load follows from them."""

    def dead(columns: JointColumns) -> JointColumns:
        one = np.ones(len(run.time_s))
        return JointColumns(current_a=0.5 * one, motor_position_rad=7.0 * one, torque_nm=columns.torque_nm)

    one = RunTable(run.time_s, {1: dead(run.joints[1])})
    result = checked(one, {1: JOINTS[1]})
    assert result.runs == ()
    stands, constant = result.refused
    assert (
        "j1: found one value of motor_position_rad in the whole run, expected motion: the joint stands"
        in stands
    )
    assert "j1.current_a: found 0.5 A in the whole run" in constant
    assert constant.endswith("dead channel, or a command")
    beside = checked(changed(run, dead))  # the other joint moves
    assert (beside.refused, set(beside.notes)) == ((), set(result.refused))


def test_a_sensor_that_reads_one_number_is_dead_where_the_joint_moves(run: RunTable) -> None:
    one = np.ones(len(run.time_s))
    [line] = checked(changed(run, lambda c: replace(c, torque_nm=7.5 * one))).refused
    assert line == (
        "r.csv: j1.torque_nm: found 7.5 Nm in the whole run while the joint moves, expected a measurement that changes: "
        "dead channel"
    )


def test_one_value_of_current_or_motion_is_said(run: RunTable) -> None:
    one = np.ones(len(run.time_s))
    commanded = checked(changed(run, lambda c: replace(c, current_a=1.5 * one)))
    assert any("j1.current_a: found 1.5 A in the whole run" in note for note in commanded.notes)
    still = replace(
        run.joints[1], motor_position_rad=one, link_position_rad=one, motor_velocity_rad_s=0.0 * one
    )
    [note] = checked(changed(run, lambda _: still)).notes
    assert "found one value of motor_position_rad and motor_velocity_rad_s and link_position_rad" in note
    towed = checked(changed(run, lambda c: replace(c, current_a=0.0 * one)))
    assert not any("in the whole run" in line for line in (*towed.notes, *towed.refused))
