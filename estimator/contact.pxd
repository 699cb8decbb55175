"""Torque rate, load of the link and contact as flat blocks; the equations stand in contact.pyx."""

from jtqd.estimator.observer cimport FusedObserverLaw, FusedObserverState

cdef enum: CONTACT_WAVES = 4  # cos and sin of 1 and 2 per turn of the motor
cdef enum: CONTACT_LATER = 4  # samples by which the trend stays behind

cdef enum Told:  # of a contact, as in the PDO
    CONTACT_OFF = 0  # not watched
    CONTACT_UNKNOWN = 1
    CONTACT_NONE = 2
    CONTACT_THERE = 3

cdef struct LinkLaw:
    bint used
    double inertia, damping

cdef struct LinkState:
    double torque, behind, q, step, dt  # of the sample before; behind: deflection less the filtered one
    int samples

cdef struct LinkSeen:
    double rate_nm_s, load_nm  # load: of the sample before

cdef struct ContactLaw:
    double threshold, release, trend, notch  # trend, notch: shares per sample
    int settle, longest, brief  # samples: until it is believed, of one contact, in which the load stays what it was

cdef struct ContactState:
    double trend, before  # before: residual of the last sample
    double under, side, size  # of a contact: trend of the residual, sign, largest residual of its beginning
    double later[CONTACT_LATER]
    double wave[CONTACT_WAVES]
    double residual_nm
    int samples, missed, held, blind, at, told

cdef int fill_link(LinkLaw *law, joint, torsion) except -1
cdef void restart_link(LinkState *s) noexcept nogil
cdef void follow_link(
    const LinkLaw *law,
    LinkState *s,
    const FusedObserverLaw *observer,
    const FusedObserverState *now,
    double young_nm,
    double dt,
    LinkSeen *out,
) noexcept nogil
cdef int fill_contact(ContactLaw *law, double threshold_nm, double period_s) except -1
cdef void restart_contact(ContactState *s) noexcept nogil
cdef void watch_contact(const ContactLaw *law, ContactState *s, double outside_nm, double angle) noexcept nogil
