"""New estimators beside the running ones: stepped through the very same inputs, which the ring of cycles holds."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, isnan
from pathlib import Path
from typing import Any, Final

from jtqd.daemon.core.estimate_pdo import PUBLISHED_STATUSES
from jtqd.daemon.shared import cycle_record as cr
from jtqd.daemon.shared.cycle_record import FLAG_MOTION, FLAG_NETWORK_SKIPPED, FLAG_POSITION
from jtqd.daemon.shared.ring import RingReader
from jtqd.estimator.sample import Estimator
from jtqd.estimator.status import Estimate

_INPUTS: Final = FLAG_POSITION | FLAG_MOTION
_SETTLED_S: Final = 0.5
"""After the first cycle seen: from here on the two estimates are compared."""
_INVALID_SHARE: Final = 0.5


def follow(estimator: Estimator, record: cr.JointRecord) -> Estimate | None:
    """Step an estimator as the loop has stepped its own in this cycle; None: it has not."""
    if record.input_flags & _INPUTS != _INPUTS:
        return None
    link = record.link_position_rad
    if isnan(link):  # one encoder: as `JointCycle`
        link = record.motor_position_rad / estimator.joint.gear_ratio
    return estimator.step(
        record.dt_s,
        record.current_a,
        record.motor_position_rad,
        record.motor_velocity_rad_s,
        link,
        record.temperature_c,
        not record.input_flags & FLAG_NETWORK_SKIPPED,
    )


class _Joint:
    """One joint's new estimator and how far it is from the running one."""

    def __init__(self, estimator: Estimator) -> None:
        self.estimator = estimator
        self.seen_s = 0.0
        self.compared = self.published = self.invalid = 0
        self.square = self.largest = 0.0

    def step(self, record: cr.JointRecord) -> None:
        found = follow(self.estimator, record)
        if found is None:
            return
        self.seen_s += record.dt_s
        if self.seen_s < _SETTLED_S or record.status not in PUBLISHED_STATUSES:
            return
        self.published += 1
        self.invalid += not isfinite(found.torque_nm)
        change = found.torque_nm - record.torque_nm
        if isfinite(change):
            self.compared += 1
            self.square += change * change
            self.largest = max(self.largest, abs(change))

    def content(self) -> dict[str, Any]:
        rms = (self.square / self.compared) ** 0.5 if self.compared else None
        return {
            "cycles": self.compared,
            "rms_change_nm": rms,
            "max_change_nm": self.largest if self.compared else None,
        }


class Shadow:
    """Steps the estimators of joint 1, 2, ... through what the ring at `path` holds, from its oldest record on.

    Raises:
        jtqd.daemon.shared.ring.RingError: there is no such ring.
    """

    def __init__(self, path: Path, estimators: Sequence[Estimator]) -> None:
        self._reader = RingReader(path, cr.layout_of(len(estimators)).size)
        self._joints = [_Joint(estimator) for estimator in estimators]
        self.cycles = 0

    @property
    def position(self) -> int:
        """Return the position in the ring of the first record that has not been seen."""
        return self._reader.position

    def catch_up(self, limit: int = 64) -> None:
        """Step through all records, `limit` at a time."""
        while self._reader.backlog:
            batch = self._reader.read(limit)
            for record in batch.records:
                for number, joint in enumerate(self._joints, start=1):
                    joint.step(cr.joint_of(record, number))
            self.cycles += len(batch.records)

    def objection(self) -> str | None:
        """Return why these estimators must not come into force: most estimates that are valid now would be invalid."""
        for number, joint in enumerate(self._joints, start=1):
            if joint.published and joint.invalid > _INVALID_SHARE * joint.published:
                return (
                    f"joint {number}: {joint.invalid} of {joint.published} estimates that are published now "
                    "would be invalid with the new files"
                )
        return None

    def changes(self) -> dict[str, dict[str, Any]]:
        """Return the RMS and the largest difference of the new estimates of each joint [Nm]."""
        return {f"joint_{number}": joint.content() for number, joint in enumerate(self._joints, start=1)}
