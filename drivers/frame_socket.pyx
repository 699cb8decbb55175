"""Frames on sockets: `FrameSocket`, one open bus over AF_CAN raw (`can0`) or a unix bus (`unix:PATH`), and `Relay`, the hub's part.

`open_frame_socket` opens either (bus_socket.py); an error is a BusError in one of three classes that need different
reactions. `FrameReceiver` takes all frames that have arrived by one recvmmsg(2) into memory that is laid out once, for
any socket. `take`, `put` and `ready` are `receive`, `send` and `wait` for compiled callers: no Python object is made but for
an error.

A client of a unix bus is an AF_UNIX SOCK_SEQPACKET connection; one message is one 16-byte `struct can_frame`. What a member
sends, every other member receives; the sender too when it asks for the echo (bit 0 of byte 5). All members see the same order
of frames. With a wire, frames cross that model first. hub.py has the socket's file, the wire and the command.
"""

from cpython.bytearray cimport PyByteArray_AsString
from cpython.bytes cimport PyBytes_AsString, PyBytes_FromStringAndSize, PyBytes_Size
from cpython.exc cimport PyErr_CheckSignals
from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.errno cimport EAGAIN, ECONNRESET, EINTR, EINVAL, ENOBUFS, ENODEV, ENOMEM, EPIPE, errno
from libc.math cimport isnan
from libc.stdint cimport INT64_MAX, int64_t, uint16_t, uint8_t
from libc.string cimport memcpy, memset
from posix.time cimport CLOCK_MONOTONIC, clock_gettime, timespec

import errno as errors
import os
import socket
import time
from collections import deque

from jtqd.drivers import bus_socket
from jtqd.drivers import frame as can
from jtqd.drivers.bus_socket import PREFIX, BusDown, BusError, BusGone
from jtqd.drivers.frame import FRAME_SIZE

__all__ = [
    "BACKLOG",
    "CAPACITY",
    "MAX_CLIENTS",
    "TX_QUEUE",
    "BusDown",
    "BusError",
    "BusGone",
    "FrameReceiver",
    "FrameSocket",
    "Relay",
    "open_frame_socket",
]

CAPACITY = 32
"""Frames that one `receive` takes at most."""

cdef int STAMP = bus_socket.SO_TIMESTAMPNS  # SCM_TIMESTAMPNS is the same number
cdef int OVERFLOW = bus_socket.SO_RXQ_OVFL
cdef uint8_t ECHO = can.ECHO_BIT
cdef unsigned int ERROR_FLAG = can.CAN_ERR_FLAG, EXTENDED = can.CAN_EFF_FLAG
cdef unsigned int EXTENDED_ID = can.CAN_EFF_MASK, STANDARD_ID = can.CAN_SFF_MASK
cdef int LONGEST = can.MAX_LENGTH
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
        self.frames_c = <Frame *>PyByteArray_AsString(self.frames)
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
        return [self.messages[i].msg_len for i in range(self.count)]

    @property
    def flags(self):
        return [self.messages[i].msg_hdr.msg_flags for i in range(self.count)]

    @property
    def stamps_ns(self):
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
    wanted = bus_socket.checked_filters(filters)
    if not bus:  # the kernel takes an empty name for all interfaces at once
        raise BusError("a bus is the name of a CAN interface, or unix:PATH")
    if bus.startswith(PREFIX):
        if bus == PREFIX:
            raise BusError(f"{bus}: a path must follow `unix:`")
        sock = bus_socket.open_unix(bus.removeprefix(PREFIX), wanted, error_frames)
    else:
        sock = bus_socket.open_socketcan(bus, wanted, receive_own, error_frames)
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
        return self.receiver.stamps_ns

    @property
    def lengths(self):
        return self.receiver.lengths

    @property
    def own(self):
        return [bool(self.own_c[i]) for i in range(self.receiver.count)]

    def send(self, bytes frame16 not None):
        """Send one frame; False when the transmit queue is full (counted, not retried).

        Raises BusDown or BusGone; BusError for a frame the kernel refuses, and for one that is not 16 bytes.
        """
        if PyBytes_Size(frame16) != sizeof(Frame):
            raise self.failure(EINVAL)
        return self.put(<const Frame *>PyBytes_AsString(frame16))

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
        wanted = bus_socket.checked_filters(filters)
        try:
            if self.on_unix:
                bus_socket.attach_filters(self.sock, wanted, self.error_frames)
            else:
                bus_socket.set_can_filters(self.sock, wanted)
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
        error = bus_socket.from_errno(number, self.bus)
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


