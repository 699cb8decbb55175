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

Columns in other units than the run table's, found by their size: degrees, rpm, counts, mNm, mA, ms.

Nothing is converted: a suspected factor belongs into the column map. What is compared holds whatever the friction may be, to
a factor of about two; the units looked for are further apart.

    velocity = d(position)/dt            motor turns = G link turns            sensor torque = slope * G Kt i + friction
    sensor torque = K (theta_m/G - theta_l)                                    peaks = a few times rated torque
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel, static_friction
from jtqd.estimator.run import JointColumns, RunTable
from jtqd.estimator.text import counted

MOVING_RAD_S: Final = 0.02
"""Joint side; slower joints are not judged."""
STUCK_S: Final = 0.2
"""A moving joint's torque or current is not constant for so long, unless everything else is."""
PARTNER_MOVED: Final = 0.1
"""Share of rated torque by which the motor torque must change before a constant sensor counts as stuck."""
SENSOR_MOVED: Final = 0.5
"""The same for the sensor and a constant current: a commanded current is constant, and friction may vary."""
RATIO_TOLERANCE: Final = 0.01
"""Gear ratio from the positions against the joint file."""
TWIST_RAD: Final = 3e-3
"""Play and hysteresis of a gear, beside the twist that the joint file states: a ratio from a swing of this size is off by as
much.
"""
_SOFTER: Final = 2.0
"""Times the twist of the joint file's stiffness: a gear, and a belt more so, is softer than its file."""
VELOCITY_TOLERANCE: Final = 0.05
"""Motor velocity against the derivative of the motor's position."""
TURNED_RAD: Final = 0.5
"""Joint side; positions that moved less show neither ratio nor sign."""
_BLOCK_S: Final = 0.05
_SPIKE: Final = 12.0
"""Times the usual step of the channel from row to row, and more than _SPIKE_RATED of rated torque."""
_SPIKE_RATED: Final = 0.1
_MOST_OF_IT: Final = 0.5
"""Part of the motor's torque from which on a known load shows whether the signs agree."""
_ENERGY: Final = -0.3
"""Losses below this part of the file's friction power mean that motion and torque have not the same sign."""
MOTION: Final = ("motor_position_rad", "motor_velocity_rad_s", "link_position_rad", "link_velocity_rad_s")
"""Columns of which any one shows that a joint moves."""


class RunIssue(NamedTuple):
    """Finding of a check of runs or joint file: a fixed name for programs, and one line with what was found and expected."""

    kind: str
    text: str


@dataclass(frozen=True)
class Channels:
    """Columns of one joint as recorded in one run, not derived (a derived position agrees with itself), and its joint file.

    where: run and joint in messages. known_load: the torque is a known load's or a model's and no sensor's: it may be
    constant, zero or small beside the motor's. Columns that are absent are not checked.
    """

    time_s: FloatArray
    run: JointColumns
    joint: Joint
    where: str
    known_load: bool = False

    @cached_property
    def motor_velocity(self) -> FloatArray | None:
        """Velocity of the motor [n, rad/s], derived where it was not recorded; None without any motion."""
        return self.run.derived(self.time_s, self.joint.gear_ratio).motor_velocity_rad_s

    @cached_property
    def speed(self) -> FloatArray | None:
        """Velocity [n, rad/s, joint side]; None without any motion."""
        return None if self.motor_velocity is None else self.motor_velocity / self.joint.gear_ratio

    @cached_property
    def moving(self) -> BoolArray:
        """Rows [n] in which the joint moves."""
        if self.speed is None:
            return np.zeros(len(self.time_s), np.bool_)
        return np.asarray(np.abs(self.speed) > MOVING_RAD_S, np.bool_)

    @cached_property
    def motor_nm(self) -> FloatArray | None:
        """Motor torque G Kt i [n, Nm]; None without a current."""
        current = self.run.current_a
        return (
            None if current is None else self.joint.gear_ratio * self.joint.torque_constant_nm_per_a * current
        )

    def rows(self, seconds: float) -> int:
        """Return the number of rows in a time, at least 1."""
        return max(1, round(seconds / float(np.median(np.diff(self.time_s)))))

    @cached_property
    def motor_steps(self) -> tuple[FloatArray, FloatArray] | None:
        """Motion of the motor in blocks of _BLOCK_S [rad] by its position and by its velocity; None where one is absent."""
        position, velocity = self.run.motor_position_rad, self.run.motor_velocity_rad_s
        if position is None or velocity is None:
            return None
        step = self.rows(_BLOCK_S)
        return np.diff(position[::step]), np.diff(integral(self.time_s, velocity)[::step])

    @cached_property
    def gear_ratio(self) -> float | None:
        """Motor turns per link turn by the two positions, signed; None where one of them moved too little.

        The median over blocks of 0.2 s in which the link turned much, as little travel shows the twist and not the ratio: a
        position that rolls over spoils single blocks only.
        """
        if self.run.motor_position_rad is None or self.run.link_position_rad is None:
            return None
        step = self.rows(0.2)
        motor, link = (np.diff(x[::step]) for x in (self.run.motor_position_rad, self.run.link_position_rad))
        turned = np.abs(link) > max(2e-3, 0.2 * float(np.quantile(np.abs(link), 0.9)))
        if float(np.sum(np.abs(link[turned]))) < TURNED_RAD:
            return None
        return float(np.median(motor[turned] / link[turned])) or None

    def issue(self, channel: str, fault: str, text: str) -> RunIssue:
        """Return the issue of a channel of this joint, of kind CHANNEL_FAULT."""
        return RunIssue(f"{channel}_{fault}", f"{self.where}.{channel}: {text}")


