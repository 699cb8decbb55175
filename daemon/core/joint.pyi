from collections.abc import Sequence
from typing import Final

from jtqd.daemon.config import Config
from jtqd.daemon.core.input_pdos import JointInputs
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.status import JointCounts, JointSafety
from jtqd.estimator.methods import AnyEstimator

STAMP_ACCURACY_NS: Final[int]

class JointCycle:
    estimator: Final[AnyEstimator]
    def __init__(
        self,
        number: int,
        inputs: JointInputs,
        estimator: AnyEstimator,
        *,
        intake: Intake,
        snapshot: JointCounts,
        period_ns: int,
        safety: JointSafety | None = None,
    ) -> None: ...
    @property
    def inputs(self) -> JointInputs: ...
    @property
    def node_id(self) -> int: ...
    @property
    def status(self) -> int: ...
    @property
    def published(self) -> tuple[int, int, int]: ...
    @property
    def sample(self) -> tuple[float, ...]: ...
    def begin_again(self) -> None: ...
    def reset_latch(self) -> bool: ...
    def resume(self, motor_offset: int, link_offset: int) -> None: ...
    def rescale(self, node_id: int, factors: Sequence[float]) -> None: ...
    def withdraw(self, status: int) -> None: ...
    def observe(self, sync_ns: int, starting: bool, network_wanted: bool) -> None: ...

class ContactWatch:
    def __init__(
        self,
        thresholds_nm: Sequence[float],
        *,
        opposed: bool = False,
        sends: bool = True,
        period_s: float = 0.001,
    ) -> None: ...
    @property
    def count(self) -> int: ...
    @property
    def sends(self) -> bool: ...

def contacts_of(config: Config) -> ContactWatch | None: ...