# Relay: members of a unix bus

MAX_CLIENTS = MOST_CLIENTS
BACKLOG = 32
_BATCH = 32
TX_QUEUE = 128
_READ_BELOW = TX_QUEUE - _BATCH  # a client with more frames waiting is not read: its own send fails with EAGAIN
_PAUSE_S = 0.1  # no accept for this long when the process is out of descriptors
_OLDEST_SEND_NS = 1_000_000_000  # a send stamp older than this means that the clock was stepped
_FULL = frozenset({errors.EMFILE, errors.ENFILE, errors.ENOBUFS, errors.ENOMEM})


cdef bint possible(const Frame *frame) noexcept nogil:
    """Return whether this is a frame that a CAN controller could send, or an error message."""
    return frame.length <= LONGEST and (
        frame.id & (EXTENDED | ERROR_FLAG) or not frame.id & EXTENDED_ID & ~STANDARD_ID
    )


cdef bytes as_bytes(const Frame *frame):
    return PyBytes_FromStringAndSize(<const char *>frame, sizeof(Frame))


cdef class HubCounters:
    """Frames and connections, accepted and refused.

    frames: accepted from members; malformed: not 16 bytes, more than 8 data bytes, or an impossible identifier; dropped: not
    delivered, that member's socket buffer was full; refused: connections beyond MAX_CLIENTS or out of descriptors; tx_full:
    frames of local ports refused by a full transmit queue.
    """


cdef class Member:
    """A receiver of frames."""

    cdef bint take(self, const Frame *frame, int64_t stamp_ns) except -1:
        """Take a frame; False when it is lost."""
        raise NotImplementedError


cdef class LocalPort(Member):
    """A node in the hub's own process.

    on_frame: called with a frame and the time it was sent (modelled wire: end of transmission), CLOCK_REALTIME ns; wanted:
    11-bit identifiers that the node listens to, None for all. Raises IndexError for others.
    """

    def __init__(self, Relay relay, on_frame, wanted=None):
        self.relay, self.on_frame = relay, on_frame
        self.hears_all = wanted is None
        memset(self.hears, 0, sizeof(self.hears))
        for can_id in wanted or ():
            if not 0 <= can_id < STANDARD_IDS:
                raise IndexError(f"found identifier {can_id:#x}, expected one of 11 bits")
            self.hears[can_id] = True

    def send(self, bytes frame16 not None):
        """Send a frame; False when the transmit queue of the wire is full.

        From within `on_frame` on a modelled wire it counts from the end of the frame being answered, however
        late the hub was: a node answers at once, and the answers of several nodes arbitrate.
        """
        if len(frame16) != sizeof(Frame):
            self.relay.counters.malformed += 1
            return False
        return self.relay.submit(self, <const Frame *>PyBytes_AsString(frame16), -1)

    cdef bint take(self, const Frame *frame, int64_t stamp_ns) except -1:
        if self.hears_all or frame.id <= STANDARD_ID and self.hears[frame.id]:
            self.relay.heard = True
            self.on_frame(as_bytes(frame), stamp_ns)
        return True

    def detach(self):
        """Leave the bus."""
        self.relay.remove(self)


cdef class Client(Member):
    """One connected socket."""

    def __init__(self, sock):
        self.sock = sock
        self.fd = sock.fileno()
        self.dropped = 0

    cdef bint take(self, const Frame *frame, int64_t stamp_ns) except -1:
        """Send a frame to the client without waiting; False when its buffer is full.

        Bytes 6 and 7 count the frames that the client has lost so far (modulo 65536), like SO_RXQ_OVFL of AF_CAN.
        """
        cdef Frame marked = frame[0]
        if self.dropped:
            marked.pad[1], marked.pad[2] = self.dropped & 0xFF, self.dropped >> 8 & 0xFF
        if send(self.fd, &marked, sizeof(Frame), MSG_DONTWAIT | MSG_NOSIGNAL) < 0 and errno == EAGAIN:
            self.dropped += 1
            return False
        return True  # a client that has ended is removed by the next read


