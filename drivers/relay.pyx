"""Members of a unix bus and the frames that each receives; hub.py has the socket's file and the command.

A client is an AF_UNIX SOCK_SEQPACKET connection; one message is one 16-byte `struct can_frame`. What a member sends, every
other member receives; the sender too when it asks for the echo (bit 0 of byte 5). All members see the same order of frames.
With a wire, frames cross that model first.
"""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize
from cpython.exc cimport PyErr_CheckSignals
from libc.errno cimport EAGAIN, EINTR, errno
from libc.math cimport isnan
from libc.stdint cimport INT64_MAX, int64_t, uint8_t, uint16_t
from libc.string cimport memset
from posix.time cimport timespec

from jtqd.drivers.frame_socket cimport (
    MSG_DONTWAIT,
    MSG_NOSIGNAL,
    POLLIN,
    Frame,
    FrameReceiver,
    pollfd,
    ppoll,
    send,
)

import errno as errors
import os
import socket
import time
from collections import deque

from jtqd.drivers import frame as can
from jtqd.drivers.bus_socket import BUFFER_BYTES, SO_TIMESTAMPNS

MAX_CLIENTS = MOST_CLIENTS
BACKLOG = 32
_BATCH = 32
TX_QUEUE = 128
_READ_BELOW = TX_QUEUE - _BATCH  # a client with more frames waiting is not read: its own send fails with EAGAIN
_PAUSE_S = 0.1  # no accept for this long when the process is out of descriptors
_OLDEST_SEND_NS = 1_000_000_000  # a send stamp older than this means that the clock was stepped
_FULL = frozenset({errors.EMFILE, errors.ENFILE, errors.ENOBUFS, errors.ENOMEM})

cdef uint8_t ECHO = can.ECHO_BIT
cdef unsigned int ERROR_FLAG = can.CAN_ERR_FLAG, EXTENDED = can.CAN_EFF_FLAG
cdef unsigned int EXTENDED_ID = can.CAN_EFF_MASK, STANDARD_ID = can.CAN_SFF_MASK
cdef int LONGEST = can.MAX_LENGTH


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
        return self.relay.submit(self, <const Frame *>PyBytes_AS_STRING(frame16), -1)

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
            sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
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
                    self.deliver(sender, <const Frame *>PyBytes_AS_STRING(frame16), end_ns + to_realtime)
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
                self.deliver_one(sender, <const Frame *>PyBytes_AS_STRING(waiting), stamp_ns)
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
