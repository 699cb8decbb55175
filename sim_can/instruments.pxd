"""Encoders, current measurement and torque sensor; the laws stand in instruments.pyx."""

cimport cython

from jtqd.sim_can.signals cimport Noise
from jtqd.sim_can.signals cimport ChannelSignal, DriveSignals

@cython.final
cdef class Encoders:
    cdef double count_rad, filter_s, link_noise, current_noise, current_offset
    cdef double count, share_dt, share
    cdef Noise noise
    cdef public double link_zero_rad
    cpdef sample(self, DriveSignals signals, double dt_s, double motor_rad, double link_rad, double current_a)

@cython.final
cdef class TorqueSensor:
    cdef double gain, noise_nm
    cdef Noise noise
    cdef public double offset_nm
    cpdef sample(self, ChannelSignal signal, double torque_nm)

@cython.final
cdef class Instruments:
    cdef Encoders encoders_1, encoders_2
    cdef DriveSignals drive_1, drive_2
    cdef readonly tuple encoders, drives
    cdef readonly TorqueSensor sensor
    cdef readonly ChannelSignal channel
    cdef double zero_nm