def check_channels(c: Channels) -> list[RunIssue]:
    """Return what is wrong with the columns of one joint; an empty list is good."""
    issues = [*_dead(c)]
    if any(each.kind == "motor_velocity_rad_s_dead" for each in issues):
        return issues
    issues += _positions(c)
    torque, motor_nm = c.run.torque_nm, c.motor_nm
    if c.speed is not None and motor_nm is not None and torque is not None:
        if not c.known_load:
            issues += _constant(c, "torque_nm", motor_nm, PARTNER_MOVED * c.joint.rated_torque_nm)
        issues += _constant(c, "current_a", torque, SENSOR_MOVED * c.joint.rated_torque_nm)
        if not issues:
            issues += _signs(c, c.speed, motor_nm, torque)
    return issues


def integral(time_s: FloatArray, signal: FloatArray) -> FloatArray:
    """Return the integral [n] of a signal from the first sample on (trapezoids)."""
    steps = 0.5 * (signal[1:] + signal[:-1]) * np.diff(time_s)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _dead(c: Channels) -> Iterator[RunIssue]:
    """Yield channels that are exactly zero although another one shows that they should not be."""

    def dead(channel: str, expected: str) -> RunIssue:
        rows = len(c.time_s)
        return c.issue(
            channel, "dead", f"found exactly zero in all {rows} rows, expected {expected}: dead channel"
        )

    torque, current, velocity = c.run.torque_nm, c.run.current_a, c.run.motor_velocity_rad_s
    if torque is not None and not np.any(torque) and not c.known_load:
        yield dead("torque_nm", "the torque of the motor's current")
    loaded = torque is not None and float(np.max(np.abs(torque))) > 0.5 * c.joint.rated_torque_nm
    if current is not None and not np.any(current) and loaded:
        yield dead("current_a", "a current for more than half rated torque")
    if velocity is not None and not np.any(velocity):
        for name, ratio in (("motor_position_rad", c.joint.gear_ratio), ("link_position_rad", 1.0)):
            position = getattr(c.run, name)
            if position is not None and float(np.ptp(position)) / ratio > TURNED_RAD:
                yield dead("motor_velocity_rad_s", f"the derivative of {name}")
                break


