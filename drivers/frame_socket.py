"""Frame socket: 16-byte CAN frames over AF_CAN raw (`can0`) or a unix bus (`unix:PATH`), alike to use.

`open_frame_socket` opens either; what goes wrong is a BusError in one of three classes that their user must treat
differently. From parts up: the errors, the client socket of a unix bus, the AF_CAN socket, `FrameSocket`.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from jtqd.drivers import filters as bpf
from jtqd.drivers.filters import CanFilter, can_raw_filter, checked
from jtqd.drivers.frame import ECHO_BIT
from jtqd.drivers.receive import NOTHING_YET, SO_RXQ_OVFL, SO_TIMESTAMPNS, FrameReceiver


class BusError(Exception):
    """The bus cannot be used; the message is one line that names the bus and says what to do."""


class BusDown(BusError):  # noqa: N818 - a state of the bus
    """The interface is down (ENETDOWN): keep the socket, it works again after `ip link set up`."""


class BusGone(BusError):  # noqa: N818
    """The interface was removed (ENODEV) or the hub has ended: close the socket and open a new one."""


_GONE = frozenset(
    {errno.ENODEV, errno.ENXIO, errno.EPIPE, errno.ECONNRESET, errno.ENOTCONN, errno.ESHUTDOWN, errno.EBADF}
)


def from_errno(number: int, bus: str) -> BusError:
    """Make the exception for error `number` of a system call on the socket of `bus`.

    ENETDOWN leaves a CAN socket bound; ENODEV (receive) and ENXIO (send) unbind it for good
    (net/can/raw.c, raw_notify and raw_sendmsg).
    """
    if number == errno.ENETDOWN:
        return BusDown(f"{bus}: the interface is down")
    if number in _GONE:
        return BusGone(f"{bus}: bus lost ({os.strerror(number)})")
    return BusError(f"{bus}: {os.strerror(number)} (errno {number})")


# A unix bus: AF_UNIX SOCK_SEQPACKET, one 16-byte frame per message ----------------------------------------------

PREFIX = "unix:"
BUFFER_BYTES = 1 << 20  # the kernel cuts it to net.core.rmem_max, wmem_max
_CONNECT_TIMEOUT = struct.Struct("@ll").pack(2, 0)  # struct timeval
_LONGEST_ADDRESS = 107  # bytes of `sun_path` without its end (unix(7))


@contextmanager
def reachable(path: Path | str) -> Iterator[str]:
    """Give the address to bind or connect to for the socket at `path`, in a directory of any depth.

    A path too long for the kernel is reached through its directory, held open as a descriptor while the `with` lasts:
    /proc/self/fd/N/NAME.

    Raises:
        OSError: a path is too long and its directory cannot be opened. A name that alone is too long stays as it is, and
            `bind` says so.
    """
    text = os.fspath(path)
    directory, name = os.path.split(text)
    if len(os.fsencode(text)) <= _LONGEST_ADDRESS or not name:
        yield text
        return
    descriptor = os.open(directory or ".", os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{name}"
    finally:
        os.close(descriptor)


def require_directory(path: str) -> None:
    """Raise BusError when a bus cannot be at `path` for want of the directory, and name that."""
    directory = os.path.dirname(path) or "."
    if not os.path.isdir(directory):
        what = "is not a directory" if os.path.lexists(directory) else "does not exist"
        raise BusError(f"{PREFIX}{path}: the directory {directory} {what}")


def open_unix(path: str, filters: Sequence[CanFilter], error_frames: bool) -> socket.socket:
    """Return a non-blocking socket connected to the hub at `path`; its filters are on before it connects.

    Raises BusError: nobody there, no such directory, something else than a hub there, a hub that does not answer within 2 s.
    """
    bus = PREFIX + path
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        bpf.attach(sock, filters, error_frames)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        # Bounds connect() when the hub hangs with a full backlog; a non-blocking connect would fail at once.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _CONNECT_TIMEOUT)
        with reachable(path) as address:
            sock.connect(address)
        sock.setblocking(False)
    except (FileNotFoundError, NotADirectoryError, ConnectionRefusedError):
        sock.close()
        require_directory(path)
        raise BusError(f"no bus at {bus}: start one with `jtq sim --bus {bus}`") from None
    except BlockingIOError:
        sock.close()
        raise BusError(f"{bus}: the hub does not answer") from None
    except OSError as error:
        sock.close()
        raise BusError(f"{bus}: not a frame hub: {error.strerror or error}") from None
    return sock


# AF_CAN -------------------------------------------------------------------------------------------------------

# linux/can.h and linux/can/raw.h; written out because a Python built without these headers lacks the names
AF_CAN = 29
CAN_RAW = 1
SOL_CAN_RAW = 101
CAN_RAW_FILTER = 1
CAN_RAW_ERR_FILTER = 2
CAN_RAW_RECV_OWN_MSGS = 4
CAN_ERR_MASK = 0x1FFFFFFF
MSG_CONFIRM = 0x800
"""In msg_flags of a received frame: sent by this very socket (net/can/raw.c, raw_rcv)."""

_NO_CAN = frozenset({errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT})


def open_socketcan(
    interface: str, filters: Sequence[CanFilter], receive_own: bool, error_frames: bool
) -> socket.socket:
    """Return a non-blocking raw socket bound to `interface`; its filters are in force before it is bound.

    Binding to an interface that is down succeeds, and the first receive then fails with ENETDOWN.
    Raises BusError: no CAN in this kernel, no such interface, not a CAN interface, or another error of bind.
    """
    try:
        sock = socket.socket(AF_CAN, socket.SOCK_RAW, CAN_RAW)
    except OSError as error:
        if error.errno in _NO_CAN:
            raise BusError(
                f"{interface}: this kernel has no CAN (AF_CAN, errno {error.errno}); use unix:PATH instead"
            ) from None
        raise BusError(f"{interface}: {error}") from None
    try:
        set_can_filters(sock, filters)
        sock.setsockopt(SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, int(receive_own))
        if error_frames:
            sock.setsockopt(SOL_CAN_RAW, CAN_RAW_ERR_FILTER, CAN_ERR_MASK)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        sock.setblocking(False)
        sock.bind((interface,))
    except OSError as error:
        sock.close()
        raise BusError(_bind_message(interface, error)) from None
    return sock


def set_can_filters(sock: socket.socket, filters: Sequence[CanFilter]) -> None:
    """Replace the filters of `sock`; an empty list receives nothing."""
    sock.setsockopt(SOL_CAN_RAW, CAN_RAW_FILTER, can_raw_filter(filters))


def _bind_message(interface: str, error: OSError) -> str:
    """Return in one line why `interface` could not be bound."""
    try:
        socket.if_nametoindex(interface)
    except OSError:
        return f"no such CAN interface: {interface}"
    if error.errno == errno.ENODEV:
        return f"not a CAN interface: {interface}"
    return f"{interface}: {error}"


# Either ---------------------------------------------------------------------------------------------------------

CAPACITY = 32
"""Frames that one `receive` takes at most."""
_QUEUE_FULL = frozenset({errno.EAGAIN, errno.ENOBUFS, errno.ENOMEM})
_MARKS = 0xFFFFFF  # bytes 5..7 of a frame, shifted down
_NO_MARKS = bytes(3)
_ECHO = bytes([ECHO_BIT])


def open_frame_socket(
    bus: str,
    filters: Iterable[CanFilter] | None,
    *,
    receive_own: bool = False,
    error_frames: bool = False,
    capacity: int = CAPACITY,
) -> FrameSocket:
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
    else:
        sock = open_socketcan(bus, wanted, receive_own, error_frames)
    unix = sock.family == socket.AF_UNIX
    return FrameSocket(
        sock, bus, unix=unix, receive_own=receive_own, error_frames=error_frames, capacity=capacity
    )


class FrameSocket:
    """An open bus. Never blocks but in `wait`; not to be shared by two receiving threads.

    After `receive` returned n, the values for i < n hold.

    Attributes:
        frames: bytearray; frame i is `frames[16 * i : 16 * i + 16]`.
        stamps_ns: kernel time stamp of frame i, CLOCK_REALTIME in ns.
        own: whether frame i is the echo of one sent here.
        lengths: bytes received, 16 expected.
        tx_dropped: frames not sent because the transmit queue was full.
        rx_dropped: frames lost because this socket was read too late. On a unix bus an upper bound, since the hub cannot
            see which of them a filter would have refused.
        rx_dropped_before: on AF_CAN added to what the kernel counts.
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
        """Wait until `receive` has frames or an error to report; False after `timeout_s` (None: wait for ever).

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
        """Return 0 when nothing has arrived; raise the kernel's error otherwise."""
        if self._receiver.closed:
            raise self._failure(errno.EPIPE)
        if -n not in NOTHING_YET and n != 0:
            raise self._failure(-n)
        if self._gone:  # the kernel reports ENODEV once; this socket stays useless
            raise self._failure(errno.ENODEV)
        return 0

    def _failure(self, number: int) -> BusError:
        """Return the exception for error `number`; remember when the bus has gone."""
        error = from_errno(number, self.bus)
        self._gone = self._gone or isinstance(error, BusGone)
        return error

    def _read_marks(self, n: int, heads: Sequence[int]) -> None:
        """Read and clear the hub's marks in the padding: echo bit and count of lost frames."""
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
