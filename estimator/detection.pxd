"""Plausibility of the readings, torque rate, load of the link and contacts: parameters and states; detection.pyx."""

from libc.stdint cimport uint8_t, uint64_t

from jtqd.estimator.observer cimport FusedObserverLaw, FusedObserverState, Sample

cdef enum: CONTACT_WAVES = 4  # cos and sin of 1 and 2 per turn of the motor
cdef enum: CONTACT_DELAY = 4  # samples by which the trend is delayed

cdef enum ContactCode:  # as in the PDO
    CONTACT_OFF = 0  # not watched
    CONTACT_UNKNOWN = 1
    CONTACT_NONE = 2
    CONTACT_PRESENT = 3

cdef struct LinkLaw:
    bint used
    double inertia, damping

cdef struct LinkState:
    double torque, fast, q, step, dt  # of the last sample; fast: deflection less the filtered one
    int samples

cdef struct LinkLoad:
    double rate_nm_s, load_nm  # load: at the last sample

cdef struct ContactLaw:
    double threshold, release, trend, notch  # trend, notch: shares per sample
    int settle, longest, brief  # samples: until the residual is valid, of one contact, of a contact's beginning

cdef struct ContactState:
    double trend, last  # last: residual of the last sample
    double baseline, sign, peak  # of a contact: trend of the residual, sign, largest residual of its beginning
    double delayed[CONTACT_DELAY]
    double wave[CONTACT_WAVES]
    double residual_nm
    int samples, missed, active, blank, at  # active: samples of this contact; blank: samples until the trend is set
    int code

cdef int fill_link(LinkLaw *law, joint, torsion) except -1
cdef void restart_link(LinkState *s) noexcept nogil
cdef void update_link(
    const LinkLaw *law, LinkState *s, const FusedObserverLaw *observer, const FusedObserverState *observed,
    double torsion_nm, double dt, LinkLoad *out
) noexcept nogil
cdef int fill_contact(ContactLaw *law, double threshold_nm, double period_s) except -1
cdef void restart_contact(ContactState *s) noexcept nogil
cdef void detect_contact(const ContactLaw *law, ContactState *s, double external_nm, double angle) noexcept nogil

cdef struct InputLaw:
    bint used
    double motor, link, current  # Nm per rad of motor and link, Nm per A: what they are to the torque
    double acceleration  # largest of a joint [Nm/s2]
    double tolerance  # [Nm]: below it nothing is doubtful
    double load_rate  # [Nm/s] of the fastest load
    double most  # [Nm]
    double noise  # variance of both readings that the file's sigma has [Nm^2]

cdef struct Runs:  # of equal samples at rest: length of the last one, mean length, how many have been seen
    double usual
    int still, seen

cdef struct Channel:  # an encoder, in Nm of torsion
    double last, step, rate  # reading, last step, rate in order [Nm/s]
    double noise  # variance of its second differences
    double quantum  # smallest of them, which is a count
    double off  # displacement that no motion explains
    double unseen  # while it stands still: motion that the velocity has

cdef struct Range:  # of the last RANGE_S
    double high, low

cdef struct Slip:  # motion of the motor's position beyond its velocity
    double lag, scale  # samples by which the velocity is behind; by how much its scale is wrong
    double by_change, changes, by_step, steps, both  # sums of products that they are of [Nm^2]
    double sum, usual  # [Nm]; square of its healthy range
    Range range, velocity

cdef struct InputState:
    Channel motor, link
    double velocity, current  # last step by the drive's velocity [Nm]; current [A]
    Slip slip
    double dt, doubt  # of the last sample [s]; [Nm]
    double strange  # samples out of order lately
    double still_nm  # current [Nm] when the link's reading began to stand still
    Runs runs, link_runs  # of samples that are equal as a whole, and of equal readings of the link
    double noise  # variance of the twist's second differences
    bint going, alive  # alive: has differed since it began, or need not

cdef int fill_inputs(InputLaw *law, joint, torsion, double noise) except -1
cdef void restart_inputs(const InputLaw *law, InputState *s) noexcept nogil
cdef void drop_inputs(InputState *s) noexcept nogil
cdef void check_inputs(const InputLaw *law, InputState *s, const Sample *x, bint standing) noexcept nogil
cdef double louder_nm2(const InputLaw *law, const InputState *s) noexcept nogil
cdef bint in_order(const InputState *s) noexcept nogil
cdef void bound_inputs(InputState *s, double most) noexcept nogil

cdef struct Run:  # of samples that equal those of a lag before
    double evidence
    unsigned int first, last, alone  # numbers of samples; how many stood once in their period

cdef struct Samples:  # hashes of the last 256 samples; where the last one of a low byte stands, and the one before it
    uint64_t words[256]
    uint8_t at[256], older[256]
    Run runs[256]  # by lag
    uint8_t next, whole  # whole: lag of a run that was a whole period at the last sample, 0 for none
    unsigned int count, since, still  # samples; since a jump; since a position changed

cdef class Plausibility:
    cdef Samples samples
    cdef double gap_s, per_turn, jump, limit, longest_frozen_s, twist_limit, twist_jump
    cdef double low, high, motor, twist, current, frozen_from, frozen_s, slip  # slip: largest of late [rad]
    cdef readonly double mismatch_rad
    cdef int check(
        self, double dt_s, double motor_position, double motor_velocity, double link_position, double current
    ) noexcept nogil
    cdef int faults(self, double dt_s, double slip, double velocity, double change) noexcept nogil
