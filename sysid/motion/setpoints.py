"""Set-points of a motion, one per millisecond, its limits, and its result. Pure.

On a towing bench one joint follows a velocity, the other a current. Any other joint follows a velocity alone. All
other joints of the bus are held: velocity zero. `Limits` hold for the measurement (`Monitor`) and for the plan
(`check_setpoints`); every refusal is one line that names joint, quantity, found value and limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Final, Literal, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray


class MotionError(Exception):
    """The motion was refused before anything moved; one line for the operator."""


class OutOfPlaceError(MotionError):
    """The motion was refused because a joint that is moved alone would leave its travel from where it stands [rad]."""

    def __init__(self, reason: str, position_rad: float) -> None:
        super().__init__(reason)
        self.position_rad = position_rad


class MotionResult(NamedTuple):
    """Result of a motion; all joints are disabled, or `reason` (joint, quantity, found, limit) has what is not confirmed.

    status: "stopped" before its end; played_s: length of the set-points that were sent.
    """

    status: Literal["done", "stopped"]
    reason: str
    played_s: float


class Violation(NamedTuple):
    """Why the motion must end, in one line.

    hard: the joints cannot be led to a stop any more (drive or SYNC lost): each drive brakes by itself, now.
    """

    reason: str
    hard: bool


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the supervision in seconds. ValueError for one that is not positive.

    Attributes:
        period_s: of SYNC, a whole number of `PERIOD_S`.
        sync_lost_s: longest time without SYNC.
        late_s: longest time from SYNC to its set-point.
        stale_cycles: SYNCs that a TPDO may be missing.
        heartbeats_missing: heartbeats of a node (1017h) that may be missing.
        temperature_s: longest time between two temperatures (TPDO3 comes every 500 ms).
        own_heartbeat_s: period of ours.
        drive_timeout_s: 1016h:2 of the drives: without our heartbeat for so long they stop by themselves.
        setpoint_delay_s: from SYNC to the set-point. The TPDOs have crossed the wire by then, so that the RPDO, whose
            identifier is lower than that of TPDO2, does not delay them.
        ready_s: for SYNC, all inputs and standstill to be there at the start.
        still_s: standstill required before the joints are enabled.
        enable_s, quick_stop_s, disable_s: for the drives to change their state.
    """

    period_s: float = 1e-3
    sync_lost_s: float = 0.02
    late_s: float = 0.02
    stale_cycles: int = 5
    heartbeats_missing: int = 3
    temperature_s: float = 2.0
    own_heartbeat_s: float = 0.1
    drive_timeout_s: float = 0.3
    setpoint_delay_s: float = 0.7e-3
    ready_s: float = 3.0
    still_s: float = 0.15
    enable_s: float = 1.0
    quick_stop_s: float = 1.0
    disable_s: float = 0.5

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0:
                raise ValueError(f"timing: {item.name} is {value!r}, expected a positive number")

    @property
    def steps(self) -> int:
        """Set-points from one SYNC to the next."""
        return max(round(self.period_s / PERIOD_S), 1)


PERIOD_S: Final = 1e-3
"""Time from one set-point to the next. With a longer period of SYNC only some of them are sent."""
OTHER_ONE: Final = 0
"""`current_joint` that is the other one of joints 1 and 2."""


def partner_of(velocity_joint: int, current_joint: int | None) -> int | None:
    """Return the joint in torque mode: as given, joint 1 or 2 for `OTHER_ONE`, None for a joint that is moved alone.

    Raises ValueError where there is no such pair.
    """
    numbers = range(1, MOST_JOINTS + 1)
    if velocity_joint not in numbers:
        raise ValueError(f"velocity_joint {velocity_joint!r}, expected 1 to {MOST_JOINTS}")
    if current_joint == OTHER_ONE and current_joint is not None:
        if velocity_joint > 2:
            raise ValueError(f"no current_joint beside velocity_joint {velocity_joint}, expected one")
        return 3 - velocity_joint
    if current_joint is not None and (current_joint not in numbers or current_joint == velocity_joint):
        raise ValueError(f"current_joint {current_joint!r}, expected another joint than {velocity_joint}")
    return current_joint


