"""A snapshot as a loop leaves it: an estimate written from Python, and an intake whose counts are read from it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jtqd.daemon.core.cycle import SnapshotWriter
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.shared import snapshot as shared
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.cycle_record import MOST_JOINTS
from jtqd.daemon.shared.snapshot import NOT_MEASURED, Snapshot, SnapshotReader, View


class EstimateWriter:
    """Writes the last estimate as the loop does, guarded by the sequence number."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self._status, self._since = [-1] * MOST_JOINTS, [0] * MOST_JOINTS

    def begin(self) -> None:
        """Mark the snapshot as inconsistent until the end of `write`."""
        self.snapshot.sequence[0] |= 1

    def write(
        self,
        cycle: int,
        sync_counter: int,
        sync_realtime_ns: int,
        joints: Sequence[Sequence[float]],
        *,
        sync_monotonic_ns: int = 0,
        measured: Sequence[Sequence[Any]] = (NOT_MEASURED,) * MOST_JOINTS,
    ) -> None:
        """Write `JointView`s, and what begins with the fields of `Measured`."""
        self.begin()
        block = self.snapshot.estimate
        for n, joint in enumerate(joints):
            if joint[7] != self._status[n]:
                self._status[n], self._since[n] = int(joint[7]), cycle
            shared.JOINT.pack_into(
                block, shared.ESTIMATE.size + n * shared.JOINT.size, *shared.JointView(*joint)
            )
            at = shared.ESTIMATE.size + MOST_JOINTS * shared.JOINT.size + n * shared.MEASURED.size
            shared.MEASURED.pack_into(block, at, *measured[n][:6])
        shared.ESTIMATE.pack_into(
            block, 0, cycle, sync_counter, sync_realtime_ns, sync_monotonic_ns, *self._since
        )
        self.snapshot.sequence[0] += 1


class _NoBus:
    tx_dropped = rx_dropped = 0

    def fileno(self) -> int:
        return -1


class IntakeSeen:
    """What a snapshot shows of an intake that counts in it."""

    def __init__(self, directory: Path, intake: Intake) -> None:
        self.intake = intake
        self._writer = SnapshotWriter(Snapshot(directory / "snapshot", 1e-3, 0.8), intake, _NoBus())  # type: ignore[arg-type]
        self._reader = SnapshotReader(directory / "snapshot")

    def view(self) -> View:
        """Return the snapshot after a flush."""
        self._writer.flush(0, 0)
        return self._reader.read()


def counted(intake: Intake) -> dict[str, int]:
    """Return the counters of an intake by name."""
    return dict(zip(COUNTERS, intake.counters, strict=True))
