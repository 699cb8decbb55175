"""Status of a joint, from the estimate and inputs of each cycle: worse at once, better only after a while. Pure.

    estimate and inputs  ->  faults of this cycle  ->  status with hysteresis and latches  ->  status and flags

`JointSafety` holds limits and checks, `JointStatus` the hysteresis, and `JointRules` applies the rules of docs/safety.md to
one cycle after the other and counts: a number leaves only through `JointRules.judge`. What it needs beside the
estimate comes from the log again: the inputs, `cr.FLAG_WITHDRAWN` (`late`), `cr.FLAG_RESET` (`reset_latch`),
`FLAG_NETWORK_SKIPPED`. So a replay gives the same.

The statuses have an order, from good to bad:

    2 valid, 6 standstill  <  3 degraded  <  1 starting  <  0 off  <  4 stale  <  15 invalid  <  5 drive fault

- A worse one is published in the cycle in which it arises. A better one only when some cycles in a row (`NEEDED`: of the
  status that is left) have asked for one; the worst that they asked for is then published.
- Standstill has a hysteresis of its own (speed) and is published at once in place of valid and degraded.
- A joint that falls back into a status without a number soon after it had left one (within RELAPSE times the cycles that it
  had to wait) waits twice as long each time, at most MOST times as long: an input that comes and goes makes a joint that is
  stale, not one that flickers. A single lost frame costs little.
- A fault that is latched (`safety.latch`) stays until `reset_latch()`: its status, or a worse one, is published whatever
  the inputs say. Status 5, 4 or 15 (`_status_of`).

No clock and no randomness: the same statuses and faults give the same answer again, in the loop and from a log.
"""

cimport cython
from libc.math cimport INFINITY, NAN, fabs, isnan, sqrt
from libc.stdint cimport int8_t, int64_t, uint64_t

from sys import float_info
from typing import Final

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core.estimate_pdo cimport has_torque
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared import faults
from jtqd.daemon.shared.counters import COUNTERS, word_of
from jtqd.daemon.shared.reasons import STATUS_OF_STATE
from jtqd.drivers.drive import STATE_MASK, STATES
from jtqd.estimator import status as st
from jtqd.estimator.detection cimport Plausibility
from jtqd.estimator.observer cimport Sample, follow_reference, restart_reference
from jtqd.estimator.estimator cimport Values
from jtqd.estimator.settings import bandwidth_of, largest_difference_nm, largest_torque_nm

NEEDED: Final = {st.DEGRADED: 100, st.STARTING: 1, st.OFF: 20, st.STALE: 5, st.INVALID: 50, st.DRIVE_FAULT: 100}
"""Cycles in a row that must be better before this status is left; the last of them is published already."""
_ORDER: Final = (
    st.VALID, st.STANDSTILL, st.DEGRADED, st.STARTING, st.OFF, st.STALE, st.INVALID, st.DRIVE_FAULT
)

cdef enum:
    CODES = 16
cdef int VALID = st.VALID, STANDSTILL = st.STANDSTILL, DEGRADED = st.DEGRADED, STARTING = st.STARTING
cdef int OFF = st.OFF, STALE = st.STALE, INVALID = st.INVALID, DRIVE_FAULT = st.DRIVE_FAULT
cdef int RANKS[CODES]
cdef int64_t WAITS[CODES]
cdef int _code
for _code in range(CODES):
    RANKS[_code] = _ORDER.index(_code) if _code in _ORDER else len(_ORDER)
    WAITS[_code] = NEEDED.get(_code, 1)
cdef int WORST = len(_ORDER)
cdef int STANDS = RANKS[st.STANDSTILL]
cdef int WITH_NUMBER = RANKS[st.DEGRADED]  # up to this rank a torque is published
cdef int RANK_INVALID = RANKS[st.INVALID]
cdef int64_t RELAPSE = 10  # times the cycles waited: a fall within these is a relapse and doubles the wait
cdef int64_t MOST = 4  # times the cycles of NEEDED: the longest wait

