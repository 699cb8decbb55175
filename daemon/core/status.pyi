from typing import Any, Final, Protocol

from jtqd.daemon.config import Config, SafetySettings
from jtqd.estimator.detection import Plausibility
from jtqd.estimator.joint import Joint
from jtqd.estimator.settings import EstimatorSettings

NEEDED: Final[dict[int, int]]

class JointCounts(Protocol):
    """Where a joint counts: the loop's snapshot, or two arrays of its layout in a replay.

    counters: unsigned 64-bit words in the order of `counters.COUNTERS`; errors: of each joint two sums of squared errors
    [Nm^2] and the number of samples, float64.
    """

    counters: Any
    errors: Any

class JointStatus:
    def __init__(self, settings: SafetySettings) -> None: ...
    latched: Final[int]
    def update(self, status: int, found: int) -> int: ...
    def late(self) -> int: ...
    def reset_latch(self) -> bool: ...

class JointSafety:
    plausibility: Final[Plausibility | None]
    torque_limit_nm: Final[float]
    sigma_limit_nm: Final[float]
    def __init__(
        self,
        settings: SafetySettings | None = None,
        estimator: EstimatorSettings | None = None,
        joint: Joint | None = None,
        period_ns: int = 1_000_000,
        network: bool = False,
    ) -> None: ...

def safety_of(config: Config) -> list[JointSafety]: ...

class JointRules:
    def __init__(self, number: int, tally: JointCounts, safety: JointSafety, with_network: bool) -> None: ...
