"""Opening an AF_CAN raw socket."""

import errno
import socket
from collections.abc import Sequence

from drivers.can_filter import CanFilter, can_raw_filter
from drivers.errors import BusError
from drivers.receive import SO_RXQ_OVFL, SO_TIMESTAMPNS

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

_BUFFER_BYTES = 1 << 20  # the kernel cuts it to net.core.rmem_max / wmem_max
_NO_CAN = frozenset({errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT})


def open_socketcan(
    interface: str, filters: Sequence[CanFilter], receive_own: bool, error_frames: bool
) -> socket.socket:
    """Return a non-blocking raw socket bound to `interface`; its filters are in force before it is bound.

    Binding to an interface that is down succeeds, and the first receive then says ENETDOWN.
    Raises BusError: no CAN in this kernel, no such interface, not a CAN interface, or what else bind says.
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
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
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
    """Say in one line why `interface` could not be bound."""
    try:
        socket.if_nametoindex(interface)
    except OSError:
        return f"no such CAN interface: {interface}"
    if error.errno == errno.ENODEV:
        return f"not a CAN interface: {interface}"
    return f"{interface}: {error}"
