"""Temperature of an emulated joint: one thermal mass. Pure."""

from libc.math cimport exp

from typing import Final

UPDATE_S: Final = 0.1
"""Of the temperature; with time constants of at least 10 s a step is below 1 % of any change."""

cdef double UPDATE = UPDATE_S


cdef class JointTemperature:
    """Temperature T of one joint: warmed by its own losses, cooled by its surroundings, felt by its friction.

        T' = (T_ambient + R P - T) / tau          P: power of the losses [W]
        viscous share of the losses times exp(-b (T - T_ref)), Coulomb share times exp(-c (T - T_ref))

    One thermal mass, as the grease that carries the viscous friction has no thermometer of its own either: the measured
    temperature is this one. `viscous` and `coulomb` are the factors of the two shares at the present temperature.
    """

    def __init__(self, thermal):
        self.usual = thermal.ambient_c
        self.reference = thermal.reference_c
        self.kelvin_per_w, self.time_constant = thermal.kelvin_per_w, thermal.time_constant_s
        self.viscous_per_k, self.coulomb_per_k = thermal.viscous_per_k, thermal.coulomb_per_k
        self.start(0.0)

    def start(self, double difference_k):
        """Begin a day in surroundings of `difference_k` above the usual ones, with the joint as warm as these."""
        self.ambient = self.celsius = self.usual + difference_k
        self.heat_j = self.time_s = 0.0
        self.factors()

    cpdef bint add(self, double power_w, double dt_s) noexcept:
        """The losses were power_w for dt_s. True when temperature and factors are new: each UPDATE_S."""
        cdef double final
        self.heat_j += power_w * dt_s
        self.time_s += dt_s
        if self.time_s < UPDATE:
            return False
        final = self.ambient + self.kelvin_per_w * self.heat_j / self.time_s
        self.celsius = final + (self.celsius - final) * exp(-self.time_s / self.time_constant)
        self.heat_j = self.time_s = 0.0
        self.factors()
        return True

    cdef void factors(self) noexcept:
        cdef double above = self.celsius - self.reference
        self.viscous = exp(-self.viscous_per_k * above)
        self.coulomb = exp(-self.coulomb_per_k * above)
