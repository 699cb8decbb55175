"""The contact PDO byte by byte."""

import math
import struct

import pytest

from jtqd.daemon.core.contact_pdo import NO_RATE, decode, encode, field
from jtqd.estimator.status import CONTACT_NONE, CONTACT_OFF, CONTACT_PRESENT, CONTACT_UNKNOWN


def test_bytes() -> None:
    """Joint 1: +640 Nm/s, pushed along its positive direction; joint 2: -640 Nm/s, against; SYNC 17."""
    data = encode(field(640.0, 2.9, CONTACT_PRESENT), field(-640.0, -2.9, CONTACT_PRESENT), 17)
    assert data.hex(" ") == "14 ec 43 11"
    assert decode(data) == ((640.0, -640.0), (3, 4), 17)


def test_what_is_not_known_is_never_a_contact_or_none() -> None:
    assert field(math.nan, math.nan, CONTACT_UNKNOWN) == (NO_RATE, 1)
    assert field(math.nan, math.nan, CONTACT_OFF) == (NO_RATE, 0)
    assert field(0.0, math.nan, CONTACT_PRESENT) == (0, 1)
    assert field(0.0, 0.1, CONTACT_NONE) == (0, 2)
    assert decode(bytes.fromhex("80801005")) == ((None, None), (0, 1), 5)


@pytest.mark.parametrize(
    ("rate", "counts"), [(1e9, 127), (-1e9, -127), (math.inf, 127), (-math.inf, -127), (16.1, 1)]
)
def test_a_rate_beyond_the_field_stands_at_its_end_and_is_never_none(rate: float, counts: int) -> None:
    assert field(rate, 0.0, CONTACT_NONE) == (counts, 2)


def test_another_length_is_refused() -> None:
    with pytest.raises(struct.error):
        decode(bytes(8))
