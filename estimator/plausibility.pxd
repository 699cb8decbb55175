"""Plausibility of a joint's encoders and current; the rules stand in plausibility.pyx."""

cdef class Plausibility:
    cdef double gap_s, per_turn, jump, limit, longest_frozen_s, twist_limit, twist_jump
    cdef double low, high, motor, twist, current, frozen_from, frozen_s
    cdef readonly double mismatch_rad
    cdef int check(
        self, double dt_s, double motor_position, double motor_velocity, double link_position, double current
    ) noexcept nogil
    cdef int faults(self, double dt_s, double slip, double velocity, double change) noexcept nogil
