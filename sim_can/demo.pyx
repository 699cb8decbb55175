"""The bench's built-in motion "demo": a velocity trajectory of joint 1 against a torque of joint 2 that varies on its own. Pure.

The velocity is two smooth bursts with rests between them; the torque has non-commensurate periods. Together they fill all four
quadrants. Everything starts from rest with zero slope.
"""

from libc.math cimport M_PI, cos, sin

from typing import Final

PERIOD_S: Final = 20.0
BURSTS: Final = (
    (1.0, 8.4, (0.66, 1.38, -0.90, 0.66)),
    (10.9, 7.6, (-0.42, -1.14, 0.54, 1.26)),
)
"""(start, length in s, amplitudes in rad/s of sin(2πk x), k = 1, 2, ..., x = -1/2..1/2 over the burst)"""
LOADS: Final = ((2.7, 7.3), (0.7, 2.9), (0.4, 1.7))
"""(amplitude in A, period in s)"""
LOAD_RISE_S: Final = 2.0

cdef struct Burst:
    double start, length
    double amplitudes[4]

cdef struct Load:
    double amplitude, period

cdef double PERIOD = PERIOD_S, RISE = LOAD_RISE_S
cdef Burst[2] bursts = [{"start": s, "length": l, "amplitudes": a} for s, l, a in BURSTS]
cdef Load[3] loads = [{"amplitude": a, "period": p} for a, p in LOADS]


cpdef double demo_velocity(double time_s) noexcept:
    """Return the velocity of joint 1 in rad/s, joint side.

    Each burst is odd about its middle, so the joint comes back to where it began; the window cos² makes
    velocity and acceleration zero at both ends.
    """
    cdef double t = time_s % PERIOD, x, window, waves = 0.0
    cdef int b, k
    for b in range(2):
        x = (t - bursts[b].start) / bursts[b].length - 0.5
        if -0.5 < x < 0.5:
            window = cos(M_PI * x)
            for k in range(4):
                waves += bursts[b].amplitudes[k] * sin(2.0 * M_PI * (k + 1) * x)
            return window * window * waves
    return 0.0


cpdef double demo_current(double time_s) noexcept:
    """Return the motor current of joint 2 in A: a sum of sines that rises smoothly from zero within LOAD_RISE_S."""
    cdef double rise = 1.0 if time_s >= RISE else 0.5 - 0.5 * cos(M_PI * time_s / RISE)
    cdef double waves = 0.0
    cdef int k
    for k in range(3):
        waves += loads[k].amplitude * sin(2.0 * M_PI * time_s / loads[k].period)
    return rise * waves
