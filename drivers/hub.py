"""Hub of a unix bus: `python -m jtqd.drivers.hub unix:PATH [--bitrate 1000000]`, or embedded beside local nodes.

Who is connected and what each receives is compiled (`relay`); here are the socket's file and the command. With a bit rate,
frames first cross a modelled wire (`jtqd.drivers.wire`).
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import signal
import socket
import stat
import sys
from types import FrameType

from jtqd.drivers.bus_socket import PREFIX, BusError, reachable, require_directory
from jtqd.drivers.relay import BACKLOG, MAX_CLIENTS, TX_QUEUE, Relay
from jtqd.drivers.wire import WireModel

__all__ = ["MAX_CLIENTS", "Hub", "listen", "main"]


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
        raise BusError(f"{bus}: cannot create the bus: {error.strerror or error}") from None
    finally:
        os.umask(umask)
    return sock


def _remove_dead(path: str, address: str) -> None:
    """Remove the socket file of a hub that no longer listens. Raises BusError for anything else."""
    if not stat.S_ISSOCK(os.lstat(path).st_mode):
        raise BusError(f"{PREFIX}{path}: a file exists there that is no socket")
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


_PR_SET_TIMERSLACK = 29


class Hub(Relay):
    """A unix bus at `path`. Raises BusError: a live hub or something else is there, or the path is unusable.

    `bitrate` None: a frame is delivered as soon as it is read. Otherwise it crosses a modelled wire.
    Not thread-safe: all calls from one thread.
    """

    def __init__(self, path: str, bitrate: int | None = None) -> None:
        wire = WireModel(bitrate, TX_QUEUE) if bitrate is not None else None
        super().__init__(listen(path, BACKLOG), wire)
        self.path = path
        self._inode = os.stat(path).st_ino

    def close(self) -> None:
        """Disconnect everybody and remove the socket file, unless it is another hub's by now."""
        for client in list(self._clients.values()):
            self.remove(client)
        self._listener.close()
        try:
            if os.stat(self.path).st_ino == self._inode:
                os.unlink(self.path)
        except OSError:
            pass


class _StopError(Exception):
    """SIGINT or SIGTERM."""


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise _StopError


def main(arguments: list[str] | None = None) -> int:
    """Run a hub until SIGINT or SIGTERM; return 0, or 1 when the bus cannot be made."""
    parser = argparse.ArgumentParser(
        prog="python -m jtqd.drivers.hub",
        description="CAN bus on a unix socket",
        epilog="example: python -m jtqd.drivers.hub unix:/tmp/bus --bitrate 1000000",
    )
    parser.add_argument("bus", help="unix:PATH")
    parser.add_argument(
        "--bitrate", type=int, help="model a wire with this bit rate [bit/s] (default: pass frames at once)"
    )
    options = parser.parse_args(arguments)
    if not options.bus.startswith(PREFIX) or options.bus == PREFIX:
        parser.error(f"found {options.bus!r}, expected unix:PATH")
    if options.bitrate is not None and options.bitrate <= 0:
        parser.error(f"--bitrate must be positive, not {options.bitrate}")
    signal.signal(signal.SIGTERM, _stop)
    signal.signal(signal.SIGINT, _stop)
    # The default slack of 50 us on every timeout is one short frame at 1 Mbit/s.
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    hub = None
    try:
        hub = Hub(options.bus.removeprefix(PREFIX), options.bitrate)
        print(f"hub: {options.bus} is up", flush=True)
        while True:  # bounded: a signal that comes just before the wait does not end it
            hub.run_once(0.5)
    except _StopError:
        return 0
    except BusError as error:
        print(f"hub: {error}", file=sys.stderr)
        return 1
    finally:
        if hub is not None:
            hub.close()


if __name__ == "__main__":
    raise SystemExit(main())
