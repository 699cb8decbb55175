"""Hub of a unix bus: `python -m jtqd.drivers.hub unix:PATH [--bitrate 1000000]`, or embedded beside local nodes.

A client is an AF_UNIX SOCK_SEQPACKET connection; one message is one 16-byte `struct can_frame`. What a member
sends, every other member receives; the sender too when it asks for the echo (bit 0 of byte 5). All members
see the same order of frames. With a bit rate, frames first cross a modelled wire (`jtqd.drivers.wire`).
"""

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import select
import signal
import socket
import stat
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType

from jtqd.drivers.bus_socket import (
    BUFFER_BYTES,
    PREFIX,
    SO_TIMESTAMPNS,
    BusError,
    reachable,
    require_directory,
)
from jtqd.drivers.frame import (
    CAN_ERR_FLAG,
    ECHO_BIT,
    FRAME_SIZE,
    is_frame,
)
from jtqd.drivers.frame_socket import FrameReceiver
from jtqd.drivers.wire import WireModel


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


OnFrame = Callable[[bytes, int], None]
"""Called with a frame and the time it was sent (modelled wire: end of transmission), CLOCK_REALTIME ns."""

MAX_CLIENTS = 64
_BACKLOG = 32
_BATCH = 32
_TX_QUEUE = 128
_READ_BELOW = (
    _TX_QUEUE - _BATCH
)  # a client with more frames waiting is not read: its own send fails with EAGAIN
_PAUSE_S = 0.1  # no accept for this long when the process is out of descriptors
_OLDEST_SEND_NS = 1_000_000_000  # a send stamp older than this means that the clock was stepped
_NO_MARKS = bytes(3)
_ECHO_ONLY = bytes([ECHO_BIT, 0, 0])
_ERROR_BYTE = CAN_ERR_FLAG >> 24
_PR_SET_TIMERSLACK = 29


@dataclass
class HubCounters:
    """Frames and connections, accepted and refused."""

    frames: int = 0  # accepted from members
    malformed: int = 0  # not 16 bytes, more than 8 data bytes, or an impossible identifier
    dropped: int = 0  # not delivered: that member's socket buffer was full
    refused: int = 0  # connections beyond MAX_CLIENTS or out of descriptors
    tx_full: int = 0  # frames of local ports refused by a full transmit queue


class LocalPort:
    """A node in the hub's own process."""

    def __init__(self, hub: Hub, on_frame: OnFrame) -> None:
        self._hub = hub
        self._on_frame = on_frame

    def send(self, frame16: bytes) -> bool:
        """Send a frame; False when the transmit queue of the wire is full.

        From within `on_frame` on a modelled wire it counts from the end of the frame being answered, however
        late the hub was: a node answers at once, and the answers of several nodes arbitrate.
        """
        return self._hub.submit(self, frame16, time.time_ns())

    def deliver(self, frame16: bytes, stamp_ns: int) -> bool:
        """Hand a frame to the node."""
        self._on_frame(frame16, stamp_ns)
        return True

    def detach(self) -> None:
        """Leave the bus."""
        self._hub.remove(self)


