"""Frame socket: 16-byte CAN frames over AF_CAN raw (`can0`) or a unix bus (`unix:PATH`), with one interface for both.

`open_frame_socket` opens either (bus_socket.py); an error is a BusError in one of three classes that need different
reactions. `FrameReceiver` takes all frames that have arrived by one recvmmsg(2) into memory that is laid out once, for
any socket; `FrameSocket` is one open bus. `take`, `put` and `ready` are `receive`, `send` and `wait` for compiled callers: no
Python object is made but for an error.
"""

from cpython.bytearray cimport PyByteArray_AS_STRING
from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_GET_SIZE
from cpython.exc cimport PyErr_CheckSignals
from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.errno cimport EAGAIN, ECONNRESET, EINTR, EINVAL, ENOBUFS, ENODEV, ENOMEM, EPIPE, errno
from libc.math cimport isnan
from libc.stdint cimport INT64_MAX, int64_t, uint8_t, uint16_t
from libc.string cimport memcpy, memset
from posix.time cimport CLOCK_MONOTONIC, clock_gettime, timespec

import socket

from jtqd.drivers import filters as bpf
from jtqd.drivers.bus_socket import (
    PREFIX,
    SO_RXQ_OVFL,
    SO_TIMESTAMPNS,
    BusDown,
    BusError,
    BusGone,
    from_errno,
    open_socketcan,
    open_unix,
    set_can_filters,
)
from jtqd.drivers.filters import checked
from jtqd.drivers.frame import ECHO_BIT, FRAME_SIZE

__all__ = ["CAPACITY", "BusDown", "BusError", "BusGone", "FrameReceiver", "FrameSocket", "open_frame_socket"]

CAPACITY = 32
"""Frames that one `receive` takes at most."""

cdef int STAMP = SO_TIMESTAMPNS  # SCM_TIMESTAMPNS is the same number
cdef int OVERFLOW = SO_RXQ_OVFL
cdef uint8_t ECHO = ECHO_BIT
cdef int64_t NS_PER_S = 1_000_000_000
cdef int64_t FOR_EVER = INT64_MAX


cdef class FrameReceiver:
    """Receive up to `capacity` messages of 16 bytes per call; not bound to one socket.

    After `receive` returned n >= 0:

    - `frames`: bytearray, 16 bytes per message, filled for the first n; a shorter message is filled up with zeros;
    - `lengths[i]`: bytes the message had (a longer one is cut to 16);
    - `flags[i]`: msg_flags (on AF_CAN MSG_CONFIRM = own echo, MSG_DONTROUTE = sent on this host);
    - `stamps_ns[i]`: the kernel's receive time stamp, CLOCK_REALTIME in ns; 0 where it gave none;
    - `overflow`: last value of the kernel's SO_RXQ_OVFL counter seen;
    - `closed`: the peer of a unix socket has ended, and nothing follows. Zero bytes with a time stamp are an empty message,
      zero bytes without are the end.
    """

    def __cinit__(self, int capacity=CAPACITY):
        cdef int i
        if capacity < 1:
            raise ValueError(f"capacity must be positive, not {capacity}")
        self.capacity = capacity
        self.frames = bytearray(FRAME_SIZE * capacity)
        self.held = memoryview(self.frames)  # as long as it is exported it cannot be resized, and so not be moved
        self.frames_c = <Frame *>PyByteArray_AS_STRING(self.frames)
        self.stamps_c = <int64_t *>PyMem_Calloc(capacity, sizeof(int64_t))
        self.messages = <mmsghdr *>PyMem_Calloc(capacity, sizeof(mmsghdr))
        self.slots = <Slot *>PyMem_Calloc(capacity, sizeof(Slot))
        if not (self.stamps_c and self.messages and self.slots):
            raise MemoryError
        for i in range(capacity):
            self.slots[i].part.iov_base = &self.frames_c[i]
            self.slots[i].part.iov_len = sizeof(Frame)
            self.messages[i].msg_hdr.msg_iov = &self.slots[i].part
            self.messages[i].msg_hdr.msg_iovlen = 1
            self.messages[i].msg_hdr.msg_control = self.slots[i].control

    def __dealloc__(self):
        PyMem_Free(self.stamps_c)
        PyMem_Free(self.messages)
        PyMem_Free(self.slots)

    @property
    def lengths(self):
        """Bytes of each message of the last `receive`."""
        return [self.messages[i].msg_len for i in range(self.count)]

    @property
    def flags(self):
        """msg_flags of each message of the last `receive`."""
        return [self.messages[i].msg_hdr.msg_flags for i in range(self.count)]

    @property
    def stamps_ns(self):
        """Kernel time stamp of each message of the last `receive`."""
        return [self.stamps_c[i] for i in range(self.count)]

    def receive(self, int fd):
        """Take what has arrived on `fd` without waiting; return the number of messages, or -errno.

        0 also for an error after which the next call gives more. An error after some messages is kept by the kernel and comes
        with the next call.
        """
        return self.take(fd)

    cdef int take(self, int fd) noexcept nogil:
        """As `receive`."""
        cdef int i, n
        cdef unsigned int length
        self.count = 0
        self.closed = False
        for i in range(self.capacity):
            self.messages[i].msg_hdr.msg_controllen = CONTROL_SIZE  # overwritten by each call
        n = recvmmsg(fd, self.messages, self.capacity, MSG_DONTWAIT | MSG_TRUNC, NULL)
        if n < 0:
            # ECONNRESET: a unix peer has ended with unread data; this comes before what it had sent, then comes the end.
            return 0 if errno == EAGAIN or errno == EINTR or errno == ECONNRESET else -errno
        for i in range(n):
            length = self.messages[i].msg_len
            if length == 0 and self.messages[i].msg_hdr.msg_controllen == 0:  # the end fills every slot that is left
                self.closed = True
                break
            if length < sizeof(Frame):
                memset(<uint8_t *>&self.frames_c[i] + length, 0, sizeof(Frame) - length)
            self.read_control(i)
            self.count += 1
        return self.count

    cdef void read_control(self, int i) noexcept nogil:
        """Read the control messages of message i, whatever their order and number."""
        cdef msghdr *header = &self.messages[i].msg_hdr
        cdef cmsghdr *part = CMSG_FIRSTHDR(header)
        cdef timespec stamp
        self.stamps_c[i] = 0
        while part:
            if part.cmsg_level == SOL_SOCKET and part.cmsg_type == STAMP:
                memcpy(&stamp, CMSG_DATA(part), sizeof(stamp))
                self.stamps_c[i] = stamp.tv_sec * NS_PER_S + stamp.tv_nsec
            elif part.cmsg_level == SOL_SOCKET and part.cmsg_type == OVERFLOW:
                memcpy(&self.overflow, CMSG_DATA(part), sizeof(self.overflow))
            part = CMSG_NXTHDR(header, part)


