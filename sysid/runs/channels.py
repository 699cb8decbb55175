"""Channels of a joint against each other: dead, stuck, saturated, wrong sign or scale, gear ratio, columns of another joint.

Nothing here is a fit of friction. Every check holds whatever the friction may be:

- A torque or current of a moving joint that is constant while its partner changes is stuck, or saturated where the number is
  the channel's extreme. At standstill stiction can hold the torque.
- The motor's velocity is the derivative of its position. Motor and link turn by the gear ratio.
- A motor that carries far more than its friction has a torque of its current's sign. Where it has not, the energy lost,
  the integral of (G Kt i - tau) v dt, shows which of the two is inverted: losses are positive.

`check_channels` holds for every use of a run. `check_energy` and `check_spikes` are for a diagnosis.

Columns that were exchanged between two joints are found by the torque balance, with coefficients fitted to each run, so
that a joint file with wrong friction does no harm:

    G Kt i = g tau + c sign(v) + f v + J dv/dt + z        g in 0.5..2;  c, f, J not below zero

Where an exchange leaves less than LESS of the error of both joints, and the error is more than MATTERS of the rated torque,
the columns were exchanged. Where all columns of two joints were exchanged only the joint files show it: each joint must
then fit the other's file better. Two joints with equal files and all columns exchanged are the same two joints.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel, static_friction
from jtqd.estimator.run import JointColumns, RunTable


class RunIssue(NamedTuple):
    """What a check noticed about runs or joint file.

    kind: a fixed name for programs, e.g. "torque_nm_stuck"; text: one line with what was found and what was expected.
    """

    kind: str
    text: str


MOVING_RAD_S: Final = 0.02
"""Joint side; slower joints are not asked."""
STUCK_S: Final = 0.2
"""A moving joint's torque or current does not stay one number for so long, unless all else stands as well."""
PARTNER_MOVED: Final = 0.1
"""Share of rated torque by which the motor torque must have moved before a constant sensor is called stuck."""
SENSOR_MOVED: Final = 0.5
"""The same for the sensor beside a constant current: a commanded current is constant, and friction may vary."""
RATIO_TOLERANCE: Final = 0.01
"""Gear ratio from the positions against the joint file."""
TWIST_RAD: Final = 3e-3
"""Of a harmonic drive at rated torque, as catalogues have it: between positions so far apart, a ratio may be off by that."""
VELOCITY_TOLERANCE: Final = 0.05
"""Motor velocity against the derivative of the motor's position."""
TURNED_RAD: Final = 0.5
"""Joint side; positions that moved less say nothing about ratio and signs."""
_BLOCK_S: Final = 0.05
_SPIKE: Final = 12.0
"""Times the usual step of the channel from row to row, and more than _SPIKE_RATED of rated torque."""
_SPIKE_RATED: Final = 0.1
_ENERGY: Final = -0.3
"""Losses below this part of the file's friction power mean that motion and torque have not the same sign."""


