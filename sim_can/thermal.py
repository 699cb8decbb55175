"""Temperature of a joint: warmed by its own losses, cooled by its surroundings, felt by its friction. Pure.

    T' = (T_ambient + R P - T) / τ          P: power of the losses [W]
    viscous share of the losses times exp(-b (T - T_ref)), Coulomb share times exp(-c (T - T_ref))

One thermal mass, as the grease that carries the viscous friction has no thermometer of its own either. The
measured temperature is this one.
"""

import math
from typing import NamedTuple

from estimator.checked import Section

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
    def from_section(cls, section: Section | None) -> "Thermal":
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
