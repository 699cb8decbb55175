"""The contact PDO byte by byte."""

import math
import struct

import pytest

from jtqd.daemon.core.estimate_pdo import NO_RATE, contact_field, decode_contact, encode_contact
from jtqd.estimator.status import CONTACT_NONE, CONTACT_OFF, CONTACT_PRESENT, CONTACT_UNKNOWN


def test_bytes() -> None:
    """Joint 1: +640 Nm/s, pushed along its positive direction; joint 2: -640 Nm/s, against; SYNC 17."""
    data = encode_contact(
        contact_field(640.0, 2.9, CONTACT_PRESENT), contact_field(-640.0, -2.9, CONTACT_PRESENT), 17
    )
    assert data.hex(" ") == "14 ec 43 11"
    assert decode_contact(data) == ((640.0, -640.0), (3, 4), 17)


def test_what_is_not_known_is_never_a_contact_or_none() -> None:
    assert contact_field(math.nan, math.nan, CONTACT_UNKNOWN) == (NO_RATE, 1)
    assert contact_field(math.nan, math.nan, CONTACT_OFF) == (NO_RATE, 0)
    assert contact_field(0.0, math.nan, CONTACT_PRESENT) == (0, 1)
    assert contact_field(0.0, 0.1, CONTACT_NONE) == (0, 2)
    assert decode_contact(bytes.fromhex("80801005")) == ((None, None), (0, 1), 5)


@pytest.mark.parametrize(
    ("rate", "counts"), [(1e9, 127), (-1e9, -127), (math.inf, 127), (-math.inf, -127), (16.1, 1)]
)
def test_a_rate_beyond_the_field_stands_at_its_end_and_is_never_none(rate: float, counts: int) -> None:
    assert contact_field(rate, 0.0, CONTACT_NONE) == (counts, 2)


def test_another_length_is_refused() -> None:
    with pytest.raises(struct.error):
        decode_contact(bytes(8))
