"""Encoders, current measurement and torque sensor; the laws stand in instruments.pyx."""

cimport cython

from jtqd.sim_can.signals cimport Noise
from jtqd.sim_can.signals cimport ChannelSignal, DriveSignals
from jtqd.sim_can.towing.plant cimport Waves

@cython.final
cdef class Readings:
    cdef double count_rad, filter_s, link_noise, current_noise
    cdef double motor_zero, link_zero, current_zero, current_gain
    cdef double last_count, share_dt, share
    cdef Waves motor_errors, link_errors, current_ripple
    cdef Noise noise
    cdef readonly DriveSignals signals
    cpdef begin_day(self, double motor_zero_rad, double link_zero_rad, double current_zero_a, double current_gain)
    cpdef sample(self, double motor_rad, double link_rad, double current_a, double housing_c, double dt_s)

@cython.final
cdef class Instruments:
    cdef readonly tuple readings, drives
    cdef readonly ChannelSignal channel
    cdef double gain, zero_nm, noise_nm, day_zero_nm
    cdef Noise noise