cdef int FAULT_NOT_FINITE = faults.NOT_FINITE, FAULT_OUT_OF_RANGE = faults.OUT_OF_RANGE
cdef int FAULT_DEVIATION = faults.DEVIATION, FAULT_DRIVE = faults.DRIVE_FAULT, FAULT_STALE = faults.STALE
cdef int FLAG_LATCHED = cr.FLAG_LATCHED, FLAG_NETWORK_SKIPPED = cr.FLAG_NETWORK_SKIPPED


cdef int _rank(int status) noexcept nogil:
    """Return the place of a status in the order from good to bad."""
    return RANKS[status] if 0 <= status < CODES else WORST


cdef int _worse(int a, int b) noexcept nogil:
    return a if _rank(a) >= _rank(b) else b


cdef int _status_of(int latched) noexcept nogil:
    """Return the status that is published while these faults are latched."""
    if latched & FAULT_DRIVE:
        return DRIVE_FAULT
    return STALE if latched == FAULT_STALE else INVALID


# Hysteresis and latches ------------------------------------------------------------------------------------------------


@cython.final
cdef class JointStatus:
    """State of one joint; `latched` are the bits of its latched faults, `latches` is how often there was a new one."""

    def __init__(self, settings):
        limit = settings.stale_latch_cycles
        self.latching, self.stale_limit = settings.latch, -1 if limit is None else limit
        self.now.held = STARTING
        self.now.asked = VALID
        self.now.needed = WAITS[STARTING]
        self.now.factor = 1

    @property
    def latched(self):
        return self.now.latched

    def reset_latch(self):
        """Release latched faults; an existing fault latches again in the next cycle. Return whether there was one."""
        was, self.now.latched, self.now.released = self.now.latched, 0, self.now.latched or self.now.released
        return bool(was)

    cpdef int update(self, int status, int found) noexcept nogil:
        """Return the status to publish for the requested `status` and the faults `found` (`shared/faults.py`)."""
        self.now.since += 1
        if status == self.now.held and not found and not self.now.latched and _rank(status) <= WITH_NUMBER:
            self.now.calm = self.now.run = self.now.found = 0
            return status
        if found:
            self.now.news |= found & ~self.now.found
            self.now.reasons |= found
        self.now.found = found
        if found and _rank(status) < RANK_INVALID:
            status = INVALID
        if status == STALE:
            found |= self.another()
        else:
            self.now.run = 0
            found |= FAULT_DRIVE if status == DRIVE_FAULT else 0
        return self.published(status, found)

    cpdef int late(self) noexcept nogil:
        """Return the status to publish if the estimate of this cycle was not ready in time, after `update`."""
        return self.published(STALE, self.another())

    cdef int another(self) noexcept nogil:
        """Count a consecutive cycle without a torque; return the fault STALE when there were too many."""
        self.now.run += 1
        return FAULT_STALE if 0 <= self.stale_limit <= self.now.run else 0

    cdef int published(self, int status, int found) noexcept nogil:
        """Apply latches and hysteresis; return the status to publish."""
        cdef int fresh = found & self.latching & ~self.now.latched
        cdef int held, rank, worst
        if fresh:
            self.now.latched |= fresh
            self.now.latches += 1
        if self.now.latched:
            status = _worse(status, _status_of(self.now.latched))
        held = self.now.held
        rank, worst = _rank(status), _rank(held)
        if rank > worst:
            self.fall(status)
        if rank >= worst or worst <= STANDS:
            self.now.held, self.now.calm = status, 0
            return status
        self.now.asked = _worse(status, self.now.asked) if self.now.calm else status
        self.now.calm += 1
        if self.now.calm < self.now.needed:
            return status if status == STANDSTILL and worst <= WITH_NUMBER else held
        self.rise(self.now.asked)
        return self.now.asked

    cdef void fall(self, int status) noexcept nogil:
        """Change to a worse status."""
        if _rank(self.now.held) <= WITH_NUMBER < _rank(status):
            self.now.factor = min(2 * self.now.factor, MOST) if self.now.since < self.now.window else 1
        self.now.needed = self.cycles(status)

    cdef void rise(self, int status) noexcept nogil:
        """Change to a better status after the hold time."""
        if _rank(status) <= WITH_NUMBER < _rank(self.now.held):
            self.now.since, self.now.window = 0, RELAPSE * self.now.needed
        if _rank(status) <= WITH_NUMBER:
            self.now.reasons = 0
        self.now.held, self.now.calm = status, 0
        self.now.needed = self.cycles(status)

    cdef int64_t cycles(self, int status) noexcept nogil:
        """Return the hold time of a status in cycles."""
        cdef int64_t wait = WAITS[status] if 0 <= status < CODES else 1
        return wait if _rank(status) <= WITH_NUMBER else wait * self.now.factor