def _positions(c: Channels) -> Iterator[RunIssue]:
    """Yield contradictions of motor velocity and motor position, of motor and link position."""
    motor, link, gear = c.run.motor_position_rad, c.run.link_position_rad, c.joint.gear_ratio
    if c.motor_steps is not None and motor is not None:
        by_position, by_velocity = c.motor_steps
        if float(np.sum(np.abs(by_velocity))) > TURNED_RAD * gear:
            # a median: blocks in which a position rolls over are few
            turning = np.abs(by_velocity) > 0.2 * float(np.max(np.abs(by_velocity)))
            yield from _velocity_scale(c, float(np.median(by_position[turning] / by_velocity[turning])))
        elif float(np.ptp(motor)) > TURNED_RAD * gear:
            text = f"found almost none while the motor turned {float(np.ptp(motor)):.3g} rad: stuck, or of the joint side"
            yield c.issue("motor_velocity_rad_s", "scale", text)
    ratio = c.gear_ratio
    if ratio is None and link is not None and motor is not None:
        turned = float(np.ptp(motor)) / gear
        if turned > TURNED_RAD and float(np.ptp(link)) < 0.05 * turned:
            text = f"found {float(np.ptp(link)):.3g} rad while the motor turned the joint by {turned:.3g}: stuck channel"
            yield c.issue("link_position_rad", "stuck", text)
    elif ratio is not None and ratio < 0.0:
        text = f"found it turning against motor_position_rad ({ratio:.5g} motor turns per turn): swapped sign"
        yield c.issue("link_position_rad", "sign", text)
    # in a small swing the twist of the gear looks like another ratio
    swing = 0.0 if link is None else float(np.ptp(link))
    loads = [float(np.ptp(x)) for x in (c.run.torque_nm, c.motor_nm) if x is not None]
    twist = TWIST_RAD + _SOFTER * min(loads, default=0.0) / c.joint.stiffness_nm_per_rad
    tolerance = max(RATIO_TOLERANCE, twist / swing if swing > 0.0 else math.inf)
    if ratio is not None and abs(abs(ratio) / gear - 1.0) > tolerance:
        text = f"found {abs(ratio):.5g} motor turns per link turn, expected gear_ratio {gear:g} of {c.joint.name}"
        yield RunIssue("gear_ratio", f"{c.where}: {text}: wrong gear ratio, or a position scaled wrongly")


def _velocity_scale(c: Channels, slope: float) -> Iterator[RunIssue]:
    """slope: motion by the motor's position per motion by its velocity."""
    if abs(slope + 1.0) < VELOCITY_TOLERANCE:
        text = "found the opposite of the derivative of motor_position_rad: one of them has a swapped sign"
        yield c.issue("motor_velocity_rad_s", "sign", text)
    elif abs(slope) < 1e-3:
        text = "found no motion while motor_velocity_rad_s is not zero: stuck channel"
        yield c.issue("motor_position_rad", "stuck", text)
    elif abs(slope - 1.0) > VELOCITY_TOLERANCE:
        text = f"found {1.0 / slope:.4g} times the derivative of motor_position_rad: a wrong scale, or stuck in part"
        yield c.issue("motor_velocity_rad_s", "scale", text)


def _constant(c: Channels, name: str, partner_nm: FloatArray, moved_nm: float) -> Iterator[RunIssue]:
    """Yield at most one issue: stretches of one number, of a moving joint, in which the partner moved by moved_nm."""
    time_s, moving, channel = c.time_s, c.moving, getattr(c.run, name)
    # a stretch begins where the value changes or the joint starts or stops moving
    new = np.diff(channel, prepend=math.nan) != 0.0
    starts = np.flatnonzero(new | np.diff(moving, prepend=not moving[0]))
    ends = np.append(starts[1:], len(channel))
    block = c.rows(_BLOCK_S)
    held_s: dict[float, float] = {}
    first: dict[float, int] = {}
    for start, end, length in zip(starts, ends, time_s[ends - 1] - time_s[starts], strict=True):
        if length < STUCK_S or not moving[start]:
            continue
        whole = (end - start) // block * block
        if float(np.ptp(partner_nm[start : start + whole].reshape(-1, block).mean(axis=1))) > moved_nm:
            value = float(channel[start])
            held_s[value] = held_s.get(value, 0.0) + float(length)
            first.setdefault(value, int(start))
    if not held_s:
        return
    value = max(held_s, key=lambda v: held_s[v])
    extreme = value in (float(np.min(channel)), float(np.max(channel)))
    # a channel that never moves again has not reached a limit
    fault = "saturated" if extreme and np.any(channel[first[value] :] != value) else "stuck"
    unit, partner = ("Nm", "motor") if name == "torque_nm" else ("A", "measured")
    held = f"found exactly {value:g} {unit} for {sum(held_s.values()):.2g} s of motion"
    text = f"{held} in which the {partner} torque moved by more than {moved_nm:g} Nm: {fault} channel"
    yield c.issue(name, fault, text)


def _signs(c: Channels, speed: FloatArray, motor_nm: FloatArray, torque: FloatArray) -> Iterator[RunIssue]:
    """Torque against current where the motor carries more than twice its friction; the energy shows which is inverted."""
    if c.known_load and _peak(torque) < _MOST_OF_IT * _peak(motor_nm):
        return  # the motor turns little but its own rotor
    loaded = (np.abs(motor_nm) > 2.0 * static_friction(c.joint.friction)) & c.moving
    if np.count_nonzero(loaded) < 20 or float(np.mean(motor_nm[loaded] * torque[loaded] > 0.0)) > 0.2:
        return
    lost_if_torque = float(integral(c.time_s, np.where(loaded, (motor_nm + torque) * speed, 0.0))[-1])
    swapped, other = ("torque_nm", "current_a") if lost_if_torque > 0.0 else ("current_a", "torque_nm")
    text = f"found the opposite sign of {other} under load (a gain of energy): swapped sign of {swapped}"
    yield c.issue(swapped, "sign", f"{text}{', or hangs_at_rad off by pi' if c.known_load else ''}")


