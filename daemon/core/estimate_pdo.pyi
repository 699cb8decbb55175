import struct
from typing import NamedTuple

LAYOUT: struct.Struct
NO_TORQUE: int
TORQUE_UNIT_NM: float
SIGMA_UNIT_NM: float
SIGMA_UNKNOWN: int
STATUS_INVALID: int
PUBLISHED_STATUSES: frozenset[int]

class EstimatePdo(NamedTuple):
    torque_nm: tuple[float | None, float | None]
    sigma_nm: tuple[float | None, float | None]
    status: tuple[int, int]
    sequence: int

def field(torque_nm: float, sigma_nm: float, status: int) -> tuple[int, int, int]: ...
def encode(one: tuple[int, int, int], two: tuple[int, int, int], sequence: int) -> bytes: ...
def decode(data: bytes) -> EstimatePdo: ...
