"""The live view's process: `python -m daemon.live.process REQUEST` reads the loop's shared memory and serves viewers.

It maps ring, snapshot and notices read-only, and nothing that a viewer sends goes anywhere: the server has no capability
(no publishing, no parameters, no services). A viewer that is too slow loses its oldest messages, not others theirs.
It ends on SIGTERM, which it also gets when its parent has gone.

REQUEST is JSON: {"ring", "snapshot", "notices": paths, "host", "port", "bus": name, "nodes": [[node-ID, name]],
"gear_ratios": [two]}.
One line of JSON on stdout says how it began: {"listening": URL} or {"failed": why}. Exit status 0 ended in order,
1 could not begin.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from daemon.live.address import Address
from daemon.live.stream import LiveStream, Message
from daemon.recording.diagnostics import Node
from daemon.shared import cycle_record
from daemon.shared.notices import NoticesError, NoticesReader
from daemon.shared.ring import RingError, RingReader
from daemon.shared.snapshot import SnapshotError, SnapshotReader

if TYPE_CHECKING:
    from daemon.live.server import LiveServer

_POLL_S = 0.02
_DIAGNOSIS_S = 1.0
_QUANTILES = (0.5, 0.99, 1.0)
_NICE = 10
_JOINT_NAMES = ("joint_1", "joint_2")


class Stop:
    """Set by SIGTERM and SIGINT."""

    def __init__(self) -> None:
        self.requested = False
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.requested = True


def _free(address: Address) -> str | None:
    """None, or why nobody can listen there: the server's own message does not always say."""
    try:
        family, _, _, _, where = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
    except OSError as error:
        return error.strerror or str(error)
    return None


class Source:
    """What the daemon leaves in shared memory, as messages.

    Args:
        request: of the process.

    Raises:
        RingError, SnapshotError: it is not there.
    """

    def __init__(self, request: dict[str, Any]) -> None:
        self._ring = RingReader(Path(request["ring"]), cycle_record.RECORD_SIZE)
        self._snapshot = SnapshotReader(Path(request["snapshot"]))
        nodes = [Node(int(number), str(name)) for number, name in request["nodes"]]
        self._stream = LiveStream(request["bus"], nodes, _JOINT_NAMES, request["gear_ratios"])
        self._notices: NoticesReader | None = None
        with suppress(NoticesError):
            self._notices = NoticesReader(Path(request["notices"]))
        self._diagnosed = time.monotonic()
        self.skip()

    def skip(self) -> None:
        """Nobody looks: keep the place."""
        self._ring.position += self._ring.backlog
        self._stream.forget()
        if self._notices is not None:
            self._notices.read()

    def read(self) -> list[Message]:
        """What is new."""
        made = self._stream.take(self._ring.read().records)
        if self._notices is not None:
            made += self._stream.notices(self._notices.read()[0])
        now = time.monotonic()
        if now - self._diagnosed >= _DIAGNOSIS_S:
            self._diagnosed = now
            work, late = self._snapshot.work_us(*_QUANTILES), self._snapshot.late_us(*_QUANTILES)
            made.append(self._stream.diagnose(self._snapshot.read(), work, late, time.time_ns()))
        return made


def serve(source: Source, server: LiveServer, stop: Stop) -> None:
    """Send until told to stop. Without a viewer it only keeps its place."""
    while not stop.requested:
        if server.watched:
            for message in source.read():
                server.send(message)
        else:
            source.skip()
        time.sleep(_POLL_S)


def _answer(**content: Any) -> None:
    with suppress(OSError):
        print(json.dumps(content), flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Command line of the process; returns the exit status."""
    request = json.loads((sys.argv[1:] if arguments is None else arguments)[0])
    stop = Stop()
    with suppress(OSError):
        os.nice(_NICE)
    address = Address(request["host"], request["port"])
    problem = _free(address)
    if problem is not None:
        _answer(failed=f"{address.host}:{address.port}: {problem}")
        return 1
    try:
        from daemon.live.server import LiveServer

        source = Source(request)
        server = LiveServer(f"jtqd on {request['bus']}", address)
    except (ImportError, RingError, SnapshotError, RuntimeError, OSError, ValueError) as error:
        _answer(failed=f"{address.host}:{address.port}: {error}")
        return 1
    _answer(listening=server.address.url)
    try:
        serve(source, server, stop)
    finally:
        server.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