def check_channels(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Return what is wrong with the measured columns of one joint in one run; an empty list is good.

    time_s [n]; run: columns as read, not derived (a derived position agrees with itself); `where` names run and joint
    in the texts, e.g. "forward_1.csv.gz: j1". Columns that are not there are not checked.
    """
    speed = _speed(time_s, run, joint)
    issues = _dead(run, joint, where)
    if any(item.kind == "motor_velocity_rad_s_dead" for item in issues):
        return issues
    issues += _positions(time_s, run, joint, where)
    if speed is not None and run.current_a is not None and run.torque_nm is not None:
        moving = np.abs(speed) > MOVING_RAD_S
        motor_nm = joint.gear_ratio * joint.torque_constant_nm_per_a * run.current_a
        rated = joint.rated_torque_nm
        torque, current = (run.torque_nm, f"{where}.torque_nm"), (run.current_a, f"{where}.current_a")
        issues += _held(time_s, *torque, partner_nm=motor_nm, moved_nm=PARTNER_MOVED * rated, moving=moving)
        issues += _held(
            time_s, *current, partner_nm=run.torque_nm, moved_nm=SENSOR_MOVED * rated, moving=moving
        )
        if not issues:
            issues += _signs(time_s, motor_nm, run.torque_nm, speed, joint=joint, where=where)
    return issues


def gear_ratio_of(time_s: FloatArray, run: JointColumns) -> float | None:
    """Return motor turns per link turn by the two positions, signed; None where they moved too little.

    The median over blocks of 0.2 s in which the link turned: a position that rolls over spoils single blocks only.
    """
    if run.motor_position_rad is None or run.link_position_rad is None:
        return None
    step = max(1, round(0.2 / float(np.median(np.diff(time_s)))))
    motor, link = np.diff(run.motor_position_rad[::step]), np.diff(run.link_position_rad[::step])
    turned = np.abs(link) > 2e-3
    if float(np.sum(np.abs(link[turned]))) < TURNED_RAD:
        return None
    return float(np.median(motor[turned] / link[turned]))


def integral(time_s: FloatArray, signal: FloatArray) -> FloatArray:
    """Return the integral [n] of a signal from the first sample on (trapezoids)."""
    steps = 0.5 * (signal[1:] + signal[:-1]) * np.diff(time_s)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _speed(time_s: FloatArray, run: JointColumns, joint: Joint) -> FloatArray | None:
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    return None if velocity is None else velocity / joint.gear_ratio


def _dead(run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Channels that are exactly zero although something else shows that they should not be."""
    issues = []
    torque, current, velocity = run.torque_nm, run.current_a, run.motor_velocity_rad_s
    if torque is not None and not np.any(torque):
        issues.append(_exactly_zero("torque_nm", where, len(torque), "the torque of the motor's current"))
    loaded = torque is not None and float(np.max(np.abs(torque))) > 0.5 * joint.rated_torque_nm
    if current is not None and not np.any(current) and loaded:
        issues.append(
            _exactly_zero("current_a", where, len(current), "a current beside more than half rated torque")
        )
    for name in ("motor_position_rad", "link_position_rad"):
        position = getattr(run, name)
        turned = position is not None and float(np.ptp(position)) / (
            joint.gear_ratio if name.startswith("motor") else 1.0
        )
        if velocity is not None and not np.any(velocity) and turned and turned > TURNED_RAD:
            issues.append(
                _exactly_zero("motor_velocity_rad_s", where, len(velocity), f"the derivative of {name}")
            )
            break
    return issues


def _exactly_zero(channel: str, where: str, rows: int, expected: str) -> RunIssue:
    return RunIssue(
        f"{channel}_dead",
        f"{where}.{channel}: found exactly zero in all {rows} rows, expected {expected}: dead channel",
    )


def _positions(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Motor velocity against motor position, motor against link position."""
    issues = []
    motor, link, velocity = run.motor_position_rad, run.link_position_rad, run.motor_velocity_rad_s
    if motor is not None and velocity is not None:
        step = max(1, round(_BLOCK_S / float(np.median(np.diff(time_s)))))
        by_velocity = np.diff(integral(time_s, velocity)[::step])
        by_position = np.diff(motor[::step])
        if float(np.sum(np.abs(by_velocity))) > TURNED_RAD * joint.gear_ratio:
            # a median: blocks in which a position rolls over are few
            turning = np.abs(by_velocity) > 0.2 * float(np.max(np.abs(by_velocity)))
            slope = float(np.median(by_position[turning] / by_velocity[turning]))
            issues += _slope_issue(slope, where)
        elif float(np.ptp(motor)) > TURNED_RAD * joint.gear_ratio:
            issues.append(
                RunIssue(
                    "motor_velocity_rad_s_scale",
                    f"{where}.motor_velocity_rad_s: found almost no motion while motor_position_rad turned by "
                    f"{float(np.ptp(motor)):.3g} rad, expected its derivative: stuck, or of the joint side",
                )
            )
    ratio = gear_ratio_of(time_s, run)
    if ratio is None and link is not None and motor is not None:
        turned = float(np.ptp(motor)) / joint.gear_ratio
        if turned > TURNED_RAD and float(np.ptp(link)) < 0.05 * turned:
            issues.append(
                RunIssue(
                    "link_position_rad_stuck",
                    f"{where}.link_position_rad: found {float(np.ptp(link)):.3g} rad of motion while the motor "
                    f"turned the joint by {turned:.3g} rad: stuck channel",
                )
            )
    elif ratio is not None and ratio < 0.0:
        issues.append(
            RunIssue(
                "link_position_rad_sign",
                f"{where}.link_position_rad: found it turning against motor_position_rad "
                f"({ratio:.5g} motor turns per turn), expected the same direction: swapped sign",
            )
        )
    if ratio is not None and abs(abs(ratio) / joint.gear_ratio - 1.0) > _ratio_tolerance(run):
        issues.append(
            RunIssue(
                "gear_ratio",
                f"{where}: found {abs(ratio):.5g} motor turns per turn of the link, expected gear_ratio "
                f"{joint.gear_ratio:g} of {joint.name}: wrong gear ratio, or a position scaled wrongly",
            )
        )
    return issues


def _ratio_tolerance(run: JointColumns) -> float:
    """Return by how much motor turns per link turn may differ from the gear ratio: in a small swing a spring does that."""
    swing = 0.0 if run.link_position_rad is None else float(np.ptp(run.link_position_rad))
    return max(RATIO_TOLERANCE, TWIST_RAD / swing if swing > 0.0 else np.inf)


def _slope_issue(slope: float, where: str) -> list[RunIssue]:
    channel = f"{where}.motor_velocity_rad_s"
    if abs(slope + 1.0) < VELOCITY_TOLERANCE:
        return [
            RunIssue(
                "motor_velocity_rad_s_sign",
                f"{channel}: found the opposite of the derivative of motor_position_rad: one of them has a swapped sign",
            )
        ]
    if abs(slope) < 1e-3:
        return [
            RunIssue(
                "motor_position_rad_stuck",
                f"{where}.motor_position_rad: found no motion while motor_velocity_rad_s is not zero: stuck channel",
            )
        ]
    if abs(slope - 1.0) > VELOCITY_TOLERANCE:
        return [
            RunIssue(
                "motor_velocity_rad_s_scale",
                f"{channel}: found {1.0 / slope:.4g} times the derivative of motor_position_rad, expected the same: "
                "a wrong scale, or one of them stuck for a part of the run",
            )
        ]
    return []


def _held(
    time_s: FloatArray,
    channel: FloatArray,
    name: str,
    *,
    partner_nm: FloatArray,
    moved_nm: float,
    moving: NDArray[np.bool_],
) -> list[RunIssue]:
    """At most one issue per channel: stretches of one number, of a moving joint, in which the partner moved by moved_nm."""
    # Runs of equal values: a new one begins where the value changes or the joint starts or stops moving.
    new = np.diff(channel, prepend=math.nan) != 0.0
    starts = np.flatnonzero(new | np.diff(moving, prepend=not moving[0]))
    ends = np.append(starts[1:], len(channel))
    seconds = time_s[ends - 1] - time_s[starts]
    block = max(1, round(_BLOCK_S / float(np.median(np.diff(time_s)))))
    held: dict[float, float] = {}
    first: dict[float, int] = {}
    for start, end, length in zip(starts, ends, seconds, strict=True):
        if length < STUCK_S or not moving[start]:
            continue
        whole = (end - start) // block * block
        blocks = partner_nm[start : start + whole].reshape(-1, block).mean(axis=1)
        if float(np.ptp(blocks)) > moved_nm:
            value = float(channel[start])
            held[value] = held.get(value, 0.0) + float(length)
            first.setdefault(value, int(start))
    if not held:
        return []
    value = max(held, key=lambda v: held[v])
    extreme = value in (float(np.min(channel)), float(np.max(channel)))
    comes_back = bool(
        np.any(channel[first[value] :] != value)
    )  # what never moves again has not reached a limit
    saturated = extreme and comes_back
    quantity = name.rsplit(".", 1)[-1]
    unit = "Nm" if quantity == "torque_nm" else "A"
    return [
        RunIssue(
            f"{quantity}_{'saturated' if saturated else 'stuck'}",
            f"{name}: found exactly {value:g} {unit} for {sum(held.values()):.2g} s of motion in which "
            f"{'the motor torque' if quantity == 'torque_nm' else 'the measured torque'} moved by more than "
            f"{moved_nm:g} Nm: {'saturated' if saturated else 'stuck'} channel",
        )
    ]


def _signs(
    time_s: FloatArray,
    motor_nm: FloatArray,
    torque: FloatArray,
    speed: FloatArray,
    *,
    joint: Joint,
    where: str,
) -> list[RunIssue]:
    """Torque against current where the motor carries more than twice its friction; the energy shows which is swapped."""
    loaded = (np.abs(motor_nm) > 2.0 * static_friction(joint.friction)) & (np.abs(speed) > MOVING_RAD_S)
    if np.count_nonzero(loaded) < 20 or float(np.mean(motor_nm[loaded] * torque[loaded] > 0.0)) > 0.2:
        return []
    if_torque_is_swapped = float(integral(time_s, np.where(loaded, (motor_nm + torque) * speed, 0.0))[-1])
    swapped, other = ("torque_nm", "current_a") if if_torque_is_swapped > 0.0 else ("current_a", "torque_nm")
    return [
        RunIssue(
            f"{swapped}_sign",
            f"{where}.{swapped}: found the opposite sign of {other} while the motor carries more than its friction, "
            f"expected the same: swapped sign of {swapped} (with the other sign the joint loses energy)",
        )
    ]


def check_energy(time_s: FloatArray, run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Friction takes energy out of motion; where motion gains it, velocity and torque are of opposite signs."""
    velocity = run.derived(time_s, joint.gear_ratio).motor_velocity_rad_s
    if velocity is None or run.current_a is None or run.torque_nm is None:
        return []
    v = velocity / joint.gear_ratio
    lost = (joint.gear_ratio * joint.torque_constant_nm_per_a * run.current_a - run.torque_nm) * v
    friction = FrictionModel(joint.friction).torque_many(v) * v
    moving = np.abs(v) > MOVING_RAD_S
    if np.count_nonzero(moving) < 100 or not float(np.sum(friction[moving])) > 0.0:
        return []
    share = float(np.sum(lost[moving]) / np.sum(friction[moving]))
    if share > _ENERGY:
        return []
    return [
        RunIssue(
            "motion_sign",
            f"{where}: found {-share:.2g} times the friction power of {joint.name} gained instead of lost, expected a loss: "
            "swapped sign of positions and velocities, or of current and torque_nm",
        )
    ]


def one_value(run: JointColumns, where: str) -> list[RunIssue]:
    """Motion and current that are one number in the whole run; a current of zero may be that beside motion."""
    motion = ("motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "link_velocity_rad_s")
    there = {name: column for name in motion if (column := getattr(run, name)) is not None}
    stands = bool(there) and all(np.ptp(column) == 0.0 for column in there.values())
    current = run.current_a
    issues = []
    if stands:
        text = f"{where}: found one value of {' and '.join(there)} in the whole run, expected motion"
        issues.append(RunIssue("standing", f"{text}: the joint stands, or dead channel"))
    if current is not None and np.ptp(current) == 0.0 and (stands or current[0] != 0.0):
        text = f"{where}.current_a: found {current[0]:.4g} A in the whole run, expected a measurement that changes"
        issues.append(RunIssue("current_a_constant", f"{text}: dead channel, or a command"))
    return issues


def check_spikes(run: JointColumns, joint: Joint, where: str) -> list[RunIssue]:
    """Jumps of the sensor from one row to the next: a spike or a drop-out is two of them."""
    torque = run.torque_nm
    if torque is None:
        return []
    steps = np.abs(np.diff(torque))
    limit = max(_SPIKE * float(np.median(steps)), _SPIKE_RATED * joint.rated_torque_nm)
    count = int(np.count_nonzero(steps > limit))
    if not count:
        return []
    return [
        RunIssue(
            "torque_nm_spikes",
            f"{where}.torque_nm: found {counted(count, 'jump')} of more than {limit:.3g} Nm from one row to the next: "
            "spikes or drop-outs",
        )
    ]


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
