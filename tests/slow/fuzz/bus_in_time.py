"""A bus with a clock of its own: frames arrive at their time, calls take some, and nothing depends on the machine.

It is a frame socket, the clock of `jtqd.daemon.core.cycle` and the module `time` of `jtqd.daemon.loop.process` at once.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from unittest.mock import patch

from jtqd.daemon.core import cycle as cycle_module
from jtqd.daemon.core.schedule import PythonClock
from jtqd.daemon.loop import process as loop_module
from jtqd.drivers.frame_socket import CAPACITY, BusDown

_SYNC = 0x080
_ESTIMATE = 0x1A0
QUEUE = 4096
"""Frames that wait for the reader; what comes on top is lost and counted, as in a socket."""

Arrival = tuple[int, bytes, bool]
"""Time [ns], frame, whether it is the echo of one of ours."""
Script = Callable[[int, int, int], Iterable[Arrival]]
"""Number of the SYNC, when it was sent [ns], its counter: what arrives because of it, or after it."""


class BusInTime:
    """What comes after SYNC n is `script(n, time of the SYNC, its counter)`.

    Attributes:
        now_ns: the time, CLOCK_MONOTONIC and CLOCK_REALTIME alike.
        syncs: SYNCs sent.
        estimate: data of the last estimate PDO.
        given: frames handed to the reader, without echoes.
        slow_ns: so much longer takes each call of `receive`.
        oversleep_ns: so much later ends the next sleep.
        down: the interface is down.
    """

    def __init__(self, script: Script) -> None:
        self.script = script
        self.now_ns = 1_700_000_000_000_000_000
        self.syncs = self.given = 0
        self.estimate = b""
        self.slow_ns = self.oversleep_ns = 0
        self.down = False
        self.frames = bytearray(16 * CAPACITY)
        self.stamps_ns: list[int] = []
        self.own: list[bool] = []
        self.tx_dropped = self.rx_dropped = 0
        self._coming: list[tuple[int, int, bytes, bool]] = []
        self._order = 0

    def installed(self) -> AbstractContextManager[object]:
        """The clock is that of the cycles that are made meanwhile."""
        return patch.multiple(cycle_module, clock=PythonClock(self))

    def installed_in_loop(self) -> AbstractContextManager[object]:
        """It takes the place of module `time` in the loop."""
        return patch.multiple(loop_module, time=self)

    # Module `time` -------------------------------------------------------------------------------------------------------

    def monotonic_ns(self) -> int:
        return self.now_ns

    time_ns = monotonic_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9) + self.oversleep_ns
        self.oversleep_ns = 0

    # Frame socket --------------------------------------------------------------------------------------------------------

    def put(self, arrivals: Iterable[Arrival]) -> None:
        for at_ns, frame, own in arrivals:
            if len(self._coming) >= QUEUE:
                self.rx_dropped += 1
                continue
            self._order += 1  # equal times keep their order
            heapq.heappush(self._coming, (at_ns, self._order, frame, own))

    def send(self, frame: bytes) -> bool:
        self.now_ns += 2_000
        if self.down:
            raise BusDown("down")
        (can_id,) = struct.unpack_from("<I", frame)
        if can_id == _SYNC:
            self.syncs += 1
            self.put(self.script(self.syncs, self.now_ns, frame[8]))
        elif can_id == _ESTIMATE:
            self.estimate = bytes(frame[8:16])
        return True

    def receive(self) -> int:
        self.now_ns += 7_000 + self.slow_ns
        if self.down:
            raise BusDown("down")
        coming, now = self._coming, self.now_ns
        self.stamps_ns, self.own = [], []
        count = 0
        while coming and coming[0][0] <= now and count < CAPACITY:
            at_ns, _, frame, own = heapq.heappop(coming)
            self.frames[16 * count : 16 * count + 16] = frame
            self.stamps_ns.append(at_ns)
            self.own.append(own)
            self.given += not own
            count += 1
        return count

    def wait(self, timeout_s: float) -> bool:
        end = self.now_ns + round(timeout_s * 1e9)
        if self._coming and self._coming[0][0] <= end:
            self.now_ns = max(self.now_ns, self._coming[0][0])
            return True
        self.now_ns = end
        return False
