"""What differs from one day to the next on a towing bench: drawn independently and uniformly, as days are. Pure."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

from jtqd.estimator.decoder import limits


@dataclass(frozen=True, slots=True)
class DayWidths:
    """Half widths of the spread of each value over the days (`run_to_run` of a bench file).

    viscous, coulomb: share of the usual friction; temperature_k: of the room; current_gain: share.
    """

    viscous: Annotated[float, limits(ge=0.0, le=0.9)] = 0.0
    coulomb: Annotated[float, limits(ge=0.0, le=0.9)] = 0.0
    temperature_k: Annotated[float, limits("K", ge=0.0, le=60.0)] = 0.0
    motor_zero_rad: Annotated[float, limits("rad", ge=0.0, le=1.0)] = 0.0
    link_zero_rad: Annotated[float, limits("rad", ge=0.0, le=0.1)] = 0.0
    current_zero_a: Annotated[float, limits("A", ge=0.0)] = 0.0
    current_gain: Annotated[float, limits(ge=0.0, le=0.5)] = 0.0
    sensor_zero_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0

    @property
    def varies(self) -> bool:
        """Whether one day differs from another."""
        return self != DayWidths()

    @property
    def nominal_day(self) -> Day:
        """The day without any difference."""
        return Day()

    def day(self, seed: int, number: int) -> Day:
        """Return day 0, 1, 2, ... of a bench with this seed."""

        def joint(side: int) -> JointDay:
            return JointDay(
                **{
                    name: getattr(self, name) * _uniform(f"{seed} day {number} joint {side} {name}")
                    for name in JointDay._fields
                }
            )

        zero = self.sensor_zero_nm * _uniform(f"{seed} day {number} sensor")
        return Day((joint(1), joint(2)), zero)


def _uniform(text: str) -> float:
    """Return the number of -1 .. 1 that belongs to a text."""
    return random.Random(text).uniform(-1.0, 1.0)


class JointDay(NamedTuple):
    """Values of one joint on one day, as differences to the usual ones."""

    viscous: float = 0.0
    coulomb: float = 0.0
    temperature_k: float = 0.0
    motor_zero_rad: float = 0.0
    link_zero_rad: float = 0.0
    current_zero_a: float = 0.0
    current_gain: float = 0.0


@dataclass(frozen=True, slots=True)
class Day:
    """One day; the default is the nominal one."""

    joints: tuple[JointDay, JointDay] = field(default=(JointDay(), JointDay()))
    sensor_zero_nm: float = 0.0