def check_energy(c: Channels) -> Iterator[RunIssue]:
    """Friction takes energy out of motion; where motion gains it, velocity and torque are of opposite signs."""
    v, motor_nm, torque, moving = c.speed, c.motor_nm, c.run.torque_nm, c.moving
    if v is None or motor_nm is None or torque is None:
        return
    friction = FrictionModel(c.joint.friction).torque_many(v) * v
    if np.count_nonzero(moving) < 100 or not float(np.sum(friction[moving])) > 0.0:
        return
    share = float(np.sum(((motor_nm - torque) * v)[moving]) / np.sum(friction[moving]))
    if share <= _ENERGY:
        text = f"found {-share:.2g} times the friction power of {c.joint.name} gained instead of lost: swapped sign"
        yield RunIssue("motion_sign", f"{c.where}: {text} of the motion, or of current and torque_nm")


def constant_channels(run: JointColumns, where: str) -> Iterator[RunIssue]:
    """Yield motion and current that are one number in the whole run; a current of zero may be so during motion."""
    motion = {name: column for name in MOTION if (column := getattr(run, name)) is not None}
    stands = bool(motion) and all(np.ptp(column) == 0.0 for column in motion.values())
    current = run.current_a
    if stands:
        text = f"{where}: found one value of {' and '.join(motion)} in the whole run, expected motion"
        yield RunIssue("standing", f"{text}: the joint stands, or dead channel")
    if current is not None and np.ptp(current) == 0.0 and (stands or current[0] != 0.0):
        text = f"{where}.current_a: found {current[0]:.4g} A in the whole run, expected a measurement that changes"
        yield RunIssue("current_a_constant", f"{text}: dead channel, or a command")


def check_spikes(c: Channels) -> Iterator[RunIssue]:
    """Jumps of the sensor from one row to the next: a spike or a drop-out is two of them."""
    if c.run.torque_nm is None or c.known_load:
        return
    steps = np.abs(np.diff(c.run.torque_nm))
    limit = max(_SPIKE * float(np.median(steps)), _SPIKE_RATED * c.joint.rated_torque_nm)
    count = int(np.count_nonzero(steps > limit))
    if count:
        text = f"found {counted(count, 'jump')} of more than {limit:.3g} Nm from one row to the next: spikes or drop-outs"
        yield c.issue("torque_nm", "spikes", text)


LESS: Final = 0.5
MATTERS: Final = 0.02
_BIN_S: Final = 0.02
_FEWEST_BINS: Final = 50
_GAIN: Final = (0.5, 2.0)
_EXCHANGES: Final = {"current_a": (1, 0, 0), "torque_nm": (0, 0, 1), "position and velocity": (0, 1, 0)}
"""What may be exchanged: which of current, motion and torque come from the other joint."""

Signals = tuple[FloatArray, ...]
"""Current [A], velocity of the motor [rad/s], torque [Nm] in bins of _BIN_S."""


def swapped_columns(
    table: RunTable, joints: Mapping[int, Joint], where: str
) -> list[tuple[int, int, RunIssue]]:
    """Return the pairs of joints whose columns were exchanged in this run, and the issue."""
    signals = {}
    for number in sorted(set(joints) & set(table.joints)):
        own = _signals(Channels(table.time_s, table.joints[number], joints[number], where))
        if own is not None:
            signals[number] = own
    exchanges = [
        (*found, a, b)
        for a, b in combinations(signals, 2)
        if (found := _exchange(a, b, signals[a], signals[b], joints)) is not None
    ]
    taken: set[int] = set()
    issues = []
    for _, text, a, b in sorted(exchanges, key=lambda each: (each[0], each[2:])):
        if not {a, b} & taken:
            taken |= {a, b}
            issues.append((a, b, RunIssue("columns_swapped", f"{where}: {text}" if where else text)))
    return issues


