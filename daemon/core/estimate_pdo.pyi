import struct
from typing import NamedTuple

LAYOUT: struct.Struct
NO_TORQUE: int
TORQUE_UNIT_NM: float
SIGMA_UNIT_NM: float
SIGMA_UNKNOWN: int
PUBLISHED_STATUSES: frozenset[int]
NO_RATE: int
RATE_UNIT_NM_S: float
CODE_NAMES: dict[int, str]

class EstimatePdo(NamedTuple):
    torque_nm: tuple[float | None, float | None]
    sigma_nm: tuple[float | None, float | None]
    status: tuple[int, int]
    sequence: int

class ContactPdo(NamedTuple):
    torque_rate_nm_s: tuple[float | None, float | None]
    contact: tuple[int, int]
    sequence: int

def field(torque_nm: float, sigma_nm: float, status: int) -> tuple[int, int, int]: ...
def encode(one: tuple[int, int, int], two: tuple[int, int, int], sequence: int) -> bytes: ...
def decode(data: bytes) -> EstimatePdo: ...
def contact_field(torque_rate_nm_s: float, contact_nm: float, state: int) -> tuple[int, int]: ...
def encode_contact(one: tuple[int, int], two: tuple[int, int], sequence: int) -> bytes: ...
def decode_contact(data: bytes) -> ContactPdo: ...
