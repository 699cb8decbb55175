"""Inputs of a cycle; the rules stand in intake.pyx."""

from libc.stdint cimport int8_t, int64_t, uint8_t, uint32_t

from jtqd.drivers.frame_socket cimport Frame

cdef enum:
    MOST_INPUTS = 20  # PDOs that the loop waits for, and as many temperatures
    MOST_FIELDS = 8
    NODES = 128
    IDENTIFIERS = 2048  # of 11 bits

cdef struct Field:  # one object of a PDO
    int offset, size
    bint is_signed

cdef struct Input:  # what the intake knows of one synchronous PDO
    uint32_t cob_id
    int length, node_id
    int64_t age_ns  # 0: sent at each SYNC; else its last frame counts for so long, and nobody waits for it
    int field_count
    Field fields[MOST_FIELDS]
    int wanted  # 0 while its node is absent or not configured: nobody waits for it then
    bint fresh, conflict, probation, has_data
    int64_t values[MOST_FIELDS]
    uint8_t data[8]
    int64_t stamp_ns, band_low_ns, band_high_ns
    int64_t debt, quarantine
    int64_t late, lost, duplicates, rejected, missed, in_a_row, too_short, too_long

cdef struct Temperature:
    uint32_t cob_id
    int node_id
    int64_t life_cycles, until
    bint news
    double celsius, c_per_unit
    int64_t lost, rejected

cdef struct GapState:
    int64_t count, arrivals, pause, length
    bint wanted, open

cdef struct NodeState:  # by node-ID
    int64_t heard_ns[NODES]
    int64_t restarts[NODES]
    uint8_t state[NODES]
    uint8_t unconfigured[NODES]
    uint8_t absent[NODES]
    int64_t boot_ups
    int wanted, waiting

cdef struct IntakeState:
    int64_t last_delay_ns, sync_stamp_ns
    int64_t foreign_sync, sync_errors, unknown_frames
    int64_t late_frames, duplicate_frames, rejected_frames, stale_inputs
    int64_t missing
    int counter
    bint foreign_sync_now

cdef class InputState:
    cdef readonly object pdo
    cdef Input input

cdef class JointTemperature:
    cdef readonly object name
    cdef Temperature known

cdef void temperature_at(Temperature *temperature, int64_t cycle) noexcept nogil

cdef class Gaps:
    cdef GapState now

cdef class NodeTrust:
    cdef tuple states_of
    cdef readonly dict heartbeats
    cdef int count
    cdef Input *inputs[MOST_INPUTS]
    cdef bint producer[NODES]
    cdef NodeState now
    cdef bint heard(self, int node_id, uint8_t state, int64_t stamp_ns) noexcept nogil
    cdef void believe(self, int node_id, bint configured) noexcept nogil

cdef class Intake:
    cdef readonly tuple pdos, temperatures
    cdef readonly list states
    cdef readonly NodeTrust nodes
    cdef readonly Gaps gaps
    cdef int count, temperature_count
    cdef Input *inputs[MOST_INPUTS]
    cdef Temperature *celsius[MOST_INPUTS]
    cdef int8_t input_of[IDENTIFIERS]
    cdef int8_t temperature_of[IDENTIFIERS]
    cdef IntakeState now
    cdef void begin_cycle(self, int counter) noexcept nogil
    cdef void take_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil
    cdef bint close_cycle(self) noexcept nogil
    cdef void drain_frame(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil
    cdef void drained(self) noexcept nogil
    cdef Input *input_with(self, uint32_t can_id) noexcept nogil
    cdef Temperature *temperature_with(self, uint32_t can_id) noexcept nogil
    cdef void wrong_length(self, Input *state, int length) noexcept nogil
    cdef bint young(self, const Input *state) noexcept nogil
    cdef void doubt(self, Input *state, int64_t delay_ns) noexcept nogil
    cdef void late(self, Input *state) noexcept nogil
    cdef void own_sync(self, int counter, int64_t stamp_ns) noexcept nogil
    cdef void second(self, Input *state, const Frame *frame, int64_t stamp_ns) noexcept nogil
    cdef void other(self, const Frame *frame, int64_t stamp_ns, bint own) noexcept nogil
    cdef bint is_heartbeat(self, uint32_t can_id) noexcept nogil
