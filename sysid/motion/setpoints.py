"""Set-points of a motion, millisecond by millisecond, its limits, and how it ends. Pure.

One joint follows a velocity, the other a current. `Limits` hold for what is measured (`Monitor`) and for what is planned
(`check_setpoints`); every refusal is one line that names joint, quantity, what was found, and the limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final, Literal, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray


class MotionError(Exception):
    """The motion was refused before anything moved; one line for the operator."""


class MotionResult(NamedTuple):
    """How a motion ended. Both joints are disabled in either case, or `reason` says what could not be confirmed.

    Attributes:
        status: "done", or "stopped" before its end.
        reason: one line: joint, quantity, found, limit; "" when done.
        played_s: length of the set-points that were sent.
    """

    status: Literal["done", "stopped"]
    reason: str
    played_s: float


class Violation(NamedTuple):
    """Why the motion must end.

    Attributes:
        reason: one line: joint, quantity, found, limit.
        hard: the joints cannot be led to a stop any more (drive or SYNC lost): each drive brakes by itself, now.
    """

    reason: str
    hard: bool


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the supervision in seconds. ValueError for one that is not positive.

    Attributes:
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


PERIOD_S: Final = 1e-3
"""Time from one set-point to the next: the period of SYNC."""


@dataclass(frozen=True, slots=True)
class Mark:
    """A named stretch of a run.

    Attributes:
        kind: "plateau", "rest", "power_off" or "fourier".
        start_s, end_s: from the first set-point, end not included.
        velocity_rad_s, current_a: what is held; None where it varies.
    """

    kind: str
    start_s: float
    end_s: float
    velocity_rad_s: float | None = None
    current_a: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Setpoints:
    """Set-points of one run, `PERIOD_S` apart; number k belongs to time k * PERIOD_S.

    Attributes:
        velocity_joint: 1 or 2, the joint in velocity mode (csv); the other one is in torque mode (cst).
        velocity_rad_s: [n] joint side, in the own frame of the velocity joint.
        current_a: [n] motor current of the other joint, in its own frame.
        marks: what is when, in order of time; for people and files, not for the motion.
        off: (first, end) of set-points during which both drives have no power, in order, end not included.

    Raises ValueError with one line for another joint, arrays that are not one-dimensional, empty, of unequal
    length, or not finite, marks that are not Mark, and times without power that overlap or have a target other than 0.
    The arrays are copied and read-only.
    """

    velocity_joint: int
    velocity_rad_s: FloatArray
    current_a: FloatArray
    marks: tuple[Mark, ...] = ()
    off: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        if self.velocity_joint not in (1, 2):
            raise ValueError(f"set-points: velocity_joint {self.velocity_joint!r}, expected 1 or 2")
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
    def current_joint(self) -> int:
        """The joint in torque mode: 1 or 2."""
        return 3 - self.velocity_joint

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
    """Largest magnitudes, for both joints alike; ValueError for one that is not a positive number.

    Attributes:
        current_a: motor current.
        velocity_rad_s: joint side (motor encoder through the gear).
        torque_nm: at the sensor between the joints.
        travel_rad: joint side, from where the motion began, by either encoder.
        temperature_c: of the joint; math.inf where the drives do not measure it.
    """

    current_a: float
    velocity_rad_s: float
    torque_nm: float
    travel_rad: float
    temperature_c: float = math.inf

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not value > 0 or (math.isinf(value) and item.name != "temperature_c"):
                raise ValueError(f"limits.{item.name}: found {value!r}, expected a positive number")


class JointSample(NamedTuple):
    """What was measured of one joint in one cycle: motor current, joint side velocity and travel, temperature.

    `temperature_c` is nan as long as none has come.
    """

    current_a: float
    velocity_rad_s: float
    travel_rad: float
    temperature_c: float


class Sample(NamedTuple):
    """What was measured in one cycle: joints 1 and 2, and the torque [Nm] of each sensor channel in use."""

    one: JointSample
    two: JointSample
    torque_nm: tuple[float, ...]


class Monitor:
    """Comparison of samples with the limits, without a state: the same sample gives the same answer."""

    __slots__ = ("_limits",)

    def __init__(self, limits: Limits) -> None:
        self._limits = limits

    def check(self, sample: Sample) -> str | None:
        """Return the first quantity beyond its limit in words; None when there is none.

        A nan is beyond every limit but temperature's, which has its own supervision.
        """
        limits = self._limits
        current, velocity, travel = limits.current_a, limits.velocity_rad_s, limits.travel_rad
        for joint in (sample.one, sample.two):
            if not (
                -current <= joint.current_a <= current
                and -velocity <= joint.velocity_rad_s <= velocity
                and -travel <= joint.travel_rad <= travel
            ) or (joint.temperature_c > limits.temperature_c):
                return self._joint_reason(1 if joint is sample.one else 2, joint)
        for channel, torque in enumerate(sample.torque_nm, 1):
            if not -limits.torque_nm <= torque <= limits.torque_nm:
                who = "joints 1 and 2" if len(sample.torque_nm) == 1 else f"joint {channel}"
                return f"{who}: torque at the sensor {torque:.2f} Nm, limit {limits.torque_nm:g} Nm"
        return None

    def _joint_reason(self, number: int, joint: JointSample) -> str:
        limits = self._limits
        for name, found, limit, unit in (
            ("current", joint.current_a, limits.current_a, "A"),
            ("velocity", joint.velocity_rad_s, limits.velocity_rad_s, "rad/s"),
            ("travel", joint.travel_rad, limits.travel_rad, "rad"),
        ):
            if not -limit <= found <= limit:
                return f"joint {number}: {name} {found:.3f} {unit}, limit {limit:g} {unit}"
        return f"joint {number}: temperature {joint.temperature_c:.1f} °C, limit {limits.temperature_c:g} °C"


def check_setpoints(setpoints: Setpoints, limits: Limits) -> None:
    """Refuse a plan that cannot be kept within the limits, or that jumps; before anything moves.

    Travel is that of the velocity joint; the other one turns with it. The first set-point is compared with
    standstill. Raises MotionError naming joint, quantity, time, found and limit.
    """
    one, other = setpoints.velocity_joint, setpoints.current_joint
    travel = np.cumsum(setpoints.velocity_rad_s) * PERIOD_S
    _below(setpoints.velocity_rad_s, limits.velocity_rad_s, f"velocity of joint {one}", "rad/s")
    _below(setpoints.current_a, limits.current_a, f"current of joint {other}", "A")
    _below(travel, limits.travel_rad, f"travel of joint {one}", "rad")
    _smooth(
        setpoints.velocity_rad_s, STEEPEST_VELOCITY_RAD_S2 * PERIOD_S, f"velocity of joint {one}", "rad/s"
    )
    _smooth(setpoints.current_a, STEEPEST_CURRENT_A_S * PERIOD_S, f"current of joint {other}", "A")


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