cdef class Relay:
    """Members of one bus. listener: a non-blocking listening socket; wire: a `WireModel`, or None.

    Without a wire a frame is delivered as soon as it is read. Not thread-safe: all calls from one thread.
    """

    def __init__(self, listener, wire=None):
        self.counters = HubCounters()
        self.wire = wire
        self._listener = listener
        self._clients = {}
        self._answering_ns = None
        self.receiver = FrameReceiver(_BATCH)
        self.members = []
        self.queue = deque()
        self.paused_until = 0.0

    def attach(self, on_frame, wanted=None):
        """Add a node in this process; its callback may send, which keeps the order of frames for all.

        wanted: the identifiers that it listens to; None for all.
        """
        port = LocalPort(self, on_frame, wanted)
        self.members = [*self.members, port]
        return port

    def remove(self, Member member):
        """Take a member off the bus; what it has sent already is still delivered."""
        cdef Client client
        self.members = [each for each in self.members if each is not member]
        if isinstance(member, Client):
            client = member
            if self._clients.pop(client.fd, None) is not None:
                client.fd = -1
                client.sock.close()

    @property
    def clients(self):
        """Connected sockets; local ports do not count."""
        return len(self._clients)

    def serve(self, timeout_s):
        """Do what is ready as it comes, until a node in this process has heard a frame or `timeout_s` have passed."""
        end_s = time.monotonic() + timeout_s
        self.heard = False
        self.run_once(timeout_s)
        while not self.heard:
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return
            self.run_once(left_s)

    cpdef run_once(self, timeout_s):
        """Wait up to `timeout_s` (None: for ever) for something to do, and do what is ready."""
        cdef pollfd waited[MOST_CLIENTS + 1]
        cdef timespec left
        cdef int64_t timeout_ns = self.bounded(timeout_s)
        cdef int count = 0, n, number
        cdef Client client
        for client in self._clients.values():
            if self.wire is None or self.wire.pending(client) < _READ_BELOW:
                waited[count].fd, waited[count].events = client.fd, POLLIN
                count += 1
        n = count
        if not self.paused_until or time.monotonic() >= self.paused_until:
            self.paused_until = 0.0
            waited[count].fd, waited[count].events = self._listener.fileno(), POLLIN
            count += 1
        left.tv_sec, left.tv_nsec = timeout_ns // 1_000_000_000, timeout_ns % 1_000_000_000
        with nogil:
            number = ppoll(waited, count, NULL if timeout_ns == INT64_MAX else &left, NULL)
            if number < 0:
                number = -errno
        PyErr_CheckSignals()  # a handler of Python's runs here, and may raise
        if number < 0:
            if number == -EINTR:
                return
            raise OSError(-number, os.strerror(-number))
        if number > 0:
            if count > n and waited[n].revents:  # first, so that a new client sees all that is read after it connected
                self.accept()
            for i in range(n):
                if waited[i].revents:
                    self.read(self._clients[waited[i].fd])
        if self.wire is not None:
            self.advance()

    cdef int64_t bounded(self, timeout_s) except -1:
        """Return `timeout_s` in ns, shortened to the end of the transmission under way, or of an accept pause."""
        cdef double wanted_ns = 1e9 * (<double>INT64_MAX if timeout_s is None else timeout_s)
        if isnan(wanted_ns):
            raise ValueError("a time to wait cannot be NaN")
        if self.paused_until:
            wanted_ns = min(wanted_ns, 1e9 * _PAUSE_S)
        end_ns = self.wire.next_end() if self.wire is not None else None
        if end_ns is not None:
            wanted_ns = min(wanted_ns, <double>(end_ns - time.monotonic_ns()))
        return INT64_MAX if wanted_ns >= INT64_MAX else <int64_t>max(wanted_ns, 0.0)

    cdef int accept(self) except -1:
        """Take the waiting connections, at most one backlog at a time."""
        for _ in range(BACKLOG):
            try:
                sock = self._listener.accept()[0]
            except OSError as error:
                if error.errno in _FULL:
                    self.counters.refused += 1
                    self.paused_until = time.monotonic() + _PAUSE_S
                return 0
            if len(self._clients) >= MAX_CLIENTS:
                self.counters.refused += 1
                sock.close()
                continue
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, bus_socket.SO_TIMESTAMPNS, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, bus_socket.BUFFER_BYTES)
            client = Client(sock)
            self._clients[sock.fileno()] = client
            self.members = [*self.members, client]
        return 0

    cdef int read(self, Client client) except -1:
        """Take one batch of frames of `client`; remove it when it has ended."""
        cdef FrameReceiver receiver = self.receiver
        cdef int n = receiver.take(client.fd)
        cdef bint ended = receiver.closed or n < 0
        for i in range(n):
            if receiver.messages[i].msg_len == sizeof(Frame):
                self.submit(client, &receiver.frames_c[i], receiver.stamps_c[i])
            else:
                self.counters.malformed += 1
        if ended:
            self.remove(client)
        return 0

    cdef bint submit(self, Member sender, const Frame *frame, int64_t stamp_ns) except -1:
        """Put a frame sent at `stamp_ns` (CLOCK_REALTIME; -1: now) on the bus; False when it was refused."""
        if not possible(frame):
            self.counters.malformed += 1
            return False
        self.counters.frames += 1
        if self.wire is None or frame.id & ERROR_FLAG:  # an error message never is on the wire
            self.deliver(sender, frame, time.time_ns() if stamp_ns < 0 else stamp_ns)
            return True
        if self._answering_ns is not None:
            sent_ns = self._answering_ns
        else:
            now_ns = time.time_ns()
            age_ns = 0 if stamp_ns < 0 else min(max(now_ns - stamp_ns, 0), _OLDEST_SEND_NS)
            sent_ns = time.monotonic_ns() - age_ns
        if not self.wire.submit(sender, as_bytes(frame), sent_ns):
            self.counters.tx_full += 1
            return False
        return True

    cdef int advance(self) except -1:
        """Deliver what has crossed the wire by now."""
        cdef bytes frame16
        now_ns = time.monotonic_ns()
        ended = self.wire.advance(now_ns)
        if ended:
            to_realtime = time.time_ns() - now_ns
            try:
                for sender, frame16, end_ns in ended:
                    self._answering_ns = end_ns
                    self.deliver(sender, <const Frame *>PyBytes_AsString(frame16), end_ns + to_realtime)
            finally:
                self._answering_ns = None
        return 0

    cdef int deliver(self, Member sender, const Frame *frame, int64_t stamp_ns) except -1:
        """Deliver a frame to all; one sent within a callback waits until all have the frame before it."""
        cdef bytes waiting
        if self.delivering:
            self.queue.append((sender, as_bytes(frame), stamp_ns))
            return 0
        self.delivering = True
        try:
            self.deliver_one(sender, frame, stamp_ns)
            while self.queue:
                sender, waiting, stamp_ns = self.queue.popleft()
                self.deliver_one(sender, <const Frame *>PyBytes_AsString(waiting), stamp_ns)
        finally:
            self.delivering = False
        return 0

    cdef int deliver_one(self, Member sender, const Frame *frame, int64_t stamp_ns) except -1:
        """Deliver a frame to every member but its sender, and to the sender first if it asks for the echo."""
        cdef Frame clean = frame[0]
        cdef Member member
        clean.pad[1] = clean.pad[2] = 0
        if frame.pad[0] & ECHO:
            clean.pad[0] = ECHO
            self.counters.dropped += not sender.take(&clean, stamp_ns)
        clean.pad[0] = 0
        for member in self.members:
            if member is not sender:
                self.counters.dropped += not member.take(&clean, stamp_ns)
        return 0
