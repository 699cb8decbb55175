"""Estimate PDO and contact PDO byte by byte, and what must never be on the wire."""

import math
import struct
from math import inf, nan

import numpy as np
import pytest

from jtqd.daemon.core.estimate_pdo import (
    CODE_NAMES,
    NO_RATE,
    contact_field,
    decode,
    decode_contact,
    encode,
    encode_contact,
    field,
)
from jtqd.estimator.status import CONTACT_NONE, CONTACT_OFF, CONTACT_PRESENT, CONTACT_UNKNOWN


def test_transcript() -> None:
    # 12.34 Nm -> 1234 = 04D2h; -0.5 Nm -> -50 = FFCEh; sigma 0.31 -> 7 steps (up), 1.0 -> 20;
    # status 2 (joint 1), 6 (joint 2) -> 62h; sequence 240 = F0h
    data = encode(field(12.34, 0.31, 2), field(-0.5, 1.0, 6), 240)
    assert data == bytes.fromhex("D204 CEFF 07 14 62 F0")


@pytest.mark.parametrize("status", [0, 1, 4, 5, 15])
def test_no_torque_without_a_status_that_carries_one(status: int) -> None:
    data = encode(field(1.0, 0.1, status), field(1.0, 0.1, 2), 1)
    assert data[0:2] == b"\x00\x80"
    assert data[4] == 255
    assert data[6] == status | 2 << 4


@pytest.mark.parametrize("torque", [nan, inf, -inf, 327.69, -327.69, 1e300])
def test_a_number_that_is_none_becomes_invalid(torque: float) -> None:
    assert field(torque, 0.1, 2) == (-0x8000, 255, 15)


def test_sigma_is_never_narrower_than_it_was() -> None:
    rng = np.random.default_rng(7)
    for sigma in rng.uniform(0.0, 12.7, 2000):
        steps = field(0.0, float(sigma), 2)[1]
        assert steps * 0.05 >= sigma - 1e-9
        assert steps * 0.05 - sigma < 0.05 + 1e-9
    assert field(0.0, 12.70, 2)[1] == 254
    assert field(0.0, 12.71, 2) == (0, 255, 2)


@pytest.mark.parametrize(("steps", "sent"), [(10.0, 10), (10 + 0.5e-9, 10), (10 + 1.5e-9, 11), (10.5, 11)])
def test_sigma_is_rounded_up_but_for_the_error_of_the_division(steps: float, sent: int) -> None:
    assert field(0.0, 0.05 * steps, 2)[1] == sent


@pytest.mark.parametrize("sigma", [12.71, 12.8, 20.0, 25.4, 1e6, 1.7e308])
def test_a_sigma_beyond_the_field_is_unknown(sigma: float) -> None:
    assert field(1.0, sigma, 2) == (100, 255, 2)


@pytest.mark.parametrize("sigma", [nan, inf, -inf, -1e-9, -1.0])
@pytest.mark.parametrize("status", [2, 3, 6])
def test_a_torque_whose_sigma_is_none_is_none(sigma: float, status: int) -> None:
    assert field(1.0, sigma, status) == (-0x8000, 255, 15)


def test_round_trip() -> None:
    rng = np.random.default_rng(11)
    for _ in range(500):
        torques = rng.uniform(-327, 327, 2)
        pdo = decode(encode(field(torques[0], 0.2, 2), field(torques[1], 0.4, 3), 17))
        assert pdo.torque_nm == pytest.approx(tuple(torques), abs=0.00501)
        assert pdo.sigma_nm == pytest.approx((0.2, 0.4))
        assert (pdo.status, pdo.sequence) == ((2, 3), 17)


def test_contact_bytes() -> None:
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
    ("contact_nm", "code"), [(0.5, "positive"), (0.0, "positive"), (-0.5, "negative"), (nan, "unknown")]
)
def test_the_code_of_a_contact_is_the_sign_of_its_torque(contact_nm: float, code: str) -> None:
    assert CODE_NAMES[contact_field(0.0, contact_nm, CONTACT_PRESENT)[1]] == code


def test_contact_codes_have_the_names_of_the_protocol() -> None:
    names = ["off", "unknown", "none"]
    assert [CODE_NAMES[each] for each in (CONTACT_OFF, CONTACT_UNKNOWN, CONTACT_NONE)] == names
    assert sorted(CODE_NAMES) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("rate", "counts"), [(1e9, 127), (-1e9, -127), (math.inf, 127), (-math.inf, -127), (16.1, 1)]
)
def test_a_rate_beyond_the_field_stands_at_its_end_and_is_never_none(rate: float, counts: int) -> None:
    assert contact_field(rate, 0.0, CONTACT_NONE) == (counts, 2)


def test_a_contact_pdo_of_another_length_is_refused() -> None:
    with pytest.raises(struct.error):
        decode_contact(bytes(8))
