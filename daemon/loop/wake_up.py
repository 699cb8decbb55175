"""When to wake up for the inputs of a cycle: when 99 of 100 times all have come; each one waited for is a wake-up more."""

from __future__ import annotations

_STEP_NS = 160
_MARGIN_NS = 10_000
_SHORTEST_NS = 50_000


class WakeUp:
    """Follows the arrival of the last input.

    Attributes:
        wait_ns: from SYNC to the wake-up.
        deadline_ns: from SYNC to the end of the wait for inputs; the wake-up never comes later.
    """

    __slots__ = ("deadline_ns", "wait_ns")

    def __init__(self, wait_ns: int, deadline_ns: int) -> None:
        self.wait_ns, self.deadline_ns = wait_ns, deadline_ns

    def follow(self, last_delay_ns: int) -> None:
        """The last input of a complete cycle came so long after its SYNC."""
        if last_delay_ns + _MARGIN_NS > self.wait_ns:
            self.wait_ns = min(self.wait_ns + 99 * _STEP_NS, self.deadline_ns - _MARGIN_NS)
        else:
            self.wait_ns = max(self.wait_ns - _STEP_NS, _SHORTEST_NS)
