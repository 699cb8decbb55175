"""Limits of a motion: of what is measured (`Monitor`) and of what is planned (`check_setpoints`). Pure.

Every refusal is one line that names joint, quantity, what was found, and the limit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final, NamedTuple

import numpy as np

from estimator.friction import FloatArray
from sysid.motion.result import MotionError
from sysid.motion.setpoints import PERIOD_S, Setpoints

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
        temperature_c: of the joint; math.inf where the drives do not tell it.
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
    """Compares samples with the limits. It keeps no state: the same sample gives the same answer."""

    __slots__ = ("_limits",)

    def __init__(self, limits: Limits) -> None:
        self._limits = limits

    def check(self, sample: Sample) -> str | None:
        """Return what is beyond its limit, the first found; None when nothing is. A nan is beyond every limit but
        temperature's, which has its own supervision.
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
