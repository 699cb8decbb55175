"""What one joint counts: why its network was dropped, its faults, and its squared errors against the sensor."""

from __future__ import annotations

from typing import Any, Final, Protocol

from daemon.loop.joint_status import JointStatus
from daemon.shared import faults
from daemon.shared.snapshot import COUNTERS
from estimator import status as st

FLAG_NETWORK_SKIPPED, FLAG_LATCHED = 0x10, 0x20
"""Bits of `input_flags`: no time for the network; a fault is latched. Bits 8 to 15: low byte of
`daemon/shared/faults.py`."""

_FALLBACKS, _LATCHES = COUNTERS.index("network_fallbacks"), COUNTERS.index("latches")
_NOT_FINITE, _FAR, _OUTSIDE, _NO_TIME = (
    COUNTERS.index(f"network_{why}") for why in ("not_finite", "far", "outside", "no_time")
)
_FAULTS: Final = tuple((bit, COUNTERS.index(f"fault_{faults.NAMES[bit]}")) for bit in faults.COUNTED)


class Tally(Protocol):
    """Where a joint counts: the loop's snapshot, or two lists in a replay.

    Attributes:
        counters: in the order of `daemon.shared.snapshot.COUNTERS`.
        errors: sum of squared errors and number of samples of each joint.
    """

    counters: Any
    errors: Any


class JointTally:
    """Counts of joint `number` (0 or 1)."""

    __slots__ = ("_counters", "_errors", "_number")

    def __init__(self, number: int, tally: Tally) -> None:
        self._counters, self._errors = tally.counters, tally.errors
        self._number = number

    def faults(self, state: JointStatus) -> int:
        """Count the faults that are new in this cycle; return the flags that tell why there is no number."""
        counters = self._counters
        new = state.news
        if new:
            for bit, index in _FAULTS:
                if new & bit:
                    counters[index] += 1
            state.news = 0
        flags = (state.reasons & 0xFF) << 8
        if state.latched:
            counters[_LATCHES] += state.latches
            state.latches = 0
            flags |= FLAG_LATCHED | (state.latched & 0xFF) << 8
        return flags

    def network(
        self, status: int, wanted: bool, network_nm: float, physics_nm: float, limit_nm: float
    ) -> None:
        """A cycle in which the network is not, or not alone, in charge (status 3), or gave no number."""
        counters = self._counters
        if status == st.DEGRADED:
            counters[_FALLBACKS] += 1
        if not wanted:
            counters[_NO_TIME] += 1
        elif network_nm - network_nm != 0.0:
            counters[_NOT_FINITE] += 1
        elif abs(network_nm - physics_nm) > limit_nm:
            counters[_FAR] += 1
        else:
            counters[_OUTSIDE] += 1

    def error(self, difference_nm: float) -> None:
        """A published estimate minus the sensor's torque."""
        number, errors = self._number, self._errors
        errors[2 * number] += difference_nm**2
        errors[2 * number + 1] += 1.0
