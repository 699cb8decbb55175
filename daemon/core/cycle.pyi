from collections.abc import Sequence
from typing import Final

from jtqd.daemon.core.input_pdos import JointInputs
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.core.joint import ContactWatch, JointCycle
from jtqd.daemon.core.schedule import Clock, Grid
from jtqd.daemon.core.status import JointSafety
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.snapshot import Snapshot
from jtqd.drivers.frame_socket import FrameSocket
from jtqd.estimator.estimator import Estimator

STARTING_CYCLES: Final[int]
CYCLE_ENDED: Final[int]
SLOT_PASSED: Final[int]
RUN_ENDED: Final[int]
clock: Clock

class SnapshotWriter:
    def __init__(self, snapshot: Snapshot, intake: Intake, socket: FrameSocket) -> None: ...
    def flush(self, missed: int, sync_ns: int) -> int: ...

def frame_counts(intake: Intake) -> dict[str, dict[str, int]]: ...

class ConfiguredNodes:
    def __init__(self, snapshot: Snapshot, intake: Intake, joints: Sequence[JointCycle]) -> None: ...
    def look(self) -> None: ...
    def doubt(self) -> None: ...

class Cycle:
    intake: Final[Intake]
    grid: Final[Grid]
    joints: Final[tuple[JointCycle, ...]]
    snapshot: Final[Snapshot]
    configured_nodes: Final[ConfiguredNodes]
    late_ns: int
    work_start_ns: int
    def __init__(
        self,
        socket: FrameSocket,
        intake: Intake,
        joints: Sequence[tuple[JointInputs, Estimator]],
        ring: Ring,
        snapshot: Snapshot,
        *,
        safety: Sequence[JointSafety] | None = None,
        node_id: int,
        counter_overflow: int,
        wait_ns: int,
        deadline_ns: int,
        heartbeat_cycles: int,
        grid: Grid,
        contacts: ContactWatch | None = None,
        shadows: Sequence[Sequence[Estimator]] = (),
    ) -> None: ...
    index: Final[int]
    counter: Final[int]
    flags: Final[int]
    sync_ns: Final[int]
    sent_ns: Final[int]
    def go_on(self, slots: int, end_ns: int) -> int: ...
    def reset_communication(self) -> int: ...
    def begin(self) -> None: ...
    def gather(self) -> None: ...
    def observe(self) -> None: ...
    def publish(self) -> None: ...
    def record(self) -> None: ...
    def pass_slot(self) -> bool: ...
    def skip(self, slots: int) -> None: ...
    def reset_faults(self) -> None: ...
    def leave(self) -> None: ...
    def write_snapshot(self) -> int: ...
