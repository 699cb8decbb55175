"""One joint in the loop; joint.pyx."""

from cpython.object cimport PyObject
from libc.stdint cimport int64_t, uint8_t

from jtqd.daemon.core.estimate_pdo cimport ContactField, Published
from jtqd.daemon.core.intake cimport Input, Intake
from jtqd.daemon.core.record cimport MOST_JOINTS, MOST_METHODS, JointBlock, ShadowBlock
from jtqd.daemon.core.status cimport JointRules, StatusState
from jtqd.estimator.detection cimport ContactLaw, ContactState
from jtqd.estimator.estimator cimport Estimator
from jtqd.estimator.observer cimport Reference, Sample

cdef enum:
    MOST_TPDOS = 4  # of a drive

cdef struct Unwrap:  # of a 32-bit position: last counts, and whole ranges that it has rolled over
    int64_t last, offset

cdef struct Scale:  # SI per count or unit
    double motor_rad, motor_rad_s, link_rad, ampere, sensor_nm

cdef struct Derived:  # velocity of a drive that sends none
    int64_t last_ns
    double last_rad, rad_s
    bint is_replayed  # by the log, which has no time of cycles without inputs
    double replayed_rad_s

cdef struct JointState:
    int64_t last_ns
    int status  # as published
    const StatusState *held
    Published published
    JointBlock sample
    ShadowBlock *shadow  # NULL without shadow methods
    double load_nm  # of the link, for `contact`

cdef struct ShadowMethod:
    PyObject *estimator
    int place  # in `ShadowBlock`
    double bandwidth, max_gap  # of the sensor as old as its estimate
    Reference seen

cdef class ShadowMethods:
    cdef readonly tuple estimators
    cdef int count
    cdef ShadowMethod methods[MOST_METHODS]
    cdef ShadowBlock now
    cdef double[::1] errors
    cdef void advance(self, const Sample *sample, const JointBlock *record) noexcept nogil

cdef class JointCycle:
    cdef readonly object inputs, estimator
    cdef Intake intake
    cdef Estimator core
    cdef JointRules rules
    cdef Unwrap motor, link
    cdef int input_count
    cdef Input *input[MOST_TPDOS]  # of its drive, and which flags of the record stand for them
    cdef int flags[MOST_TPDOS]
    cdef Input *motor_position  # the one that carries the motor position
    cdef const int64_t *motor_count
    cdef const int64_t *link_count  # NULL without a link encoder
    cdef const int64_t *motor_speed  # NULL where it is derived
    cdef const int64_t *current_count
    cdef const int64_t *statusword
    cdef Input *sensor  # NULL without reference
    cdef const double *celsius
    cdef int64_t period_ns
    cdef Scale scale
    cdef double gear_ratio
    cdef Derived derived
    cdef JointState now
    cdef ShadowMethods shadows  # None without
    cdef int find_inputs(self, inputs) except -1
    cdef int set_scale(self, inputs) except -1
    cpdef void observe(self, int64_t sync_ns, bint starting, bint network_wanted) noexcept nogil
    cdef void estimate(self, int64_t sync_ns, bint starting, bint network_wanted, int flags) noexcept nogil
    cdef void miss(self, int flags) noexcept nogil
    cdef int reference(self) noexcept nogil
    cdef double since_last(self, int64_t sync_ns) noexcept nogil
    cdef int64_t on_grid(self, int64_t dt_ns) noexcept nogil
    cdef bint derive(self, int64_t sync_ns) noexcept nogil
    cpdef void withdraw(self, int status) noexcept nogil
    cpdef void observe_shadows(self) noexcept nogil

cdef class ContactWatch:
    cdef readonly int count
    cdef readonly bint sends
    cdef bint opposed
    cdef ContactLaw law[MOST_JOINTS]
    cdef ContactState state[MOST_JOINTS]
    cdef ContactField fields[MOST_JOINTS]
    cdef int begun  # contacts that began in the last cycle
    cdef void watch(self, JointState **joints) noexcept nogil
    cdef void report(self, JointState *joint, int n, double contact_nm, int state) noexcept nogil
    cdef void withdraw(self, JointState **joints) noexcept nogil
    cdef void encode(self, uint8_t *data, int pair, int sequence) noexcept nogil
