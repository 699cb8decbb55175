from typing import Final, NamedTuple

MOVING_RAD_S: Final = 0.05
ONE_WAY: Final = 0.9
BLOCK: Final = 16
CORRELATION_S: Final = 0.3
DOUBT: Final = 2.0
SURE: Final = 4.0
SLEW_S: Final = 0.25
LARGEST_LINK: Final = 0.3
CURRENT_SHARE: Final = 0.2
LEAST_GAIN: Final = 0.01
DRIFT_S: Final = 600.0
JUMP: Final = 4.0
JUMP_S: Final = 0.3
KNOWN_SHARE: Final = 0.5
TRACKED: int
LEARNED: int
BEYOND: int
LEFT: int
APART: int

class Zeros(NamedTuple):
    link_rad: float
    link_sigma_rad: float
    link_used_rad: float
    current_a: float
    current_sigma_a: float
    current_used_a: float
    limit_rad: float
    flags: int
    jumps: int
    @property
    def tracked(self) -> bool: ...
    @property
    def learned(self) -> bool: ...
    @property
    def plausible(self) -> bool: ...
