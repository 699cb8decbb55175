"""Numbers of joints on several buses as of one instant: pure, cycle records in, `Aligned` out.

The buses' SYNCs share a clock and no grid: periods differ, a foreign master's clock drifts, slots are missed. The torque of
a cycle is as old as its record states: it is that of SYNC's time less its age. The arm has its own grid, with the period of
the slowest bus; at each instant of it positions, torques and sigmas are straight lines between the samples around it.
Steps are equal because filters of a constant period take them: SYNC's own jitter would come out as speed.

`Aligned`: what is known of all joints at one instant (CLOCK_MONOTONIC), NaN where it is not. position_rad, torque_nm,
sigma_nm [n] in the URDF's directions; status [n] of the torque, `estimator.status`: OFF for a joint whose jtqd was not there
yet, STALE where it has stopped or is late, DEGRADED across a short gap.
"""

from libc.math cimport NAN, isfinite, isnan, llround
from libc.stdint cimport int64_t, uint8_t

from jtqd.daemon.core.record cimport Header, JointBlock

from collections import namedtuple

import numpy as np

from jtqd.estimator.status import DEGRADED, OFF, PUBLISHED, STALE

BRIDGED_PERIODS = 3
"""Between two samples, in periods of their bus: at 10 rad/s2 the straight line is off by 11 urad then."""
WAITED_PERIODS = 10
"""Of the slowest bus: a bus that is so far behind the foremost one is not waited for."""

cdef int64_t SILENT_NS = 100_000_000  # ... and one from which nothing has come for so long, nor from any other
cdef int64_t LONGEST_NS = 5_000_000_000  # a gap that is longer is not gone through instant by instant
cdef int64_t BRIDGED = BRIDGED_PERIODS, WAITED = WAITED_PERIODS
cdef uint8_t IS_OFF = OFF, IS_STALE = STALE, IS_DEGRADED = DEGRADED
cdef enum:
    KEPT = 4096  # samples that wait for their instant: the ring of jtqd is as long

cdef bint[256] COUNTS
for code in range(256):
    COUNTS[code] = code in PUBLISHED

Aligned = namedtuple("Aligned", ("instant_ns", "position_rad", "torque_nm", "sigma_nm", "status"))

cdef struct Sample:
    int64_t instant_ns
    double first, second


cdef class Series:
    """Samples of two numbers in the order of their instants; a straight line between two at most `bridged_ns` apart."""

    cdef Sample[KEPT] samples
    cdef int64_t begin, end, bridged_ns

    cdef void add(self, int64_t instant_ns, double first, double second) noexcept nogil:
        """Take a sample; the oldest makes room."""
        self.samples[self.end % KEPT] = Sample(instant_ns, first, second)
        self.end += 1
        self.begin = max(self.begin, self.end - KEPT)

    cdef Sample before(self, int64_t instant_ns) noexcept nogil:
        """Return the last sample up to an instant, which never goes back; NaN where there is none."""
        while self.begin + 1 < self.end and self.samples[(self.begin + 1) % KEPT].instant_ns <= instant_ns:
            self.begin += 1
        cdef Sample found = self.samples[self.begin % KEPT]
        return found if self.end and found.instant_ns <= instant_ns else Sample(instant_ns, NAN, NAN)

    cdef Sample at(self, int64_t instant_ns) noexcept nogil:
        """Return the numbers of an instant, which never goes back; NaN where they are not known."""
        cdef Sample before = self.before(instant_ns), after = self.samples[(self.begin + 1) % KEPT]
        cdef int64_t length_ns = after.instant_ns - before.instant_ns
        cdef double share = <double>(instant_ns - before.instant_ns) / length_ns
        if before.instant_ns == instant_ns:
            return before
        if self.begin + 1 >= self.end or length_ns > self.bridged_ns:
            return Sample(instant_ns, NAN, NAN)
        return Sample(
            instant_ns,
            before.first + share * (after.first - before.first),
            before.second + share * (after.second - before.second),
        )


