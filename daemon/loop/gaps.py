"""Slots without SYNC: what comes in one is late, and what has not come by the end of a silent one was lost. Plain state.

The rule is in `daemon/loop/intake.py`; it asks for a gap where the delay of a frame does not tell whether it is a late one.
"""

from __future__ import annotations

_LONGEST = 10
"""Slots; after that SYNC goes on and the debts stay."""
_PAUSE = 20
"""Cycles between two gaps: a bus that loses frames all the time must not lose its SYNC as well."""


class Gaps:
    """Gaps so far, and the one that is open.

    Attributes:
        count: slots without SYNC so far.
        wanted: the next slot shall pass without SYNC.
        open: the last slot did.
        arrivals: late frames in the last slot.
        pause: cycles before the next gap.
        length: slots of the present gap.
    """

    __slots__ = ("arrivals", "count", "length", "open", "pause", "wanted")

    def __init__(self) -> None:
        self.count = self.arrivals = self.pause = self.length = 0
        self.wanted = self.open = False

    def pass_slot(self) -> None:
        """This slot has no SYNC."""
        self.count += 1
        self.wanted, self.open = False, True
        self.arrivals = 0
        self.length += 1
        self.pause = _PAUSE

    @property
    def may_go_on(self) -> bool:
        """Late frames came in the slot that has just passed, and one slot more is not too many."""
        return self.open and self.arrivals > 0 and self.length < _LONGEST
