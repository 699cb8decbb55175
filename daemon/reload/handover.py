"""A loop hands the bus over to its successor between two cycles, and no cycle is late or missing for it.

The successor is another loop process, built and warmed up with other joint files beside the running loop; it has stepped its
estimators through the ring of cycles, so that they have settled on the very same inputs. What is left to hand over is what
the loop has learned of the bus (`daemon/reload/carry.py`), and the time grid. The running loop (`Giver`) does that in the
pause after a cycle, in steps of different cycles, each only when the pause is longer than the step takes:

    connect     to the successor's socket
    list        tell what there is to hand over, some objects at a time
    fill        tell what they hold, as many at a time
    rehearse    some times: send what has changed; the successor puts it in place and answers how long that took
    hand over   in a cycle that was complete, with nothing unread: send what is known, send nothing more on the bus, and wait
                for "taken". If the successor ends without that word, the loop goes on, and the grid counts the pause.

Where no pause is long enough for a while, a step may delay the next SYNC by a tenth of a period. Where even that does not
do, handing over may take a slot: that SYNC comes late by up to half a period or not at all, and is counted as missed.

Both ends are the daemon's own processes; the socket lies in its runtime directory with mode 0600.
"""

from __future__ import annotations

import json
import socket
import time
from collections import deque
from pathlib import Path
from typing import Any

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.reload.carry import CarryError, Changed, Fill, Walk
from jtqd.drivers.bus_socket import reachable

MESSAGE_BYTES = 1 << 18
TAKEN = b"taken"
_MARGIN_NS = 40_000
"""Kept free before the next SYNC, beyond what the steps have taken so far."""
_TRIES = 5000
"""Cycles that may pass without a chance for the next step."""
_REHEARSALS = 20
_OBJECTS = 6
"""Listed or filled in one pause."""
_CHANGING = 0.6
"""Part of what is known that changes from one cycle to the next, at most (`python -m tests.benchmarks service`)."""
_FACTOR = 1.25
"""Allowance on what steps of a kind have taken."""


class Refused(Exception):  # noqa: N818 - the successor's or the loop's no, not an error of either
    """The bus is not handed over; the message says why."""


def state_of(cycle: Cycle, walk: Walk) -> list[Any]:
    """Return the state of the loop and the counters of its socket. Raises Changed."""
    sock = cycle.socket
    return [walk.changes(), sock.tx_dropped, sock.rx_dropped]


def install(cycle: Cycle, fill: Fill, state: list[Any]) -> None:
    """Restore another loop's state. Raises CarryError."""
    changes, tx_dropped, rx_dropped = state
    fill.put(changes)
    cycle.use_own()
    sock = cycle.socket
    sock.tx_dropped = tx_dropped
    sock.rx_dropped = sock.rx_dropped_before = rx_dropped


