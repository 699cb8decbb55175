"""What both joints are told, millisecond by millisecond: one joint follows a velocity, the other a current. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.friction import FloatArray

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
