"""When a set-point is due: SYNC sets the pace, our own clock once SYNC is lost. Pure; times are CLOCK_MONOTONIC in ns."""

from __future__ import annotations

from typing import Final

from sysid.motion.result import Timing, Violation
from sysid.motion.setpoints import PERIOD_S

PERIOD_NS: Final = round(PERIOD_S * 1e9)
UNPACED_NS: Final = 2 * PERIOD_NS
"""Period of our own clock while there is no SYNC."""
LARGEST_ADVANCE: Final = 4
"""Set-points passed over after lost cycles, at most: what is lost beyond that makes the motion longer, never a jump."""


class Pace:
    """Follows SYNC. `synced`: it runs; `pending`: its newest one has not had its set-point."""

    def __init__(self, timing: Timing, now_ns: int) -> None:
        self.synced = False
        self.pending = False
        self._timing = timing
        self._newest_ns = now_ns  # SYNC, or our own beat while there is none
        self._slots = 0
        self._delay_ns = round(timing.setpoint_delay_s * 1e9)
        self._lost_ns = round(timing.sync_lost_s * 1e9)
        self._late_ns = round(timing.late_s * 1e9)

    @property
    def wake_ns(self) -> int:
        """When the frames of the present cycle, or else of the next one, should all have come; 0: nobody knows."""
        if not self.synced:
            return 0
        return self._newest_ns + self._delay_ns + (0 if self.pending else PERIOD_NS)

    @property
    def due_ns(self) -> int:
        """When something must happen although no frame comes."""
        if not self.synced:
            return self._newest_ns + UNPACED_NS
        return self._newest_ns + (self._delay_ns if self.pending else self._lost_ns)

    def on_sync(self, t_ns: int, now_ns: int) -> Violation | None:
        """A SYNC received at t_ns is looked at now; says when it comes too late, or we do."""
        gap_ns = t_ns - self._newest_ns
        followed = self.synced
        self.synced = self.pending = True
        self._newest_ns = t_ns
        if not followed:
            return None
        self._slots += max(1, round(gap_ns / PERIOD_NS))
        if gap_ns > self._lost_ns:
            return self._lost(gap_ns)
        if now_ns - t_ns > self._late_ns:
            late, limit = (now_ns - t_ns) * 1e-6, self._timing.late_s * 1e3
            return Violation(f"commander: late by {late:.0f} ms, limit {limit:.0f} ms", False)
        return None

    def watch(self, now_ns: int) -> Violation | None:
        """SYNC is not there: told once, from then on our own clock counts."""
        gap_ns = now_ns - self._newest_ns
        if not self.synced or gap_ns <= self._lost_ns:
            return None
        self.synced = self.pending = False
        self._newest_ns = now_ns - UNPACED_NS
        return self._lost(gap_ns)

    def ready(self, now_ns: int) -> bool:
        """A set-point is to be sent now: the inputs of the newest SYNC have had their time on the wire."""
        if not self.synced:
            return now_ns >= self._newest_ns + UNPACED_NS
        return self.pending and now_ns >= self._newest_ns + self._delay_ns

    def served(self, now_ns: int) -> int:
        """The set-point is on its way; by how many set-points the motion has gone on since the last one."""
        advance = min(self._slots, LARGEST_ADVANCE)
        self._slots = 0
        self.pending = False
        if not self.synced:
            self._newest_ns = now_ns
        return advance

    def _lost(self, gap_ns: int) -> Violation:
        limit = self._timing.sync_lost_s * 1e3
        return Violation(f"SYNC missing for {gap_ns * 1e-6:.0f} ms, limit {limit:.0f} ms", True)
