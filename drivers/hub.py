"""Hub of a unix bus: `python -m jtqd.drivers.hub unix:PATH [--bitrate 1000000]`, or embedded beside local nodes.

`frame_socket.Relay` (compiled) passes the frames on; here are the socket's file, the command, and the model of a wire that
frames cross first when a bit rate is given.
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
from collections import deque
from collections.abc import Hashable
from types import FrameType
from typing import Any, NamedTuple

from jtqd.drivers.bus_socket import PREFIX, BusError, reachable, require_directory
from jtqd.drivers.frame import FRAME, arbitration_key, stuffed_bits
from jtqd.drivers.frame_socket import BACKLOG, MAX_CLIENTS, TX_QUEUE, Relay

# The wire

_NS_PER_S = 1_000_000_000


class _Waiting(NamedTuple):
    """A frame in a transmit queue."""

    key: int
    submitted_ns: int
    order: int
    bits: int
    frame: bytes
    sender: Hashable


class WireModel:
    """A classic CAN wire of `bitrate` bit/s. Times are integer nanoseconds on any one clock, and arguments.

    Each sender is a controller with a first-in first-out queue of `queue_limit` frames; the head of its queue takes part in
    arbitration. A frame starts when the wire is free and a sender has one; all that is submitted by then arbitrates.
    Submissions may come late (a hub reads its sockets late, with the kernel's stamp of the send): only a frame already
    started by an earlier `advance` keeps the wire.

    Attributes:
        bits, frames: transmitted so far.
    """

    def __init__(self, bitrate: int, queue_limit: int = 128) -> None:
        if bitrate <= 0:
            raise ValueError(f"bit rate must be positive, not {bitrate}")
        self.bitrate = bitrate
        self.bits = 0
        self.frames = 0
        self._queue_limit = queue_limit
        self._queues: dict[Hashable, deque[_Waiting]] = {}
        self._free_ns = 0
        self._on_wire: tuple[_Waiting, int] | None = None
        self._order = 0

    def duration_ns(self, bits: int) -> int:
        """Return the time of `bits` on the wire, rounded up to ns."""
        return -(-bits * _NS_PER_S // self.bitrate)

    def pending(self, sender: Hashable) -> int:
        """Return how many frames of `sender` wait for the wire."""
        queue = self._queues.get(sender)
        return len(queue) if queue else 0

    def submit(self, sender: Hashable, frame: bytes, t_ns: int) -> bool:
        """Queue the 16-byte `frame` of `sender` at time t_ns; False when its queue is full.

        Times of one sender must not decrease; one that does counts as the time before it.
        """
        queue = self._queues.get(sender)
        if queue is None:
            queue = self._queues[sender] = deque()
        elif len(queue) >= self._queue_limit:
            return False
        elif queue:
            t_ns = max(t_ns, queue[-1].submitted_ns)
        can_id, length, data = FRAME.unpack(frame)
        bits = stuffed_bits(can_id, data[:length])
        self._order += 1
        queue.append(_Waiting(arbitration_key(can_id), t_ns, self._order, bits, frame, sender))
        return True

    def next_end(self) -> int | None:
        """Return when the next transmission ends if nothing else is submitted; None for an idle wire."""
        if self._on_wire is not None:
            return self._on_wire[1]
        following = self._following()
        if following is None:
            return None
        start, winner = following
        return start + self.duration_ns(winner.bits)

    def advance(self, t_ns: int) -> list[tuple[Hashable, bytes, int]]:
        """Let time pass to t_ns; return (sender, frame, end_ns) of each transmission that ended by then.

        A frame that starts before t_ns is on the wire for good. One that would start at t_ns itself still
        arbitrates against what is submitted for that moment afterwards.
        """
        ended: list[tuple[Hashable, bytes, int]] = []
        while True:
            if self._on_wire is None:
                following = self._following()
                if following is None or following[0] >= t_ns:
                    return ended
                start, winner = following
                queue = self._queues[winner.sender]
                queue.popleft()
                if not queue:
                    del self._queues[winner.sender]
                self._on_wire = (winner, start + self.duration_ns(winner.bits))
            sent, end = self._on_wire
            if end > t_ns:
                return ended
            self._on_wire = None
            self._free_ns = end
            self.bits += sent.bits
            self.frames += 1
            ended.append((sent.sender, sent.frame, end))

    def _following(self) -> tuple[int, _Waiting] | None:
        """Return (start, winner) of the next arbitration; equal fields go in order of submission."""
        if not self._queues:
            return None
        heads = [queue[0] for queue in self._queues.values()]
        start = max(self._free_ns, min(head.submitted_ns for head in heads))
        return start, min(head for head in heads if head.submitted_ns <= start)


# The hub

__all__ = ["MAX_CLIENTS", "Hub", "StopError", "listen", "main", "until_stopped"]


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
            pass  # a full backlog or another kind of socket: a process has it
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
        """Disconnect all members and remove the socket file, unless another hub has replaced it."""
        for client in list(self._clients.values()):
            self.remove(client)
        self._listener.close()
        try:
            if os.stat(self.path).st_ino == self._inode:
                os.unlink(self.path)
        except OSError:
            pass


class StopError(Exception):
    """SIGINT or SIGTERM."""


def _stop(_number: int, _frame: FrameType | None) -> None:
    raise StopError


def until_stopped() -> dict[int, Any]:
    """Let SIGINT and SIGTERM raise StopError, and timeouts end in time; return the handlers before.

    The default slack of 50 us on every timeout is one short frame at 1 Mbit/s.
    """
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0)
    return {number: signal.signal(number, _stop) for number in (signal.SIGTERM, signal.SIGINT)}


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
    until_stopped()
    hub = None
    try:
        hub = Hub(options.bus.removeprefix(PREFIX), options.bitrate)
        print(f"hub: {options.bus} is up", flush=True)
        while True:  # bounded: a signal that comes just before the wait does not end it
            hub.run_once(0.5)
    except StopError:
        return 0
    except BusError as error:
        print(f"hub: {error}", file=sys.stderr)
        return 1
    finally:
        if hub is not None:
            hub.close()


if __name__ == "__main__":
    raise SystemExit(main())
