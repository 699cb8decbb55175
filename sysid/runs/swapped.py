"""Columns of two joints that were exchanged, in part or whole: found by the torque balances.

A joint's current, motion and torque belong together:

    G Kt i = g tau + c sign(v) + f v + J dv/dt + z        g in 0.5..2;  c, f, J not below zero

with coefficients fitted to each run, so that a joint file with wrong friction does no harm. With one column of another
joint the balance is off by as much as the two columns differ. Where an exchange between two joints leaves less than half of
the error (LESS) of both together, and the error is more than MATTERS of the rated torque, the columns were exchanged. If all
columns of two joints were, only the joint files tell: there all coefficients are the files', and each joint must fit the
other's file better. Two joints with equal files and all columns exchanged are the same two joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.sysid.runs.channels import MOVING_RAD_S, RunIssue

LESS: Final = 0.5
MATTERS: Final = 0.02
_BIN_S: Final = 0.02
_FEWEST: Final = 50
_GAIN: Final = (0.5, 2.0)
_PARTS: Final = {"current_a": (1, 0, 0), "torque_nm": (0, 0, 1), "position and velocity": (0, 1, 0)}
"""What may be exchanged: which of current, motion and torque come from the other joint."""

Signals = tuple[FloatArray, FloatArray, FloatArray]
"""Current [A], velocity of the motor [rad/s], torque [Nm] in bins of _BIN_S."""


def swapped_columns(
    table: RunTable, joints: Mapping[int, Joint], where: str
) -> list[tuple[int, int, RunIssue]]:
    """Return the pairs of joints whose columns were exchanged in this run, and the line that says so."""
    signals = {}
    for number in sorted(set(joints) & set(table.joints)):
        found = _signals(table.time_s, table.joints[number], joints[number])
        if found is not None:
            signals[number] = found
    out: list[tuple[float, int, int, str]] = []
    for a, b in combinations(signals, 2):
        out += _exchanged(a, b, signals[a], signals[b], joints)
    taken: set[int] = set()
    issues = []
    for _, a, b, text in sorted(out):
        if not {a, b} & taken:
            taken |= {a, b}
            issues.append((a, b, RunIssue("columns_swapped", f"{where}: {text}" if where else text)))
    return issues


def _signals(time_s: FloatArray, columns: JointColumns, joint: Joint) -> Signals | None:
    """Return the signals of one joint, None where one is missing or the joint hardly moves."""
    velocity = columns.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    if columns.current_a is None or columns.torque_nm is None or velocity is None:
        return None
    samples = max(1, round(_BIN_S / float(np.median(np.diff(time_s)))))
    count = len(time_s) // samples
    current, speed, torque = (
        x[: count * samples].reshape(count, samples).mean(axis=1)
        for x in (columns.current_a, velocity, columns.torque_nm)
    )
    if np.count_nonzero(np.abs(speed) > MOVING_RAD_S * joint.gear_ratio) < _FEWEST or not np.any(torque):
        return None
    return current, speed, torque


def _exchanged(
    a: int, b: int, one: Signals, two: Signals, joints: Mapping[int, Joint]
) -> list[tuple[float, int, int, str]]:
    """Return by how much the error falls, and the line, where an exchange between two joints explains both."""
    least = MATTERS * float(np.hypot(joints[a].rated_torque_nm, joints[b].rated_torque_nm))
    own = float(np.hypot(balance_error(one, joints[a]), balance_error(two, joints[b])))
    errors = {}
    for what, which in _PARTS.items():
        mixed = tuple(y if other else x for x, y, other in zip(one, two, which, strict=True))
        back = tuple(x if other else y for x, y, other in zip(one, two, which, strict=True))
        errors[what] = float(np.hypot(balance_error(mixed, joints[a]), balance_error(back, joints[b])))  # type: ignore[arg-type]
    best = min(errors, key=lambda what: errors[what])
    if own > least and errors[best] < LESS * own:
        what = f"j{a} and j{b}, {best}" if " " in best else f"j{a}.{best} and j{b}.{best}"
        return [
            (
                errors[best] / own,
                a,
                b,
                f"{what}: found the other joint's (the torque balances are off by {own:.3g} Nm rms, exchanged by "
                f"{errors[best]:.3g} Nm), expected each joint's own: swapped columns",
            )
        ]
    files = [[file_error(s, joints[n]) for n in (a, b)] for s in (one, two)]
    better = max(files[0][1] / max(files[0][0], 1e-30), files[1][0] / max(files[1][1], 1e-30))
    if better < LESS and min(files[0][0], files[1][1]) > MATTERS * min(
        joints[n].rated_torque_nm for n in (a, b)
    ):
        return [
            (
                better,
                a,
                b,
                f"j{a} and j{b}: found that each fits the other's joint file ({files[0][1]:.3g} and {files[1][0]:.3g} Nm "
                f"rms) and not its own ({files[0][0]:.3g} and {files[1][1]:.3g} Nm): swapped columns or joint files",
            )
        ]
    return []


def balance_error(signals: Signals, joint: Joint) -> float:
    """Return the rms of the torque balance with coefficients fitted to it [Nm], inside their bounds."""
    current, turning, torque = signals
    speed = turning / joint.gear_ratio
    moving = np.abs(speed) > MOVING_RAD_S
    motor = (joint.gear_ratio * joint.torque_constant_nm_per_a * current)[moving]
    v = speed[moving]
    acceleration = np.gradient(speed, _BIN_S)[moving]
    ladder = np.column_stack((torque[moving], np.sign(v), v, acceleration, np.ones_like(v)))
    low = np.array([_GAIN[0], 0.0, 0.0, 0.0, -np.inf])
    high = np.array([_GAIN[1], *([np.inf] * 4)])
    fixed: dict[int, float] = {}
    while True:
        free = [k for k in range(5) if k not in fixed]
        rest = motor - ladder[:, list(fixed)] @ np.array(list(fixed.values()))
        found, *_ = np.linalg.lstsq(ladder[:, free], rest, rcond=1e-9)
        inside = np.clip(found, low[free], high[free])
        beyond = np.abs(found - inside) * np.sqrt(np.mean(ladder[:, free] ** 2, axis=0))
        worst = int(np.argmax(beyond))
        if not beyond[worst] > 0.0:
            return float(np.sqrt(np.mean((rest - ladder[:, free] @ found) ** 2)))
        fixed[free[worst]] = float(inside[worst])


def file_error(signals: Signals, joint: Joint) -> float:
    """Return the standard deviation of the torque balance with the values of a joint file [Nm]."""
    current, turning, torque = signals
    speed = turning / joint.gear_ratio
    moving = np.abs(speed) > MOVING_RAD_S
    friction = joint.friction.coulomb_nm * np.sign(speed) + joint.friction.viscous_nms_per_rad * speed
    inertia = joint.gear_ratio**2 * joint.rotor_inertia_kgm2
    left = joint.gear_ratio * joint.torque_constant_nm_per_a * current - torque - friction
    return float(np.std((left - inertia * np.gradient(speed, _BIN_S))[moving]))
