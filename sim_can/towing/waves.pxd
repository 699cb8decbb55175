"""Sums of cosines over an angle."""

cdef enum: MOST_WAVES = 8

cdef struct Waves:
    int count
    double order[MOST_WAVES]
    double amplitude[MOST_WAVES]
    double phase[MOST_WAVES]

cdef Waves waves_of(entries) except *
cdef double waves_at(const Waves *waves, double angle) noexcept nogil
cdef double waves_slope(const Waves *waves, double angle) noexcept nogil
