"""The successor's side of a hand-over (`daemon/reload/handover.py`): it puts in place what it is told, and takes over."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path

from daemon.loop.cycle import Cycle
from daemon.reload.carry import CarryError, Fill
from daemon.reload.handover import MESSAGE_BYTES, TAKEN, Refused, install
from drivers.socket_path import reachable


class Taker:
    """The successor's side: waits for the running loop at `path`. Raises OSError."""

    def __init__(self, cycle: Cycle, path: Path) -> None:
        self._cycle, self._fill = cycle, Fill(cycle)
        self._path = path
        path.unlink(missing_ok=True)
        self._listener = socket.socket(
            socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        )
        with reachable(path) as address:
            self._listener.bind(address)
        path.chmod(0o600)
        self._listener.listen(1)
        self._socket: socket.socket | None = None
        self.end_ns: int | None = None
        self.before_ns = 0
        """CLOCK_REALTIME: all frames stamped before this have been taken by the other loop."""

    @property
    def descriptors(self) -> list[int]:
        """To wait on."""
        return [(self._socket or self._listener).fileno()]

    def step(self) -> bool:
        """Take what has come; True: the bus is ours, its state in place, and `taken` must be said.

        Raises:
            Refused: the other loop has given up, or its state does not fit.
        """
        if self._socket is None:
            try:
                self._socket, _ = self._listener.accept()
            except BlockingIOError:
                return False
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, MESSAGE_BYTES)
        while True:
            try:
                data = self._socket.recv(MESSAGE_BYTES)
            except BlockingIOError:
                return False
            except ConnectionError:
                data = b""
            if not data:
                raise Refused("the running loop has given up")
            if self._take(self._socket, data):
                return True

    def _take(self, sock: socket.socket, data: bytes) -> bool:
        began = time.monotonic_ns()
        message = json.loads(data)
        try:
            if "found" in message:
                self._fill.learn(message["found"])
                return False
            if "some" in message:
                self._fill.put(message["some"])
                return False
            install(self._cycle, self._fill, message["state"])
        except CarryError as error:
            why = f"the program has changed since jtqd started, it needs a restart: {error}"
            sock.send(json.dumps({"refused": why}).encode())
            raise Refused(why) from None
        self.end_ns = message["end_ns"]
        if "before_ns" in message:
            self.before_ns = message["before_ns"]
            return True
        sock.send(json.dumps({"install_ns": time.monotonic_ns() - began}).encode())
        return False

    def taken(self) -> None:
        """Tell the other loop that it is none any more."""
        assert self._socket is not None
        self._socket.send(TAKEN)
        self.close()

    def close(self) -> None:
        """Nobody is waited for any more."""
        if self._socket is not None:
            self._socket.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)
