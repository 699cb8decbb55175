"""Opening a client socket of a unix bus: AF_UNIX SOCK_SEQPACKET, one 16-byte frame per message."""

import os
import socket
import struct
from collections.abc import Sequence

from drivers import bpf
from drivers.can_filter import CanFilter
from drivers.errors import BusError
from drivers.receive import SO_TIMESTAMPNS
from drivers.socket_path import reachable

PREFIX = "unix:"
BUFFER_BYTES = 1 << 20  # the kernel cuts it to net.core.wmem_max
_CONNECT_TIMEOUT = struct.Struct("@ll").pack(2, 0)  # struct timeval


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
