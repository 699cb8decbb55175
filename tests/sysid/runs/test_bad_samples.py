"""Bad samples: channels that are saturated, stuck, or without their own noise, and rows with an outlier."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import COLUMN_NAMES, JointColumns, RunTable
from jtqd.sysid.runs.bad_samples import (
    LONGEST_HELD,
    Held,
    Limits,
    check_held,
    held_values,
    outlier_rows,
    saturation_limits,
    without_outliers,
)
from jtqd.sysid.runs.channels import Channels, RunIssue
from tests.sysid.runs.spoiled_runs import JOINTS, bench, checked, column, having

JOINT = JOINTS[1]
SCALE = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a
T = np.arange(0.0, 8.0, 1e-3)


def run(noise: float = 1.0, swing: float = 0.4) -> RunTable:
    """Turning at 0.5 rad/s under a load that swings; noise of some steps of a digital channel."""
    rng = np.random.default_rng(2)
    load = swing * JOINT.rated_torque_nm * np.sin(2.0 * np.pi * 0.4 * T + 0.3)
    part = 1e-3 * noise * JOINT.rated_torque_nm

    def channel(x: FloatArray, step: float) -> FloatArray:
        return np.asarray(step * np.round((x + 8.0 * step * noise * rng.normal(size=len(x))) / step))

    torque = channel(load, part / 8.0 if noise else 1e-4 * JOINT.rated_torque_nm)
    current = channel(load / SCALE, 1e-4 * JOINT.rated_torque_nm / SCALE)
    columns = JointColumns(
        current_a=current,
        torque_nm=torque,
        motor_position_rad=0.5 * JOINT.gear_ratio * T,
        motor_velocity_rad_s=np.full(len(T), 0.5 * JOINT.gear_ratio),
    )
    return RunTable(T, {1: columns})


def held_in(table: RunTable, limits: Limits | None = None) -> dict[str, Held]:
    return held_values(Channels(T, table.joints[1], JOINT, "r"), limits)


def issues_of(table: RunTable) -> tuple[list[RunIssue], list[RunIssue]]:
    return check_held(Channels(T, table.joints[1], JOINT, "run1.csv: j1"))


def frozen(table: RunTable, name: str, first: int, last: int) -> RunTable:
    values = column(table, name)
    values[first:last] = values[first]
    return having(table, **{name: values})


def clipped(table: RunTable, limit: float, span: slice = slice(None)) -> RunTable:
    torque = column(table, "torque_nm")
    torque[span] = np.clip(torque[span], -limit, limit)
    return having(table, torque_nm=torque)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_measured_channel_is_not_held(noise):
    assert held_in(run(noise)) == {}


@pytest.mark.parametrize("name", ["current_a", "torque_nm"])
def test_a_channel_without_its_own_noise_is_stuck_however_little_its_partner_moves(name):
    """Sixty rows at the crest of the load, which hardly changes there."""
    held = held_in(frozen(run(swing=0.01), name, 3000, 3060))
    assert list(held) == [name]
    assert np.flatnonzero(held[name].stuck).tolist() == list(range(3000, 3060))
    assert not held[name].saturated.any()


@pytest.mark.parametrize("name", ["current_a", "torque_nm"])
def test_a_channel_that_is_stuck_in_motion_stays_so_at_rest_and_at_rest_alone_none_is(name):
    clean = run()
    there = frozen(clean, name, 3000, 3100)
    speed, values = column(clean, "motor_velocity_rad_s"), column(there, name)
    for stops, found in ((3040, range(3000, 3100)), (2990, range(0))):
        still = np.where((stops <= T * 1e3) & (T < 3.2), 0.0, speed)
        held = held_in(having(there, motor_velocity_rad_s=still, motor_position_rad=np.cumsum(still) * 1e-3))
        assert [int(k) for h in held.values() for k in np.flatnonzero(h.rows)] == list(found)
    line = np.linspace(values[2999], values[3100], 102)[1:-1]
    deviation = held_in(there)[name].deviation
    assert deviation[3000:3100] == pytest.approx(values[3000:3100] - line)
    assert not deviation[:3000].any()
    assert not deviation[3100:].any()


def test_a_current_without_noise_anywhere_or_without_power_is_not_stuck():
    assert held_in(frozen(run(noise=0.0, swing=0.01), "current_a", 3000, 3060)) == {}
    noisy = run(swing=0.01)
    off = column(noisy, "current_a")
    off[3000:3060] = 0.0
    assert held_in(having(noisy, current_a=off)) == {}
    off[3000:3060] = 0.02
    assert "current_a" in held_in(having(noisy, current_a=off))
    enabled = np.ones(len(T))
    enabled[3000:3060] = 0.0
    assert held_in(having(noisy, current_a=off, enabled=enabled)) == {}


def test_a_commanded_current_that_goes_to_a_level_and_on_is_measured():
    """It repeats no number on its way, but it has no noise, and the load does not change meanwhile."""
    current = np.round(np.interp(T, [0.0, 3.0, 3.06, 8.0], [0.5, 2.15, 2.15, 4.867]), 4)
    assert held_in(having(run(swing=0.01), current_a=current)) == {}


@pytest.mark.parametrize("span", [slice(None), slice(0, 1500)])
def test_one_number_at_the_end_of_the_range_is_saturation_however_long_or_seldom(span):
    """Of the second, only one crest is clipped: half a second of one number, never again."""
    limit = 0.35003 * JOINT.rated_torque_nm  # between two steps of the channel
    there = clipped(run(), limit, span)
    if span.stop:
        later = column(there, "torque_nm")
        later[1500:] *= 0.5  # the extreme of the run is the clip
        there = having(there, torque_nm=later)
    held = held_in(there)["torque_nm"]
    assert np.array_equal(held.saturated, np.abs(column(there, "torque_nm")) == limit)
    assert not held.stuck.any()
    long, short = issues_of(there)
    assert not long
    assert "saturated or clipped channel" in short[0].text
    assert short[0].text.startswith(f"run1.csv: j1.torque_nm: found exactly {limit:.6g} Nm held for")


def test_one_number_in_the_middle_of_the_range_is_stuck():
    there = frozen(run(), "torque_nm", 3500, 3900)
    held = held_in(there)["torque_nm"]
    assert held.stuck[3500:3900].all()
    assert not held.saturated.any()
    _, [issue] = issues_of(there)
    assert issue.kind == "torque_nm_stuck"
    assert "from 3.5 s on" in issue.text


def test_a_number_that_is_never_left_again_is_no_limit():
    top = int(np.argmax(column(run(), "torque_nm")[:6000]))
    held = held_in(frozen(run(), "torque_nm", top, len(T)))["torque_nm"]
    assert held.stuck[top:].all()
    assert not held.saturated.any()


def test_a_limit_of_one_run_is_a_limit_of_all_runs_and_joints_at_the_sensor():
    limit = 0.25003 * JOINT.rated_torque_nm  # between two steps of the channel
    often, seldom = clipped(run(), limit), clipped(run(), limit, slice(500, 503))
    limits = saturation_limits([often, RunTable(T, {2: seldom.joints[1]})], {1: JOINT, 2: JOINT})
    assert [set(limits[n]["torque_nm"]) for n in (1, 2)] == [{limit}, {limit}]
    assert held_in(seldom) == {}
    rows = held_in(seldom, limits[2])["torque_nm"].saturated
    assert np.flatnonzero(rows).tolist() == [500, 501, 502]


def test_a_run_that_is_held_for_the_most_part_is_refused():
    long, short = issues_of(frozen(run(), "torque_nm", 500, 500 + int((LONGEST_HELD + 0.05) * len(T))))
    assert [issue.kind for issue in long] == ["torque_nm_stuck"]
    assert not short


# Outliers -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured():
    return bench()


def with_outlier(table: RunTable, name: str, value: float) -> RunTable:
    values = column(table, name)
    values[7000] = value
    return having(table, **{name: values})


@pytest.mark.parametrize("name", sorted(set(COLUMN_NAMES) - {"enabled", "link_velocity_rad_s"}))
@pytest.mark.parametrize("value", [1e30, -1e6, 4e3])
def test_a_row_with_an_outlier_is_left_out_with_a_note(measured, name, value):
    kept, [note] = without_outliers(with_outlier(measured, name, value), JOINTS, "r.csv")
    assert f"j1.{name}: found 1 outlier sample, {value:.4g} at 7 s" in note.text
    assert np.array_equal(kept.time_s, np.delete(measured.time_s, 7000))
    for number, each in ((1, name), (2, "torque_nm")):
        assert np.array_equal(column(kept, each, number), np.delete(column(measured, each, number), 7000))


def test_an_outlier_is_interpolated_as_a_lost_row(measured):
    result = checked(with_outlier(measured, "torque_nm", 1e30))
    outlier, uneven = result.notes
    assert "1 outlier sample" in outlier
    assert "found 1 of 19998 steps off" in uneven
    assert result.refused == ()
    assert column(result.runs[0][1], "torque_nm") == pytest.approx(column(measured, "torque_nm"), abs=2.0)


def test_a_motion_that_a_joint_can_do_is_no_outlier(measured):
    """A kick of twice the rating at the start, a blow, a channel that steps, one that is wrong for longer."""
    for rows, value in ((slice(1, 2), 80.0), (slice(7000, 7001), 18.0), (slice(7000, 8000), 1e3)):
        torque = column(measured, "torque_nm")
        torque[rows] += value
        assert without_outliers(having(measured, torque_nm=torque), JOINTS, "r.csv")[1] == []
    assert not outlier_rows(np.repeat([0.0, 50.0], 500), 1.0).any()
    assert not outlier_rows(np.append([0.0], np.sin(np.arange(0.0, 20.0, 0.01)) + 9.0), 1.0).any(), "an end"
