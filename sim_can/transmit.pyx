"""TPDOs of the emulated devices: present values in device units, packed into frames.

`Value` is a process object whose number is made without Python; any callable that returns an int serves as well.
"""

from cpython.bytes cimport PyBytes_FromStringAndSize
from libc.math cimport fmax, fmin, fabs, isnan, rint
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from jtqd.drivers.frame_socket cimport Frame
from jtqd.sim_can.drives cimport ChannelSignal, DriveSignals

from jtqd.drivers import drive, pdo as pdos

NEVER_NS = 1 << 62
NOT_VALID, POSITIVE_OVERLOAD, NEGATIVE_OVERLOAD = 1, 2, 4
"""Bits of 6150h."""
MAX_16, MAX_32 = 0x7FFF, 0x7FFF_FFFF

cdef int LAST_SYNC_TYPE = pdos.LAST_SYNC_TYPE
cdef int64_t NS_PER_MS = 1_000_000, NEVER = NEVER_NS, NOT_MEASURED = drive.NOT_MEASURED
cdef int INVALID = NOT_VALID, ABOVE = POSITIVE_OVERLOAD, BELOW = NEGATIVE_OVERLOAD


cdef class Value:
    """A process object; called, it returns its present number."""

    cdef int64_t number(self) except? -1:
        raise NotImplementedError

    def __call__(self):
        return self.number()


cdef int64_t rounded(double value) except? -1:
    """Return the nearest whole number. Raises ValueError for what is none that 64 bits hold."""
    if not fabs(value) < 9.2e18:
        raise ValueError(f"found a measured value of {value}, expected a finite one")
    return <int64_t>rint(value)


cdef int64_t saturated(double value, double low, double high) except? -1:
    """Return the nearest whole number held within its range: anything but a position saturates."""
    return rounded(value if isnan(value) else fmin(fmax(value, low), high))


cdef class DriveValue(Value):
    """A measured quantity of a drive, times `units`: 6064h, 606Ch, 60E4h, 6077h, 6078h, 3001h.

    quantity: name of the signal. Positions are counters of 32 bits, which wrap around; all others saturate.
    """

    def __init__(self, DriveSignals signals not None, str quantity not None, double units):
        self.signals, self.units = signals, units
        self.quantity = ("motor_position_rad", "link_position_rad", "motor_velocity_rad_s", "current_a", "temperature_c").index(
            quantity
        )

    cdef int64_t number(self) except? -1:
        cdef DriveSignals s = self.signals
        if self.quantity == 0:
            return <int32_t>rounded(s.motor_position_rad * self.units)
        if self.quantity == 1:
            return <int32_t>rounded(s.link_position_rad * self.units)
        if self.quantity == 2:
            return saturated(s.motor_velocity_rad_s * self.units, -MAX_32, MAX_32)
        if self.quantity == 3:
            return saturated(s.current_a * self.units, -MAX_16, MAX_16)
        if isnan(s.temperature_c):
            return NOT_MEASURED
        return saturated(s.temperature_c * self.units, -MAX_16, MAX_16)


cdef class Channel:
    """One measuring channel of the sensor: value = round((torque - zero) 10^decimals); without signal 0, and not valid."""

    def __init__(self, ChannelSignal signal, int decimals):
        self.signal = signal
        self.zero_nm = 0.0
        self.set_decimals(decimals)

    def set_decimals(self, int decimals):
        """Set the decimal digits: 6132h."""
        self.scale = 10.0**decimals

    def autozero(self):
        """Make the present torque zero: 6125h."""
        if self.signal is not None:
            self.zero_nm = self.signal.torque_nm

    cdef int64_t value(self, double limit) except? -1:
        """Return the value, held within -limit - 1 and limit."""
        if self.signal is None:
            return 0
        return saturated((self.signal.torque_nm - self.zero_nm) * self.scale, -limit - 1.0, limit)

    cdef int64_t status(self, double limit) except? -1:
        """Return 6150h: not valid without a signal; overload where the range does not hold the value."""
        cdef int64_t value = self.value(limit)
        cdef int overload = ABOVE if value == <int64_t>limit else BELOW if value == -<int64_t>limit - 1 else 0
        if self.signal is None or not self.signal.valid:
            return INVALID | (overload if limit == MAX_16 else 0)
        return overload


cdef class ChannelValue(Value):
    """The measured value of a channel in 16 or 32 bits, 7130h or 9130h; `status`: 6150h of a channel read so instead."""

    def __init__(self, Channel channel not None, int bits, bint status=False):
        self.channel, self.status = channel, status
        self.limit = {16: MAX_16, 32: MAX_32}[bits]

    cdef int64_t number(self) except? -1:
        return self.channel.status(self.limit) if self.status else self.channel.value(self.limit)


cdef class TransmitPdo:
    """One TPDO compiled from its mapping.

    getters: one per mapped object; start: wait for this SYNC counter first (18xxh:6), 0: no waiting; period_ms: event timer of
    types 254 and 255; timed_only: no change of its values is an event; last: the frame sent last.
    """

    def __init__(self, pdo, tuple getters not None, int start, int period_ms, bint timed_only):
        self.cob_id, self.length, self.type = pdo.cob_id, pdo.length, pdo.transmission_type
        self.getters = getters
        for k, mapped in enumerate(pdo.objects):
            self.sizes[k] = mapped.bits // 8
        self.start, self.count = start, 0
        self.last = b""
        self.period_ns = period_ms * NS_PER_MS
        self.timed_only = timed_only
        self.due_ns = NEVER

    cpdef bytes frame(self):
        """Return the PDO with its present values, little endian."""
        cdef Frame frame
        cdef object getter
        cdef int64_t value
        cdef int at = 0, k = 0
        memset(&frame, 0, sizeof(frame))
        frame.id, frame.length = self.cob_id, self.length
        for getter in self.getters:
            value = (<Value>getter).number() if isinstance(getter, Value) else <int64_t>getter()
            memcpy(&frame.data[at], &value, self.sizes[k])
            at += self.sizes[k]
            k += 1
        return PyBytes_FromStringAndSize(<const char *>&frame, sizeof(frame))

    cpdef bytes on_sync(self, int counter):
        """Return the frame to send at a SYNC with this counter (0: without), None for nothing; see CiA 301, 7.5.2.35."""
        cdef bytes frame
        cdef bint due
        if self.type > LAST_SYNC_TYPE:
            return None
        if self.start and counter:
            if counter != self.start:
                return None
            self.start = 0
            self.count = self.type - 1
        self.count += 1
        if self.count < self.type:
            return None
        self.count = 0
        frame = self.frame()
        due = self.type > 0 or frame != self.last  # type 0: synchronous, but only after a change
        self.last = frame
        return frame if due else None
