"""Sums of cosines over an angle, Σ A_k cos(k θ + φ_k): ripple, errors of gear and encoders."""

from libc.math cimport cos, sin

from dataclasses import astuple


cdef Waves waves_of(entries) except *:
    """Return the waves of a bench file's list: order per turn, amplitude, phase; at most MOST_WAVES (IndexError)."""
    cdef Waves waves
    waves.count = 0
    for order, amplitude, phase in map(astuple, entries):
        if waves.count == MOST_WAVES:
            raise IndexError(f"found more than {MOST_WAVES} waves")
        waves.order[waves.count] = order
        waves.amplitude[waves.count] = amplitude
        waves.phase[waves.count] = phase
        waves.count += 1
    return waves


cdef double waves_at(const Waves *waves, double angle) noexcept nogil:
    """Return the sum at this angle."""
    cdef double total = 0.0
    cdef int k
    for k in range(waves.count):
        total += waves.amplitude[k] * cos(waves.order[k] * angle + waves.phase[k])
    return total


cdef double waves_slope(const Waves *waves, double angle) noexcept nogil:
    """Return the sum's derivative with respect to the angle."""
    cdef double total = 0.0
    cdef int k
    for k in range(waves.count):
        total -= waves.amplitude[k] * waves.order[k] * sin(waves.order[k] * angle + waves.phase[k])
    return total
