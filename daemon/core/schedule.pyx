"""Schedule of a cycle: the time grid, when to wake up for the inputs, and whether there is time for the networks.

Pure: times are arguments, integer ns of CLOCK_MONOTONIC.
"""

from libc.stdint cimport int64_t

from typing import Final


_STEP_NS: Final = 160
_MARGIN_NS: Final = 10_000
_SHORTEST_NS: Final = 50_000
RESERVED_NS: Final = 40_000
"""For making and sending the estimate PDO."""
FORGET_CYCLES: Final = 1024
"""Time constant in cycles without the network."""
_SETTLE_CYCLES: Final = 16
"""... and with it."""

cdef int64_t STEP_NS = _STEP_NS, MARGIN_NS = _MARGIN_NS, SHORTEST_NS = _SHORTEST_NS
cdef int64_t RESERVE_NS = RESERVED_NS, FORGET = FORGET_CYCLES, SETTLE = _SETTLE_CYCLES


cdef class Grid:
    """Absolute time grid of the loop, slots at `start + n * period`; missed ones are counted and skipped, never made up.

    A slot is missed when it cannot be begun within half a period of its time: a SYNC later than that would leave its
    successor less than half a cycle, and drives would see two SYNCs in quick succession.

    Attributes:
        slot_ns: time of the current slot.
        missed: slots skipped so far.
    """

    def __init__(self, int64_t start_ns, int64_t period_ns):
        self.now = GridState(start_ns, period_ns, 0)

    @property
    def slot_ns(self):
        return self.now.slot_ns

    @slot_ns.setter
    def slot_ns(self, int64_t slot_ns):
        self.now.slot_ns = slot_ns

    @property
    def period_ns(self):
        return self.now.period_ns

    @period_ns.setter
    def period_ns(self, int64_t period_ns):
        self.now.period_ns = period_ns

    @property
    def missed(self):
        return self.now.missed

    @missed.setter
    def missed(self, int64_t missed):
        self.now.missed = missed

    cpdef int64_t advance(self, int64_t now_ns) noexcept:
        """Go to the next slot that can still be begun in time at `now_ns`; return the slots skipped on the way."""
        cdef int64_t half_ns = self.now.period_ns // 2, late_ns, skipped
        self.now.slot_ns += self.now.period_ns
        late_ns = now_ns - self.now.slot_ns
        if late_ns <= half_ns:
            return 0
        skipped = (late_ns + half_ns) // self.now.period_ns
        self.now.slot_ns += skipped * self.now.period_ns
        self.now.missed += skipped
        return skipped

    cpdef bint too_late(self, int64_t now_ns) noexcept:
        """Return whether the current slot's time has passed by more than half a period (late wake-up)."""
        return now_ns - self.now.slot_ns > self.now.period_ns // 2

    cdef int64_t end_ns(self) noexcept:
        """Return when the next SYNC is due."""
        return self.now.slot_ns + self.now.period_ns


cdef class WakeUp:
    """When to wake up for the inputs of a cycle: when 99 of 100 times all have come; each one waited for is a wake-up more.

    Attributes:
        wait_ns: from SYNC to the wake-up.
        deadline_ns: from SYNC to the end of the wait for inputs; the wake-up never comes later.
    """

    def __init__(self, int64_t wait_ns, int64_t deadline_ns):
        self.now = WakeUpState(wait_ns, deadline_ns)

    @property
    def wait_ns(self):
        return self.now.wait_ns

    @property
    def deadline_ns(self):
        return self.now.deadline_ns

    cpdef void follow(self, int64_t last_delay_ns) noexcept:
        """Learn from a complete cycle: the last input arrived this long after its SYNC."""
        if last_delay_ns + MARGIN_NS > self.now.wait_ns:
            self.now.wait_ns = min(self.now.wait_ns + 99 * STEP_NS, self.now.deadline_ns - MARGIN_NS)
        else:
            self.now.wait_ns = max(self.now.wait_ns - STEP_NS, SHORTEST_NS)


cdef class NetworkBudget:
    """Time budget of the networks before the next SYNC; without time the cycle is physics only.

    Call `first`, `second` and `ended` in each cycle, around the estimates of joint 1 and joint 2. Joint 1 comes first and
    leaves time for joint 2.

    How long a joint's estimate takes with its network is learned: the shorter of its last two times, which one stall of the
    machine does not change, at once upwards and slowly downwards. The first slow call of a network cannot be foreseen:
    such a cycle is late as a whole and withdrawn. After the second the network is left out; after FORGET_CYCLES or so it is
    tried again. When inputs come so late that there is no time, it is left out at once.
    """

    def __init__(self):
        self.now.one.wanted = self.now.two.wanted = True

    cpdef bint first(self, int64_t now_ns, int64_t next_sync_ns) noexcept:
        """Return whether joint 1, whose estimate begins, may use its network; `next_sync_ns`: due time of the next SYNC."""
        cdef BudgetState *budget = &self.now
        budget.since_ns, budget.end_ns = now_ns, next_sync_ns - RESERVE_NS
        budget.one.wanted = now_ns + budget.one.cost_ns + budget.two.cost_ns <= budget.end_ns
        return budget.one.wanted

    cpdef bint second(self, int64_t now_ns) noexcept:
        """Return whether joint 2 may use its network, after joint 1's estimate."""
        cdef BudgetState *budget = &self.now
        _took(&budget.one, now_ns - budget.since_ns)
        budget.since_ns = now_ns
        budget.two.wanted = now_ns + budget.two.cost_ns <= budget.end_ns
        return budget.two.wanted

    cpdef void ended(self, int64_t now_ns) noexcept:
        """Note the end of joint 2's estimate."""
        _took(&self.now.two, now_ns - self.now.since_ns)


cdef void _took(Cost *joint, int64_t spent_ns) noexcept nogil:
    """Learn the duration of this cycle's estimate."""
    cdef int64_t cost_ns = joint.cost_ns, believed_ns
    if not joint.wanted:
        joint.cost_ns = cost_ns - cost_ns // FORGET - 1 if cost_ns > 0 else 0
        return
    believed_ns = min(spent_ns, joint.last_ns)
    joint.last_ns = spent_ns
    joint.cost_ns = max(believed_ns, cost_ns - cost_ns // SETTLE)
