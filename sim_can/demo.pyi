from typing import Final

PERIOD_S: Final[float]
BURSTS: Final[tuple[tuple[float, float, tuple[float, ...]], ...]]
LOADS: Final[tuple[tuple[float, float], ...]]
LOAD_RISE_S: Final[float]

def demo_velocity(time_s: float) -> float: ...
def demo_current(time_s: float) -> float: ...
