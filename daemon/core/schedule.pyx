"""Clocks and schedule of a cycle: the time grid, when to wake up for the inputs, and whether there is time for the networks.

Times are integer ns: CLOCK_MONOTONIC of the grid, CLOCK_REALTIME of the kernel's stamps. All but the clocks is pure.
"""

from libc.errno cimport EINTR
from libc.stdint cimport int64_t
from posix.time cimport CLOCK_MONOTONIC, CLOCK_REALTIME, clock_gettime, clock_nanosleep, timespec

from typing import Final

from jtqd.daemon.core.record cimport MOST_JOINTS

RESERVED_NS: Final = 40_000
"""For making and sending the estimate PDO."""
FORGET_CYCLES: Final = 1024
"""Time constant in cycles without the network."""

cdef int64_t STEP_NS = 160, MARGIN_NS = 10_000, SHORTEST_NS = 50_000  # of `WakeUp`
cdef int64_t RESERVE_NS = RESERVED_NS, FORGET = FORGET_CYCLES, SETTLE = 16  # cycles with the network
cdef int64_t MEAN_OF = 16, DRIFT = 64, ALL = 1 << 20  # of SYNCs of another node: intervals, SYNCs, share

cdef enum:
    TIMER_ABSTIME = 1
cdef int64_t NS_PER_S = 1_000_000_000


cdef int64_t _read(int clock) noexcept nogil:
    cdef timespec now
    clock_gettime(clock, &now)
    return now.tv_sec * NS_PER_S + now.tv_nsec


cdef class Clock:
    """The clocks of the machine."""

    cdef int64_t monotonic(self) except? -1:
        """Return CLOCK_MONOTONIC."""
        return _read(CLOCK_MONOTONIC)

    cdef int64_t realtime(self) except? -1:
        """Return CLOCK_REALTIME."""
        return _read(CLOCK_REALTIME)

    cdef int sleep_until(self, int64_t due_ns) except -1:
        """Sleep until `due_ns` (CLOCK_MONOTONIC); other threads may run meanwhile."""
        cdef timespec due
        due.tv_sec, due.tv_nsec = due_ns // NS_PER_S, due_ns % NS_PER_S
        with nogil:
            while clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL) == EINTR:
                pass
        return 0


cdef class PythonClock(Clock):
    """Clocks of a test: `monotonic_ns`, `time_ns` and `sleep` of module `time` or of what takes its place."""

    cdef object time

    def __init__(self, time):
        self.time = time

    cdef int64_t monotonic(self) except? -1:
        """Return CLOCK_MONOTONIC."""
        return self.time.monotonic_ns()

    cdef int64_t realtime(self) except? -1:
        """Return CLOCK_REALTIME."""
        return self.time.time_ns()

    cdef int sleep_until(self, int64_t due_ns) except -1:
        """Sleep until `due_ns`."""
        cdef int64_t left_ns = due_ns - self.monotonic()
        if left_ns > 0:
            self.time.sleep(left_ns * 1e-9)
        return 0


cdef class Grid:
    """Absolute time grid of the loop, slots at `start + n * period`; missed ones are counted and skipped, never made up.

    A slot is missed when it cannot be begun within half a period of its time: a SYNC later than that would leave its
    successor less than half a cycle, and drives would see two SYNCs in quick succession.

    slot_ns: time of the current slot; period_ns: between two slots; missed: slots skipped so far.
    """

    def __init__(self, int64_t start_ns, int64_t period_ns):
        self.slot_ns, self.period_ns = start_ns, period_ns

    cpdef int64_t advance(self, int64_t now_ns) noexcept:
        """Go to the next slot that can still be begun in time at `now_ns`; return the slots skipped on the way."""
        cdef int64_t half_ns = self.period_ns // 2, late_ns, skipped
        self.slot_ns += self.period_ns
        late_ns = now_ns - self.slot_ns
        if late_ns <= half_ns:
            return 0
        skipped = (late_ns + half_ns) // self.period_ns
        self.slot_ns += skipped * self.period_ns
        self.missed += skipped
        return skipped

    cpdef bint too_late(self, int64_t now_ns) noexcept:
        """Return whether the current slot's time has passed by more than half a period (late wake-up)."""
        return now_ns - self.slot_ns > self.period_ns // 2

    cdef int64_t end_ns(self) noexcept:
        """Return when the next SYNC is due."""
        return self.slot_ns + self.period_ns


