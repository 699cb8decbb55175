"""Is there time for the networks before the next SYNC? If not, this cycle is physics only. Pure: times are arguments [ns].

How long a joint's estimate takes with its network is learned: the shorter of its last two times, which one stall of the
machine does not change, at once upwards and slowly downwards. The first slow call of a network cannot be foreseen: such a
cycle is late as a whole and withdrawn. After the second the network is left out; after FORGET_CYCLES or so it is tried
again. When inputs come so late that there is no time, it is left out at once.

Joint 1 comes first and leaves time for joint 2.
"""

from __future__ import annotations

RESERVED_NS = 40_000
"""For making and sending the estimate PDO."""
FORGET_CYCLES = 1024
"""Time constant in cycles without the network."""
_SETTLE_CYCLES = 16
"""... and with it."""


class _Joint:
    """What one joint's estimate takes with its network, as far as known."""

    __slots__ = ("cost_ns", "last_ns", "wanted")

    def __init__(self) -> None:
        self.cost_ns = self.last_ns = 0
        self.wanted = True

    def took(self, spent_ns: int) -> None:
        """The estimate of this cycle took so long."""
        cost = self.cost_ns
        if not self.wanted:
            self.cost_ns = cost - cost // FORGET_CYCLES - 1 if cost > 0 else 0
            return
        believed = spent_ns if spent_ns < self.last_ns else self.last_ns
        self.last_ns = spent_ns
        slow = cost - cost // _SETTLE_CYCLES
        self.cost_ns = believed if believed > slow else slow


class NetworkBudget:
    """Call `first`, `second` and `ended` in each cycle, around the estimates of joint 1 and joint 2."""

    __slots__ = ("_end_ns", "_one", "_since_ns", "_two")

    def __init__(self) -> None:
        self._one, self._two = _Joint(), _Joint()
        self._end_ns = self._since_ns = 0

    def first(self, now_ns: int, next_sync_ns: int) -> bool:
        """The estimate of joint 1 begins now: may it use its network? `next_sync_ns`: when the next SYNC is due."""
        self._since_ns, self._end_ns = now_ns, next_sync_ns - RESERVED_NS
        wanted = now_ns + self._one.cost_ns + self._two.cost_ns <= self._end_ns
        self._one.wanted = wanted
        return wanted

    def second(self, now_ns: int) -> bool:
        """The estimate of joint 1 is there: may joint 2 use its network?"""
        self._one.took(now_ns - self._since_ns)
        self._since_ns = now_ns
        wanted = now_ns + self._two.cost_ns <= self._end_ns
        self._two.wanted = wanted
        return wanted

    def ended(self, now_ns: int) -> None:
        """The estimate of joint 2 is there."""
        self._two.took(now_ns - self._since_ns)
