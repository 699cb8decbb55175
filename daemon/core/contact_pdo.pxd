"""The contact PDO on C values; the rules stand in contact_pdo.pyx."""

from libc.stdint cimport uint8_t

cdef struct ToldContact:  # one joint's part of the PDO
    int rate, code

cdef ToldContact NO_JOINT  # of a joint that there is not

cdef ToldContact told_of(double torque_rate_nm_s, double contact_nm, int told) noexcept nogil
cdef void encode_contact(uint8_t *data, const ToldContact *one, const ToldContact *two, int sequence) noexcept nogil
