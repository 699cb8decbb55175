"""Is this run what it was meant to be? Looks at a run table beside its set-points and names what is wrong. Pure.

Nothing here judges a model. What is found are missing cycles, broken channels, wrong wiring, and motions that did not
take place.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from estimator.friction import FloatArray
from estimator.parameters import Joint
from sysid.campaign.log_to_run import LoggedRun
from sysid.channel_checks import check_channels
from sysid.motion.setpoints import PERIOD_S, Setpoints

LONGEST_GAP_S: Final = 0.0095
"""A longer step, of 10 cycles or more: the table would be refused by whoever reads it (sim_can.run_files)."""
LOST_SHARE: Final = 0.01
FOLLOW_VELOCITY: Final = (0.05, 0.05)
FOLLOW_CURRENT: Final = (0.1, 0.05)
"""RMS that is allowed between set-point and measurement: rad/s or A, and a part of the peak."""
OPPOSITE_TOLERANCE: Final = 0.02
MOVED_RAD: Final = 1.0
"""Least motion of a link from which the other one's says anything."""


def unusable(logged: LoggedRun) -> str | None:
    """Why a table cannot be kept at all, or None."""
    if logged.longest_gap_s > LONGEST_GAP_S:
        time_s = logged.table.time_s
        at = time_s[int(np.argmax(np.diff(time_s)))]
        return (
            f"found a gap of {logged.longest_gap_s * 1e3:.1f} ms in the log at {at:.3f} s, "
            f"expected at most {LONGEST_GAP_S * 1e3:.1f} ms"
        )
    return None


def findings(
    logged: LoggedRun, setpoints: Setpoints, joints: tuple[Joint, Joint], *, sensor: bool
) -> tuple[str, ...]:
    """What is wrong with a run, a line each; empty when nothing is.

    Args:
        logged: whose first row belongs to the first set-point.
        joints: as jtqd was told. sensor: the bench has a torque sensor.
    """
    table = logged.table
    channels = [
        item.text
        for number, joint in zip((1, 2), joints, strict=True)
        for item in check_channels(table.time_s, table.joints[number], joint, f"j{number}")
    ]
    return (
        *_lost(logged),
        *(_no_sensor(logged) if sensor else ()),
        *channels,
        *_followed(logged, setpoints, joints),
        *_opposite(logged),
    )


def _lost(logged: LoggedRun) -> Iterator[str]:
    if logged.lost_share <= LOST_SHARE:
        return
    by = ", ".join(f"{name} {count}" for name, count in logged.incomplete_by.items() if count)
    yield (
        f"cycles: found {logged.lost_share:.1%} missing ({logged.missed} without a cycle, {logged.incomplete} incomplete"
        f"{': ' + by if by else ''}), expected at most {LOST_SHARE:.0%}"
    )


def _no_sensor(logged: LoggedRun) -> Iterator[str]:
    for number, columns in logged.table.joints.items():
        if columns.torque_nm is None:
            yield f"j{number}.torque_nm: found no value in the whole run, expected the sensor's: dead channel"


def _followed(logged: LoggedRun, setpoints: Setpoints, joints: tuple[Joint, Joint]) -> Iterator[str]:
    """The velocity joint against its velocity, the other one against its current."""
    table = logged.table
    place = np.minimum(np.round(table.time_s / PERIOD_S).astype(np.intp), len(setpoints) - 1)
    mover, driver = setpoints.velocity_joint, setpoints.current_joint
    velocity, current = table.joints[mover].motor_velocity_rad_s, table.joints[driver].current_a
    assert velocity is not None  # log_to_run sees to it that these are there
    assert current is not None
    joint_side = velocity / joints[mover - 1].gear_ratio
    yield from _follows(
        joint_side,
        setpoints.velocity_rad_s[place],
        FOLLOW_VELOCITY,
        f"j{mover}.motor_velocity_rad_s: through the gear",
        "rad/s",
    )
    yield from _follows(current, setpoints.current_a[place], FOLLOW_CURRENT, f"j{driver}.current_a:", "A")


def _follows(
    found: FloatArray, wanted: FloatArray, allowed: tuple[float, float], what: str, unit: str
) -> Iterator[str]:
    rms = float(np.sqrt(np.mean((found - wanted) ** 2)))
    limit = allowed[0] + allowed[1] * float(np.abs(wanted).max())
    if rms <= limit:
        return
    opposite = float(np.sqrt(np.mean((found + wanted) ** 2))) <= limit
    yield (
        f"{what} found {rms:.3g} {unit} rms off the set-point, expected at most {limit:.3g} {unit}"
        f"{': it has the opposite sign' if opposite else ''}"
    )


def _opposite(logged: LoggedRun) -> Iterator[str]:
    """The links are one body: in their own frames they turn oppositely."""
    one, two = (logged.table.joints[number].link_position_rad for number in (1, 2))
    assert one is not None
    assert two is not None
    if max(float(np.ptp(one)), float(np.ptp(two))) < MOVED_RAD:
        return
    dx: FloatArray = one - one.mean()
    variance = float(dx @ dx)
    slope = float(dx @ (two - two.mean())) / variance if variance else np.inf
    if abs(slope + 1.0) > OPPOSITE_TOLERANCE:
        yield f"j2.link_position_rad: found it turning {slope:.4g} times as far as j1's, expected -1"
