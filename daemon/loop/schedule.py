"""Schedule of a cycle: the time grid, when to wake up for the inputs, and whether there is time for the networks.

Pure: times are arguments, integer ns of CLOCK_MONOTONIC.
"""

from __future__ import annotations


class Grid:
    """Absolute time grid of the loop, slots at `start + n * period`; missed ones are counted and skipped, never made up.

    A slot is missed when it cannot be begun within half a period of its time: a SYNC later than that would leave its
    successor less than half a cycle, and drives would see two SYNCs in quick succession.

    Attributes:
        slot_ns: time of the current slot.
        missed: slots skipped so far.
    """

    __slots__ = ("_half_ns", "missed", "period_ns", "slot_ns")

    def __init__(self, start_ns: int, period_ns: int) -> None:
        self.period_ns = period_ns
        self._half_ns = period_ns // 2
        self.slot_ns = start_ns
        self.missed = 0

    def advance(self, now_ns: int) -> int:
        """Go to the next slot that can still be begun in time at `now_ns`; returns the slots skipped on the way."""
        self.slot_ns += self.period_ns
        late_ns = now_ns - self.slot_ns
        if late_ns <= self._half_ns:
            return 0
        skipped = (late_ns + self._half_ns) // self.period_ns
        self.slot_ns += skipped * self.period_ns
        self.missed += skipped
        return skipped

    def too_late(self, now_ns: int) -> bool:
        """Return whether the current slot's time has passed by more than half a period (late wake-up)."""
        return now_ns - self.slot_ns > self._half_ns


_STEP_NS = 160
_MARGIN_NS = 10_000
_SHORTEST_NS = 50_000


class WakeUp:
    """When to wake up for the inputs of a cycle: when 99 of 100 times all have come; each one waited for is a wake-up more.

    Attributes:
        wait_ns: from SYNC to the wake-up.
        deadline_ns: from SYNC to the end of the wait for inputs; the wake-up never comes later.
    """

    __slots__ = ("deadline_ns", "wait_ns")

    def __init__(self, wait_ns: int, deadline_ns: int) -> None:
        self.wait_ns, self.deadline_ns = wait_ns, deadline_ns

    def follow(self, last_delay_ns: int) -> None:
        """Learn from a complete cycle: the last input arrived this long after its SYNC."""
        if last_delay_ns + _MARGIN_NS > self.wait_ns:
            self.wait_ns = min(self.wait_ns + 99 * _STEP_NS, self.deadline_ns - _MARGIN_NS)
        else:
            self.wait_ns = max(self.wait_ns - _STEP_NS, _SHORTEST_NS)


RESERVED_NS = 40_000
"""For making and sending the estimate PDO."""
FORGET_CYCLES = 1024
"""Time constant in cycles without the network."""
_SETTLE_CYCLES = 16
"""... and with it."""


class _Cost:
    """What one joint's estimate takes with its network, as far as known."""

    __slots__ = ("cost_ns", "last_ns", "wanted")

    def __init__(self) -> None:
        self.cost_ns = self.last_ns = 0
        self.wanted = True

    def took(self, spent_ns: int) -> None:
        """Learn the duration of this cycle's estimate."""
        cost = self.cost_ns
        if not self.wanted:
            self.cost_ns = cost - cost // FORGET_CYCLES - 1 if cost > 0 else 0
            return
        believed = spent_ns if spent_ns < self.last_ns else self.last_ns
        self.last_ns = spent_ns
        slow = cost - cost // _SETTLE_CYCLES
        self.cost_ns = believed if believed > slow else slow


class NetworkBudget:
    """Time budget of the networks before the next SYNC; without time the cycle is physics only.

    Call `first`, `second` and `ended` in each cycle, around the estimates of joint 1 and joint 2. Joint 1 comes first and
    leaves time for joint 2.

    How long a joint's estimate takes with its network is learned: the shorter of its last two times, which one stall of the
    machine does not change, at once upwards and slowly downwards. The first slow call of a network cannot be foreseen:
    such a cycle is late as a whole and withdrawn. After the second the network is left out; after FORGET_CYCLES or so it is
    tried again. When inputs come so late that there is no time, it is left out at once.
    """

    __slots__ = ("_end_ns", "_one", "_since_ns", "_two")

    def __init__(self) -> None:
        self._one, self._two = _Cost(), _Cost()
        self._end_ns = self._since_ns = 0

    def first(self, now_ns: int, next_sync_ns: int) -> bool:
        """Return whether joint 1, whose estimate begins, may use its network; `next_sync_ns`: due time of the next SYNC."""
        self._since_ns, self._end_ns = now_ns, next_sync_ns - RESERVED_NS
        wanted = now_ns + self._one.cost_ns + self._two.cost_ns <= self._end_ns
        self._one.wanted = wanted
        return wanted

    def second(self, now_ns: int) -> bool:
        """Return whether joint 2 may use its network, after joint 1's estimate."""
        self._one.took(now_ns - self._since_ns)
        self._since_ns = now_ns
        wanted = now_ns + self._two.cost_ns <= self._end_ns
        self._two.wanted = wanted
        return wanted

    def ended(self, now_ns: int) -> None:
        """Note the end of joint 2's estimate."""
        self._two.took(now_ns - self._since_ns)
