"""Harmonic-drive gear: transmission error, hardening spring, damping, several slips.

    δ = θ/G + Σ e_k cos(k θ + φ_k) - φ          τ = spring(δ) + D dδ/dt + Σ H_j z_j
    dz_j = dδ / travel_j, held within -1 .. 1

The spring has three straight parts, as catalogues state it: K1 up to T1, K2 up to T2, K3 beyond. The slips are those of Tjahjowidodo et al. 2013.
"""

from libc.math cimport copysign, fabs, fmax, fmin

from jtqd.sim_can.towing.waves cimport waves_at, waves_of, waves_slope


cdef class Gear:
    """Gear of one joint with its state; `law`: `bench_file.Gear`. torsion: δ in rad after the last `turn`."""

    def __init__(self, law, double ratio):
        self.per_ratio, self.damping = 1.0 / ratio, law.damping_nms_per_rad
        self.stiffness = law.stiffness_nm_per_rad
        self.level = law.corners_nm
        self.corner[0] = self.level[0] / self.stiffness[0]
        self.corner[1] = self.corner[0] + (self.level[1] - self.level[0]) / self.stiffness[1]
        self.errors = waves_of(law.errors)
        self.slips = 0
        for slip in law.slips:
            if self.slips == MOST_SLIPS:
                raise IndexError(f"found more than {MOST_SLIPS} slips")
            self.slip_nm[self.slips], self.per_travel[self.slips] = slip.torque_nm, 1.0 / slip.travel_rad
            self.state[self.slips] = 0.0
            self.slips += 1
        self.torsion = 0.0

    cpdef double spring(self, double torsion) noexcept:
        """Return the spring's torque [Nm] at a torsion [rad]; odd."""
        cdef double size = fabs(torsion)
        if size <= self.corner[0]:
            return self.stiffness[0] * torsion
        if size <= self.corner[1]:
            return copysign(self.level[0] + self.stiffness[1] * (size - self.corner[0]), torsion)
        return copysign(self.level[1] + self.stiffness[2] * (size - self.corner[1]), torsion)

    cdef double slope(self, double angle) noexcept:
        """Return dδ/dθ, joint rad per motor rad."""
        return self.per_ratio + waves_slope(&self.errors, angle)

    cdef double torque(self, double rate) noexcept:
        """Return τ [Nm] at the present torsion and its rate [rad/s]."""
        cdef double total = self.spring(self.torsion) + self.damping * rate
        cdef int k
        for k in range(self.slips):
            total += self.slip_nm[k] * self.state[k]
        return total

    cpdef void turn(self, double angle, double link) noexcept:
        """Go to a motor angle and a link angle, joint frame [rad]."""
        cdef double torsion = angle * self.per_ratio + waves_at(&self.errors, angle) - link
        cdef double change = torsion - self.torsion
        cdef int k
        for k in range(self.slips):
            self.state[k] = fmin(fmax(self.state[k] + change * self.per_travel[k], -1.0), 1.0)
        self.torsion = torsion

    cpdef void relax(self, double angle, double link) noexcept:
        """Go there with all slips relaxed, as assembled."""
        cdef int k
        self.turn(angle, link)
        for k in range(self.slips):
            self.state[k] = 0.0
