"""The memory of the running jtqd that an arm's joints belong to: found by bus, read-only, found again after a restart."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from jtqd.daemon.arm.arm_file import JointSource
from jtqd.daemon.cli.running import find_daemons, on_bus
from jtqd.daemon.shared.cycle_record import RingReader, layout_of
from jtqd.daemon.shared.runtime_dir import About, SharedMemoryError
from jtqd.estimator.decoder import FieldError
from jtqd.estimator.text import counted

RETRY_NS: Final = 500_000_000
"""Between two looks for a jtqd that is not there; one that is silent for so long is looked at."""


class Source:
    """The records of the jtqd on `bus`. joints: of the arm that are its joints, by name; times: CLOCK_MONOTONIC [ns]."""

    def __init__(self, bus: str, joints: Mapping[str, JointSource]) -> None:
        self.bus, self.joints = bus, joints
        self.about: About | None = None
        """What is read now; None where nothing is."""
        self.why = ""
        """Why nothing is read."""
        self.lost = 0
        """Cycles that the ring overwrote before they were read."""
        self._ring: RingReader | None = None
        self._due_ns = 0

    def read(self, now_ns: int) -> list[bytes]:
        """Return the new cycle records.

        Raises FieldError for a jtqd that does not have so many joints.
        """
        if self._ring is None:
            if now_ns < self._due_ns:
                return []
            self._due_ns = now_ns + RETRY_NS
            self._open()
            return []
        batch = self._ring.read(self._ring.backlog)
        self.lost += batch.lost
        if batch.records:
            self._due_ns = now_ns + RETRY_NS
            return batch.records
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + RETRY_NS
            if self.about is not None and not self.about.running():
                self.about = self._ring = None
                self.why = f"jtqd on {self.bus} has ended"
        return []

    def _open(self) -> None:
        """Open the ring of the jtqd that runs on the bus now, behind its newest record."""
        search = find_daemons()
        daemon = on_bus(search, self.bus)
        if daemon is None:
            hidden = counted(len(search.closed) + len(search.foreign), "directory", "directories")
            self.why = f"no jtqd runs on {self.bus} ({hidden} of other users not read)"
            return
        count = len(daemon.about.joints)
        for name, joint in self.joints.items():
            if joint.joint > count:
                expected = f"at most {count}: jtqd on {self.bus} has {counted(count, 'joint')}"
                raise FieldError("arm", f"joints.{name}.joint", joint.joint, expected)
        for shadow in (False, True):
            try:
                ring = RingReader(daemon.directory / "ring", layout_of(count, shadow).size)
            except SharedMemoryError as error:
                self.why = str(error)
                continue
            ring.position += ring.backlog
            self._ring, self.about, self.why = ring, daemon.about, ""
            return
