"""The contact PDO on C values; the rules stand in contact_pdo.pyx."""

from libc.stdint cimport uint8_t

cdef struct ContactField:  # one joint's part of the PDO
    int rate, code

cdef ContactField NO_JOINT  # of a joint that does not exist

cdef ContactField contact_field(double torque_rate_nm_s, double contact_nm, int state) noexcept nogil
cdef void encode_contact(uint8_t *data, const ContactField *one, const ContactField *two, int sequence) noexcept nogil
