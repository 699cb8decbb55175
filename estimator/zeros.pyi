from typing import Final

MOVING_RAD_S: Final = 0.05
ONE_WAY: Final = 0.9
BLOCK: Final = 16
CORRELATION_S: Final = 0.3
DOUBT: Final = 2.0
SURE: Final = 4.0
COVERED: Final = 0.5
SLEW_S: Final = 0.25
LARGEST_LINK: Final = 0.3
CURRENT_SHARE: Final = 0.2
LEAST_GAIN: Final = 0.03
FRICTION_SHARE: Final = 0.2
DRIFT_S: Final = 600.0
JUMP: Final = 4.0
JUMP_S: Final = 0.3
KNOWN_SHARE: Final = 0.5
