"""What all benches have in common: drives and sensor by their file, days, and the `Source` of what is measured.

The bench calls `Source.advance(dt_s)` once per SYNC (dt_s = 0.0 at the first one: that is time zero of the source)
and then reads `drives` and `channels`, which the source updates in place. All quantities are SI, already with
the noise and delays of the measurement but not yet rounded to PDO units: that is the nodes' job, with the
scaling of their own objects (`DriveRatings`).

Signs (design): each drive's quantities are positive in its own positive direction; a torque is positive along
the own positive current of both joints. Sensor channel 0 is the bench's sensor. A second channel exists only
where each joint has a sensor of its own (measured runs): then channel 0 belongs to drive 0 and channel 1 to
drive 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from jtqd.estimator.decoder import FieldError, limits
from jtqd.estimator.errors import range_text
from jtqd.sim_can.drives import CURRENT, OFF, VELOCITY, ChannelSignal, DriveSignals

__all__ = ["CURRENT", "OFF", "VELOCITY", "ChannelSignal", "DriveSignals"]

# Sections of plant files and bench files


@dataclass(frozen=True)
class DriveParameters:
    """Ratings and loops of a drive (`drive`). Velocity loop gains are on the motor side.

    velocity_bandwidth_rad_s: of the proportional loop with the rotor's inertia alone; acceleration_feedforward: in
    rotor inertias, as a towing pair moves both rotors; friction_feedforward_a: times sign(reference velocity);
    acceleration_limit_rad_s2: joint side, of the velocity reference. Currents left out follow from the rated one.
    """

    rated_current_a: Annotated[float, limits("A", ge=0.1, le=1000.0)] = 8.0
    current_limit_a: Annotated[float, limits("A", ge=0.1)] = math.nan
    trip_current_a: Annotated[float, limits("A", ge=0.05)] = math.nan
    current_bandwidth_hz: Annotated[float, limits("Hz", ge=50.0, le=5000.0)] = 500.0
    velocity_bandwidth_rad_s: Annotated[float, limits("rad/s", ge=1.0, le=2000.0)] = 400.0
    velocity_integral_time_s: Annotated[float, limits("s", ge=0.002, le=10.0)] = 0.01
    acceleration_feedforward: Annotated[float, limits("rotor inertias", ge=0.0, le=10.0)] = 2.0
    friction_feedforward_a: Annotated[float, limits("A", ge=0.0)] = 0.0
    acceleration_limit_rad_s2: Annotated[float, limits("rad/s2", ge=0.1)] = 60.0

    def __post_init__(self) -> None:
        if math.isnan(self.current_limit_a):
            object.__setattr__(self, "current_limit_a", 1.125 * self.rated_current_a)
        if math.isnan(self.trip_current_a):
            object.__setattr__(self, "trip_current_a", 1.33 * self.current_limit_a)
        for key, high in (
            ("current_limit_a", 20.0 * self.rated_current_a),
            ("friction_feedforward_a", self.current_limit_a),
        ):
            value = getattr(self, key)
            if value > high:
                raise FieldError("drive", key, value, range_text("a number in A", None, high, None))


USUAL_DRIVE: Final = DriveParameters(trip_current_a=12.0)
"""Of a joint without a section `drive`."""


@dataclass(frozen=True)
class SensorParameters:
    """Torque sensor between the joints (`sensor`): measured = gain * true + offset + noise."""

    noise_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    offset_nm: Annotated[float, limits("Nm")] = 0.0
    gain: Annotated[float, limits(ge=0.01, le=100.0)] = 1.0


@dataclass(frozen=True)
class MeasurementParameters:
    """Encoders and current measurement of a drive (`measurement`), whatever the bench."""

    motor_counts_per_rev: Annotated[int, limits(ge=16, le=1 << 24)] = 65536
    link_counts_per_rev: Annotated[int, limits(ge=16, le=1 << 26)] = 524288
    link_noise_rad: Annotated[float, limits("rad", ge=0.0)] = 0.0
    velocity_filter_s: Annotated[float, limits("s", ge=0.0, le=0.1)] = 0.001
    current_noise_a: Annotated[float, limits("A", ge=0.0)] = 0.0


class Day(NamedTuple):
    """One day as differences to the usual values; the default is the nominal day. Pairs are of joint 1 and joint 2.

    viscous, coulomb, current_gain: shares; temperature_k: of the surroundings; zeros are added to the readings.
    """

    viscous: tuple[float, float] = (0.0, 0.0)
    temperature_k: tuple[float, float] = (0.0, 0.0)
    link_zero_rad: tuple[float, float] = (0.0, 0.0)
    sensor_zero_nm: float = 0.0
    coulomb: tuple[float, float] = (0.0, 0.0)
    motor_zero_rad: tuple[float, float] = (0.0, 0.0)
    current_zero_a: tuple[float, float] = (0.0, 0.0)
    current_gain: tuple[float, float] = (0.0, 0.0)


# Source


@dataclass(frozen=True)
class DriveRatings:
    """Ratings of a drive, readable by SDO, and the rounding of its PDOs."""

    gear_ratio: float
    rated_current_a: float  # 6075h; 6078h is 1/1000 of it
    rated_torque_nm: float  # 6076h, motor side: torque constant the drive believes in times rated current
    trip_current_a: float  # overcurrent fault above this magnitude; math.inf: never
    motor_counts_per_rev: int = 65536  # 608Fh, 6090h
    link_counts_per_rev: int = 524288  # 60E6h/60EBh


class Source:
    """Measurements of one or two drives and one or two torque channels. Pure: time comes in as dt_s.

    A recorded run ignores `command`, `resume` and `interpolate`, which do nothing here.

    Attributes:
        ratings: one or two entries, fixed for the life of the source.
        drives: one entry for each rating; the same objects every time, updated by `advance`.
        channels: one or two entries; the same objects every time, updated by `advance`.
    """

    ratings: Sequence[DriveRatings]
    drives: Sequence[DriveSignals]
    channels: Sequence[ChannelSignal]

    def advance(self, dt_s: float) -> bool:
        """Advance by dt_s >= 0 and sample. False: the run is over (signals keep their last value); the bench then ends."""
        raise NotImplementedError

    def command(self, drive: int, mode: int, target: float) -> None:
        """Command drive 0 or 1: OFF, VELOCITY (rad/s, motor side) or CURRENT (A)."""

    def resume(self) -> None:
        """Continue the run: a drive that was switched off, but not set up again, is about to be enabled again."""

    def interpolate(self, drive: int, period_s: float) -> None:
        """Set the time between two targets of drive 0 or 1 [s] (60C2h); without, it is one control cycle.

        VELOCITY targets are approached in a straight line of that length.
        """
