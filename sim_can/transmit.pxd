"""TPDOs of the emulated devices; what they do stands in transmit.pyx."""

from libc.stdint cimport int64_t, uint8_t

from jtqd.sim_can.drives cimport ChannelSignal, DriveSignals

cdef class Value:
    cdef int64_t number(self) except? -1

cdef class DriveValue(Value):
    cdef DriveSignals signals
    cdef double units
    cdef int quantity

cdef class Channel:
    cdef readonly ChannelSignal signal
    cdef public double zero_nm
    cdef double scale
    cdef int64_t value(self, double limit) except? -1
    cdef int64_t status(self, double limit) except? -1

cdef class ChannelValue(Value):
    cdef Channel channel
    cdef bint status
    cdef double limit

cdef class TransmitPdo:
    cdef readonly int cob_id, length, type, start, count
    cdef readonly int64_t period_ns
    cdef readonly bint timed_only
    cdef public bytes last
    cdef public int64_t due_ns
    cdef tuple getters
    cdef uint8_t sizes[8]
    cpdef bytes frame(self)
    cpdef bytes on_sync(self, int counter)