def open_frame_socket(bus, filters, *, receive_own=False, error_frames=False, capacity=CAPACITY):
    """Open `bus`: the name of a SocketCAN interface, or `unix:PATH`.

    filters: only frames that match one of them are received (kernel side); None means everything.
    receive_own: frames sent by this socket come back as echo when a filter matches, with `own` set.
    error_frames: receive the error messages of the driver too. capacity: frames per `receive`.
    Raises BusError with one line for the operator; ValueError for filters that no transport knows.
    """
    wanted = checked(filters)
    if not bus:  # the kernel takes an empty name for all interfaces at once
        raise BusError("a bus is the name of a CAN interface, or unix:PATH")
    if bus.startswith(PREFIX):
        if bus == PREFIX:
            raise BusError(f"{bus}: a path must follow `unix:`")
        sock = open_unix(bus.removeprefix(PREFIX), wanted, error_frames)
    else:
        sock = open_socketcan(bus, wanted, receive_own, error_frames)
    unix = sock.family == socket.AF_UNIX
    return FrameSocket(
        sock, bus, unix=unix, receive_own=receive_own, error_frames=error_frames, capacity=capacity
    )


cdef class FrameSocket:
    """An open bus. Never blocks but in `wait`; not to be shared by two receiving threads.

    After `receive` returned n, the values for i < n hold.

    Attributes:
        bus, fd: its name and its descriptor, -1 once closed.
        frames: bytearray; frame i is `frames[16 * i : 16 * i + 16]`.
        stamps_ns: kernel time stamp of frame i, CLOCK_REALTIME in ns.
        own: whether frame i is the echo of one sent here.
        lengths: bytes received, 16 expected.
        tx_dropped: frames not sent because the transmit queue was full.
        rx_dropped: frames lost because this socket was read too late. On a unix bus an upper bound, since the hub cannot
            see which of them a filter would have refused.
    """

    def __cinit__(self, sock, str bus, *, bint unix, bint receive_own, bint error_frames, int capacity):
        self.receiver = FrameReceiver(capacity)
        self.frames, self.frames_c = self.receiver.frames, self.receiver.frames_c
        self.stamps_c = self.receiver.stamps_c
        self.own_c = <bint *>PyMem_Calloc(capacity, sizeof(bint))
        if not self.own_c:
            raise MemoryError
        self.sock, self.bus, self.fd = sock, bus, sock.fileno()
        self.on_unix, self.receive_own, self.error_frames = unix, receive_own, error_frames

    def __dealloc__(self):
        PyMem_Free(self.own_c)

    @property
    def stamps_ns(self):
        """Kernel receive time stamps of the last `receive`, CLOCK_REALTIME in ns."""
        return self.receiver.stamps_ns

    @property
    def lengths(self):
        """Bytes of each message of the last `receive`."""
        return self.receiver.lengths

    @property
    def own(self):
        """Whether each frame of the last `receive` is the echo of one sent here."""
        return [bool(self.own_c[i]) for i in range(self.receiver.count)]

    def send(self, bytes frame16 not None):
        """Send one frame; False when the transmit queue is full (counted, not retried).

        Raises BusDown or BusGone; BusError for a frame the kernel refuses, and for one that is not 16 bytes.
        """
        if PyBytes_GET_SIZE(frame16) != sizeof(Frame):
            raise self.failure(EINVAL)
        return self.put(<const Frame *>PyBytes_AS_STRING(frame16))

    cdef bint put(self, const Frame *frame) except -1:
        """As `send`."""
        cdef Frame marked
        if self.on_unix and self.receive_own:
            marked = frame[0]
            marked.pad[0] = ECHO
            frame = &marked
        if send(self.fd, frame, sizeof(Frame), MSG_DONTWAIT | MSG_NOSIGNAL) >= 0:
            return True
        if errno == EAGAIN or errno == ENOBUFS or errno == ENOMEM:
            self.tx_dropped += 1
            return False
        raise self.failure(errno)

    def receive(self):
        """Take all frames that have arrived (at most the capacity) by one system call; return their number.

        Raises BusDown, BusGone (again at each call once the bus has gone), BusError.
        """
        return self.take()

    cdef int take(self) except -1:
        """As `receive`."""
        cdef int i, n = self.receiver.take(self.fd)
        if n <= 0:
            return self.nothing(n)
        if self.on_unix:
            for i in range(n):
                self.read_marks(i)
        else:
            self.rx_dropped = self.receiver.overflow
            for i in range(n):  # MSG_CONFIRM: sent by this very socket (net/can/raw.c, raw_rcv)
                self.own_c[i] = (
                    self.receive_own and self.receiver.messages[i].msg_hdr.msg_flags & MSG_CONFIRM != 0
                )
        return n

    def wait(self, timeout_s):
        """Wait until `receive` has frames or an error to report; False after `timeout_s` (None: wait for ever)."""
        cdef double timeout_ns
        if timeout_s is None:
            return self.ready(FOR_EVER)
        timeout_ns = <double>timeout_s * 1e9
        if isnan(timeout_ns):
            raise ValueError("a time to wait cannot be NaN")
        if timeout_ns >= FOR_EVER:
            return self.ready(FOR_EVER)
        return self.ready(<int64_t>timeout_ns if timeout_ns > 0.0 else 0)

    cdef bint ready(self, int64_t timeout_ns) except -1:
        """As `wait`; a negative time is over already, INT64_MAX is for ever."""
        cdef pollfd waited
        cdef timespec left
        cdef int n, number
        cdef int64_t end_ns = 0
        if self.fd < 0:  # closed: poll would never report it
            return True
        waited.fd, waited.events = self.fd, POLLIN
        if timeout_ns <= 0:
            timeout_ns = 0
        else:
            end_ns = monotonic_ns()
            if timeout_ns < FOR_EVER - end_ns:
                end_ns += timeout_ns
            else:
                timeout_ns, end_ns = FOR_EVER, 0
        while True:
            left.tv_sec, left.tv_nsec = timeout_ns // NS_PER_S, timeout_ns % NS_PER_S
            with nogil:
                n = ppoll(&waited, 1, NULL if timeout_ns == FOR_EVER else &left, NULL)
                number = errno
            if n >= 0:
                return n > 0
            if number != EINTR:
                raise self.failure(number)
            PyErr_CheckSignals()  # a handler of Python's runs here, and may raise
            if end_ns:
                timeout_ns = max(end_ns - monotonic_ns(), 0)

    def set_filters(self, filters):
        """Replace the receive filters; frames that are queued already stay. Raises BusError, ValueError."""
        wanted = checked(filters)
        try:
            if self.on_unix:
                bpf.attach(self.sock, wanted, self.error_frames)
            else:
                set_can_filters(self.sock, wanted)
        except OSError as error:
            raise self.failure(error.errno or 0) from None

    def close(self):
        """Close the socket; a second call does nothing."""
        self.fd = -1
        self.sock.close()

    cdef int nothing(self, int n) except -1:
        """Return 0 when nothing has arrived; raise the kernel's error otherwise."""
        if self.receiver.closed:
            raise self.failure(EPIPE)
        if n < 0:
            raise self.failure(-n)
        if self.gone:  # the kernel reports ENODEV once; this socket stays useless
            raise self.failure(ENODEV)
        return 0

    cdef object failure(self, int number):
        """Return the exception for error `number`; remember when the bus has gone."""
        error = from_errno(number, self.bus)
        self.gone = self.gone or isinstance(error, BusGone)
        return error

    cdef void read_marks(self, int i) noexcept nogil:
        """Read and clear the hub's marks in the padding: echo bit and count of lost frames."""
        cdef Frame *frame = &self.frames_c[i]
        cdef uint16_t lost
        if self.receiver.messages[i].msg_len != sizeof(Frame):
            self.own_c[i] = False
            return
        self.own_c[i] = frame.pad[0] & ECHO
        lost = <uint16_t>(frame.pad[1] | frame.pad[2] << 8)
        self.rx_dropped += <uint16_t>(lost - self.hub_drops)  # a 16-bit count that wraps
        self.hub_drops = lost
        memset(frame.pad, 0, sizeof(frame.pad))


cdef int64_t monotonic_ns() noexcept nogil:
    cdef timespec now
    clock_gettime(CLOCK_MONOTONIC, &now)
    return now.tv_sec * NS_PER_S + now.tv_nsec
