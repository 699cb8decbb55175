from collections.abc import Sequence
from typing import Final

from jtqd.daemon.config import Config
from jtqd.daemon.core.input_pdos import JointInputs
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.status import JointCounts, JointSafety
from jtqd.estimator.estimator import Estimator

STAMP_ACCURACY_NS: Final[int]

class JointCycle:
    estimator: Final[Estimator]
    def __init__(
        self,
        number: int,
        inputs: JointInputs,
        estimator: Estimator,
        *,
        intake: Intake,
        snapshot: JointCounts,
        period_ns: int,
        safety: JointSafety | None = None,
        shadows: Sequence[Estimator] = (),
    ) -> None: ...
    inputs: Final[JointInputs]
    node_id: Final[int]
    status: Final[int]
    published: Final[tuple[int, int, int]]
    sample: Final[tuple[float, ...]]
    def begin_again(self) -> None: ...
    def trust(self, trusted: bool) -> None: ...
    def reset_latch(self) -> bool: ...
    def resume(self, motor_offset: int, link_offset: int) -> None: ...
    def rescale(self, node_id: int, factors: Sequence[float]) -> None: ...
    def withdraw(self, status: int) -> None: ...
    def observe(self, sync_ns: int, starting: bool, network_wanted: bool) -> None: ...
    def observe_shadows(self) -> None: ...

class ContactWatch:
    def __init__(
        self,
        thresholds_nm: Sequence[float],
        *,
        opposed: bool = False,
        sends: bool = True,
        period_s: float = 0.001,
    ) -> None: ...
    count: Final[int]
    sends: Final[bool]

def contacts_of(config: Config) -> ContactWatch | None: ...
