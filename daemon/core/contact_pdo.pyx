"""The contact PDOs of node 20h: four bytes for two joints, so that they fit beside everything else at 1 kHz (docs/estimator.md).

COB-ID 3A0h holds joints 1 and 2; 4A0h, of the same form, joints 3 and 4. A joint that does not exist has code 0.

    rate_1 I8 32 Nm/s | rate_2 I8 | contact U8 (two nibbles) | sequence U8

Rate: of the torsion; 80h is no rate, and what is beyond the field stands at its end. Contact: 0 not watched, 1 not known, 2 none,
3 pushed along the joint's positive direction, 4 against it; all else is not used. A receiver stops on 3 and 4, and trusts 2 only.
"""

from libc.math cimport NAN, isnan, nearbyint
from libc.stdint cimport int8_t, uint8_t

import struct
from typing import NamedTuple

from jtqd.estimator.status import CONTACT_OFF, CONTACT_PRESENT, CONTACT_UNKNOWN

LAYOUT = struct.Struct("<bbBB")
NO_RATE = -0x80
RATE_UNIT_NM_S = 32.0
POSITIVE, NEGATIVE = 3, 4
CODE_NAMES = {0: "off", 1: "unknown", 2: "none", POSITIVE: "positive", NEGATIVE: "negative"}

cdef int NONE = NO_RATE, AGAINST = NEGATIVE
cdef int OFF = CONTACT_OFF, UNKNOWN = CONTACT_UNKNOWN, THERE = CONTACT_PRESENT
cdef double PER_NM_S = 1.0 / RATE_UNIT_NM_S, LARGEST = 127.0


class ContactPdo(NamedTuple):
    """Decoded content; a rate is None where the PDO has none. contact: see CODE_NAMES."""

    torque_rate_nm_s: tuple[float | None, float | None]
    contact: tuple[int, int]
    sequence: int


cdef ContactField contact_field(double torque_rate_nm_s, double contact_nm, int state) noexcept nogil:
    """Return one joint's part; a contact without a size is none that is known."""
    cdef double counts = torque_rate_nm_s * PER_NM_S
    cdef int rate = NONE, code = state
    if not isnan(counts):
        rate = <int> nearbyint(-LARGEST if counts < -LARGEST else LARGEST if counts > LARGEST else counts)
    if state == THERE:
        if isnan(contact_nm):
            code = UNKNOWN
        elif contact_nm < 0.0:
            code = AGAINST
    return ContactField(rate, code)


cdef void encode_contact(uint8_t *data, const ContactField *one, const ContactField *two, int sequence) noexcept nogil:
    """Write the four bytes; `sequence` is the SYNC counter of the inputs."""
    data[0], data[1] = <uint8_t> <int8_t> one.rate, <uint8_t> <int8_t> two.rate
    data[2] = one.code | two.code << 4
    data[3] = sequence


NO_JOINT = contact_field(NAN, NAN, OFF)


def field(double torque_rate_nm_s, double contact_nm, int state):
    """Return the integers (rate, code) of one joint; state: of `jtqd.estimator.contact`."""
    cdef ContactField made = contact_field(torque_rate_nm_s, contact_nm, state)
    return made.rate, made.code


def encode(one, two, int sequence):
    """Encode four bytes from the `field`s of two joints and the SYNC counter of the inputs."""
    cdef ContactField first = ContactField(one[0], one[1])
    cdef ContactField second = ContactField(two[0], two[1])
    cdef uint8_t data[4]
    encode_contact(data, &first, &second, sequence)
    return (<const char *> data)[:4]


def decode(data):
    """Decode the four bytes; raises struct.error on any other length."""
    rate_1, rate_2, contact, sequence = LAYOUT.unpack(data)
    rates = [None if rate == NO_RATE else rate * RATE_UNIT_NM_S for rate in (rate_1, rate_2)]
    return ContactPdo((rates[0], rates[1]), (contact & 0x0F, contact >> 4), sequence)
