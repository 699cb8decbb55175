from typing import Final

PERIOD_S: Final = 20.0
BURSTS: Final[tuple[tuple[float, float, tuple[float, ...]], ...]]
LOADS: Final[tuple[tuple[float, float], ...]]
LOAD_RISE_S: Final = 2.0

def demo_velocity(time_s: float) -> float: ...
def demo_current(time_s: float) -> float: ...
