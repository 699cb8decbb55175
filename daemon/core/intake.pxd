"""Inputs of a cycle; the rules stand in intake.pyx."""

from libc.stdint cimport int8_t, int64_t, uint8_t, uint32_t, uint64_t

from jtqd.drivers.frame_socket cimport Frame

cdef enum:
    MOST_INPUTS = 20  # PDOs that the loop waits for, and as many temperatures
    MOST_FIELDS = 8
    NODES = 128
    IDENTIFIERS = 2048  # of 11 bits
    NOT_HEARD = 0xFF  # of `Nodes.state`

cdef struct Field:  # one object of a PDO
    int offset, size
    bint is_signed

cdef struct Input:  # one input PDO
    uint32_t cob_id
    int length, node_id
    int64_t age_ns  # 0: sent at each SYNC; else its last frame counts for so long, and nobody waits for it
    int field_count
    Field fields[MOST_FIELDS]
    int wanted  # 0 while its node is absent or not configured: nobody waits for it then
    bint fresh  # it is an input of the cycle just closed, or has come in this one
    bint conflict, probation, has_data
    int64_t values[MOST_FIELDS]
    uint8_t data[8]
    int64_t stamp_ns, band_low_ns, band_high_ns  # kernel stamp of its last frame; usual arrival after SYNC
    int64_t debt, quarantine  # frames that are missing and may still come; regular cycles until it is used again
    int64_t late, lost, duplicates, rejected, missed, in_a_row, too_short, too_long  # `InputView` of the snapshot

cdef struct Temperature:  # one joint's, by TPDO3
    uint32_t cob_id
    int node_id
    int64_t life_cycles, until
    bint arrived
    double celsius, c_per_unit
    int64_t lost, rejected

cdef struct Gap:  # slots without SYNC
    int64_t arrivals, pause, length  # late frames in the last one; cycles before the next gap; slots of the present one
    bint open  # the last slot had no SYNC

cdef struct Nodes:  # by node-ID
    int64_t heard_ns[NODES]
    int64_t restarts[NODES]
    uint8_t state[NODES]
    uint8_t unconfigured[NODES]
    uint8_t absent[NODES]
    int wanted, waiting  # PDOs whose node is believed; nodes that are not

cdef class Intake:
    cdef readonly tuple pdos, temperatures
    cdef readonly uint64_t[::1] counters, conflict
    cdef readonly int64_t sync_stamp_ns, last_delay_ns
    cdef public bint gap_wanted, claims
    cdef int count, temperature_count
    cdef Input inputs[MOST_INPUTS]
    cdef Temperature celsius[MOST_INPUTS]
    cdef int8_t input_of[IDENTIFIERS]
    cdef int8_t temperature_of[IDENTIFIERS]
    cdef bint is_producer[NODES]
    cdef Gap gap
    cdef Nodes nodes
    cdef int64_t missing
    cdef int sync_counter
    cdef bint foreign_sync_now
    cpdef void begin(self, int counter) noexcept
    cdef void take_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil
    cpdef bint close(self) noexcept
    cdef void drain_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil
    cdef void drained(self) noexcept nogil
    cdef int without_own(self, Frame *frames, int64_t *stamps_ns, bint *own, int count) noexcept nogil
    cpdef void pass_slot(self) noexcept
    cdef void idle(self, int node_id) noexcept nogil
    cdef void begin_seen(self, int counter, int64_t stamp_ns, bint regular, int64_t slots) noexcept
    cdef Input *input_with(self, uint32_t can_id) noexcept nogil
    cdef Temperature *temperature_with(self, uint32_t can_id) noexcept nogil
    cdef void wrong_length(self, Input *state, int length) noexcept nogil
    cdef bint is_young(self, const Input *state) noexcept nogil
    cdef void leave_unused(self, Input *state, int64_t delay_ns) noexcept nogil
    cdef void late(self, Input *state) noexcept nogil
    cdef void duplicate(self, Input *state, bint differs) noexcept nogil
    cdef void own_sync(self, int counter, int64_t stamp_ns) noexcept nogil
    cdef void second(self, Input *state, const Frame *frame, int64_t stamp_ns) noexcept nogil
    cdef void other(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil
    cpdef void age_temperatures(self, int64_t cycle) noexcept nogil
    cdef bint is_heartbeat(self, uint32_t can_id) noexcept nogil
    cdef void heartbeat(self, int node_id, uint8_t state, int64_t stamp_ns) noexcept nogil
    cdef void believe(self, int node_id, bint configured) noexcept nogil
