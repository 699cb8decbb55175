"""The estimate PDOs of node 20h: eight bytes for two joints that never carry a stale or unfounded number.

COB-ID 1A0h holds joints 1 and 2; 2A0h, of the same form, joints 3 and 4. A joint that does not exist has status 0 (off).

    torque_1 I16 0.01 Nm | torque_2 I16 | sigma_1 U8 0.05 Nm | sigma_2 U8 | status U8 (two nibbles) | sequence U8

Torque is sent only with status 2 (valid), 3 (degraded) and 6 (standstill); with any other status, outside the range of
the field, or with a sigma that is none (not finite, negative), it is 8000h and sigma is 255. Sigma is rounded up, so that
the interval on the wire is never narrower; 255 beside a torque means more than 12.7 Nm.
"""

from libc.math cimport INFINITY, NAN, ceil, nearbyint
from libc.stdint cimport int16_t, uint8_t
from libc.string cimport memcpy

import struct
from typing import NamedTuple

from jtqd.estimator import status as st

LAYOUT = struct.Struct("<hhBBBB")
NO_TORQUE = -0x8000
TORQUE_UNIT_NM = 0.01
SIGMA_UNIT_NM = 0.05
SIGMA_UNKNOWN = 255
STATUS_INVALID = st.INVALID
PUBLISHED_STATUSES = frozenset(st.PUBLISHED)
_TORQUE_LIMIT = 32767
_SIGMA_LIMIT_NM = 12.7

cdef int NONE = NO_TORQUE, UNKNOWN = SIGMA_UNKNOWN, INVALID = STATUS_INVALID
cdef double LARGEST = _TORQUE_LIMIT, WIDEST_NM = _SIGMA_LIMIT_NM
cdef double PER_NM = round(1.0 / TORQUE_UNIT_NM), STEPS_PER_NM = round(1.0 / SIGMA_UNIT_NM)
cdef bint HAS_TORQUE[16]
cdef int _code
for _code in range(16):
    HAS_TORQUE[_code] = _code in PUBLISHED_STATUSES


class EstimatePdo(NamedTuple):
    """Decoded content; torque and sigma are None where the PDO has none."""

    torque_nm: tuple[float | None, float | None]
    sigma_nm: tuple[float | None, float | None]
    status: tuple[int, int]
    sequence: int


cdef bint has_torque(int status) noexcept nogil:
    """A torque goes out with this status."""
    return 0 <= status < 16 and HAS_TORQUE[status]


cdef Published field_of(double torque_nm, double sigma_nm, int status) noexcept nogil:
    """Return one joint's part; a torque or sigma that is none, or does not fit, is status 15."""
    cdef double counts = torque_nm * PER_NM
    if not has_torque(status):
        return Published(NONE, UNKNOWN, status)
    if not (-LARGEST <= counts <= LARGEST and 0.0 <= sigma_nm < INFINITY):  # also false for NaN
        return Published(NONE, UNKNOWN, INVALID)
    # A sigma of 12.70 Nm must not become 255 by the rounding of 12.7 / 0.05.
    cdef int steps = <int> ceil(sigma_nm * STEPS_PER_NM - 1e-9) if sigma_nm <= WIDEST_NM else UNKNOWN
    return Published(<int> nearbyint(counts), steps, status)


cdef void encode_into(uint8_t *data, const Published *one, const Published *two, int sequence) noexcept nogil:
    """Write the eight bytes; `sequence` is the SYNC counter of the inputs."""
    cdef int16_t torques[2]
    torques[0], torques[1] = one.torque, two.torque
    memcpy(data, torques, sizeof(torques))
    data[4], data[5] = one.sigma, two.sigma
    data[6] = one.status | two.status << 4
    data[7] = sequence


NOBODY = field_of(NAN, INFINITY, st.OFF)


def field(double torque_nm, double sigma_nm, int status):
    """Return the integers (torque, sigma, status) of one joint; an invalid torque or sigma gives status 15."""
    cdef Published made = field_of(torque_nm, sigma_nm, status)
    return made.torque, made.sigma, made.status


def encode(one, two, int sequence):
    """Encode eight bytes from the `field`s of two joints and the SYNC counter of the inputs."""
    cdef Published first = Published(one[0], one[1], one[2])
    cdef Published second = Published(two[0], two[1], two[2])
    cdef uint8_t data[8]
    encode_into(data, &first, &second, sequence)
    return (<const char *> data)[:8]


def decode(data):
    """Decode the eight bytes; raises struct.error on any other length."""
    torque_1, torque_2, sigma_1, sigma_2, status, sequence = LAYOUT.unpack(data)

    def torque(counts):
        return None if counts == NO_TORQUE else counts * TORQUE_UNIT_NM

    def sigma(steps):
        return None if steps == SIGMA_UNKNOWN else steps * SIGMA_UNIT_NM

    return EstimatePdo(
        (torque(torque_1), torque(torque_2)),
        (sigma(sigma_1), sigma(sigma_2)),
        (status & 0x0F, status >> 4),
        sequence,
    )
