"""The listening socket of a unix bus and the life of its file."""

import errno
import os
import socket
import stat

from drivers.errors import BusError
from drivers.socket_path import reachable
from drivers.unix_socket import PREFIX, require_directory


def listen(path: str, backlog: int) -> socket.socket:
    """Return a listening socket at `path`, mode 0600; the file of a dead hub is replaced.

    Raises BusError: a live hub or another file is there, or the path is unusable.
    """
    bus = PREFIX + path
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    umask = os.umask(0o177)
    try:
        with reachable(path) as address:
            try:
                sock.bind(address)
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                _remove_dead(path, address)
                sock.bind(address)
        sock.listen(backlog)
        sock.setblocking(False)
    except BusError:
        sock.close()
        raise
    except OSError as error:
        sock.close()
        require_directory(path)
        raise BusError(f"{bus}: cannot make the bus: {error.strerror or error}") from None
    finally:
        os.umask(umask)
    return sock


def _remove_dead(path: str, address: str) -> None:
    """Remove the socket file of a hub that no longer listens. Raises BusError for anything else."""
    if not stat.S_ISSOCK(os.lstat(path).st_mode):
        raise BusError(f"{PREFIX}{path}: a file that is no socket is there")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(address)
        except ConnectionRefusedError:
            os.unlink(path)
            return
        except OSError:
            pass  # a full backlog or another kind of socket: somebody lives there
    raise BusError(f"{PREFIX}{path}: another hub is running there")
