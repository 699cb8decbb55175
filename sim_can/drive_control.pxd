"""Loops of one drive; the laws stand in drive_control.pyx."""

cimport cython

@cython.final
cdef class DriveControl:
    cdef readonly int mode
    cdef readonly double target, current_a, integral_a, reference_rad_s, slope_rad_s2
    cdef public double interpolation_s
    cdef double bandwidth, kp, integral_rate, inertia_a, friction, smooth, slope_limit, limit
    cdef double to_go_s, feedforward, base, decay_step, decay
    cpdef void plan(self, double dt_s) noexcept
    cpdef double step(self, double h, double motor_velocity_rad_s) noexcept