def _signals(c: Channels) -> Signals | None:
    """Return the signals of one joint, None where one is missing or the joint hardly moves."""
    if c.run.current_a is None or c.run.torque_nm is None or c.motor_velocity is None:
        return None
    samples = c.rows(_BIN_S)
    count = len(c.time_s) // samples
    current, velocity, torque = (
        x[: count * samples].reshape(count, samples).mean(axis=1)
        for x in (c.run.current_a, c.motor_velocity, c.run.torque_nm)
    )
    moving = np.count_nonzero(np.abs(velocity) > MOVING_RAD_S * c.joint.gear_ratio)
    return (current, velocity, torque) if moving >= _FEWEST_BINS and np.any(torque) else None


def _exchange(
    a: int, b: int, one: Signals, two: Signals, joints: Mapping[int, Joint]
) -> tuple[float, str] | None:
    """Return by how much the error falls, and a line, where an exchange between two joints explains both."""
    least = MATTERS * float(np.hypot(joints[a].rated_torque_nm, joints[b].rated_torque_nm))

    def error(first: Signals, second: Signals) -> float:
        return float(np.hypot(_balance_error(first, joints[a]), _balance_error(second, joints[b])))

    own = error(one, two)
    errors = {
        what: error(
            tuple(y if other else x for x, y, other in zip(one, two, which, strict=True)),
            tuple(x if other else y for x, y, other in zip(one, two, which, strict=True)),
        )
        for what, which in _EXCHANGES.items()
    }
    best = min(errors, key=lambda what: errors[what])
    if own > least and errors[best] < LESS * own:
        what = f"j{a} and j{b}, {best}" if " " in best else f"j{a}.{best} and j{b}.{best}"
        text = f"errors of {own:.3g} Nm rms, exchanged {errors[best]:.3g} Nm"
        return errors[best] / own, f"{what}: found the other joint's ({text}): swapped columns"
    (one_a, one_b), (two_a, two_b) = ([_file_error(s, joints[n]) for n in (a, b)] for s in (one, two))
    better = max(one_b / max(one_a, 1e-30), two_a / max(two_b, 1e-30))
    if better < LESS and min(one_a, two_b) > MATTERS * min(joints[n].rated_torque_nm for n in (a, b)):
        text = (
            f"j{a} and j{b}: found that each fits the other's joint file ({one_b:.3g} and {two_a:.3g} Nm rms) and not its "
            f"own ({one_a:.3g} and {two_b:.3g} Nm): swapped columns or joint files"
        )
        return better, text
    return None


def _in_motion(signals: Signals, joint: Joint) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return motor torque [Nm], sensor torque [Nm], velocity and acceleration [rad/s, rad/s2, joint side] in motion."""
    current, velocity, torque = signals
    speed = velocity / joint.gear_ratio
    moving = np.abs(speed) > MOVING_RAD_S
    motor = joint.gear_ratio * joint.torque_constant_nm_per_a * current
    return motor[moving], torque[moving], speed[moving], np.gradient(speed, _BIN_S)[moving]


def _balance_error(signals: Signals, joint: Joint) -> float:
    """Return the rms of the torque balance with coefficients fitted to it [Nm], inside their bounds."""
    motor, torque, v, acceleration = _in_motion(signals, joint)
    regressor = np.column_stack((torque, np.sign(v), v, acceleration, np.ones_like(v)))
    low = np.array([_GAIN[0], 0.0, 0.0, 0.0, -np.inf])
    high = np.array([_GAIN[1], *([np.inf] * 4)])
    fixed: dict[int, float] = {}
    while True:
        free = [k for k in range(5) if k not in fixed]
        rest = motor - regressor[:, list(fixed)] @ np.array(list(fixed.values()))
        found, *_ = np.linalg.lstsq(regressor[:, free], rest, rcond=1e-9)
        inside = np.clip(found, low[free], high[free])
        beyond = np.abs(found - inside) * np.sqrt(np.mean(regressor[:, free] ** 2, axis=0))
        worst = int(np.argmax(beyond))
        if not beyond[worst] > 0.0:
            return float(np.sqrt(np.mean((rest - regressor[:, free] @ found) ** 2)))
        fixed[free[worst]] = float(inside[worst])


def _file_error(signals: Signals, joint: Joint) -> float:
    """Return the standard deviation of the torque balance with the values of a joint file [Nm]."""
    motor, torque, v, acceleration = _in_motion(signals, joint)
    friction = joint.friction.coulomb_nm * np.sign(v) + joint.friction.viscous_nms_per_rad * v
    inertia = joint.gear_ratio**2 * joint.rotor_inertia_kgm2
    return float(np.std(motor - torque - friction - inertia * acceleration))


_CLOSE: Final = 0.05
"""Relative: two angle channels are proportional to each other, so that a factor between them is sharp."""
_SLOPE: Final = (0.2, 5.0)
"""Sensor torque per motor torque, friction aside, is 1; a joint file's torque constant is not wrong by more than this."""
_STIFFNESS: Final = 10.0
"""A joint file's stiffness is not wrong by more than this factor."""
_FASTEST_MOTOR_RAD_S: Final = 1000.0
"""Slower motors are not judged by their speed."""
_FASTEST_RAD_S: Final = 30.0
"""Joint side: no joint behind a gear is faster, in degrees most are. Motors of small servos reach 5000 rad/s."""
_PEAK: Final = 10.0
"""Times rated torque; joints are overloaded two- or threefold."""
_OVER: Final = 3.0
"""Times the speed limit of the joint file: a limit of planned motions is no limit of the joint."""
_ANY_RAD_S: Final = 1e3
_OWN: Final = 1e-6
"""Part of a column that is its own, beyond rounding."""
_LOAD: Final = "mass_kg in g or lever_m in mm of a known load, or a model's torque in another unit"
_HOTTEST_C: Final = 150.0
_STEP_K, _WARMING_K_PER_S = 2.0, 1.0  # between two samples: resolution, and more than any joint warms
_TURN: Final = 1.0 / (2.0 * math.pi)
_ENCODERS: Final = {f"({2**bits} per revolution)": 2**bits / (2.0 * math.pi) for bits in range(10, 25)}
_ANGLES: Final = {
    "degrees": 180.0 / math.pi,
    "revolutions": _TURN,
    **{f"encoder counts {each}": factor for each, factor in _ENCODERS.items()},
}
"""Unit of an angle -> its value per rad."""
_SPEEDS: Final = {
    "rpm": 60.0 / (2.0 * math.pi),
    "degrees per second": 180.0 / math.pi,
    "revolutions per second": _TURN,
    **{f"encoder counts per second {each}": factor for each, factor in _ENCODERS.items()},
}
"""Unit of a velocity -> its value per rad/s."""