cdef class SyncGrid(Grid):
    """Grid of a SYNC that another node sends: its slots stand where the SYNC was seen; it skips none.

    regular: SYNC comes with the period: not with a mean interval below 0.9 periods (two producers), nor above 1.1 where few
    intervals are near the period (a producer that misses slots has many).
    """

    def __init__(self, int64_t period_ns):
        self.period_ns = self.mean_ns = period_ns
        self.near, self.regular = ALL, True

    cpdef int64_t advance(self, int64_t now_ns) noexcept:
        return 0

    cdef int64_t end_ns(self) noexcept:
        """Return when the next SYNC may come: its producer is late at times, early never."""
        return self.due_ns + self.mean_ns

    cdef int64_t seen(self, int64_t sync_ns) noexcept:
        """Take a SYNC; return the slots since the last one, at least 1."""
        cdef int64_t period_ns = self.period_ns, interval_ns = sync_ns - self.slot_ns, late_ns
        cdef int64_t slots = max(1, (interval_ns + period_ns // 2) // period_ns)
        cdef int64_t near = ALL if -period_ns <= 10 * (interval_ns - period_ns) <= period_ns else 0
        self.slot_ns = sync_ns
        self.mean_ns += (max(0, min(interval_ns, 2 * period_ns)) - self.mean_ns) // MEAN_OF
        self.near += (near - self.near) * min(slots, 4) // MEAN_OF
        self.regular = 10 * self.mean_ns >= 9 * period_ns and (10 * self.mean_ns <= 11 * period_ns or 4 * self.near >= ALL)
        late_ns = sync_ns - self.due_ns - slots * self.mean_ns if self.due_ns else 0
        late_ns = max(0, min(late_ns, period_ns // 4))
        self.due_ns = sync_ns - late_ns + late_ns // DRIFT
        return slots


cdef class WakeUp:
    """When to wake up for the inputs of a cycle: when 99 of 100 times all have come; each one waited for is a wake-up more.

    wait_ns, deadline_ns: from SYNC to the wake-up, and to the end of the wait for inputs, after which it never comes.
    """

    def __init__(self, int64_t wait_ns, int64_t deadline_ns):
        self.wait_ns, self.deadline_ns = wait_ns, deadline_ns

    cpdef void follow(self, int64_t last_delay_ns) noexcept:
        """Learn from a complete cycle: the last input arrived this long after its SYNC."""
        if last_delay_ns + MARGIN_NS > self.wait_ns:
            self.wait_ns = min(self.wait_ns + 99 * STEP_NS, self.deadline_ns - MARGIN_NS)
        else:
            self.wait_ns = max(self.wait_ns - STEP_NS, SHORTEST_NS)


cdef class NetworkBudget:
    """Time budget of the networks before the next SYNC; without time the cycle is physics only.

    Call `begin` at the start of the estimates of a cycle, `wanted` before that of each joint and `ended` after the last. A
    joint leaves time for those that come after it.

    How long a joint's estimate takes with its network is learned: the shorter of its last two times, at once upwards and slowly
    downwards. A cycle with the first slow call is late as a whole and withdrawn; after the second the network is left out, and
    tried again after FORGET_CYCLES or so. When inputs come so late that there is no time, it is left out at once.
    """

    def __init__(self, int joints=2):
        cdef int n
        if not 1 <= joints <= MOST_JOINTS:
            raise ValueError(f"found {joints} joints, expected 1 to {MOST_JOINTS}")
        self.joints = joints
        for n in range(joints):
            self.costs[n].wanted = True

    cpdef void begin(self, int64_t next_sync_ns) noexcept:
        """Begin the estimates of a cycle; `next_sync_ns`: due time of the next SYNC."""
        cdef int n
        self.latest_ns = next_sync_ns - RESERVE_NS
        self.left_ns = 0
        for n in range(self.joints):
            self.left_ns += self.costs[n].cost_ns

    cpdef bint wanted(self, int joint, int64_t now_ns) noexcept:
        """Return whether joint number `joint` (from 0 on), whose estimate begins, may use its network."""
        cdef Cost *cost = &self.costs[joint]
        if joint:
            _took(cost - 1, now_ns - self.since_ns)
        self.since_ns = now_ns
        cost.wanted = now_ns + self.left_ns <= self.latest_ns
        self.left_ns -= cost.cost_ns
        return cost.wanted

    cpdef void ended(self, int64_t now_ns) noexcept:
        """Note the end of the last joint's estimate."""
        _took(&self.costs[self.joints - 1], now_ns - self.since_ns)


cdef void _took(Cost *joint, int64_t spent_ns) noexcept nogil:
    """Learn the duration of this cycle's estimate."""
    cdef int64_t cost_ns = joint.cost_ns, believed_ns
    if not joint.wanted:
        joint.cost_ns = cost_ns - cost_ns // FORGET - 1 if cost_ns > 0 else 0
        return
    believed_ns = min(spent_ns, joint.last_ns)
    joint.last_ns = spent_ns
    joint.cost_ns = max(believed_ns, cost_ns - cost_ns // SETTLE)
