"""The PDOs on C values; the rules stand in estimate_pdo.pyx."""

from libc.stdint cimport uint8_t

cdef struct Published:  # one joint's part of the estimate PDO
    int torque, sigma, status

cdef struct ContactField:  # and of the contact PDO
    int rate, code

cdef Published NOBODY  # of a joint that does not exist: the second half of the last PDO of an odd number
cdef ContactField NO_JOINT

cdef bint has_torque(int status) noexcept nogil
cdef Published field_of(double torque_nm, double sigma_nm, int status) noexcept nogil
cdef void encode_into(uint8_t *data, const Published *one, const Published *two, int sequence) noexcept nogil
cdef ContactField contact_field_of(double torque_rate_nm_s, double contact_nm, int state) noexcept nogil
cdef void encode_contact_into(uint8_t *data, const ContactField *one, const ContactField *two, int sequence) noexcept nogil
