from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from jtqd.daemon.arm.arm_file import JointSource
from jtqd.estimator.arrays import FloatArray, StatusArray

BRIDGED_PERIODS: Final[int]
WAITED_PERIODS: Final[int]

class Aligned(NamedTuple):
    instant_ns: int
    position_rad: FloatArray
    torque_nm: FloatArray
    sigma_nm: FloatArray
    status: StatusArray

class Bus:
    def __init__(self, sources: Mapping[int, JointSource], period_ns: int) -> None: ...
    def take(self, records: Sequence[bytes]) -> None: ...

class Aligner:
    def __init__(self, buses: Sequence[Bus], period_ns: int) -> None: ...
    def ready(self, now_ns: int) -> list[Aligned]: ...
