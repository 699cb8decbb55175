"""Source of the bench's measurements: what the plant (`plant_source`) and a recorded run (`play`) give to the nodes.

The bench calls `advance(dt_s)` once per SYNC (dt_s = 0.0 at the first one: that is time zero of the source)
and then reads `drives` and `channels`, which the source updates in place. All quantities are SI, already with
the noise and delays of the measurement but not yet rounded to PDO units: that is the nodes' job, with the
scaling of their own objects (`DriveRatings`).

Signs (design): each drive's quantities are positive in its own positive direction; a torque is positive along
the own positive current of both joints. Sensor channel 0 is the bench's sensor. A second channel exists only
where each joint has a sensor of its own (measured runs): then channel 0 belongs to drive 0 and channel 1 to
drive 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from jtqd.sim_can.signals import ChannelSignal, DriveSignals

__all__ = ["CURRENT", "OFF", "VELOCITY", "ChannelSignal", "DriveRatings", "DriveSignals", "Source"]

# Modes of operation a source is commanded with (CiA 402 object 6061h; OFF: power stage off).
OFF = 0
VELOCITY = 9  # cyclic synchronous velocity; target: motor velocity in rad/s
CURRENT = 10  # cyclic synchronous torque; target: motor current in A


@dataclass(frozen=True)
class DriveRatings:
    """Ratings of a drive, readable by SDO, and the rounding of its PDOs."""

    gear_ratio: float
    rated_current_a: float  # 6075h; 6078h is 1/1000 of it
    rated_torque_nm: float  # 6076h, motor side: torque constant the drive believes in times rated current
    trip_current_a: float  # overcurrent fault above this magnitude; math.inf: never
    motor_counts_per_rev: int = 65536  # 608Fh, 6090h
    link_counts_per_rev: int = 524288  # 60E6h/60EBh


class Source(Protocol):
    """Measurements of one or two drives and one or two torque channels. Pure: time comes in as dt_s, nothing here
    reads a clock.
    """

    @property
    def ratings(self) -> Sequence[DriveRatings]:
        """One or two entries, fixed for the life of the source."""

    @property
    def drives(self) -> Sequence[DriveSignals]:
        """One entry for each rating; the same objects every time, updated by `advance`."""

    @property
    def channels(self) -> Sequence[ChannelSignal]:
        """One or two entries; the same objects every time, updated by `advance`."""

    def advance(self, dt_s: float) -> bool:
        """Advance by dt_s >= 0 and sample. False: the run is over (signals keep their last value); the bench then ends."""

    def command(self, drive: int, mode: int, target: float) -> None:
        """Command drive 0 or 1: OFF, VELOCITY (rad/s, motor side) or CURRENT (A). A recorded run ignores it."""

    def resume(self) -> None:
        """Continue the run: a drive that was switched off, but not set up again, is about to be enabled again.

        A recorded run ignores it.
        """

    def interpolate(self, drive: int, period_s: float) -> None:
        """Set the time between two targets of drive 0 or 1 [s] (60C2h).

        VELOCITY targets are approached in a straight line of that length. Not called: one control cycle. A recorded run
        ignores it.
        """
