"""EMCY messages of the nodes: a bounded history of each, and few lines for the operator. Pure: bytes and times in.

Every message is kept in the ring of its node and counted. A line is said at once for the first message of a code; what
repeats is counted and told with the next line (`daemon/supervisor/rate_limit.py`), so that a storm is a few lines in five
seconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

from daemon.supervisor.rate_limit import RateLimit
from drivers.emcy import NO_ERROR, Emergency, describe, parse

DEPTH = 32
"""Messages kept of each node."""


class Kept(NamedTuple):
    """One message in the history; `time_s` is CLOCK_MONOTONIC."""

    time_s: float
    emergency: Emergency


class _Node:
    def __init__(self) -> None:
        self.history: deque[Kept] = deque(maxlen=DEPTH)
        self.count = 0
        self.limit = RateLimit()


class EmcyLog:
    """Histories of these nodes; a message of any other is passed over."""

    def __init__(self, nodes: Iterable[int]) -> None:
        self._nodes = {node: _Node() for node in nodes}
        self.count = 0
        """Messages of all nodes."""

    def receive(self, node: int, data: bytes, now_s: float) -> str | None:
        """Take a message; the line to be said, if any."""
        seen = self._nodes.get(node)
        if seen is None:
            return None
        emergency = parse(data)
        self.count += 1
        seen.count += 1
        seen.history.append(Kept(now_s, emergency))
        unsaid = seen.limit.may_say((emergency.code, emergency.register), now_s)
        if unsaid is None:
            return None
        over = emergency.code == NO_ERROR and not emergency.register
        what = "EMCY 0000h: no error any more" if over else describe(emergency)
        return f"node {node}: {what}" + (f" ({unsaid} more before)" if unsaid else "")

    def history(self, node: int) -> list[Kept]:
        """Messages of a node, the oldest first, `DEPTH` at most."""
        return list(self._nodes[node].history)

    def count_of(self, node: int) -> int:
        """How many messages a node has sent."""
        return self._nodes[node].count

    def last(self, node: int) -> Emergency | None:
        """Its last message; None: none yet."""
        history = self._nodes[node].history
        return history[-1].emergency if history else None
