"""What can go wrong with a bus, in the three classes its user must treat differently."""

import errno
import os


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
        return BusGone(f"{bus}: the bus has gone ({os.strerror(number)})")
    return BusError(f"{bus}: {os.strerror(number)} (errno {number})")
