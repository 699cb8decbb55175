"""The run table of a motion that was driven: short gaps of lost cycles are interpolated, and faults of the run are found.

Faults are missing cycles, broken channels, wrong wiring, and a motion that did not take place. No model is judged here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import RunTable
from jtqd.sysid.motion.setpoints import PERIOD_S, Setpoints
from jtqd.sysid.runs.checks import check_run
from jtqd.sysid.runs.logs import LoggedRun

LONGEST_INTERPOLATED_S: Final = 0.0505
"""50 periods of 1 ms; the trajectories' harmonics lie below 1 Hz."""
_INTERPOLATED_SHARE: Final = 0.005
"""Largest part of a table that is interpolated."""
LONGEST_GAP: Final = 9.5
"""In periods of SYNC: readers refuse a table with a gap of 10 cycles (jtqd.sysid.runs.segments)."""
_LOST_SHARE: Final = 0.01
LOST_FINDING: Final = "cycles:"
"""First word of the finding that more cycles than that are missing."""
_LOST_END_S: Final = 0.1
_FOLLOW_VELOCITY: Final = (0.05, 0.05)
_FOLLOW_CURRENT: Final = (0.1, 0.05)
"""RMS that is allowed between set-point and measurement: rad/s or A, and a part of the peak."""
_OPPOSITE_TOLERANCE: Final = 0.02
_LEAST_MOTION_RAD: Final = 1.0
"""Of a link, for its motion to be compared with the other one's."""


def gaps_of(time_s: FloatArray, longest_gap_s: float) -> list[list[float]]:
    """Return start and end [s] of each step that is longer than longest_gap_s."""
    places = np.flatnonzero(np.diff(time_s) > longest_gap_s)
    return [[round(float(time_s[place]), 6), round(float(time_s[place + 1]), 6)] for place in places]


def interpolate_gaps(
    logged: LoggedRun, longest_gap_s: float, period_s: float = PERIOD_S
) -> tuple[LoggedRun, int]:
    """Interpolate gaps longer than longest_gap_s linearly; returns the run and the number of rows added, period_s apart.

    The run is returned as it is where a gap is longer than LONGEST_INTERPOLATED_S, or too many rows would be added.
    """
    time_s = logged.table.time_s
    steps = np.diff(time_s)
    places = np.flatnonzero(steps > longest_gap_s)
    if not len(places) or float(steps.max()) > LONGEST_INTERPOLATED_S:
        return logged, 0
    added = np.concatenate(
        [time_s[place] + period_s * np.arange(1, round(float(steps[place]) / period_s)) for place in places]
    )
    if len(added) > _INTERPOLATED_SHARE * (len(added) + len(time_s)):
        return logged, 0
    whole: FloatArray = np.sort(np.concatenate((time_s, added)))

    def at_all_times(name: str, column: FloatArray) -> FloatArray:
        values: FloatArray = np.interp(whole, time_s, column)
        return np.round(values) if name == "enabled" else values

    joints = {number: columns.map(at_all_times) for number, columns in logged.table.joints.items()}
    longest = float(np.diff(whole).max())
    return replace(logged, table=RunTable(whole, joints), longest_gap_s=longest), len(added)


def unusable(logged: LoggedRun, setpoints: Setpoints, longest_gap_s: float) -> str | None:
    """Return why a table cannot be kept at all: a gap, or the end of the motion is missing; else None."""
    time_s = logged.table.time_s
    if logged.longest_gap_s > longest_gap_s:
        at = time_s[int(np.argmax(np.diff(time_s)))]
        return (
            f"found a gap of {logged.longest_gap_s * 1e3:.1f} ms in the log at {at:.3f} s, "
            f"expected at most {longest_gap_s * 1e3:.1f} ms"
        )
    if time_s[-1] < setpoints.duration_s - _LOST_END_S:  # lost cycles only make a motion longer
        return f"found the last row of the log at {time_s[-1]:.3f} s, expected it after {setpoints.duration_s:.3f} s"
    return None


