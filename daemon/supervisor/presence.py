"""Something that comes and goes, told in few lines: neither a flicker nor a flapping contact floods the log."""

from __future__ import annotations

from collections.abc import Callable
from math import inf

_HOLD_S = 0.1
"""A change that does not last so long is none; counters and the log's events have it all the same."""
_QUIET_S = 5.0
"""Between two lines that tell a loss. Its end is told at once."""


class Presence:
    """Makes "lost: cause" and "back after 2.3 s" out of readings.

    A loss that comes too soon after the last one is told together with its end, or with those that follow.
    """

    def __init__(self) -> None:
        self.lost = False
        self._reading, self._since = False, -inf
        self._began = 0.0
        self._losses, self._lost_s = 0, 0.0
        self._cause = ""
        self._said = False
        self._not_before = -inf

    def update(self, lost: bool, now_s: float, cause: Callable[[], str]) -> str | None:
        """The line that is due, if any; call it with every reading. `cause` is asked when a loss has lasted."""
        if lost != self._reading:
            self._reading, self._since = lost, now_s
        if lost != self.lost and now_s - self._since >= _HOLD_S:
            self.lost = lost
            if lost:
                self._began, self._losses, self._cause = self._since, self._losses + 1, cause()
            else:
                self._lost_s += self._since - self._began
        may_say = self._said or now_s >= self._not_before
        if self.lost:
            return self._tell_loss(now_s) if may_say and not self._said else None
        return self._tell_return(now_s) if may_say and self._losses else None

    def _tell_loss(self, now_s: float) -> str:
        self._said, self._not_before = True, now_s + _QUIET_S
        return f"lost: {self._cause}"

    def _tell_return(self, now_s: float) -> str:
        text = f"back after {self._lost_s:.1f} s"
        if self._losses > 1:
            text += f", lost {self._losses} times"
        if not self._said:
            text += f": {self._cause}"
            self._not_before = now_s + _QUIET_S
        self._said, self._losses, self._lost_s = False, 0, 0.0
        return text