cdef class Joint:
    """One joint of the arm. number: at its jtqd, from 0 on; place: in the arm."""

    cdef Series position, torque, status
    cdef readonly int number, place
    cdef double sign, zero_rad
    cdef int64_t age_ns

    def __init__(self, source, int place, int64_t bridged_ns):
        self.position, self.torque, self.status = Series(), Series(), Series()
        self.position.bridged_ns = self.torque.bridged_ns = bridged_ns
        self.number, self.place = source.joint - 1, place
        self.sign, self.zero_rad = source.direction, source.zero_rad

    cdef void take(self, int64_t sync_ns, const JointBlock *block) noexcept nogil:
        """Take a cycle; a torque counts with a status of `PUBLISHED` and an age."""
        if isfinite(block.link_position_rad):
            self.position.add(sync_ns, self.sign * (block.link_position_rad - self.zero_rad), 0.0)
        if COUNTS[block.status & 0xFF] and isfinite(block.age_ms):
            self.age_ns = llround(1e6 * block.age_ms)
            self.torque.add(sync_ns - self.age_ns, self.sign * block.torque_nm, block.sigma_nm)
        self.status.add(sync_ns - self.age_ns, block.status & 0xFF, 0.0)

    cdef uint8_t status_at(self, int64_t instant_ns, double torque_nm) noexcept nogil:
        """Return the status of the record before an instant, where it is that of the torque."""
        cdef double code = self.status.before(instant_ns).first
        if isnan(torque_nm):
            return IS_OFF if isnan(code) else IS_STALE if COUNTS[<uint8_t>code] else <uint8_t>code
        return <uint8_t>code if COUNTS[<uint8_t>code] else IS_DEGRADED


cdef class Bus:
    """The joints of one jtqd. sources: place in the arm, from 0 on -> where the joint is."""

    cdef readonly list joints
    cdef int64_t reach_ns  # up to it everything is known that will be; 0 before the first record
    cdef int64_t oldest_ns  # age of a torque

    def __init__(self, sources, int64_t period_ns):
        self.joints = [Joint(each, place, BRIDGED * period_ns) for place, each in sources.items()]

    def take(self, records):
        """Take cycle records of its jtqd (`jtqd.daemon.shared.cycle_record`), oldest first."""
        cdef const uint8_t[::1] record
        cdef const Header *header
        cdef Joint joint
        for record in records:
            header = <const Header *>&record[0]
            for joint in self.joints:
                joint.take(header.sync_monotonic_ns, <const JointBlock *>&record[sizeof(Header)] + joint.number)
            for joint in self.joints:
                self.oldest_ns = max(self.oldest_ns, joint.age_ns)
            self.reach_ns = header.sync_monotonic_ns - self.oldest_ns


cdef class Aligner:
    """Instants of an arm. buses: with all its joints; period_ns: that of the slowest bus."""

    cdef list buses, joints
    cdef int64_t period_ns, next_ns

    def __init__(self, buses, int64_t period_ns):
        self.buses, self.period_ns = list(buses), period_ns
        self.joints = sorted((joint for bus in buses for joint in bus.joints), key=lambda joint: joint.place)

    def ready(self, int64_t now_ns):
        """Return the instants for which every bus has records, or is not waited for any more; now_ns: CLOCK_MONOTONIC."""
        cdef Bus bus
        cdef int64_t first = now_ns, last = 0, oldest = 0
        for bus in self.buses:
            first, last = min(first, bus.reach_ns), max(last, bus.reach_ns + bus.oldest_ns)
            oldest = max(oldest, bus.oldest_ns)
        cdef int64_t limit = max(first, max(last - WAITED * self.period_ns, now_ns - SILENT_NS) - oldest)
        if not self.next_ns or limit - self.next_ns > LONGEST_NS:
            self.next_ns = limit
        instants = range(self.next_ns, limit + 1, self.period_ns)
        self.next_ns += len(instants) * self.period_ns
        return self.aligned(instants)

    cdef list aligned(self, instants):
        cdef Joint joint
        cdef Sample found
        cdef Py_ssize_t k
        cdef int64_t instant_ns
        shape = len(instants), len(self.joints)
        if not shape[0]:
            return []
        numbers, status = np.empty((3, *shape)), np.empty(shape, np.uint8)
        cdef double[:, :, ::1] into = numbers
        cdef uint8_t[:, ::1] codes = status
        for k, instant_ns in enumerate(instants):
            for joint in self.joints:
                into[0, k, joint.place] = joint.position.at(instant_ns).first
                found = joint.torque.at(instant_ns)
                into[1, k, joint.place], into[2, k, joint.place] = found.first, found.second
                codes[k, joint.place] = joint.status_at(instant_ns, found.first)
        return [*map(Aligned, instants, *numbers, status)]