def unit_issues(c: Channels) -> list[RunIssue]:
    """Return at most one issue for the columns of a joint: what follows from the first wrong unit is not reported again."""
    for check in (_velocity, _angles, _motor_speed, _torque_and_current, _torsion):
        found = check(c)
        if found is not None:
            return [found]
    return []


def temperature_issue(c: Channels) -> RunIssue | None:
    """Return an issue for a temperature that no joint has, or a step that no joint can make."""
    temperature, time_s = c.run.temperature_c, c.time_s
    if temperature is None:
        return None
    steps = np.abs(np.diff(temperature))
    jumps = np.flatnonzero(steps > _STEP_K + _WARMING_K_PER_S * np.diff(time_s))
    if len(jumps):
        step, at = steps[jumps[0]], time_s[jumps[0] + 1]
        text = f"found a step of {step:.3g} degC at {at:.3f} s, expected none above {_STEP_K:g}; not used"
        return c.issue("temperature_c", "step", text)
    middle = float(np.median(temperature))
    if -60.0 < middle < _HOTTEST_C:
        return None
    guess = "kelvin or tenths of a degree" if 200.0 < middle < 450.0 else "another unit, or a dead channel"
    text = f"found {middle:.4g} degC as median, expected -60 to {_HOTTEST_C:g}: {guess} suspected; not used"
    return c.issue("temperature_c", "unit", text)


def _velocity(c: Channels) -> RunIssue | None:
    """Motor velocity against the derivative of the motor position."""
    if c.motor_steps is None:
        return None
    by_position, by_velocity = c.motor_steps
    if not np.any(by_position) or not np.any(by_velocity):
        return None
    turning = np.abs(by_position) > 0.2 * float(np.max(np.abs(by_position)))
    ratio = abs(float(np.median(by_velocity[turning] / by_position[turning])))
    if _near(ratio, 1.0) or ratio == 0.0:
        return None
    at_speed, at_angle, at_time = ".motor_velocity_rad_s", ".motor_position_rad", ": time_s"
    suspects = [
        *((ratio, factor, at_speed, unit, "rad/s") for unit, factor in _SPEEDS.items()),
        *((1.0 / ratio, factor, at_angle, unit, "rad") for unit, factor in _ANGLES.items()),
        (ratio, 1000.0, at_time, "milliseconds", "seconds"),
        (ratio, 1e6, at_time, "microseconds", "seconds"),
        (ratio, 1.0 / c.joint.gear_ratio, at_speed, "the joint side's velocity", "the motor's"),
        (ratio, 1.0 / 6.0, at_speed, "rpm and degrees", "rad/s and rad"),
    ]
    for found, factor, at, unit, expected in suspects:
        if _near(found, factor):
            text = f"found {ratio:.4g} times the derivative of motor_position_rad, expected the same: {unit} suspected"
            return RunIssue("motor_velocity_rad_s_unit", f"{c.where}{at}: {text}, expected {expected}")
    return None  # a scale without a name: `check_channels` reports it


