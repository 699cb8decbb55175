"""Absolute time grid of the loop: missed slots are counted and skipped, never made up in a burst."""

from __future__ import annotations


class Grid:
    """Slots at `start + n * period`; all times are CLOCK_MONOTONIC in integer ns, handed in by the caller.

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
        """True when the current slot's time has passed by more than half a period (woken too late)."""
        return now_ns - self.slot_ns > self._half_ns
