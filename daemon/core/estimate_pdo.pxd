"""The estimate PDO on C values; the rules stand in estimate_pdo.pyx."""

from libc.stdint cimport uint8_t

cdef struct Published:  # one joint's part of the PDO
    int torque, sigma, status

cdef Published NOBODY  # of a joint that does not exist: the second half of the last PDO of an odd number

cdef bint has_torque(int status) noexcept nogil
cdef Published field_of(double torque_nm, double sigma_nm, int status) noexcept nogil
cdef void encode_into(uint8_t *data, const Published *one, const Published *two, int sequence) noexcept nogil