def moved_joints(velocity_joint: int, current_joint: int | None) -> tuple[int, ...]:
    """Return the numbers of the joints that are moved, rising."""
    return tuple(sorted((velocity_joint,) if current_joint is None else (velocity_joint, current_joint)))


MOST_JOINTS: Final = 4
"""Of a bus."""


@dataclass(frozen=True, slots=True)
class Mark:
    """An interval of a run, end not included: "plateau", "rest", "power_off", "ramp" or "fourier"; what is held, None where
    it varies.
    """

    kind: str
    start_s: float
    end_s: float
    velocity_rad_s: float | None = None
    current_a: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Setpoints:
    """Set-points of one run, `PERIOD_S` apart; number k belongs to time k * PERIOD_S.

    velocity_rad_s [n]: of the velocity joint (csv), joint side; current_a [n]: of the current joint (cst), each in its own
    frame. marks: for people and files. off: (first, end) of set-points without power, end not included. current_joint:
    None: the velocity joint is moved alone and current_a is zero; left out: the other one of joints 1 and 2.

    Raises ValueError for joints that are no pair, arrays that are not one-dimensional, empty, of unequal length or not
    finite, marks that are not Mark, and times without power that overlap or have a target. The arrays are copied and
    read-only.
    """

    velocity_joint: int
    velocity_rad_s: FloatArray
    current_a: FloatArray
    marks: tuple[Mark, ...] = ()
    off: tuple[tuple[int, int], ...] = ()
    current_joint: int | None = OTHER_ONE

    def __post_init__(self) -> None:
        try:
            partner = partner_of(self.velocity_joint, self.current_joint)
        except ValueError as error:
            raise ValueError(f"set-points: {error}") from None
        object.__setattr__(self, "current_joint", partner)
        for name in ("velocity_rad_s", "current_a"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.ndim != 1 or not array.size:
                raise ValueError(
                    f"set-points: {name} has shape {array.shape}, expected one dimension, not empty"
                )
            bad = np.flatnonzero(~np.isfinite(array))
            if bad.size:
                raise ValueError(
                    f"set-points: {name} is {array[bad[0]]} at {bad[0] * PERIOD_S:.3f} s, expected numbers"
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if len(self.velocity_rad_s) != len(self.current_a):
            found = f"{len(self.velocity_rad_s)} velocities and {len(self.current_a)} currents"
            raise ValueError(f"set-points: {found}, expected as many of both")
        if self.current_joint is None and np.any(self.current_a):
            raise ValueError("set-points: a current and no joint to follow it, expected zeros")
        object.__setattr__(self, "marks", tuple(self.marks))
        for mark in self.marks:
            if not isinstance(mark, Mark):
                raise ValueError(f"set-points: {mark!r} is no Mark")
        object.__setattr__(self, "off", tuple(self.off))
        before = 0
        for first, end in self.off:
            if not before <= first < end <= len(self):
                raise ValueError(
                    f"set-points: off from {first} to {end}, expected rising numbers up to {len(self)}"
                )
            before = end
            for array in (self.velocity_rad_s, self.current_a):
                if np.any(array[first:end]):
                    raise ValueError(
                        f"set-points: off at {first * PERIOD_S:.3f} s with a target other than 0, expected rest"
                    )

    def __len__(self) -> int:
        return len(self.velocity_rad_s)

    @property
    def joints(self) -> tuple[int, ...]:
        """Numbers of the joints that are moved, rising."""
        return moved_joints(self.velocity_joint, self.current_joint)

    @property
    def duration_s(self) -> float:
        """Length of the run."""
        return len(self) * PERIOD_S

    @property
    def time_s(self) -> FloatArray:
        """Time [n] of each set-point from the first one."""
        return np.arange(len(self), dtype=np.float64) * PERIOD_S


STEEPEST_VELOCITY_RAD_S2: Final = 50.0
"""Steepest planned velocity, joint side: 0.05 rad/s from one set-point to the next."""
STEEPEST_CURRENT_A_S: Final = 500.0
"""Steepest planned current: 0.5 A from one set-point to the next."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Largest magnitudes, for all joints that are moved; ValueError for one that is not a positive number.

    current_a: of the motor; velocity_rad_s: joint side; torque_nm: at the sensor of these joints; travel_rad: from where
    the motion began, by either encoder; temperature_c: math.inf where the drives do not measure it; position_rad: range of
    a joint that is moved alone, by its own encoder.
    """

    current_a: float
    velocity_rad_s: float
    torque_nm: float
    travel_rad: float
    temperature_c: float = math.inf
    position_rad: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        low, high = self.position_rad
        if not low < high:
            raise ValueError(f"limits.position_rad: found {[low, high]}, expected two rising numbers")
        for item in fields(self):
            if item.name == "position_rad":
                continue
            value = getattr(self, item.name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not value > 0 or (math.isinf(value) and item.name != "temperature_c"):
                raise ValueError(f"limits.{item.name}: found {value!r}, expected a positive number")


class JointSample(NamedTuple):
    """Measurement of one joint in one cycle; temperature nan as long as none has come; position from its own encoder's
    zero.
    """

    current_a: float
    velocity_rad_s: float
    travel_rad: float
    temperature_c: float
    position_rad: float = 0.0


class Sample(NamedTuple):
    """Measurement of one cycle: joints 1, 2, ..., and the torque [Nm] of each sensor channel in use."""

    joints: tuple[JointSample, ...]
    torque_nm: tuple[float, ...]


HELD_RAD: Final = 0.05
"""Joint side: largest travel of a joint that is held."""
HELD_RAD_S: Final = 0.3
"""Joint side: largest velocity of a joint that is held."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What of the bus is not moved: largest current of each joint that is held (missing: as of those that are moved).

    channels: joints of each sensor channel for which the torque limit holds; None: all channels, and the joints of a single
    one are 1 and 2.
    """

    held_current_a: Mapping[int, float] = field(default_factory=dict)
    channels: Mapping[int, tuple[int, ...]] | None = None


class Monitor:
    """Compares samples with the limits of the joints that are moved (numbers `moved`); all others are held. No state."""

    __slots__ = ("_channels", "_limits", "_of", "_temperature")

    def __init__(
        self, limits: Limits, moved: tuple[int, ...] = (1, 2), around: Surroundings | None = None
    ) -> None:
        around = around or Surroundings()
        self._limits = limits
        self._channels = around.channels
        self._temperature = limits.temperature_c
        own = (limits.current_a, limits.velocity_rad_s, limits.travel_rad, limits.position_rad)
        free = (-math.inf, math.inf)
        self._of = tuple(
            own
            if number in moved
            else (around.held_current_a.get(number, limits.current_a), HELD_RAD_S, HELD_RAD, free)
            for number in range(1, MOST_JOINTS + 1)
        )

    def check(self, sample: Sample) -> str | None:
        """Return the first quantity beyond its limit in words; None when there is none.

        A nan is beyond every limit but temperature's, which has its own supervision.
        """
        for place, joint in enumerate(sample.joints):
            current, velocity, travel, (low, high) = self._of[place]
            if not (
                -current <= joint.current_a <= current
                and -velocity <= joint.velocity_rad_s <= velocity
                and -travel <= joint.travel_rad <= travel
                and low <= joint.position_rad <= high
            ) or (joint.temperature_c > self._temperature):
                return self._joint_reason(1 + place, joint)
        limit = self._limits.torque_nm
        for channel, torque in enumerate(sample.torque_nm, 1):
            if -limit <= torque <= limit or (self._channels is not None and channel not in self._channels):
                continue
            return f"{self._owner(channel, len(sample.torque_nm))}: torque at the sensor {torque:.2f} Nm, limit {limit:g} Nm"
        return None

    def _owner(self, channel: int, channels: int) -> str:
        if self._channels is None:
            return "joints 1 and 2" if channels == 1 else f"joint {channel}"
        joints = self._channels[channel]
        return f"joint{'s' if len(joints) > 1 else ''} {' and '.join(map(str, joints))}"

    def _joint_reason(self, number: int, joint: JointSample) -> str:
        current, velocity, travel, (low, high) = self._of[number - 1]
        for name, found, limit, unit in (
            ("current", joint.current_a, current, "A"),
            ("velocity", joint.velocity_rad_s, velocity, "rad/s"),
            ("travel", joint.travel_rad, travel, "rad"),
        ):
            if not -limit <= found <= limit:
                return f"joint {number}: {name} {found:.3f} {unit}, limit {limit:g} {unit}"
        if not low <= joint.position_rad <= high:
            return f"joint {number}: position {joint.position_rad:.3f} rad, limits {low:g} to {high:g} rad"
        return f"joint {number}: temperature {joint.temperature_c:.1f} °C, limit {self._temperature:g} °C"


def check_setpoints(setpoints: Setpoints, limits: Limits) -> None:
    """Refuse a plan that exceeds the limits, or that jumps, before anything moves. Raises MotionError.

    Travel is that of the velocity joint. The first set-point is compared with standstill. The position of a joint that is
    moved alone is checked at the start (`out_of_range`).
    """
    one, other = setpoints.velocity_joint, setpoints.current_joint
    _below(setpoints.velocity_rad_s, limits.velocity_rad_s, f"velocity of joint {one}", "rad/s")
    _below(setpoints.current_a, limits.current_a, f"current of joint {other}", "A")
    _below(path(setpoints), limits.travel_rad, f"travel of joint {one}", "rad")
    low, high = path_range(setpoints)
    travel = limits.position_rad[1] - limits.position_rad[0]
    if high - low > travel:
        raise MotionError(f"plan: joint {one} moves over {high - low:.3f} rad, limit {travel:g} rad")
    _smooth(
        setpoints.velocity_rad_s, STEEPEST_VELOCITY_RAD_S2 * PERIOD_S, f"velocity of joint {one}", "rad/s"
    )
    _smooth(setpoints.current_a, STEEPEST_CURRENT_A_S * PERIOD_S, f"current of joint {other}", "A")


def path(setpoints: Setpoints) -> FloatArray:
    """Return the travel [n] of the velocity joint from where it begins [rad], joint side."""
    found: FloatArray = np.cumsum(setpoints.velocity_rad_s) * PERIOD_S
    return found


def path_range(setpoints: Setpoints) -> tuple[float, float]:
    """Return the least and the largest of `path`, the start included."""
    found = path(setpoints)
    return min(float(found.min()), 0.0), max(float(found.max()), 0.0)


def out_of_range(setpoints: Setpoints, limits: Limits, start_rad: float) -> str | None:
    """Return why the velocity joint cannot begin at start_rad [rad], or None."""
    (low, high), (down, up) = limits.position_rad, path_range(setpoints)
    if low <= start_rad + down and start_rad + up <= high:
        return None
    return (
        f"joint {setpoints.velocity_joint}: stands at {start_rad:.3f} rad, expected {low - down:.3f} to {high - up:.3f} "
        f"rad, as the motion goes from {down:.3f} to {up:.3f} rad beside its start, travel_rad is {low:g} to {high:g}"
    )


def _below(series: FloatArray, limit: float, what: str, unit: str) -> None:
    beyond = np.flatnonzero(np.abs(series) > limit)
    if beyond.size:
        found, time_s = series[beyond[0]], beyond[0] * PERIOD_S
        raise MotionError(f"plan: {what} {found:.3f} {unit} at {time_s:.3f} s, limit {limit:g} {unit}")


def _smooth(series: FloatArray, limit: float, what: str, unit: str) -> None:
    """`series` must not change by more than `limit` from one set-point to the next, nor begin with more."""
    steps = np.diff(series, prepend=0.0)
    jumps = np.flatnonzero(np.abs(steps) > limit * (1.0 + 1e-9))
    if jumps.size:
        where = "starts with a jump" if jumps[0] == 0 else f"jumps at {jumps[0] * PERIOD_S:.3f} s"
        raise MotionError(
            f"plan: {what} {where} of {steps[jumps[0]]:.3f} {unit}, limit {limit:g} {unit} per ms"
        )
