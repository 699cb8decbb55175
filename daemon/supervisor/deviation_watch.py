"""A warning when an estimate stays further from the torque sensor than its sigma allows: one of the two is wrong.

Pure: readings of the snapshot and times in, lines out. It runs in the supervisor, beside the loop.
"""

from __future__ import annotations

from math import inf, isfinite

from daemon.shared.snapshot import JointView, View
from estimator.status import PUBLISHED

FAR, NEAR = 3.0, 2.0
"""An episode begins beyond FAR times sigma and ends within NEAR: on the edge it does not begin again and again."""
LASTING_S = 1.0
"""Both must last so long: delays and friction at a reversal are over sooner."""
_GAP_S = 0.5
"""Readings further apart say nothing about the time between them."""


class _Joint:
    """One joint's episode, and since when the readings have been asking for a change."""

    def __init__(self) -> None:
        self.far = False
        self.since_s = inf
        self.last_s = -inf


class DeviationWatch:
    """Call `lines` with each reading of the snapshot, some twenty times a second.

    Attributes:
        episodes: how many there were of joint 1 and 2.
    """

    def __init__(self) -> None:
        self.episodes = [0, 0]
        self._joints = (_Joint(), _Joint())
        self._cycle = -1

    def lines(self, view: View, now_s: float) -> list[str]:
        """One line for each episode that begins now (CLOCK_MONOTONIC)."""
        if view.cycle == self._cycle:
            return []
        self._cycle = view.cycle
        said = []
        for n, (joint, seen) in enumerate(zip(self._joints, view.joints, strict=True)):
            if _update(joint, _sigmas(seen), now_s) and joint.far:
                self.episodes[n] += 1
                said.append(
                    f"joint {n + 1}: the estimate has been more than {FAR:g} sigma away from the torque sensor for "
                    f"{LASTING_S:g} s: {seen.torque_nm:.2f} Nm against {seen.sensor_nm:.2f} Nm, "
                    f"sigma {seen.sigma_nm:.2f} Nm"
                )
        return said


def _sigmas(seen: JointView) -> float | None:
    """Distance between estimate and sensor in sigmas; None where one of them is missing."""
    difference = abs(seen.torque_nm - seen.sensor_nm)
    if seen.status not in PUBLISHED or not isfinite(difference) or not seen.sigma_nm > 0.0:
        return None
    return difference / seen.sigma_nm


def _update(joint: _Joint, sigmas: float | None, now_s: float) -> bool:
    """Take in a reading; True when an episode begins or ends. One without a number is passed over."""
    if sigmas is None:
        return False
    asks = sigmas < NEAR if joint.far else sigmas > FAR
    if not asks:
        joint.since_s = inf
    elif joint.since_s == inf or now_s - joint.last_s > _GAP_S:
        joint.since_s = now_s
    joint.last_s = now_s
    if not asks or now_s - joint.since_s < LASTING_S:
        return False
    joint.far, joint.since_s = not joint.far, inf
    return True