class Giver:
    """The running loop's side.

    Args:
        cycle: the loop's.
        path: the successor's socket.
        end_ns: when the run ends by itself, CLOCK_MONOTONIC; handed over too.

    Attributes:
        refused: why the last attempt came to nothing.
    """

    def __init__(self, cycle: Cycle, path: Path, end_ns: int | None = None) -> None:
        self._cycle, self._path, self.end_ns = cycle, str(path), end_ns
        self._socket: socket.socket | None = None
        self._walk = Walk(cycle)
        self._stage = self._connect
        self._tries = 0
        self.refused: str | None = None
        self._filled = 0
        self._lists_ns: deque[int] = deque(maxlen=_REHEARSALS)
        self._list_ns, self._first_tell_ns = self._measured()
        self._tell_ns, self._install_ns = self._first_tell_ns, 0
        self._tells_ns: list[int] = []
        self._installs_ns: list[int] = []

    def begin(self) -> None:
        """Begin the hand-over to a waiting successor; call `step` from now on."""
        self._drop()
        self._tries, self.refused = 0, None

    def step(self) -> bool | None:
        """Call in the pause after each cycle. True: the bus is the successor's; None: nothing will come of it."""
        self._tries += 1
        try:
            if self._tries > _TRIES:
                raise Refused(self._why())
            return self._stage()
        except Changed:
            self.refused = "a node appeared or restarted meanwhile; send the order again"
        except (OSError, Refused, ValueError) as error:
            self.refused = str(error)
        self._drop()
        return None

    def _pause_ns(self, *, last: bool = False) -> int:
        """Time left for a step: first what the pause has, then a tenth of a period more, for the last step a whole one."""
        grid = self._cycle.grid
        if 3 * self._tries <= _TRIES:
            more_ns = -_MARGIN_NS
        elif last and 3 * self._tries > 2 * _TRIES:
            more_ns = grid.period_ns
        else:
            more_ns = grid.period_ns // 10
        return grid.slot_ns + grid.period_ns - time.monotonic_ns() + more_ns

    def _connect(self) -> bool:
        if self._pause_ns() > self._list_ns:
            sock = socket.socket(
                socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
            )
            self._socket = sock
            with reachable(self._path) as address:
                sock.connect(address)
            self._walk, self._stage = Walk(self._cycle), self._list
        return False

    def _list(self) -> bool:
        if self._pause_ns() > self._list_ns:
            began = time.monotonic_ns()
            found = self._walk.step(_OBJECTS)
            self._send({"found": found})
            self._listed(time.monotonic_ns() - began)
            if not found:
                self._filled, self._stage = 0, self._fill
        return False

    def _fill(self) -> bool:
        if self._pause_ns() > self._list_ns:
            began = time.monotonic_ns()
            self._send({"some": self._walk.changes(self._filled, self._filled + _OBJECTS)})
            self._listed(time.monotonic_ns() - began)
            self._filled += _OBJECTS
            if self._filled >= self._walk.count:
                self._stage = self._rehearse
        return False

    def _listed(self, took_ns: int) -> None:
        """Note what a step of listing or filling took; one that was interrupted is no measure of the next."""
        self._lists_ns.append(took_ns)
        self._list_ns = _allowance(list(self._lists_ns))

    def _rehearse(self) -> bool:
        if self._pause_ns() > self._tell_ns:
            self._tell()
            self._stage = self._hear
        return False

    def _hear(self) -> bool:
        assert self._socket is not None
        try:
            answer = self._socket.recv(4096)
        except BlockingIOError:
            return False
        if not answer:
            raise Refused("the new loop ended")
        content = json.loads(answer)
        if "refused" in content:
            raise Refused(content["refused"])
        self._installs_ns.append(content["install_ns"])
        if len(self._installs_ns) < _REHEARSALS:
            self._stage = self._rehearse
            return False
        # The first one went through cold code.
        self._tell_ns, self._install_ns = _allowance(self._tells_ns[1:]), _allowance(self._installs_ns[1:])
        self._stage = self._hand_over
        return False

    def _hand_over(self) -> bool:
        cycle, sock = self._cycle, self._socket
        assert sock is not None
        if self._pause_ns(last=True) <= self._tell_ns + self._install_ns:
            return False
        gaps = cycle.intake.gaps
        before_ns = time.time_ns()
        if not cycle.complete or gaps.wanted or gaps.open or cycle.socket.wait(0.0):
            return False
        self._tell(before_ns=before_ns)
        sock.setblocking(True)
        if sock.recv(64) != TAKEN:
            raise Refused("the new loop ended during the hand-over")
        return True

    def _tell(self, **about: int) -> None:
        """Send the changes. Raises Changed."""
        began = time.monotonic_ns()
        state = state_of(self._cycle, self._walk)
        self._send({**about, "state": state, "end_ns": self.end_ns})
        self._tells_ns.append(time.monotonic_ns() - began)

    def _send(self, message: dict[str, Any]) -> None:
        assert self._socket is not None
        self._socket.send(json.dumps(message).encode())

    def _measured(self) -> tuple[int, int]:
        """How long it takes to list or fill some objects, and to tell what has changed, before the first cycle [ns]."""
        listing, telling = [], []
        for _ in range(_REHEARSALS):
            walk = Walk(self._cycle)
            while walk.left:
                began = time.monotonic_ns()
                json.dumps({"found": walk.step(_OBJECTS)}).encode()
                listing.append(time.monotonic_ns() - began)
            began = time.monotonic_ns()
            json.dumps({"state": state_of(self._cycle, walk), "end_ns": self.end_ns}).encode()
            telling.append(time.monotonic_ns() - began)
        self._lists_ns.extend(listing)
        return _allowance(list(self._lists_ns)), round(_CHANGING * _allowance(telling))

    def _why(self) -> str:
        if self._stage == self._hear:
            return "the new loop did not answer"
        last = self._stage == self._hand_over
        if last:
            needed_ns = self._tell_ns + self._install_ns
        else:
            needed_ns = self._tell_ns if self._stage == self._rehearse else self._list_ns
        if self._pause_ns(last=last) < needed_ns:
            needed_us = needed_ns / 1000
            what = self._stage.__name__.strip("_").replace("_", " ")
            return f"no pause between two cycles was long enough to {what}: {needed_us:.0f} us are needed"
        return "inputs are missing: a hand-over needs a cycle with all of them"

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._stage = None, self._connect
        self._tell_ns, self._install_ns = self._first_tell_ns, 0
        self._tells_ns, self._installs_ns = [], []


def _allowance(times_ns: list[int]) -> int:
    """Without the longest ones: these were interrupted, or the first of their kind."""
    return round(_FACTOR * sorted(times_ns)[len(times_ns) * 3 // 4])


class Taker:
    """The successor's side: waits for the running loop at `path`, puts what it is told in place, takes over.

    Raises OSError.
    """

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
        """Return the descriptors to wait on."""
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
                raise Refused("the running loop has cancelled the hand-over")
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
        """Confirm the hand-over to the other loop."""
        assert self._socket is not None
        self._socket.send(TAKEN)
        self.close()

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)