def _angles(c: Channels) -> RunIssue | None:
    """Motor against link position."""
    if c.gear_ratio is None:
        return None
    turns, gear = abs(c.gear_ratio), c.joint.gear_ratio
    off = turns / gear
    if _near(off, 1.0):  # a direct drive too: both sides are one
        return None
    found = f"found {turns:.5g} motor turns per turn of the link, gear_ratio of {c.joint.name} is {gear:g}"
    for channel, value in (("motor_position_rad", off), ("link_position_rad", 1.0 / off)):
        for unit, factor in _ANGLES.items():
            if _near(value, factor):
                return c.issue(channel, "unit", f"{found}: {unit} suspected, expected rad")
    if _near(off, 1.0 / gear):
        text = f"{found}: an angle of the joint side suspected, expected the motor's"
        return c.issue("motor_position_rad", "unit", text)
    return None


def _motor_speed(c: Channels) -> RunIssue | None:
    """Return an issue for a joint faster than joints are, or than its torque allows: angles are in degrees or counts."""
    if c.motor_velocity is None:
        return None
    top, gear = _peak(c.motor_velocity), c.joint.gear_ratio
    if top < _FASTEST_MOTOR_RAD_S:
        return None
    limits = c.joint.motion_limits
    allowed = max(_FASTEST_RAD_S, _OVER * min(limits.velocity_rad_s, _ANY_RAD_S) if limits else 0.0)
    needed = _needed_nm(c)
    had = max((_peak(x) for x in (c.motor_nm, c.run.torque_nm) if x is not None), default=math.inf)
    if top / gear < allowed and needed < _PEAK * had:
        return None
    position = c.run.link_position_rad if c.run.motor_position_rad is None else c.run.motor_position_rad
    whole = position is not None and bool(np.all(position == np.round(position)))
    text = (
        f"{c.where}: found a motor speed of {top:.4g} rad/s ({top / gear:.4g} rad/s of the joint), which needs "
        f"{needed:.3g} Nm by {c.joint.name}, expected less than {allowed:g} rad/s of the joint, and torques like "
        f"those recorded ({had:.3g} Nm): {'encoder counts' if whole or top > 1e5 else 'degrees'} suspected in "
        "positions and velocities, expected rad and rad/s"
    )
    return RunIssue("motor_velocity_rad_s_unit", text)


def _needed_nm(c: Channels) -> float:
    """Return the torque that the file's rotor and viscous friction need for the motion (99 % quantile), joint side."""
    assert c.speed is not None
    step = c.rows(_BLOCK_S)
    whole = len(c.speed) // step * step
    v = c.speed[:whole].reshape(-1, step).mean(axis=1)
    if len(v) < 2:
        return 0.0
    inertia = c.joint.gear_ratio**2 * c.joint.rotor_inertia_kgm2
    return _peak(inertia * np.gradient(v, _BLOCK_S)) + c.joint.friction.viscous_nms_per_rad * _peak(v)