class _Client:
    """One connected socket."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.fd = sock.fileno()
        self.dropped = 0
        self._send = sock.send

    def deliver(self, frame16: bytes, _stamp_ns: int) -> bool:
        """Send a frame to the client without waiting; False when its buffer is full.

        Bytes 6 and 7 count the frames that the client has lost so far (modulo 65536), like SO_RXQ_OVFL of AF_CAN.
        """
        if self.dropped:
            frame16 = frame16[:6] + (self.dropped & 0xFFFF).to_bytes(2, "little") + frame16[8:]
        try:
            self._send(frame16)
        except BlockingIOError:
            self.dropped += 1
            return False
        except OSError:
            return True  # it has ended: the next read sees that and removes it
        return True


class Hub:
    """A unix bus at `path`. Raises BusError: a live hub or something else is there, or the path is unusable.

    `bitrate` None: a frame is delivered as soon as it is read. Otherwise it crosses a modelled wire.
    Not thread-safe: all calls from one thread.
    """

    def __init__(self, path: str, bitrate: int | None = None) -> None:
        self.path = path
        self.counters = HubCounters()
        self.wire = WireModel(bitrate, _TX_QUEUE) if bitrate is not None else None
        self._listener = listen(path, _BACKLOG)
        self._inode = os.stat(path).st_ino
        self._receiver = FrameReceiver(_BATCH)
        self._clients: dict[int, _Client] = {}
        self._members: tuple[LocalPort | _Client, ...] = ()
        self._queue: deque[tuple[LocalPort | _Client, bytes, int]] = deque()
        self._delivering = False
        self._answering_ns: int | None = None  # CLOCK_MONOTONIC end of the frame being delivered by the wire
        self._paused_until = 0.0

    def attach(self, on_frame: OnFrame) -> LocalPort:
        """Add a node in this process; its callback may send, which keeps the order of frames for all."""
        port = LocalPort(self, on_frame)
        self._members += (port,)
        return port

    def remove(self, member: LocalPort | _Client) -> None:
        """Take a member off the bus; what it has sent already is still delivered."""
        self._members = tuple(each for each in self._members if each is not member)
        if isinstance(member, _Client) and self._clients.pop(member.fd, None) is not None:
            member.sock.close()

    def run_once(self, timeout_s: float | None) -> None:
        """Wait up to `timeout_s` (None: for ever) for something to do, and do what is ready.

        select(2) because its timeout has microseconds: epoll's has milliseconds, eight frames on the wire.
        """
        readable = self._wanted()
        wait_s = self._bounded(timeout_s)
        ready = select.select(readable, (), (), wait_s)[0]
        listener = self._listener.fileno()
        if listener in ready:  # first, so that a new client sees all that is read after it connected
            self._accept()
        for fd in ready:
            if fd != listener:
                self._read(self._clients[fd])
        if self.wire is not None:
            self._advance(self.wire)

    @property
    def clients(self) -> int:
        """Connected sockets; local ports do not count."""
        return len(self._clients)

    def submit(self, sender: LocalPort | _Client, frame16: bytes, stamp_ns: int) -> bool:
        """Put a frame sent at `stamp_ns` (CLOCK_REALTIME) on the bus; False when it was refused."""
        if not is_frame(frame16):
            self.counters.malformed += 1
            return False
        self.counters.frames += 1
        wire = self.wire
        if wire is None or frame16[3] & _ERROR_BYTE:  # an error message never is on the wire
            self._deliver(sender, frame16, stamp_ns)
            return True
        if self._answering_ns is not None:
            sent_ns = self._answering_ns
        else:
            age_ns = min(max(time.time_ns() - stamp_ns, 0), _OLDEST_SEND_NS)
            sent_ns = time.monotonic_ns() - age_ns
        if not wire.submit(sender, frame16, sent_ns):
            self.counters.tx_full += 1
            return False
        return True

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

    def _wanted(self) -> list[int]:
        """Return the descriptors to read: the listener unless paused, clients with room in their queue."""
        wire = self.wire
        if wire is None:
            fds = list(self._clients)
        else:
            fds = [fd for fd, client in self._clients.items() if wire.pending(client) < _READ_BELOW]
        if not self._paused_until or time.monotonic() >= self._paused_until:
            self._paused_until = 0.0
            fds.append(self._listener.fileno())
        return fds

    def _bounded(self, timeout_s: float | None) -> float | None:
        """Return `timeout_s` shortened to the end of the transmission under way, or of an accept pause."""
        if self._paused_until:
            timeout_s = _PAUSE_S if timeout_s is None else min(timeout_s, _PAUSE_S)
        end_ns = self.wire.next_end() if self.wire is not None else None
        if end_ns is not None:
            left_s = max(end_ns - time.monotonic_ns(), 0) * 1e-9
            timeout_s = left_s if timeout_s is None else min(timeout_s, left_s)
        return None if timeout_s is None else max(timeout_s, 0.0)

    def _accept(self) -> None:
        """Take the waiting connections, at most one backlog at a time."""
        for _ in range(_BACKLOG):
            try:
                sock = self._listener.accept()[0]
            except OSError as error:
                if error.errno in {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}:
                    self.counters.refused += 1
                    self._paused_until = time.monotonic() + _PAUSE_S
                return
            if len(self._clients) >= MAX_CLIENTS:
                self.counters.refused += 1
                sock.close()
                continue
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
            client = _Client(sock)
            self._clients[client.fd] = client
            self._members += (client,)

    def _read(self, client: _Client) -> None:
        """Take one batch of frames of `client`; remove it when it has ended."""
        receiver = self._receiver
        n = receiver.receive(client.fd)
        ended = receiver.closed or n < 0
        if n > 0:
            frames = bytes(receiver.frames[: FRAME_SIZE * n])
            lengths, stamps = receiver.lengths, receiver.stamps_ns
            for i in range(n):
                if lengths[i] == FRAME_SIZE:
                    self.submit(client, frames[FRAME_SIZE * i : FRAME_SIZE * (i + 1)], stamps[i])
                else:
                    self.counters.malformed += 1
        if ended:
            self.remove(client)

    def _advance(self, wire: WireModel) -> None:
        """Deliver what has crossed the wire by now."""
        now_ns = time.monotonic_ns()
        ended = wire.advance(now_ns)
        if ended:
            to_realtime = time.time_ns() - now_ns
            try:
                for sender, frame16, end_ns in ended:
                    assert isinstance(sender, LocalPort | _Client)
                    self._answering_ns = end_ns
                    self._deliver(sender, frame16, end_ns + to_realtime)
            finally:
                self._answering_ns = None

    def _deliver(self, sender: LocalPort | _Client, frame16: bytes, stamp_ns: int) -> None:
        """Deliver a frame to all; one sent within a callback waits until all have the frame before it."""
        self._queue.append((sender, frame16, stamp_ns))
        if self._delivering:
            return
        self._delivering = True
        try:
            while self._queue:
                self._deliver_one(*self._queue.popleft())
        finally:
            self._delivering = False

    def _deliver_one(self, sender: LocalPort | _Client, frame16: bytes, stamp_ns: int) -> None:
        """Deliver a frame to every member but its sender, and to the sender first if it asks for the echo."""
        lost = 0
        clean = frame16
        if frame16[5:8] != _NO_MARKS:
            clean = frame16[:5] + _NO_MARKS + frame16[8:]
            if frame16[5] & ECHO_BIT:
                lost += not sender.deliver(frame16[:5] + _ECHO_ONLY + frame16[8:], stamp_ns)
        for member in self._members:
            if member is not sender:
                lost += not member.deliver(clean, stamp_ns)
        self.counters.dropped += lost


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
        while True:
            hub.run_once(None)
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
