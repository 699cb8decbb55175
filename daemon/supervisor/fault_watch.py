"""Lines for the operator when a joint has no torque because of a fault, when a fault is latched, and when all is well again.

Pure: readings of the snapshot and times in, lines out. It runs in the supervisor, so that no line costs the loop anything.
"""

from __future__ import annotations

from daemon.shared.faults import MEANINGS, NAMES
from daemon.shared.snapshot import JointView, View
from daemon.supervisor.rate_limit import RateLimit


class FaultWatch:
    """Call `lines` with each reading of the snapshot, some twenty times a second.

    Attributes:
        present: faults of joint 1 and 2 as of the last reading, bits of `daemon/shared/faults.py`.
        latched: those that are latched.
    """

    def __init__(self) -> None:
        self.present, self.latched = [0, 0], [0, 0]
        self._since_s = [0.0, 0.0]
        self._limits = (RateLimit(), RateLimit())

    def lines(self, view: View, now_s: float) -> list[str]:
        """What has to be told now (CLOCK_MONOTONIC)."""
        said = []
        for n, seen in enumerate(view.joints):
            line = self._line(n, seen, now_s)
            if line is not None:
                said.append(f"joint {n + 1}: {line}")
        return said

    def _line(self, n: int, seen: JointView, now_s: float) -> str | None:
        present = seen.input_flags >> 8 | seen.latched
        before, self.present[n] = self.present[n], present
        held, self.latched[n] = self.latched[n], seen.latched
        new = present & ~before | seen.latched & ~held
        if new:
            if not before:
                self._since_s[n] = now_s
            if self._limits[n].may_say(new, now_s) is None:
                return None
            end = "; latched: `jtq control reset` releases it" if seen.latched & new else ""
            return f"no torque: {_meanings(new)}{end}"
        if before and not present and self._limits[n].may_say(0, now_s) is not None:
            return f"no fault any more after {now_s - self._since_s[n]:.1f} s"
        return None


def _meanings(bits: int) -> str:
    return ", ".join(f"{MEANINGS[bit]} ({name})" for bit, name in NAMES.items() if bits & bit)