def findings(
    logged: LoggedRun, setpoints: Setpoints, joints: Sequence[Joint], *, measured: Collection[int]
) -> tuple[str, ...]:
    """Return the faults of a run, a line each.

    Args:
        logged: its first row belongs to the first set-point. joints: of jtqd's configuration, 1, 2, ...
        measured: numbers of the joints of the run that have a channel of the torque sensor.
    """
    by_number = {number: joints[number - 1] for number in setpoints.joints}
    return (
        *_lost(logged),
        *_no_sensor(logged, measured),
        *(issue.text for issue in check_run(logged.table, by_number).refused),
        *_followed(logged, setpoints, joints),
        *(() if setpoints.current_joint is None else _opposite(logged, setpoints.joints, joints)),
    )


def _lost(logged: LoggedRun) -> Iterator[str]:
    if logged.lost_share > _LOST_SHARE:
        by = ", ".join(f"{name} {count}" for name, count in logged.incomplete_by.items() if count)
        yield (
            f"{LOST_FINDING} found {logged.lost_share:.1%} missing ({logged.missed} without a cycle, "
            f"{logged.incomplete} incomplete{': ' + by if by else ''}), expected at most {_LOST_SHARE:.0%}"
        )


def _no_sensor(logged: LoggedRun, measured: Collection[int]) -> Iterator[str]:
    for number, columns in logged.table.joints.items():
        if columns.torque_nm is None and number in measured:
            yield f"j{number}.torque_nm: found no value in the whole run, expected the sensor's: dead channel"


def _followed(logged: LoggedRun, setpoints: Setpoints, joints: Sequence[Joint]) -> Iterator[str]:
    """Compare the velocity joint with its velocity, the other one with its current, at the time of each row."""
    table = logged.table
    place = np.minimum(np.round(table.time_s / PERIOD_S).astype(np.intp), len(setpoints) - 1)
    mover, driver = setpoints.velocity_joint, setpoints.current_joint
    velocity = table.joints[mover].motor_velocity_rad_s
    assert velocity is not None  # log_to_run was asked for all columns
    yield from _follows(
        velocity / joints[mover - 1].gear_ratio,
        setpoints.velocity_rad_s[place],
        _FOLLOW_VELOCITY,
        f"j{mover}.motor_velocity_rad_s: through the gear",
        "rad/s",
    )
    if driver is not None:
        current = table.joints[driver].current_a
        assert current is not None
        wanted = setpoints.current_a[place]
        yield from _follows(current, wanted, _FOLLOW_CURRENT, f"j{driver}.current_a:", "A")


def _follows(
    found: FloatArray, wanted: FloatArray, allowed: tuple[float, float], what: str, unit: str
) -> Iterator[str]:
    rms = float(np.sqrt(np.mean((found - wanted) ** 2)))
    limit = allowed[0] + allowed[1] * float(np.abs(wanted).max())
    if rms > limit:
        opposite = float(np.sqrt(np.mean((found + wanted) ** 2))) <= limit
        yield (
            f"{what} found {rms:.3g} {unit} rms off the set-point, expected at most {limit:.3g} {unit}"
            f"{': it has the opposite sign' if opposite else ''}"
        )


def _opposite(logged: LoggedRun, pair: tuple[int, ...], joints: Sequence[Joint]) -> Iterator[str]:
    """Compare the links, which are one body and turn oppositely; a joint with one encoder through its gear."""
    one, two = (
        logged.table.joint(number, joints[number - 1].gear_ratio).link_position_rad for number in pair
    )
    assert one is not None
    assert two is not None
    if max(float(np.ptp(one)), float(np.ptp(two))) < _LEAST_MOTION_RAD:
        return
    dx: FloatArray = one - one.mean()
    variance = float(dx @ dx)
    slope = float(dx @ (two - two.mean())) / variance if variance else np.inf
    if abs(slope + 1.0) > _OPPOSITE_TOLERANCE:
        link = logged.table.joints[pair[1]].link_position_rad is not None
        name = "link_position_rad:" if link else "motor_position_rad: through the gear"
        yield f"j{pair[1]}.{name} found it turning {slope:.4g} times as far as j{pair[0]}'s, expected -1"
