"""Status of a joint; the rules stand in status.pyx."""

from libc.stdint cimport int64_t, uint64_t

from jtqd.estimator.detection cimport Plausibility
from jtqd.estimator.observer cimport Reference, Sample
from jtqd.estimator.estimator cimport Values

cdef struct StatusState:
    int held, asked  # the status that stays until a better one was asked for long enough; the worst of those
    # bits of faults: of the last cycle, begun since they were counted, since a torque was last published, latched, released last
    int found, news, reasons, latched, released
    int64_t latches, counted  # how often a fault was latched; of these, those in the tally
    int64_t needed, calm, run
    int64_t since, window, factor

cdef class JointStatus:
    cdef StatusState now
    cdef int latching
    cdef int64_t stale_limit  # -1: none
    cpdef int update(self, int status, int found) noexcept nogil
    cpdef int late(self) noexcept nogil
    cdef int another(self) noexcept nogil
    cdef int published(self, int status, int found) noexcept nogil
    cdef void fall(self, int status) noexcept nogil
    cdef void rise(self, int status) noexcept nogil
    cdef int64_t cycles(self, int status) noexcept nogil

cdef class JointRules:
    cdef uint64_t[::1] counters
    cdef double[::1] errors
    cdef int number
    cdef JointStatus status
    cdef Plausibility plausibility
    cdef bint is_checked, with_network, at_most_degraded
    cdef double torque_limit_nm, sigma_limit_nm, network_limit_nm, deviation_sigmas, sensor_variance
    cdef int64_t deviation_cycles, deviates
    cdef double bandwidth, max_gap, age_ms
    cdef Reference seen
    cdef double reference(self, double dt, double sensor_nm) noexcept nogil
    cdef int judge(
        self, const Values *estimate, const Sample *sample, double reference_nm,
        int statusword, bint starting, bint network_wanted, int *flags,
    ) noexcept nogil
    cdef int stale(self, int *flags) noexcept nogil
    cdef int fault_flags(self) noexcept nogil
    cdef void count_network(self, const Values *estimate, bint wanted) noexcept nogil
    cdef void error(self, double aligned_nm, double now_nm) noexcept nogil
    cdef int faults_of(self, const Values *estimate, double reference_nm, bint network_wanted) noexcept nogil
