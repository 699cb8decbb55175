"""Thermal behaviour of the emulated joints, and what differs from one day to the next: friction, temperature, zeros. Pure.

A fit that is tested on the day it was made on looks better than it is. So the emulated bench has days: the
values of day n come from a Kronecker sequence, frac(s_j + n α_j), which is uniform and spreads evenly even
over a handful of runs, where independent draws would clump (Niederreiter 1992, section 3.1). s_j come from
the seed.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from jtqd.estimator.decoder import limits

REFERENCE_C: Final = 25.0


@dataclass(frozen=True, slots=True)
class Thermal:
    """Thermal behaviour of a joint (`thermal` of a plant file); the defaults are one that stays as it is.

    reference_c: where the joint file's friction holds; ambient_c: surroundings of the nominal day; left out: at the
    reference.
    """

    reference_c: Annotated[float, limits("degC", ge=-40.0, le=100.0)] = REFERENCE_C
    viscous_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.1)] = 0.0
    coulomb_per_k: Annotated[float, limits("1/K", ge=0.0, le=0.1)] = 0.0
    kelvin_per_w: Annotated[float, limits("K/W", ge=0.0, le=20.0)] = 0.0
    time_constant_s: Annotated[float, limits("s", ge=10.0, le=1.0e5)] = 600.0
    ambient_c: Annotated[float, limits("degC", ge=-40.0, le=100.0)] = math.nan

    def __post_init__(self) -> None:
        if math.isnan(self.ambient_c):
            object.__setattr__(self, "ambient_c", self.reference_c)


# α_j = frac(sqrt(prime)), in the order of `Day`'s values: viscous, temperature and link zero of both joints, sensor zero.
# Not any primes: where a α_i + b α_j is nearly a whole number for small a and b (2 frac(sqrt(71)) - 3 frac(sqrt(53)) is
# 0.012), two values stay on a few lines of their square for as many days, no more even together than independent draws.
# These were searched for a small diaphony (Zinterhof 1976) of every pair, over 12 to 96 days, every one or every 2nd to
# 6th of them; and ordered so that it is smallest for the sensor's zero beside a link encoder's, the sum that a run shows.
_PRIMES = (5, 17, 37, 97, 11, 53, 23)
_STEPS = tuple(math.sqrt(prime) % 1.0 for prime in _PRIMES)


@dataclass(frozen=True, slots=True)
class RunToRun:
    """Half widths of the uniform spread of each value over the days (`run_to_run` of a plant file).

    viscous: share of the file's viscous friction, below 1 so that friction stays dissipative; temperature_k: ambient
    and start of the day against the joint's reference.
    """

    viscous: Annotated[float, limits(ge=0.0, le=0.9)] = 0.0
    sensor_zero_nm: Annotated[float, limits("Nm", ge=0.0)] = 0.0
    temperature_k: Annotated[float, limits("K", ge=0.0, le=100.0)] = 0.0
    link_zero_rad: Annotated[float, limits("rad", ge=0.0, le=0.1)] = 0.0

    @property
    def varies(self) -> bool:
        """Whether one day differs from another."""
        return self != RunToRun()

    @property
    def nominal_day(self) -> Day:
        """The day without any difference."""
        return NOMINAL_DAY

    def day(self, seed: int, n: int) -> Day:
        """Day n = 0, 1, 2, ... of a bench with this seed; every value lies within its half width."""
        if not self.varies:
            return NOMINAL_DAY
        # a text as seed: the noise generator of the same seed must not give the same numbers
        start = random.Random(f"run to run {seed}")
        u = [2.0 * ((start.random() + n * step) % 1.0) - 1.0 for step in _STEPS]
        return Day(
            viscous=(self.viscous * u[0], self.viscous * u[1]),
            temperature_k=(self.temperature_k * u[2], self.temperature_k * u[3]),
            link_zero_rad=(self.link_zero_rad * u[4], self.link_zero_rad * u[5]),
            sensor_zero_nm=self.sensor_zero_nm * u[6],
        )


class Day(NamedTuple):
    """One day; the defaults are the nominal day. Pairs are of joint 1 and joint 2."""

    viscous: tuple[float, float] = (0.0, 0.0)  # viscous friction is 1 + this times the usual
    temperature_k: tuple[float, float] = (0.0, 0.0)
    link_zero_rad: tuple[float, float] = (0.0, 0.0)  # added to what the link encoder says
    sensor_zero_nm: float = 0.0  # added to what the sensor says


NOMINAL_DAY = Day()
