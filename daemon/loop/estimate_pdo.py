"""The estimate PDO of node 20h (COB-ID 1A0h): eight bytes that never carry a stale or unfounded number.

    torque_1 I16 0.01 Nm | torque_2 I16 | sigma_1 U8 0.05 Nm | sigma_2 U8 | status U8 (two nibbles) | sequence U8

Torque is sent only with status 2 (valid), 3 (degraded) and 6 (standstill); with any other status, outside the range of
the field, or with a sigma that is none (not finite, negative), it is 8000h and sigma is 255. Sigma is rounded up, so that
the interval on the wire is never narrower; 255 beside a torque means more than 12.7 Nm.
"""

from __future__ import annotations

import struct
from math import ceil, inf
from typing import NamedTuple

LAYOUT = struct.Struct("<hhBBBB")
NO_TORQUE = -0x8000
TORQUE_UNIT_NM = 0.01
SIGMA_UNIT_NM = 0.05
SIGMA_UNKNOWN = 255
STATUS_INVALID = 15
PUBLISHED_STATUSES = frozenset((2, 3, 6))
_TORQUE_LIMIT = 32767


class EstimatePdo(NamedTuple):
    """Decoded content; torque and sigma are None where the PDO says that there is none."""

    torque_nm: tuple[float | None, float | None]
    sigma_nm: tuple[float | None, float | None]
    status: tuple[int, int]
    sequence: int


def field(torque_nm: float, sigma_nm: float, status: int) -> tuple[int, int, int]:
    """Return the integers (torque, sigma, status) of one joint; an invalid torque or sigma becomes status 15."""
    if status not in PUBLISHED_STATUSES:
        return NO_TORQUE, SIGMA_UNKNOWN, status
    counts = torque_nm * 100.0
    if not (-_TORQUE_LIMIT <= counts <= _TORQUE_LIMIT and 0.0 <= sigma_nm < inf):  # also false for NaN
        return NO_TORQUE, SIGMA_UNKNOWN, STATUS_INVALID
    # A sigma of 12.70 Nm must not become 255 by the rounding of 12.7 / 0.05.
    steps = ceil(sigma_nm * 20.0 - 1e-9) if sigma_nm <= 12.7 else SIGMA_UNKNOWN
    return round(counts), steps, status


def encode(one: tuple[int, int, int], two: tuple[int, int, int], sequence: int) -> bytes:
    """Encode eight bytes from the `field`s of both joints and the SYNC counter of the inputs."""
    return LAYOUT.pack(one[0], two[0], one[1], two[1], one[2] | two[2] << 4, sequence)


def decode(data: bytes) -> EstimatePdo:
    """Decode the eight bytes; raises struct.error on any other length."""
    torque_1, torque_2, sigma_1, sigma_2, status, sequence = LAYOUT.unpack(data)

    def torque(counts: int) -> float | None:
        return None if counts == NO_TORQUE else counts * TORQUE_UNIT_NM

    def sigma(steps: int) -> float | None:
        return None if steps == SIGMA_UNKNOWN else steps * SIGMA_UNIT_NM

    return EstimatePdo(
        (torque(torque_1), torque(torque_2)),
        (sigma(sigma_1), sigma(sigma_2)),
        (status & 0x0F, status >> 4),
        sequence,
    )