# Counts ---------------------------------------------------------------------------------------------------------------

cdef int FALLBACKS = word_of("network_fallbacks"), LATCHES = word_of("latches")
cdef int NETWORK_NOT_FINITE = word_of("network_not_finite"), NETWORK_FAR = word_of("network_far")
cdef int NETWORK_OUTSIDE = word_of("network_outside"), NETWORK_NO_TIME = word_of("network_no_time")
cdef enum:
    LOW_BYTE = 8  # bits of the faults that a cycle can have besides its status
cdef int COUNTER_OF[LOW_BYTE]
cdef int _bit
for _bit in range(LOW_BYTE):
    COUNTER_OF[_bit] = word_of(f"fault_{faults.NAMES[1 << _bit]}")
if faults.COUNTED != tuple([1 << _bit for _bit in range(LOW_BYTE)]):
    raise ImportError("the faults that are counted are not those of the low byte")


# Limits and checks of a joint ------------------------------------------------------------------------------------------

TORQUE_RANGE_NM: Final = 327.67
"""Of the field of the estimate PDO."""
SIGMA_LIMIT: Final = 0.5
"""Part of the rated torque: a torque that is known no better than this is of no use to a receiver."""
cdef double LARGEST = float_info.max


class JointSafety:
    """Limits and checks of one joint, for the loop or a replay of its log; without a joint file those that need none.

    Attributes:
        settings: as configured (`SafetySettings`).
        plausibility: checks of its inputs, None for none.
        torque_limit_nm, sigma_limit_nm: a torque beyond it, or with a larger sigma, is never published.
        network_limit_nm: a network further from physics than this has been dropped by the estimator.
        deviation_cycles: length of the fault `deviation`, 0 where it is not latched.
        sensor_zero_nm: of the torque sensor, beside sigma: standard deviation.
        bandwidth_rad_s: that makes the estimate's age; 0 without a joint: its sensor is taken as it is.
        max_gap_s: that a sensor of the same age bridges.
    """

    def __init__(self, settings=None, estimator=None, joint=None, period_ns=1_000_000, network=False):
        self.settings = settings or SafetySettings()
        self.plausibility = None
        self.torque_limit_nm, self.network_limit_nm = TORQUE_RANGE_NM, INFINITY
        self.sigma_limit_nm = LARGEST
        self.deviation_cycles, self.sensor_zero_nm = 0, 0.0
        self.bandwidth_rad_s, self.max_gap_s = 0.0, 0.05
        if self.settings.latch & faults.DEVIATION:
            self.deviation_cycles = max(1, round(self.settings.deviation_s * 1e9 / period_ns))
        if joint is None or estimator is None:
            return
        self.bandwidth_rad_s, self.max_gap_s = bandwidth_of(joint, estimator, network=network), estimator.max_gap_s
        self.torque_limit_nm = min(TORQUE_RANGE_NM, largest_torque_nm(joint, estimator))
        self.sigma_limit_nm = SIGMA_LIMIT * joint.rated_torque_nm
        self.network_limit_nm = largest_difference_nm(joint, estimator)
        self.sensor_zero_nm = estimator.sensor_zero_nm(joint.rated_torque_nm)
        if self.settings.plausibility is not None:
            self.plausibility = Plausibility(joint, estimator.torque_limit, self.settings.plausibility, period_ns * 1e-9)


