"""The PDOs of node 20h, for receivers that act on them: no stale or unfounded number goes out.

Estimate PDO, eight bytes for two joints: COB-ID 1A0h holds joints 1 and 2; 2A0h, of the same form, joints 3 and 4.

    torque_1 I16 0.01 Nm | torque_2 I16 | sigma_1 U8 0.05 Nm | sigma_2 U8 | status U8 (two nibbles) | sequence U8

Torque is sent only with status 2 (valid), 3 (degraded) and 6 (standstill); with any other status, outside the range of
the field, or with a sigma that is none (not finite, negative), it is 8000h and sigma is 255. Sigma is rounded up, so that
the interval on the wire is never narrower; 255 beside a torque means more than 12.7 Nm. A joint that does not exist has
status 0 (off).

Contact PDO, four bytes so that it fits beside everything else at 1 kHz (docs/estimator.md): COB-ID 3A0h and 4A0h.

    rate_1 I8 32 Nm/s | rate_2 I8 | contact U8 (two nibbles) | sequence U8

Rate: of the torsion; 80h is no rate, and what is beyond the field stands at its end. Contact: 0 not watched (or no such
joint), 1 not known, 2 none, 3 pushed along the joint's positive direction, 4 against it; all else is not used. A receiver
stops on 3 and 4, and trusts 2 only.
"""

from libc.math cimport INFINITY, NAN, ceil, isnan, nearbyint
from libc.stdint cimport int8_t, int16_t, uint8_t
from libc.string cimport memcpy

import struct
from typing import NamedTuple

from jtqd.estimator import status as st

LAYOUT = struct.Struct("<hhBBBB")
NO_TORQUE = -0x8000
TORQUE_UNIT_NM = 0.01
SIGMA_UNIT_NM = 0.05
SIGMA_UNKNOWN = 255
PUBLISHED_STATUSES = frozenset(st.PUBLISHED)

cdef int NONE = NO_TORQUE, UNKNOWN = SIGMA_UNKNOWN, INVALID = st.INVALID
cdef double LARGEST = 32767.0  # counts of an I16
cdef double WIDEST_NM = 12.7  # 254 steps of sigma; 255 is SIGMA_UNKNOWN
cdef double PER_NM = round(1.0 / TORQUE_UNIT_NM), STEPS_PER_NM = round(1.0 / SIGMA_UNIT_NM)
cdef bint HAS_TORQUE[16]
HAS_TORQUE[:] = [code in PUBLISHED_STATUSES for code in range(16)]


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
    torques = [None if each == NO_TORQUE else each * TORQUE_UNIT_NM for each in (torque_1, torque_2)]
    sigmas = [None if each == SIGMA_UNKNOWN else each * SIGMA_UNIT_NM for each in (sigma_1, sigma_2)]
    return EstimatePdo(tuple(torques), tuple(sigmas), (status & 0x0F, status >> 4), sequence)


# Contact PDO ----------------------------------------------------------------------------------------------------------

CONTACT_LAYOUT = struct.Struct("<bbBB")
NO_RATE = -0x80
RATE_UNIT_NM_S = 32.0
POSITIVE, NEGATIVE = 3, 4
CODE_NAMES = {0: "off", 1: "unknown", 2: "none", POSITIVE: "positive", NEGATIVE: "negative"}

cdef int WITHOUT_RATE = NO_RATE, AGAINST = NEGATIVE
cdef int CONTACT_NOT_KNOWN = st.CONTACT_UNKNOWN, CONTACT_THERE = st.CONTACT_PRESENT
cdef double PER_NM_S = 1.0 / RATE_UNIT_NM_S, LARGEST_RATE = 127.0


class ContactPdo(NamedTuple):
    """Decoded content; a rate is None where the PDO has none. contact: see CODE_NAMES."""

    torque_rate_nm_s: tuple[float | None, float | None]
    contact: tuple[int, int]
    sequence: int


cdef ContactField contact_field_of(double torque_rate_nm_s, double contact_nm, int state) noexcept nogil:
    """Return one joint's part; a contact without a size is none that is known."""
    cdef double counts = torque_rate_nm_s * PER_NM_S
    cdef int rate = WITHOUT_RATE, code = state
    if not isnan(counts):
        rate = <int> nearbyint(max(-LARGEST_RATE, min(LARGEST_RATE, counts)))
    if state == CONTACT_THERE:
        if isnan(contact_nm):
            code = CONTACT_NOT_KNOWN
        elif contact_nm < 0.0:
            code = AGAINST
    return ContactField(rate, code)


cdef void encode_contact_into(uint8_t *data, const ContactField *one, const ContactField *two, int sequence) noexcept nogil:
    """Write the four bytes; `sequence` is the SYNC counter of the inputs."""
    data[0], data[1] = <uint8_t> <int8_t> one.rate, <uint8_t> <int8_t> two.rate
    data[2] = one.code | two.code << 4
    data[3] = sequence


NO_JOINT = contact_field_of(NAN, NAN, st.CONTACT_OFF)


def contact_field(double torque_rate_nm_s, double contact_nm, int state):
    """Return the integers (rate, code) of one joint; state: of `jtqd.estimator.detection`."""
    cdef ContactField made = contact_field_of(torque_rate_nm_s, contact_nm, state)
    return made.rate, made.code


def encode_contact(one, two, int sequence):
    """Encode four bytes from the `contact_field`s of two joints and the SYNC counter of the inputs."""
    cdef ContactField first = ContactField(one[0], one[1]), second = ContactField(two[0], two[1])
    cdef uint8_t data[4]
    encode_contact_into(data, &first, &second, sequence)
    return (<const char *> data)[:4]


def decode_contact(data):
    """Decode the four bytes; raises struct.error on any other length."""
    rate_1, rate_2, contact, sequence = CONTACT_LAYOUT.unpack(data)
    rates = [None if rate == NO_RATE else rate * RATE_UNIT_NM_S for rate in (rate_1, rate_2)]
    return ContactPdo(tuple(rates), (contact & 0x0F, contact >> 4), sequence)
