"""Where a cycle takes its frames from and puts its own: the one place that knows what a frame socket looks like."""

from libc.stdint cimport int64_t
from libc.string cimport memcpy

from jtqd.drivers.frame_socket cimport Frame, FrameSocket
from jtqd.drivers import frame_socket

cdef enum:
    CAPACITY = 32
if CAPACITY != frame_socket.CAPACITY:
    raise ImportError(f"a socket gives up to {frame_socket.CAPACITY} frames at once, there is room for {CAPACITY}")


cdef class Bus:
    """After `take` returned n: n frames, their kernel stamps (CLOCK_REALTIME), and whether each is an echo of ours."""

    cdef int take(self) except -1:
        """Take what has come; return the number of frames. Raises BusDown, BusGone, BusError."""
        raise NotImplementedError

    cdef bint put(self, const Frame *frame) except -1:
        """Send a frame; False when the transmit queue is full. Raises BusDown, BusGone, BusError."""
        raise NotImplementedError

    cdef bint wait(self, int64_t timeout_ns) except -1:
        """Wait until there is something to take; False after `timeout_ns`."""
        raise NotImplementedError

    cdef int64_t tx_dropped(self) except -1:
        """Return the frames that were not sent because the transmit queue was full."""
        raise NotImplementedError

    cdef int64_t rx_dropped(self) except -1:
        """Return the frames that were lost because the socket was read too late."""
        raise NotImplementedError


cdef class SocketBus(Bus):
    """A `FrameSocket`."""

    cdef FrameSocket socket

    def __init__(self, FrameSocket socket):
        self.socket = socket
        self.frames, self.stamps_ns, self.own = socket.frames_c, socket.stamps_c, socket.own_c

    cdef int take(self) except -1:
        """As `receive`."""
        return self.socket.take()

    cdef bint put(self, const Frame *frame) except -1:
        """As `send`."""
        return self.socket.put(frame)

    cdef bint wait(self, int64_t timeout_ns) except -1:
        """As `wait`."""
        return self.socket.ready(timeout_ns)

    cdef int64_t tx_dropped(self) except -1:
        return self.socket.tx_dropped

    cdef int64_t rx_dropped(self) except -1:
        return self.socket.rx_dropped


cdef class PythonBus(Bus):
    """What takes the place of a frame socket in a test, through its Python methods."""

    cdef object socket
    cdef Frame frame_room[CAPACITY]
    cdef int64_t stamp_room[CAPACITY]
    cdef bint own_room[CAPACITY]

    def __init__(self, socket):
        self.socket = socket
        self.frames, self.stamps_ns, self.own = self.frame_room, self.stamp_room, self.own_room

    cdef int take(self) except -1:
        """Copy what `receive` gives."""
        cdef int count = self.socket.receive(), n
        cdef const unsigned char[::1] frames
        if count == 0:
            return 0
        if count > CAPACITY:
            raise ValueError(f"found {count} frames at once, expected at most {CAPACITY}")
        frames = self.socket.frames
        memcpy(self.frame_room, &frames[0], count * sizeof(Frame))
        stamps_ns, own = self.socket.stamps_ns, self.socket.own
        for n in range(count):
            self.stamp_room[n], self.own_room[n] = stamps_ns[n], own[n]
        return count

    cdef bint put(self, const Frame *frame) except -1:
        """As `send`."""
        return self.socket.send((<const char *> frame)[:sizeof(Frame)])

    cdef bint wait(self, int64_t timeout_ns) except -1:
        """As `wait`."""
        return self.socket.wait(timeout_ns * 1e-9)

    cdef int64_t tx_dropped(self) except -1:
        return self.socket.tx_dropped

    cdef int64_t rx_dropped(self) except -1:
        return self.socket.rx_dropped


cdef Bus bus_of(object socket):
    """Return the bus behind a frame socket."""
    return SocketBus(socket) if isinstance(socket, FrameSocket) else PythonBus(socket)