def safety_of(config):
    """Return the configured limits and checks of each joint."""
    common = config.safety, config.estimator
    return [JointSafety(*common, each.joint, config.period_ns, each.network is not None) for each in config.joints]


# The rules of docs/safety.md ------------------------------------------------------------------------------------------


cdef enum:
    POWERED = -1  # the motor carries current
    STATE_BITS = 0x7F
if STATE_BITS != STATE_MASK:
    raise ImportError(f"found {STATE_MASK:02X}h, expected the state of a drive in the bits {STATE_BITS:02X}h of its statusword")
cdef int8_t OF_STATE[STATE_BITS + 1]
for _code in range(STATE_BITS + 1):
    _forced = STATUS_OF_STATE.get(STATES[_code], st.OFF)
    OF_STATE[_code] = POWERED if _forced is None else _forced


cdef int _forced_status(int statusword) noexcept nogil:
    """Return the status that the state of a drive forces (`shared.reasons.STATUS_OF_STATE`), POWERED for none."""
    return OF_STATE[statusword & STATE_BITS]


cdef class JointRules:
    """The rules for joint `number` (from 0 on), one cycle after the other.

    tally: where it counts why its network was dropped, its faults, and its squared errors against the sensor: `counters` and
    `errors` of a `Snapshot`, or arrays of their layout; safety: limits and checks; with_network: the estimator uses one.
    """

    def __init__(self, int number, tally, safety, bint with_network):
        self.counters, self.errors, self.number = tally.counters, tally.errors, number
        if self.counters.shape[0] != len(COUNTERS) or self.errors.shape[0] < 3 * number + 3:
            raise ValueError("not the counters and errors of a snapshot")
        restart_reference(&self.seen)
        self.status = JointStatus(safety.settings)
        self.with_network = with_network
        self.plausibility, self.is_checked = safety.plausibility, safety.plausibility is not None
        self.torque_limit_nm, self.network_limit_nm = safety.torque_limit_nm, safety.network_limit_nm
        self.sigma_limit_nm = safety.sigma_limit_nm
        self.deviation_cycles, self.deviation_sigmas = safety.deviation_cycles, safety.settings.deviation_sigmas
        self.sensor_variance = safety.sensor_zero_nm**2
        self.bandwidth, self.max_gap = safety.bandwidth_rad_s, safety.max_gap_s
        self.age_ms = 1e3 / self.bandwidth if self.bandwidth else NAN

    def begin_again(self):
        """Restart after a restart of the drive: earlier encoder positions are invalid."""
        self.deviates = 0
        if self.is_checked:
            self.plausibility.reset()

    cdef double reference(self, double dt, double sensor_nm) noexcept nogil:
        """Return the sensor [Nm] as old as the estimate of this sample, dt after the one before; NaN where unknown."""
        if not self.bandwidth:
            return sensor_nm
        return follow_reference(&self.seen, self.bandwidth, self.max_gap, dt, sensor_nm)

    cdef int judge(
        self, const Values *estimate, const Sample *sample, double reference_nm,
        int statusword, bint starting, bint network_wanted, int *flags,
    ) noexcept nogil:
        """Return the status to publish and set its bits of `input_flags`.

        sample: what the estimate was made of; reference_nm: of the same age, NaN where unknown; while `starting`, an
        estimate with a number has status 1 instead.
        """
        cdef int found = 0, status = estimate.status, forced = _forced_status(statusword)
        if self.is_checked:
            found = self.plausibility.check(
                sample.dt_s, sample.motor_position_rad, sample.motor_velocity_rad_s, sample.link_position_rad, sample.current_a
            )
        if self.with_network and not network_wanted:
            flags[0] |= FLAG_NETWORK_SKIPPED
        if forced != POWERED:
            status = forced
        elif has_torque(status):
            found |= self.faults_of(estimate, reference_nm, network_wanted)
            if starting:
                status = STARTING
            elif self.at_most_degraded:
                status = DEGRADED
        elif status == INVALID:
            found |= FAULT_OUT_OF_RANGE
        status = self.status.update(status, found)
        flags[0] |= self.fault_flags()
        return status

    cdef int stale(self, int *flags) noexcept nogil:
        """An input of this cycle is missing: return the status to publish and set its bits of `input_flags`."""
        cdef int status = self.status.update(STALE, 0)
        flags[0] |= self.fault_flags()
        return status

    cdef int faults_of(self, const Values *estimate, double reference_nm, bint network_wanted) noexcept nogil:
        """Return the faults of numbers that the estimator marked as good."""
        cdef double torque = estimate.torque_nm, sigma = estimate.sigma_nm, network = estimate.network_nm
        cdef double limit = self.torque_limit_nm
        cdef int found = 0
        if not (-limit <= torque <= limit and 0.0 <= sigma <= self.sigma_limit_nm):  # so that NaN fails too
            found = FAULT_OUT_OF_RANGE if torque - torque == 0.0 and 0.0 <= sigma < INFINITY else FAULT_NOT_FINITE
        if self.with_network and (estimate.status == DEGRADED or network - network != 0.0):
            self.count_network(estimate, network_wanted)
        if self.deviation_cycles:
            if fabs(torque - reference_nm) <= self.deviation_sigmas * sqrt(sigma * sigma + self.sensor_variance):
                self.deviates = 0
            elif not isnan(reference_nm):
                self.deviates += 1
            if self.deviates >= self.deviation_cycles:
                found |= FAULT_DEVIATION
        return found

    cdef int fault_flags(self) noexcept nogil:
        """Count the faults that are new in this cycle; return the bits of `input_flags` that explain the missing torque."""
        cdef StatusState *state = &self.status.now
        cdef int flags, bit
        if not (state.reasons or state.latched):
            return 0
        if state.news:
            for bit in range(LOW_BYTE):
                if state.news >> bit & 1:
                    self.counters[COUNTER_OF[bit]] += 1
            state.news = 0
        flags = (state.reasons & 0xFF) << 8
        if state.latched:
            self.counters[LATCHES] += state.latches - state.counted
            state.counted = state.latches
            flags |= FLAG_LATCHED | (state.latched & 0xFF) << 8
        return flags

    cdef void count_network(self, const Values *estimate, bint wanted) noexcept nogil:
        """Count a cycle in which the network is not fully used (status 3), or gave no torque."""
        cdef double network_nm = estimate.network_nm
        if estimate.status == DEGRADED:
            self.counters[FALLBACKS] += 1
        if not wanted:
            self.counters[NETWORK_NO_TIME] += 1
        elif network_nm - network_nm != 0.0:
            self.counters[NETWORK_NOT_FINITE] += 1
        elif fabs(network_nm - estimate.physics_nm) > self.network_limit_nm:
            self.counters[NETWORK_FAR] += 1
        else:
            self.counters[NETWORK_OUTSIDE] += 1

    cdef void error(self, double aligned_nm, double now_nm) noexcept nogil:
        """Add the error of a published estimate against the sensor of its age, and against the sensor now."""
        self.errors[3 * self.number] += aligned_nm * aligned_nm
        self.errors[3 * self.number + 1] += now_nm * now_nm
        self.errors[3 * self.number + 2] += 1.0
