"""The record of one cycle as C sees it: the layout of `jtqd.daemon.shared.cycle_record`, whose names these are."""

from libc.stdint cimport int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t

from jtqd.drivers.frame_socket cimport Frame

cdef enum:
    MOST_JOINTS = 4
    MOST_FRAMES = 32  # that a record of any layout holds
    MOST_METHODS = 4  # of estimation

cdef struct Header:
    uint64_t cycle
    int64_t sync_monotonic_ns, sync_realtime_ns
    uint32_t flags, work_ns
    int32_t late_ns
    uint32_t missed
    uint8_t sync_counter, frame_count, frames_left_out
    uint8_t stale_inputs, late_frames, duplicate_frames, rejected_frames
    uint8_t spare

cdef struct JointBlock:
    double current_a, motor_position_rad, motor_velocity_rad_s, link_position_rad, sensor_torque_nm, temperature_c
    double torque_nm, sigma_nm, tob_nm, physics_nm, network_nm, dt_s, reference_nm, age_ms
    double torque_rate_nm_s, contact_nm
    uint16_t statusword, status, sensor_status, input_flags

cdef struct ShadowValues:  # of one shadow method
    double torque_nm, sigma_nm, reference_nm, age_ms

cdef struct ShadowBlock:  # by the order of `cycle_record.SHADOW_METHODS`
    ShadowValues methods[MOST_METHODS]
    uint16_t status[MOST_METHODS]

cdef struct Layout:  # `jtqd.daemon.shared.cycle_record.Layout`
    int joints, frame_capacity
    Py_ssize_t frames_offset, stamps_offset, shadow_offset, tail_offset, size

cdef struct Record:  # one record in the ring's memory
    Header *header
    JointBlock *joints
    Frame *frames
    int64_t *stamps_ns
    ShadowBlock *shadows  # not there without shadow methods
    uint64_t *tail

cdef struct KeptFrames:  # of slots without a record
    int64_t count
    Frame frames[MOST_FRAMES]
    int64_t stamps_ns[MOST_FRAMES]

cdef class RecordRing:
    cdef object memory
    cdef uint64_t[::1] head
    cdef uint8_t[::1] records
    cdef uint64_t *written
    cdef uint64_t slots
    cdef Layout layout
    cdef Record record
    cdef int count, left_out
    cdef KeptFrames kept
    cdef void begin(self) noexcept nogil
    cdef void commit(self) noexcept nogil
    cdef void keep_for_next(self, const Frame *frame, int64_t stamp_ns) noexcept nogil
    cdef void keep(self, const Frame *frames, const int64_t *stamps_ns, int count) noexcept nogil
