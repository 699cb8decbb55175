"""Temperatures of one joint: grease, warmed by the friction, and housing with the thermometer, warmed through the grease.

    dTg/dt = (Th + Rg P - Tg) / τg          dTh/dt = (T_room + Rh P - Th) / τh

    Coulomb friction times 1 - b (Tg - T_ref)
    viscous friction times exp(B / (Tg - C) - B / (T_ref - C)): Vogel's law of the viscosity of an oil, B = a (T_ref - C)², where
    -a is the relative slope at the reference
"""

from libc.math cimport exp, fmax

from typing import Final

UPDATE_S: Final = 0.1
VOGEL_C: Final = -95.0
"""C of Vogel's law for a mineral oil."""

cdef double UPDATE = UPDATE_S


cdef class Warmth:
    """Thermal state of one joint; `law`: `bench_file.Warmth`.

    coulomb, viscous: factors of the friction at the present temperature of the grease.
    """

    def __init__(self, law):
        self.ambient_c, self.reference_c = law.ambient_c, law.reference_c
        self.grease_k_per_w, self.grease_s = law.grease_kelvin_per_w, law.grease_time_constant_s
        self.housing_k_per_w, self.housing_s = law.housing_kelvin_per_w, law.housing_time_constant_s
        self.coulomb_per_k = law.coulomb_per_k
        self.vogel_c = VOGEL_C
        self.vogel_k = law.viscous_per_k * (law.reference_c - VOGEL_C) ** 2
        self.start(0.0)

    cpdef void start(self, double difference_k) noexcept:
        """Begin a day in a room of `difference_k` above the usual one, the joint as warm as the room."""
        self.room_c = self.grease_c = self.housing_c = self.ambient_c + difference_k
        self.heat_j = self.time_s = 0.0
        self._factors()

    cpdef bint add(self, double power_w, double dt_s) noexcept:
        """Add losses of power_w for dt_s seconds. Returns True when temperatures and factors are new."""
        cdef double power
        self.heat_j += power_w * dt_s
        self.time_s += dt_s
        if self.time_s < UPDATE:
            return False
        power = self.heat_j / self.time_s
        self.grease_c += _share(self.time_s, self.grease_s) * (self.housing_c + self.grease_k_per_w * power - self.grease_c)
        self.housing_c += _share(self.time_s, self.housing_s) * (self.room_c + self.housing_k_per_w * power - self.housing_c)
        self.heat_j = self.time_s = 0.0
        self._factors()
        return True

    def _factors(self):
        self.coulomb = fmax(1.0 - self.coulomb_per_k * (self.grease_c - self.reference_c), 0.2)
        self.viscous = exp(self.vogel_k / (self.grease_c - self.vogel_c) - self.vogel_k / (self.reference_c - self.vogel_c))


cdef double _share(double time_s, double constant_s) noexcept:
    return 1.0 - exp(-time_s / constant_s)
