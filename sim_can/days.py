"""What differs from one day to the next: friction, temperature and the zeros of link encoders and sensor. Pure.

A fit that is tested on the day it was made on looks better than it is. So the emulated bench has days: the
values of day n come from a Kronecker sequence, frac(s_j + n α_j), which is uniform and spreads evenly even
over a handful of runs, where independent draws would clump (Niederreiter 1992, section 3.1). s_j come from
the seed.
"""

from __future__ import annotations

import math
import random
from typing import NamedTuple

from jtqd.estimator.checked import Section

# Temperature of a joint: warmed by its own losses, cooled by its surroundings, felt by its friction. Pure.
#
#     T' = (T_ambient + R P - T) / τ          P: power of the losses [W]
#     viscous share of the losses times exp(-b (T - T_ref)), Coulomb share times exp(-c (T - T_ref))
#
# One thermal mass, as the grease that carries the viscous friction has no thermometer of its own either. The
# measured temperature is this one.


REFERENCE_C = 25.0
UPDATE_S = 0.1  # of the temperature; with time constants of at least 10 s a step is below 1 % of any change


class Thermal(NamedTuple):
    """Thermal behaviour of a joint (`thermal` of a plant file); the defaults are one that stays as it is."""

    reference_c: float = REFERENCE_C  # where the joint file's friction holds
    viscous_per_k: float = 0.0
    coulomb_per_k: float = 0.0
    kelvin_per_w: float = 0.0
    time_constant_s: float = 600.0
    ambient_c: float = REFERENCE_C  # surroundings of the nominal day

    @classmethod
    def from_section(cls, section: Section | None) -> Thermal:
        """Checked values; a joint without this section keeps its temperature. Raises ConfigError."""
        if section is None:
            return cls()
        reference_c = section.number("reference_c", unit="degC", low=-40.0, high=100.0, default=REFERENCE_C)
        thermal = cls(
            reference_c=reference_c,
            ambient_c=section.number("ambient_c", unit="degC", low=-40.0, high=100.0, default=reference_c),
            viscous_per_k=section.number("viscous_per_k", unit="1/K", low=0.0, high=0.1, default=0.0),
            coulomb_per_k=section.number("coulomb_per_k", unit="1/K", low=0.0, high=0.1, default=0.0),
            kelvin_per_w=section.number("kelvin_per_w", unit="K/W", low=0.0, high=20.0, default=0.0),
            time_constant_s=section.number("time_constant_s", unit="s", low=10.0, high=1.0e5, default=600.0),
        )
        section.finish()
        return thermal


class JointTemperature:
    """State of one joint. `viscous` and `coulomb` are the factors of the two shares at the present
    temperature.
    """

    __slots__ = ("_ambient", "_heat_j", "_thermal", "_time_s", "celsius", "coulomb", "viscous")

    def __init__(self, thermal: Thermal) -> None:
        self._thermal = thermal
        self.start(0.0)

    def start(self, difference_k: float) -> None:
        """Begin a day in surroundings of `difference_k` above the usual ones, with the joint as warm as
        these.
        """
        self._ambient = self.celsius = self._thermal.ambient_c + difference_k
        self._heat_j = self._time_s = 0.0
        self._factors()

    def add(self, power_w: float, dt_s: float) -> bool:
        """The losses were power_w for dt_s. True when temperature and factors are new: each UPDATE_S."""
        self._heat_j += power_w * dt_s
        self._time_s += dt_s
        if self._time_s < UPDATE_S:
            return False
        thermal = self._thermal
        final = self._ambient + thermal.kelvin_per_w * self._heat_j / self._time_s
        self.celsius = final + (self.celsius - final) * math.exp(-self._time_s / thermal.time_constant_s)
        self._heat_j = self._time_s = 0.0
        self._factors()
        return True

    def _factors(self) -> None:
        above = self.celsius - self._thermal.reference_c
        self.viscous = math.exp(-self._thermal.viscous_per_k * above)
        self.coulomb = math.exp(-self._thermal.coulomb_per_k * above)


# α_j = frac(sqrt(prime)), in the order of `Day`'s values: viscous, temperature and link zero of both joints, sensor zero.
# Not any primes: where a α_i + b α_j is nearly a whole number for small a and b (2 frac(sqrt(71)) - 3 frac(sqrt(53)) is
# 0.012), two values stay on a few lines of their square for as many days, no more even together than independent draws.
# These were searched for a small diaphony (Zinterhof 1976) of every pair, over 12 to 96 days, every one or every 2nd to
# 6th of them; and ordered so that it is smallest for the sensor's zero beside a link encoder's, the sum that a run shows.
_PRIMES = (5, 17, 37, 97, 11, 53, 23)
_STEPS = tuple(math.sqrt(prime) % 1.0 for prime in _PRIMES)

# Day-to-day viscous changes must leave friction dissipative.
_MOST_VISCOUS = 0.9


class RunToRun(NamedTuple):
    """Half widths of the uniform spread of each value over the days (`run_to_run` of a plant file)."""

    viscous: float = 0.0  # share of the file's viscous friction
    sensor_zero_nm: float = 0.0
    temperature_k: float = 0.0  # ambient and start of the day against the joint's reference
    link_zero_rad: float = 0.0

    @classmethod
    def from_section(cls, section: Section | None) -> RunToRun:
        """Checked widths; all zero where the file has no such section. Raises ConfigError."""
        if section is None:
            return cls()
        widths = cls(
            viscous=section.number("viscous", unit="1", low=0.0, high=_MOST_VISCOUS, default=0.0),
            sensor_zero_nm=section.number("sensor_zero_nm", unit="Nm", low=0.0, default=0.0),
            temperature_k=section.number("temperature_k", unit="K", low=0.0, high=100.0, default=0.0),
            link_zero_rad=section.number("link_zero_rad", unit="rad", low=0.0, high=0.1, default=0.0),
        )
        section.finish()
        return widths


class Day(NamedTuple):
    """One day; the defaults are the nominal day. Pairs are of joint 1 and joint 2."""

    viscous: tuple[float, float] = (0.0, 0.0)  # viscous friction is 1 + this times the usual
    temperature_k: tuple[float, float] = (0.0, 0.0)
    link_zero_rad: tuple[float, float] = (0.0, 0.0)  # added to what the link encoder says
    sensor_zero_nm: float = 0.0  # added to what the sensor says


NOMINAL_DAY = Day()


def day(widths: RunToRun, seed: int, n: int) -> Day:
    """Day n = 0, 1, 2, ... of a bench with this seed; every value lies within its half width."""
    if not any(widths):
        return NOMINAL_DAY
    # a text as seed: the noise generator of the same seed must not give the same numbers
    start = random.Random(f"run to run {seed}")
    u = [2.0 * ((start.random() + n * step) % 1.0) - 1.0 for step in _STEPS]
    return Day(
        viscous=(widths.viscous * u[0], widths.viscous * u[1]),
        temperature_k=(widths.temperature_k * u[2], widths.temperature_k * u[3]),
        link_zero_rad=(widths.link_zero_rad * u[4], widths.link_zero_rad * u[5]),
        sensor_zero_nm=widths.sensor_zero_nm * u[6],
    )
