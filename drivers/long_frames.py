"""Count CAN FD and CAN XL frames on an interface, which jtqd's own sockets do not receive.

A raw socket gets only classic frames unless it asks for the others (linux/can/raw.h: CAN_RAW_FD_FRAMES, CAN_RAW_XL_FRAMES).
This one asks, and a BPF program lets the long ones through alone: the classic frames of every cycle cost nothing here.
"""

from __future__ import annotations

import errno
import socket
import struct
from contextlib import suppress
from typing import Final

from jtqd.drivers.bus_socket import PREFIX, SO_RXQ_OVFL
from jtqd.drivers.filters import attach_program

_FD_FRAMES, _XL_FRAMES = 5, 7
"""CAN_RAW_FD_FRAMES; CAN_RAW_XL_FRAMES, since Linux 6.2."""
_CLASSIC_BYTES, _XL_FLAG = 16, 0x80
"""Size of struct can_frame; bit of `flags` in struct canxl_frame, where a classic frame has its length (0 to 8)."""
_PROGRAM: Final = (
    (0x30, 0, 0, 4),  # ldb [4]
    (0x45, 2, 0, _XL_FLAG),  # jset: a CAN XL frame, which may be as short as a classic one
    (0x80, 0, 0, 0),  # ld len
    (0x25, 0, 1, _CLASSIC_BYTES),  # jgt: CAN FD
    (0x06, 0, 0, _CLASSIC_BYTES),  # ret: let through, cut
    (0x06, 0, 0, 0),  # ret: refuse
)
_MOST: Final = 256
"""Read in one call; what overflows the queue meanwhile is counted by the kernel."""


class LongFrames:
    """Counter of one interface. It counts nothing on a unix bus, and where the kernel or the interface has only classic CAN.

    Attributes:
        count: since it was made.
    """

    def __init__(self, bus: str) -> None:
        self.count = 0
        self._lost = 0
        self._socket = None if bus.startswith(PREFIX) else _open(bus)

    def poll(self) -> int:
        """Count what has come; return the count."""
        if self._socket is None:
            return self.count
        with suppress(OSError):  # nothing waits; the interface is down or has gone
            for _ in range(_MOST):
                _, ancillary, _, _ = self._socket.recvmsg(_CLASSIC_BYTES, socket.CMSG_SPACE(4))
                self.count += 1
                for _, kind, data in ancillary:
                    if kind == SO_RXQ_OVFL:
                        (lost,) = struct.unpack("=I", data[:4])
                        self.count += (lost - self._lost) & 0xFFFF_FFFF
                        self._lost = lost
        return self.count

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


def _open(interface: str) -> socket.socket | None:
    try:
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError:
        return None
    try:
        attach_program(sock, _PROGRAM)
        sock.setsockopt(socket.SOL_CAN_RAW, _FD_FRAMES, 1)
        try:
            sock.setsockopt(socket.SOL_CAN_RAW, _XL_FRAMES, 1)
        except OSError as error:
            if error.errno != errno.ENOPROTOOPT:
                raise
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        sock.setblocking(False)
        sock.bind((interface,))
    except OSError:
        sock.close()
        return None
    return sock
