from typing import Any, Final, Protocol

from jtqd.daemon.config import SafetySettings
from jtqd.daemon.core.joint_safety import JointSafety

NEEDED: Final[dict[int, int]]

class JointCounts(Protocol):
    """Where a joint counts: the loop's snapshot, or two arrays in a replay.

    Attributes:
        counters: unsigned 64-bit words in the order of `jtqd.daemon.shared.counters.COUNTERS`.
        errors: sum of squared errors and number of samples of each joint, float64.
    """

    counters: Any
    errors: Any

class JointStatus:
    def __init__(self, settings: SafetySettings) -> None: ...
    @property
    def latched(self) -> int: ...
    @property
    def latches(self) -> int: ...
    def update(self, status: int, found: int) -> int: ...
    def late(self) -> int: ...
    def reset_latch(self) -> bool: ...

class JointRules:
    def __init__(self, number: int, tally: JointCounts, safety: JointSafety, with_network: bool) -> None: ...
