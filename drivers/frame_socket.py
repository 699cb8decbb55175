"""Frame socket: 16-byte CAN frames over AF_CAN raw (`can0`) or a unix bus (`unix:PATH`), alike to use."""

import errno
import select
import socket
import struct
from collections.abc import Iterable, Sequence

from drivers import bpf
from drivers.can_filter import CanFilter, checked, exact, look_alikes
from drivers.errors import BusError, BusGone, from_errno
from drivers.frame import ECHO_BIT
from drivers.receive import NOTHING_YET, FrameReceiver
from drivers.socketcan import MSG_CONFIRM, open_socketcan, set_can_filters
from drivers.unix_socket import PREFIX, open_unix

__all__ = ["CanFilter", "FrameSocket", "exact", "look_alikes", "open_frame_socket"]

CAPACITY = 32
_QUEUE_FULL = frozenset({errno.EAGAIN, errno.ENOBUFS, errno.ENOMEM})
_MARKS = 0xFFFFFF  # bytes 5..7 of a frame, shifted down
_NO_MARKS = bytes(3)


def open_frame_socket(
    bus: str,
    filters: Iterable[CanFilter] | None,
    *,
    receive_own: bool = False,
    error_frames: bool = False,
    capacity: int = CAPACITY,
) -> "FrameSocket":
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
        if not bus[len(PREFIX) :]:
            raise BusError(f"{bus}: a path must follow `unix:`")
        sock = open_unix(bus[len(PREFIX) :], wanted, error_frames)
        return FrameSocket(
            sock, bus, unix=True, receive_own=receive_own, error_frames=error_frames, capacity=capacity
        )
    sock = open_socketcan(bus, wanted, receive_own, error_frames)
    return FrameSocket(
        sock, bus, unix=False, receive_own=receive_own, error_frames=error_frames, capacity=capacity
    )


class FrameSocket:
    """An open bus. Never blocks but in `wait`; not to be shared by two receiving threads.

    After `receive` returned n, for i < n: `frames[16 * i : 16 * i + 16]`, `stamps_ns[i]` (kernel time stamp,
    CLOCK_REALTIME, ns), `own[i]` (echo of a frame sent here), `lengths[i]` (bytes received, 16 expected).
    Counters: `tx_dropped` (transmit queue full), `rx_dropped` (lost because this socket was read too late; on
    a unix bus an upper bound, since the hub cannot see which of them a filter would have refused; `rx_dropped_before` is
    added to what the kernel counts).
    """

    def __init__(
        self,
        sock: socket.socket,
        bus: str,
        *,
        unix: bool,
        receive_own: bool,
        error_frames: bool,
        capacity: int,
    ) -> None:
        self.bus = bus
        self.fd = sock.fileno()
        self.tx_dropped = 0
        self.rx_dropped = self.rx_dropped_before = 0
        self.own: Sequence[bool] = ()
        self._receiver = FrameReceiver(capacity)
        self.frames = self._receiver.frames
        self._sock = sock
        self._send = sock.send
        self._unix = unix
        self._receive_own = receive_own
        self._mark_echo = unix and receive_own
        self._error_frames = error_frames
        self._gone = False
        self._hub_drops = 0
        self._readers = [self.fd]
        self._not_own = [(False,) * n for n in range(capacity + 1)]
        self._heads = [struct.Struct("<" + "Q8x" * n) for n in range(capacity + 1)]

    @property
    def stamps_ns(self) -> Sequence[int]:
        """Kernel receive time stamps of the last `receive`, CLOCK_REALTIME in ns."""
        return self._receiver.stamps_ns

    @property
    def lengths(self) -> Sequence[int]:
        """Bytes of each message of the last `receive`."""
        return self._receiver.lengths

    def send(self, frame16: bytes) -> bool:
        """Send one frame; False when the transmit queue is full (counted, not retried).

        Raises BusDown or BusGone; BusError for a frame the kernel refuses.
        """
        try:
            if self._mark_echo:
                self._send(frame16[:5] + _ECHO + frame16[6:])
            else:
                self._send(frame16)
        except OSError as error:
            if error.errno in _QUEUE_FULL:
                self.tx_dropped += 1
                return False
            raise self._failure(error.errno or 0) from None
        return True

    def receive(self) -> int:
        """Take all frames that have arrived (at most the capacity) by one system call; return their number.

        Raises BusDown, BusGone (again at each call once the bus has gone), BusError.
        """
        receiver = self._receiver
        n = receiver.receive(self.fd)
        if n <= 0:
            return self._nothing(n)
        if self._unix:
            heads = self._heads[n].unpack_from(self.frames)
            if max(heads) >> 40:
                self._read_marks(n, heads)
            else:
                self.own = self._not_own[n]
        else:
            self.rx_dropped = receiver.overflow + self.rx_dropped_before
            if self._receive_own:
                self.own = [flags & MSG_CONFIRM != 0 for flags in receiver.flags]
            else:
                self.own = self._not_own[n]
        return n

    def wait(self, timeout_s: float | None) -> bool:
        """Wait until `receive` has frames or an error to tell; False after `timeout_s` (None: wait for ever).

        select(2) because its timeout has microseconds; poll and epoll of the standard library round to 1 ms.
        """
        if timeout_s is not None and timeout_s < 0.0:
            timeout_s = 0.0
        return bool(select.select(self._readers, (), (), timeout_s)[0])

    def set_filters(self, filters: Iterable[CanFilter] | None) -> None:
        """Replace the receive filters; frames that are queued already stay. Raises BusError, ValueError."""
        wanted = checked(filters)
        try:
            if self._unix:
                bpf.attach(self._sock, wanted, self._error_frames)
            else:
                set_can_filters(self._sock, wanted)
        except OSError as error:
            raise self._failure(error.errno or 0) from None

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._sock.close()

    def _nothing(self, n: int) -> int:
        """Return 0 when nothing has arrived; raise what the kernel said otherwise."""
        if self._receiver.closed:
            raise self._failure(errno.EPIPE)
        if -n not in NOTHING_YET and n != 0:
            raise self._failure(-n)
        if self._gone:  # the kernel says ENODEV once; this socket stays useless
            raise self._failure(errno.ENODEV)
        return 0

    def _failure(self, number: int) -> BusError:
        """Return the exception for `number` and remember that the bus has gone."""
        error = from_errno(number, self.bus)
        self._gone = self._gone or isinstance(error, BusGone)
        return error

    def _read_marks(self, n: int, heads: Sequence[int]) -> None:
        """Read and clear what the hub has written into the padding: echo bit and count of lost frames."""
        own = [False] * n
        for i in range(n):
            marks = heads[i] >> 40 & _MARKS
            own[i] = bool(marks & ECHO_BIT)
            if marks:
                self.frames[16 * i + 5 : 16 * i + 8] = _NO_MARKS
            lost = marks >> 8
            self.rx_dropped += lost - self._hub_drops & 0xFFFF  # a 16-bit count that wraps
            self._hub_drops = lost
        self.own = own


_ECHO = bytes([ECHO_BIT])
