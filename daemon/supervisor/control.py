"""Control socket of a running daemon: orders from its own user and from root, one JSON object each way.

`control` in the runtime directory, AF_UNIX SOCK_SEQPACKET, mode 0600. One connection is one request and one reply:

    {"verb": "ping" | "reset" | "save"}   ->   {"ok": true, ...}  or  {"ok": false, "error": "one line"}

Served by the supervisor between its other duties, without a thread: nobody who connects can delay a cycle of the loop, and
nobody can keep it busy: few connections, short messages, limited waiting.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from jtqd.drivers.bus_socket import reachable
from jtqd.estimator.decoder import parse_json
from jtqd.estimator.files import peer_user

FILE = "control"
"""Name of the socket in the runtime directory."""
VERBS = ("ping", "reset", "save")
REQUEST_BYTES, REPLY_BYTES = 4096, 65_536
MOST_CONNECTIONS = 8
PATIENCE_S = 5.0
"""A connection that asks nothing for so long is closed."""
_BACKLOG = 8

Reply = dict[str, Any]
Answer = Callable[[], Reply | None]
"""Asked again and again until it has the reply."""


class ControlError(Exception):
    """A request that cannot be carried out; the message is one line."""


class _Connection:
    """One client: waits for its request, then for the reply."""

    def __init__(self, sock: socket.socket, until_s: float) -> None:
        self.socket, self.until_s = sock, until_s
        self.answer: Answer | None = None


class ControlServer:
    """Listens at `path`; an older socket there is replaced. Raises OSError.

    handlers: of each verb; called with the request, they return the reply, or a function that has it later, or raise
    ControlError.
    """

    def __init__(self, path: Path, handlers: dict[str, Callable[[Reply], Reply | Answer]]) -> None:
        self._path, self._handlers = path, handlers
        self._connections: list[_Connection] = []
        path.unlink(missing_ok=True)
        self._listener = socket.socket(
            socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        )
        mask = os.umask(0o177)  # never open to others, not even for a moment
        try:
            with reachable(path) as address:
                self._listener.bind(address)
        finally:
            os.umask(mask)
        self._listener.listen(_BACKLOG)

    @property
    def descriptors(self) -> list[int]:
        """For select: the listener, and who has not asked yet."""
        waiting = [each.socket.fileno() for each in self._connections if each.answer is None]
        full = len(self._connections) >= MOST_CONNECTIONS
        return waiting if full else [self._listener.fileno(), *waiting]

    def serve(self) -> None:
        """Process all pending requests; never blocks, never raises for client errors."""
        self._accept()
        now = time.monotonic()
        for connection in list(self._connections):
            try:
                done = self._attend(connection, now)
            except OSError:
                done = True
            if done:
                connection.socket.close()
                self._connections.remove(connection)

    def close(self) -> None:
        """Stop accepting orders."""
        for connection in self._connections:
            with suppress(OSError):
                _send(connection.socket, _error("jtqd is ending"))
            connection.socket.close()
        self._connections.clear()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        while len(self._connections) < MOST_CONNECTIONS:  # who comes later waits for one of these to end
            try:
                sock, _ = self._listener.accept()
            except OSError:
                return
            sock.setblocking(False)
            error = _objection(sock)
            if error is not None:
                with suppress(OSError):
                    _send(sock, _error(error))
                sock.close()
                continue
            self._connections.append(_Connection(sock, time.monotonic() + PATIENCE_S))

    def _attend(self, connection: _Connection, now_s: float) -> bool:
        """Return whether the connection is finished or timed out."""
        if connection.answer is None:
            reply = self._request(connection)
            if reply is None:
                return connection.answer is None and now_s > connection.until_s
        else:
            reply = connection.answer()
        if reply is None:
            return False
        _send(connection.socket, reply)
        return True

    def _request(self, connection: _Connection) -> Reply | None:
        try:
            data, _, flags, _ = connection.socket.recvmsg(REQUEST_BYTES)
        except BlockingIOError:
            return None
        if flags & socket.MSG_TRUNC:
            return _error(f"found a request of more than {REQUEST_BYTES} bytes")
        try:
            answer = self._carry_out(data)
        except ControlError as error:
            return _error(str(error))
        if callable(answer):
            connection.answer = answer
            return answer()
        return answer

    def _carry_out(self, data: bytes) -> Reply | Answer:
        try:
            request = parse_json(data)
        except ValueError:
            raise ControlError("found no JSON") from None
        verb = request.get("verb") if isinstance(request, dict) else None
        handler = self._handlers.get(verb) if isinstance(verb, str) else None
        if handler is None:
            raise ControlError(f"verb: found {verb!r:.60}, expected one of {', '.join(self._handlers)}")
        return handler(request)


def _objection(sock: socket.socket) -> str | None:
    """Return an objection to the peer; a second check beside the mode of the socket file."""
    uid = peer_user(sock)
    return None if uid in (0, os.getuid()) else f"user {uid} may not give orders"


def _error(text: str) -> Reply:
    return {"ok": False, "error": text}


def _send(sock: socket.socket, reply: Reply) -> None:
    data = json.dumps(reply).encode()
    sock.send(data if len(data) <= REPLY_BYTES else json.dumps(_error("the reply is too long")).encode())
