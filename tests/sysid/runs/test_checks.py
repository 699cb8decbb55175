"""Channels before a diagnosis: contradictions left out, oddities noted, good runs untouched; the time base."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import shipped
from jtqd.sim_can.emulated_run import emulate_run
from jtqd.sim_can.plant_file import load_plant, plant_of_joint
from jtqd.sysid.runs import checks
from jtqd.sysid.runs.checks import check_runs, on_even_steps, skew_s, unwrapped
from tests.estimator.effects.effect_signals import PLAIN
from tests.sysid.runs.spoiled_runs import (
    ANGLES,
    JOINTS,
    bench,
    changed,
    checked,
    column,
    each_column,
    having,
    motion,
    times,
)


@pytest.fixture(scope="module")
def run():
    return bench()


@pytest.mark.parametrize("seed", [11, 12])
def test_good_runs_pass_unchanged(seed):
    rng = np.random.default_rng(seed)
    benches = (
        (load_plant(shipped("campaign_plant.yaml")), JOINTS),
        (plant_of_joint(JOINTS[1]), dict.fromkeys((1, 2), JOINTS[1])),
    )
    for plant, joints in benches:
        table = emulate_run(plant, motion(rng.uniform(0.3, 2.0)), 15.0, seed, day=seed)
        result = checked(table, joints)
        assert (result.refused, result.notes, result.lost) == ((), (), ())
        assert result.runs[0][1] is table or np.array_equal(result.runs[0][1].time_s, table.time_s)


def test_a_joint_file_that_is_wrong_by_a_half_is_left_to_the_diagnosis(run):
    rng = np.random.default_rng(21)
    for key in (
        "torque_constant_nm_per_a",
        "stiffness_nm_per_rad",
        "rotor_inertia_kgm2",
        "link_inertia_kgm2",
    ):
        off = {key: getattr(JOINTS[1], key) * float(rng.choice([0.5, 2.0]))}
        assert checked(run, {1: replace(JOINTS[1], **off), 2: JOINTS[2]}).refused == ()


@pytest.mark.parametrize(
    ("change", "expected"),
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
def test_contradictions_leave_the_joint_out(run, change, expected):
    result = checked(changed(run, change))
    assert any(expected in line for line in result.refused)
    assert list(result.runs[0][1].joints) == [2]


def test_a_joint_in_the_others_frame_is_left_out(run):
    result = checked(changed(run, times(f"{ANGLES} current_a torque_nm", -1.0), 2))
    assert "frame of the other" in result.refused[0]
    assert list(result.runs[0][1].joints) == [1]


def test_a_joint_file_of_another_joint(run):
    for change, expected in (
        ({"gear_ratio": 80.0}, "wrong gear ratio"),
        ({"torque_constant_nm_per_a": 0.0062}, "joint file of another joint"),
    ):
        joints = {1: replace(JOINTS[1], **change), 2: JOINTS[2]}
        assert expected in checked(run, joints).refused[0]


def held(run: RunTable, name: str, first: int, last: int) -> RunTable:
    values = column(run, name)
    values[first:last] = values[first]
    return having(run, **{name: values})


def test_stuck_channels_by_how_long(run):
    current = column(run, "current_a")
    # where the motor's torque changes much: stuck, and not merely constant
    spread = [float(np.ptp(current[k : k + 300])) for k in range(2000, 15000, 100)]
    first = 2000 + 100 * int(np.argmax(spread))
    short = checked(held(run, "torque_nm", first, first + 300))
    assert short.refused == ()
    assert any("stuck channel" in note and f"from {first / 1000:g} s" in note for note in short.notes)
    assert list(short.runs[0][1].joints) == [1, 2]
    assert "stuck channel" in checked(held(run, "torque_nm", 3000, 18000)).refused[0]


@pytest.mark.parametrize("name", ["link_position_rad", "motor_position_rad"])
def test_a_stuck_encoder_is_not_used_and_the_joint_stays(run, name):
    result = checked(held(run, name, 0, len(run.time_s)))
    assert result.refused == ()
    assert f"j1.{name}" in result.notes[0]
    assert "stuck channel; not used" in result.notes[0]
    joints = result.runs[0][1].joints
    assert (getattr(joints[1], name) is None, getattr(joints[2], name) is None) == (True, False)


def test_a_saturated_sensor_is_refused_when_it_is_so_most_of_the_time(run):
    torque = column(run, "torque_nm")
    mostly, often, seldom = (
        checked(having(run, torque_nm=np.clip(torque, -limit, limit)))
        for limit in np.quantile(np.abs(torque), [0.2, 0.8, 0.999])
    )
    assert "saturated or clipped channel" in mostly.refused[0]
    assert often.refused == seldom.refused == ()
    assert any("j1.torque_nm" in note and "saturated or clipped channel" in note for note in often.notes)


def test_spikes_are_counted_and_kept(run):
    spiky = column(run, "torque_nm")
    spiky[[3000, 7000, 7500, 16000]] += 25.0
    result = checked(having(run, torque_nm=spiky))
    assert "found 8 jumps" in result.notes[0]
    assert np.array_equal(column(result.runs[0][1], "torque_nm"), spiky)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [(25.0, 28.7, "found a step of 3.7 degC at 0.3"), (298.1, 298.1, "kelvin"), (25.0, 26.0, "")],
    ids=["a step", "kelvin", "a coarse thermometer"],
)
def test_a_temperature_that_no_joint_has_is_not_used(run, before, after, expected):
    result = checked(having(run, temperature_c=np.where(run.time_s < 0.3, before, after)))
    joints = result.runs[0][1].joints
    assert (joints[1].temperature_c is None) == bool(expected)
    assert joints[2].temperature_c is not None
    assert [expected in note for note in result.notes[:1]] == [True] * bool(expected)


@pytest.mark.parametrize(("factor", "rate"), [(100, "10 Hz"), (25, "40 Hz")])
def test_slow_recordings_are_refused(run, factor, rate):
    result = checked(each_column(run, lambda x: x[::factor]))
    assert rate in result.refused[0]
    assert (result.runs, result.lost) == ((), (1, 2))


def test_time_in_milliseconds_is_suspected(run):
    assert "milliseconds" in checked(RunTable(run.time_s * 1000.0, run.joints)).refused[0]


@pytest.mark.parametrize("count", [2, 10, 900])
def test_a_run_that_is_too_short(run, count):
    [line] = checked(each_column(run, lambda x: x[:count])).refused
    assert line == f"r.csv: found {count} samples, {count * 1e-3:.3g} s, expected a run of at least 1 s"


def test_every_run_is_judged_for_itself(run):
    bad = changed(run, times("torque_nm", 1000.0))
    result = check_runs([("a", run), ("b", bad), ("c", each_column(run, lambda x: x[::100]))], JOINTS)
    assert [(name, list(table.joints)) for name, table in result.runs] == [("a", [1, 2]), ("b", [2])]
    assert result.lost == ()
    assert [line[0] for line in result.refused] == ["b", "c"]


def test_a_run_in_which_nothing_changes_is_not_used(run):
    """As from a dead bus: position and current (of the duty) are one number, the torque of the load follows from them."""
    one = np.ones(len(run.time_s))
    dead = JointColumns(0.5 * one, 7.0 * one, torque_nm=column(run, "torque_nm"))
    result = checked(RunTable(run.time_s, {1: dead}), {1: JOINTS[1]})
    assert result.runs == ()
    stands, constant = result.refused
    expected = "j1: found one value of motor_position_rad in the whole run, expected motion: the joint stands"
    assert expected in stands
    assert "j1.current_a: found 0.5 A in the whole run" in constant
    assert constant.endswith("dead channel, or a command")
    beside = checked(changed(run, lambda _: dead))  # the other joint moves
    assert (beside.refused, set(beside.notes)) == ((), set(result.refused))


def test_channels_of_one_value(run):
    one = np.ones(len(run.time_s))
    [line] = checked(having(run, torque_nm=7.5 * one)).refused
    assert line == "r.csv: j1.torque_nm: found 7.5 Nm in the whole run while the joint moves: dead channel"
    commanded = checked(having(run, current_a=1.5 * one))
    assert any("j1.current_a: found 1.5 A in the whole run" in note for note in commanded.notes)
    still = {"motor_position_rad": one, "link_position_rad": one, "motor_velocity_rad_s": 0.0 * one}
    [note] = checked(having(run, **still)).notes
    assert "found one value of motor_position_rad and motor_velocity_rad_s and link_position_rad" in note
    towed = checked(having(run, current_a=0.0 * one))
    assert not any("in the whole run" in line for line in (*towed.notes, *towed.refused))


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


@pytest.mark.parametrize(("jitter", "noted"), [(1e-5, False), (4e-4, True)])
def test_samples_that_jitter_are_brought_to_equal_steps(jitter, noted):
    """A hundredth of a step at 160 rad/s is 16 steps of the encoder: to be used, although it is not worth a note."""
    t = 1e-3 * np.arange(8000) + jitter * np.sin(2.0 * np.arange(8000.0))
    table, notes = on_even_steps(swing(t), "r")
    assert np.ptp(np.diff(table.time_s)) < 1e-9
    off = column(table, "motor_position_rad") - 80.0 * np.sin(2.0 * table.time_s)
    assert np.sqrt(np.mean(off[4:-4] ** 2)) < 4e-5 + 1e-2 * 160.0 * jitter * noted
    assert [note.kind for note in notes] == ["time_uneven"] * noted


def test_stamps_that_are_off_by_less_than_positions_show_stay():
    t = 1e-3 * np.arange(8000) + 2e-8 * np.sin(2.0 * np.arange(8000.0))
    table, notes = on_even_steps(swing(t), "r")
    assert (table.time_s.tolist(), notes) == (t.tolist(), [])


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


@pytest.mark.parametrize("coulomb_nm", [3.0, 5.0])
def test_a_pendulum_that_sticks_has_its_torque_in_step(coulomb_nm):
    """The joint stands while the current leads a wave inside the friction: the sensor has the weight's torque alone."""
    joint, inertia, weight, step = PLAIN, 0.3, 9.0, 1e-3
    gain = joint.gear_ratio * joint.torque_constant_nm_per_a
    whole = inertia + joint.gear_ratio**2 * joint.rotor_inertia_kgm2
    q = v = 0.0
    rows = []
    for k in range(20000):
        t = k * step
        wanted = 0.4 * math.sin(0.9 * t) + 0.3 * math.sin(1.7 * t) + 0.2 * math.sin(3.1 * t)
        motor = 60.0 * whole * (wanted - q) - 16.0 * whole * v
        motor += weight * math.sin(q) + coulomb_nm * math.tanh(10.0 * math.cos(0.9 * t))
        free = v + step * (motor - weight * math.sin(q)) / whole
        after = math.copysign(max(abs(free) - step * coulomb_nm / whole, 0.0), free)
        rows.append(
            (t, joint.gear_ratio * q, motor / gain, weight * math.sin(q) + inertia * (after - v) / step)
        )
        v = after
        q += step * v
    t, position, current, torque = np.array(rows).T
    columns = JointColumns(current_a=current, motor_position_rad=position, torque_nm=torque)
    assert skew_s(RunTable(t, {1: columns}), 1, joint) == 0.0
    late = replace(columns, torque_nm=np.roll(torque, 150))
    assert skew_s(RunTable(t, {1: late}), 1, joint) == pytest.approx(0.15, abs=0.006)


@pytest.mark.parametrize(("least", "late_s"), [(0.02, 0.105), (0.031, None)])
def test_a_shift_counts_where_it_halves_the_residual(monkeypatch, least, late_s):
    """0.051 in step and 0.031 after 0.105 s come from slow motions with stiction, whose channels are in step."""
    t = np.arange(0.0, 20.0, 1e-3)
    velocity = np.sin(t)
    columns = JointColumns(current_a=velocity, motor_velocity_rad_s=100.0 * velocity, torque_nm=np.cos(t))

    def residual_shares(_q: object, _rows: object, _y: object, shifts: int) -> np.ndarray:
        curve = np.full(shifts, 0.051)
        curve[shifts // 2 + 21] = least
        return curve

    monkeypatch.setattr(checks, "_residual_shares", residual_shares)
    found = checks.skew_s(RunTable(t, {1: columns}), 1, PLAIN)
    assert found == (late_s if late_s is None else pytest.approx(late_s))
