import struct
from typing import NamedTuple

LAYOUT: struct.Struct
NO_RATE: int
RATE_UNIT_NM_S: float
POSITIVE: int
NEGATIVE: int
CODE_NAMES: dict[int, str]

class ContactPdo(NamedTuple):
    torque_rate_nm_s: tuple[float | None, float | None]
    contact: tuple[int, int]
    sequence: int

def field(torque_rate_nm_s: float, contact_nm: float, state: int) -> tuple[int, int]: ...
def encode(one: tuple[int, int], two: tuple[int, int], sequence: int) -> bytes: ...
def decode(data: bytes) -> ContactPdo: ...
