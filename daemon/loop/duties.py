"""What the loop does in the pause after a cycle, beside its work: the watchdog, orders of the supervisor, a hand-over.

Costs one call per cycle and, every n-th cycle, one datagram and one look at shared memory (docs/deployment.md).
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

from daemon.loop.cycle import Cycle
from daemon.reload.handover import Giver
from daemon.supervisor.notify import LoopWatchdog

_ORDERS_EVERY = 16
"""Cycles between two looks at the orders."""


class Duties:
    """Call it once after each cycle; True: the bus belongs to the successor, leave without a word.

    Args:
        cycle: the loop's.
        watchdog: to be fed.
        giver: hands the bus over when SIGUSR2 has asked for it.
        tell: says to the supervisor why a hand-over came to nothing.
    """

    def __init__(
        self, cycle: Cycle, watchdog: LoopWatchdog, giver: Giver, tell: Callable[[str], None]
    ) -> None:
        self._cycle, self._orders = cycle, cycle.snapshot.orders
        self._advanced = watchdog.advanced
        self._giver, self._tell = giver, tell
        self._left = _ORDERS_EVERY
        self._wanted = self._giving = False
        signal.signal(signal.SIGUSR2, self._on_signal)

    def __call__(self) -> bool:
        """One more cycle has ended."""
        self._advanced()
        self._left -= 1
        if self._left == 0:
            self._left = _ORDERS_EVERY
            orders = self._orders
            if orders[0] != orders[1]:
                self._reset()
            if orders[2] != orders[3]:
                self._doubt()
        if self._wanted:
            self._wanted, self._giving = False, True
            self._giver.begin()
        return self._giving and self._give()

    def _give(self) -> bool:
        given = self._giver.step()
        if given is None:
            self._giving = False
            self._tell(self._giver.refused or "")
        return bool(given)

    def _reset(self) -> None:
        number = self._orders[0]
        self._cycle.reset_faults()
        self._orders[1] = number

    def _doubt(self) -> None:
        number = self._orders[2]
        self._cycle.configured_nodes.doubt()
        self._orders[3] = number

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._wanted = True
