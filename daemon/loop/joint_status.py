"""From what each cycle says of a joint to the status that is published: bad at once, good only after a while. Pure.

The statuses have an order, from good to bad:

    2 valid, 6 standstill  <  3 degraded  <  1 starting  <  0 off  <  4 stale  <  15 invalid  <  5 drive fault

- A worse one is published in the cycle in which it arises. A better one only when some cycles in a row (`NEEDED`: of the
  status that is left) have asked for one; the worst that they asked for is then published.
- Standstill has a hysteresis of its own (speed) and is published at once in place of valid and degraded.
- A joint that falls back into a status without a number soon after it had left one (within RELAPSE times the cycles that it
  had to wait) waits twice as long each time, at most MOST times as long: an input that comes and goes makes a joint that is
  stale, not one that flickers. A single lost frame costs little.
- A fault that is latched (`safety.latch`) stays until `reset_latch()`: its status, or a worse one, is published whatever
  the inputs say. Status 5, 4 or 15, see `daemon.shared.faults.status_of`.

No clock and no randomness: the same statuses and faults give the same answer again, in the loop and from a log.
"""

from __future__ import annotations

from typing import Final

from daemon.safety_settings import SafetySettings
from daemon.shared import faults
from estimator import status as st

NEEDED: Final = {
    st.DEGRADED: 100,
    st.STARTING: 1,
    st.OFF: 20,
    st.STALE: 5,
    st.INVALID: 50,
    st.DRIVE_FAULT: 100,
}
"""Cycles in a row that must be better before this status is left; the last of them is published already."""
RELAPSE: Final = 10
MOST: Final = 4

_ORDER: Final = (
    st.VALID,
    st.STANDSTILL,
    st.DEGRADED,
    st.STARTING,
    st.OFF,
    st.STALE,
    st.INVALID,
    st.DRIVE_FAULT,
)
_RANK: Final = tuple(_ORDER.index(code) if code in _ORDER else len(_ORDER) for code in range(16))
_STANDS: Final = _RANK[st.STANDSTILL]
_WITH_NUMBER: Final = _RANK[st.DEGRADED]
"""Up to this rank a torque is published."""


class JointStatus:
    """State of one joint.

    Attributes:
        latched: bits of the faults that are latched (`daemon/shared/faults.py`).
        reasons: faults since a number was last published; 0 while one is.
        news, latches: faults that began, and how often one was latched, since whoever counts them set these to 0.
    """

    __slots__ = (
        "_asked",
        "_calm",
        "_factor",
        "_found",
        "_held",
        "_latching",
        "_needed",
        "_run",
        "_since",
        "_stale_limit",
        "_window",
        "latched",
        "latches",
        "news",
        "reasons",
    )

    def __init__(self, settings: SafetySettings) -> None:
        self.use(settings)
        self._held = st.STARTING
        self._asked = st.VALID
        self._needed = NEEDED[st.STARTING]
        self._calm = self._run = 0
        self._factor = 1
        self._since = self._window = 0
        self._found = 0
        self.latched = self.latches = self.news = self.reasons = 0

    def use(self, settings: SafetySettings) -> None:
        """From now on these faults are latched; what is held and latched stays."""
        self._latching, self._stale_limit = settings.latch, settings.stale_latch_cycles

    def update(self, status: int, found: int = 0) -> int:
        """Status to publish in a cycle that asks for `status` and has the faults `found` (`daemon/shared/faults.py`)."""
        self._since += 1
        if status == self._held and not found and not self.latched and _RANK[status] <= _WITH_NUMBER:
            self._calm = self._run = self._found = 0
            return status
        if found:
            self.news |= found & ~self._found
            self.reasons |= found
        self._found = found
        if found and _RANK[status] < _RANK[st.INVALID]:
            status = st.INVALID
        if status == st.STALE:
            found |= self._another()
        else:
            self._run = 0
            found |= faults.DRIVE_FAULT if status == st.DRIVE_FAULT else 0
        return self._publish(status, found)

    def pass_over(self, cycles: int) -> None:
        """So many more cycles like the last, which asked for the status that it got: with a number or off, no fault."""
        self._since += cycles

    def late(self) -> int:
        """The estimate of this cycle, whose status `update` has given, was not ready in time: status to publish."""
        return self._publish(st.STALE, self._another())

    def reset_latch(self) -> bool:
        """Release what is latched; a fault that is still there latches again in the next cycle. True if anything was."""
        was, self.latched = self.latched, 0
        return bool(was)

    def _another(self) -> int:
        """One more cycle in a row without a number; the fault STALE when there have been too many."""
        self._run += 1
        return faults.STALE if self._stale_limit is not None and self._run >= self._stale_limit else 0

    def _publish(self, status: int, found: int) -> int:
        new = found & self._latching & ~self.latched
        if new:
            self.latched |= new
            self.latches += 1
        if self.latched:
            status = _worse(status, faults.status_of(self.latched))
        held = self._held
        rank, worst = _RANK[status], _RANK[held]
        if rank > worst:
            self._fall(status)
        if rank >= worst or worst <= _STANDS:
            self._held, self._calm = status, 0
            return status
        self._asked = _worse(status, self._asked) if self._calm else status
        self._calm += 1
        if self._calm < self._needed:
            return status if status == st.STANDSTILL and worst <= _WITH_NUMBER else held
        self._rise(self._asked)
        return self._asked

    def _fall(self, status: int) -> None:
        """A worse status than the one that is held begins."""
        if _RANK[self._held] <= _WITH_NUMBER < _RANK[status]:
            self._factor = min(2 * self._factor, MOST) if self._since < self._window else 1
        self._needed = self._cycles(status)

    def _rise(self, status: int) -> None:
        """The held status is left for a better one."""
        if _RANK[status] <= _WITH_NUMBER < _RANK[self._held]:
            self._since, self._window = 0, RELAPSE * self._needed
        if _RANK[status] <= _WITH_NUMBER:
            self.reasons = 0
        self._held, self._calm = status, 0
        self._needed = self._cycles(status)

    def _cycles(self, status: int) -> int:
        """How long a status is held."""
        needed = NEEDED.get(status, 1)
        return needed if _RANK[status] <= _WITH_NUMBER else needed * self._factor


def _worse(a: int, b: int) -> int:
    return a if _RANK[a] >= _RANK[b] else b