def _torque_and_current(c: Channels) -> RunIssue | None:
    """Sensor torque against motor torque, and both against rated torque: the one that is out of size is reported."""
    torque, motor = c.run.torque_nm, c.motor_nm
    if torque is None or motor is None:
        return None
    rated = c.joint.rated_torque_nm
    sizes = {"torque_nm": _peak(torque) / rated, "current_a": _peak(motor) / rated}
    slope = _slope(c)
    if c.known_load and slope is not None and abs(slope) < 1.0:
        slope = None if sizes["current_a"] < _PEAK else slope  # rotor and friction may need all the current
    if slope is None or _SLOPE[0] < abs(slope) < _SLOPE[1]:
        if max(sizes.values()) < _PEAK:
            return None
        # both are too large alike: the joint file is common to them
        text = f"found peaks of {sizes['torque_nm']:.3g} times rated_torque_nm ({rated:g}) of {c.joint.name}"
        why = f"expected at most {_PEAK:g}: a joint file of another joint, or {_LOAD if c.known_load else 'mNm and mA'}"
        return RunIssue("joint_file", f"{c.where}: {text}, {why}")
    size = abs(slope)
    if size > 1.0:
        channel, unit = "torque_nm", "mNm or counts"
        if sizes["torque_nm"] < _PEAK and sizes["current_a"] < 0.01:
            channel, unit = "current_a", "kA, or a value relative to rated current,"
        elif 200.0 < size < 5000.0:
            unit = "mNm"
        elif 5.0 < size < 15.0:
            unit = "inch pounds or kgf cm"
    elif sizes["current_a"] > sizes["torque_nm"] and sizes["current_a"] >= _PEAK:
        channel = "current_a"
        unit = "mA or counts" if 1.0 / size > 100.0 else "per mille of rated current, or counts,"
    elif _SLOPE[0] < size * c.joint.gear_ratio < _SLOPE[1]:
        channel, unit = "torque_nm", "torque of the motor side (or kNm)"
    else:
        channel, unit = "torque_nm", "kNm or a signal in volts"
    at = "of the load" if c.known_load else "at the sensor"
    unit = _LOAD if c.known_load and channel == "torque_nm" else unit
    text = f"found {size:.3g} Nm {at} per Nm of the motor (G Kt i), friction aside, expected about 1: {unit} suspected"
    return c.issue(channel, "unit", f"{text}, or a joint file of another joint")


def _slope(c: Channels) -> float | None:
    """Return d(sensor)/d(motor torque) in motion; None: friction or inertia, not load, makes most of the current.

    Friction's sign, velocity and a constant are fitted beside it, and the acceleration: a light joint whose motor turns
    little but its own rotor has a sensor torque of a small part. A torque larger than the motor's is no inertia's.
    """
    signals = _signals(c)
    if signals is None:
        return None
    motor, sensor, v, acceleration = _in_motion(signals, c.joint)
    friction = np.column_stack((np.sign(v), v, np.ones_like(v)))
    with_inertia = _partial_slope(motor, sensor, np.column_stack((friction, acceleration)))
    if with_inertia is not None:
        return with_inertia
    plain = _partial_slope(motor, sensor, friction)
    return plain if plain is not None and abs(plain) > 1.0 else None


def _partial_slope(x: FloatArray, y: FloatArray, others: FloatArray) -> float | None:
    """Return d y / d x beside other columns; None where what of x is its own explains less of y than remains."""
    q, _ = np.linalg.qr(others / np.maximum(np.linalg.norm(others, axis=0), 1e-30))
    own, rest = x - q @ (q.T @ x), y - q @ (q.T @ y)
    energy = float(own @ own)
    if energy <= _OWN**2 * float(x @ x):
        return None
    slope = float(own @ rest) / energy
    return slope if float(np.std(slope * own)) >= 2.0 * float(np.std(rest - slope * own)) else None


def _torsion(c: Channels) -> RunIssue | None:
    """Sensor torque against the torsion between both encoders: the absolute scale of both angles."""
    motor, link, torque = c.run.motor_position_rad, c.run.link_position_rad, c.run.torque_nm
    if motor is None or link is None or torque is None or not c.run.two_encoders(c.joint.gear_ratio):
        return None
    if c.gear_ratio is not None and not _near(abs(c.gear_ratio) / c.joint.gear_ratio, 1.0):
        return None  # another ratio turns more than any spring
    twist = motor / c.joint.gear_ratio - link
    twist, torque = twist - np.mean(twist), torque - np.mean(torque)
    energy = float(twist @ twist) * float(torque @ torque)
    if energy == 0.0 or float(np.ptp(motor)) < TURNED_RAD:
        return None
    both = float(twist @ torque)
    if both * both < 0.5 * energy:
        return None  # the torsion is not the spring's: encoder errors, hardly any torque
    stiffness = abs(float(torque @ torque) / both)
    off = c.joint.stiffness_nm_per_rad / stiffness
    if 1.0 / _STIFFNESS < off < _STIFFNESS:
        return None
    text = (
        f"{c.where}: found a stiffness of {stiffness:.3g} Nm/rad between torque_nm and the torsion of both positions, "
        f"{c.joint.name} has {c.joint.stiffness_nm_per_rad:.3g}: {'degrees' if 20.0 < off < 170.0 else 'another unit'} "
        "suspected in motor_position_rad and link_position_rad, expected rad, or a joint file of another joint"
    )
    return RunIssue("position_unit", text)


def _near(ratio: float, factor: float) -> bool:
    return abs(ratio / factor - 1.0) < _CLOSE


def _peak(values: FloatArray) -> float:
    return float(np.quantile(np.abs(values), 0.99))
