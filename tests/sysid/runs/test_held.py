"""Rows that are no measurement: clipped, stuck, or without the channel's own noise; and what is measured all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.models.files import load_joint, shipped
from jtqd.sysid.runs.bad_samples import LONGEST_HELD, Held, Limits, check_held, held_values, saturation_limits
from jtqd.sysid.runs.channels import Channels

JOINT = load_joint(shipped("joint1.yaml"))
SCALE = JOINT.gear_ratio * JOINT.torque_constant_nm_per_a
T = np.arange(0.0, 8.0, 1e-3)


def run(noise: float = 1.0, swing: float = 0.4) -> JointColumns:
    """Turning at 0.5 rad/s under a load that swings; noise of some steps of a digital channel."""
    rng = np.random.default_rng(2)
    load = swing * JOINT.rated_torque_nm * np.sin(2.0 * np.pi * 0.4 * T + 0.3)
    part = 1e-3 * noise * JOINT.rated_torque_nm

    def channel(x: FloatArray, step: float) -> FloatArray:
        return np.asarray(step * np.round((x + 8.0 * step * noise * rng.normal(size=len(x))) / step))

    torque = channel(load, part / 8.0 if noise else 1e-4 * JOINT.rated_torque_nm)
    current = channel(load / SCALE, 1e-4 * JOINT.rated_torque_nm / SCALE)
    return JointColumns(
        current_a=current,
        torque_nm=torque,
        motor_position_rad=0.5 * JOINT.gear_ratio * T,
        motor_velocity_rad_s=np.full(len(T), 0.5 * JOINT.gear_ratio),
    )


def held_in(columns: JointColumns, limits: Limits | None = None) -> dict[str, Held]:
    return held_values(Channels(T, columns, JOINT, "r"), limits)


def frozen(x: FloatArray, first: int, last: int) -> FloatArray:
    y = x.copy()
    y[first:last] = y[first]
    return y


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_what_is_measured_is_not_held(noise: float) -> None:
    assert held_in(run(noise)) == {}


@pytest.mark.parametrize("column", ["current_a", "torque_nm"])
def test_a_channel_without_its_own_noise_is_stuck_however_little_its_partner_moves(column: str) -> None:
    """Sixty rows at the crest of the load, which hardly changes there."""
    clean = run(swing=0.01)
    values = getattr(clean, column)
    held = held_in(replace(clean, **{column: frozen(values, 3000, 3060)}))
    assert np.flatnonzero(held[column].stuck).tolist() == list(range(3000, 3060))
    assert not held[column].saturated.any()
    assert list(held) == [column]


@pytest.mark.parametrize("column", ["current_a", "torque_nm"])
def test_what_is_stuck_in_motion_is_so_at_rest_too_and_at_rest_alone_nothing_is(column: str) -> None:
    clean = run()
    speed = clean.motor_velocity_rad_s
    assert speed is not None
    values = frozen(getattr(clean, column), 3000, 3100)
    for stops, found in ((3040, range(3000, 3100)), (2990, range(0))):
        still = np.where((stops <= T * 1e3) & (T < 3.2), 0.0, speed)
        there = replace(
            clean, motor_velocity_rad_s=still, motor_position_rad=np.cumsum(still) * 1e-3, **{column: values}
        )
        held = held_in(there)
        assert [int(k) for h in held.values() for k in np.flatnonzero(h.rows)] == list(found)
    line = np.linspace(values[2999], values[3100], 102)[1:-1]
    there = replace(clean, **{column: values})
    apart = held_in(there)[column].deviation
    assert apart[3000:3100] == pytest.approx(values[3000:3100] - line)
    assert not apart[:3000].any()
    assert not apart[3100:].any()


def test_a_current_without_noise_anywhere_or_without_power_is_none() -> None:
    smooth = run(noise=0.0, swing=0.01)
    assert smooth.current_a is not None
    assert held_in(replace(smooth, current_a=frozen(smooth.current_a, 3000, 3060))) == {}
    noisy = run(swing=0.01)
    assert noisy.current_a is not None
    off = noisy.current_a.copy()
    off[3000:3060] = 0.0
    assert held_in(replace(noisy, current_a=off)) == {}
    off[3000:3060] = 0.02
    assert "current_a" in held_in(replace(noisy, current_a=off))
    enabled = np.ones(len(T))
    enabled[3000:3060] = 0.0
    assert held_in(replace(noisy, current_a=off, enabled=enabled)) == {}


def test_a_commanded_current_that_goes_to_a_level_and_on_is_measured() -> None:
    """It never repeats a number on its way, but it has no noise either, and the load does not change meanwhile."""
    current = np.round(np.interp(T, [0.0, 3.0, 3.06, 8.0], [0.5, 2.15, 2.15, 4.867]), 4)
    assert held_in(replace(run(swing=0.01), current_a=current)) == {}


def clipped(columns: JointColumns, limit: float, span: slice = slice(None)) -> JointColumns:
    assert columns.torque_nm is not None
    torque = columns.torque_nm.copy()
    torque[span] = np.clip(torque[span], -limit, limit)
    return replace(columns, torque_nm=torque)


@pytest.mark.parametrize("span", [slice(None), slice(0, 1500)])
def test_one_number_at_the_end_of_the_range_is_a_clip_however_long_or_seldom(span: slice) -> None:
    """Of the second, only one crest is clipped: half a second of one number, never again."""
    limit = 0.35003 * JOINT.rated_torque_nm  # between two steps of the channel
    there = clipped(run(), limit, span)
    if span.stop:
        assert there.torque_nm is not None
        later = there.torque_nm.copy()
        later[1500:] *= 0.5  # the extreme of the run is the clip
        there = replace(there, torque_nm=later)
    held = held_in(there)["torque_nm"]
    assert there.torque_nm is not None
    assert np.array_equal(held.saturated, np.abs(there.torque_nm) == limit)
    assert not held.stuck.any()
    long, short = check_held(Channels(T, there, JOINT, "run1.csv: j1"))
    assert not long
    assert "saturated or clipped channel" in short[0].text
    assert short[0].text.startswith(f"run1.csv: j1.torque_nm: found exactly {limit:.6g} Nm held for")


def test_one_number_in_the_middle_of_the_range_is_stuck() -> None:
    there = run()
    assert there.torque_nm is not None
    there = replace(there, torque_nm=frozen(there.torque_nm, 3500, 3900))
    held = held_in(there)["torque_nm"]
    assert held.stuck[3500:3900].all()
    assert not held.saturated.any()
    _, [issue] = check_held(Channels(T, there, JOINT, "r"))
    assert issue.kind == "torque_nm_stuck"
    assert "from 3.5 s on" in issue.text


def test_what_never_comes_back_has_not_reached_a_limit() -> None:
    there = run()
    assert there.torque_nm is not None
    top = int(np.argmax(there.torque_nm[:6000]))
    stuck = held_in(replace(there, torque_nm=frozen(there.torque_nm, top, len(T))))["torque_nm"]
    assert stuck.stuck[top:].all()
    assert not stuck.saturated.any()


def test_a_limit_of_one_run_is_a_limit_of_all_runs_and_joints_at_the_sensor() -> None:
    limit = 0.25003 * JOINT.rated_torque_nm  # between two steps of the channel
    often = RunTable(T, {1: clipped(run(), limit)})
    seldom = clipped(run(), limit, slice(500, 503))
    limits = saturation_limits([often, RunTable(T, {2: seldom})], {1: JOINT, 2: JOINT})
    assert [set(limits[n]["torque_nm"]) for n in (1, 2)] == [{limit}, {limit}]
    assert held_in(seldom) == {}
    rows = held_in(seldom, limits[2])["torque_nm"].saturated
    assert np.flatnonzero(rows).tolist() == [500, 501, 502]


def test_a_run_of_which_most_is_held_is_refused() -> None:
    there = run()
    assert there.torque_nm is not None
    last = 500 + int((LONGEST_HELD + 0.05) * len(T))
    long, short = check_held(
        Channels(T, replace(there, torque_nm=frozen(there.torque_nm, 500, last)), JOINT, "r")
    )
    assert [issue.kind for issue in long] == ["torque_nm_stuck"]
    assert not short
