"""New estimators beside a running loop: they are stepped through the ring of its cycles until they have seen what it has."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from daemon.loop.estimate_pdo import PUBLISHED_STATUSES
from daemon.loop.joint_cycle import FLAG_MOTION, FLAG_NETWORK_SKIPPED, FLAG_POSITION
from daemon.shared import cycle_record as cr
from daemon.shared.ring import RingReader
from estimator.methods import AnyEstimator
from estimator.status import INVALID

_INPUTS = FLAG_POSITION | FLAG_MOTION
_SETTLED_S = 0.5
"""After the first cycle seen: from here on the two estimates are compared."""
_INVALID_SHARE = 0.5


class _Joint:
    """One joint's new estimator and how far it is from the running one."""

    def __init__(self, estimator: AnyEstimator) -> None:
        self.estimator = estimator
        self.seen_s = 0.0
        self.compared = self.published = self.invalid = 0
        self.square = self.largest = 0.0

    def step(self, record: cr.JointRecord) -> None:
        if record.input_flags & _INPUTS != _INPUTS:
            return  # the running loop has not stepped either
        given = (
            record.dt_s,
            record.current_a,
            record.motor_position_rad,
            record.motor_velocity_rad_s,
            record.link_position_rad,
            record.temperature_c,
        )
        found = self.estimator.step(*given, not record.input_flags & FLAG_NETWORK_SKIPPED)
        self.seen_s += record.dt_s
        if self.seen_s < _SETTLED_S or record.status not in PUBLISHED_STATUSES:
            return
        self.published += 1
        self.invalid += found.status == INVALID
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
    """Steps the estimators of joint 1 and 2 through what the ring at `path` holds, from its oldest record on.

    Raises:
        daemon.shared.ring.RingError: there is no such ring.
    """

    def __init__(self, path: Path, estimators: Sequence[AnyEstimator]) -> None:
        self._reader = RingReader(path, cr.RECORD_SIZE)
        self._joints = [_Joint(estimator) for estimator in estimators]
        self.cycles = 0

    def follow(self, limit: int = 64) -> int:
        """Step through at most `limit` records; returns how many are left."""
        batch = self._reader.read(limit)
        for record in batch.records:
            for number, joint in enumerate(self._joints, start=1):
                joint.step(cr.joint_of(record, number))
        self.cycles += len(batch.records)
        return self._reader.backlog

    def catch_up(self) -> None:
        """Step through all there is."""
        while self.follow():
            pass

    def objection(self) -> str | None:
        """Why these estimators must not take over: most of what is valid now would be invalid with them."""
        for number, joint in enumerate(self._joints, start=1):
            if joint.published and joint.invalid > _INVALID_SHARE * joint.published:
                return (
                    f"joint {number}: {joint.invalid} of {joint.published} estimates that are published now "
                    "would be invalid with the new files"
                )
        return None

    def changes(self) -> dict[str, dict[str, Any]]:
        """What the new estimators would have said otherwise: RMS and largest difference of each joint [Nm]."""
        return {f"joint_{number}": joint.content() for number, joint in enumerate(self._joints, start=1)}
