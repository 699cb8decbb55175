"""Contacts of all joints of a cycle; contact.pyx."""

from libc.stdint cimport uint8_t

from jtqd.daemon.core.contact_pdo cimport ContactField
from jtqd.daemon.core.joint cimport JointState
from jtqd.daemon.core.record cimport MOST_JOINTS
from jtqd.estimator.contact cimport ContactLaw, ContactState

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
