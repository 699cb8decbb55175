"""Few lines, however much happens: each kind of line once in a while, and not many lines together. Pure."""

from __future__ import annotations

from collections import deque
from math import inf

QUIET_S = 5.0
"""Between two lines of the same kind."""
_BURST = 6
"""Lines of all kinds within that time."""


class RateLimit:
    """Asked before a line is said; what it refuses it counts."""

    def __init__(self, quiet_s: float = QUIET_S, burst: int = _BURST) -> None:
        self._quiet_s, self._burst = quiet_s, burst
        self._not_before: dict[object, float] = {}
        self._said: deque[float] = deque(maxlen=burst)
        self._refused = 0

    def may_say(self, kind: object, now_s: float) -> int | None:
        """None: not now. Otherwise how many have been refused since the last line."""
        window = self._said[0] if len(self._said) == self._burst else -inf
        if now_s < self._not_before.get(kind, -inf) or now_s < window + self._quiet_s:
            self._refused += 1
            return None
        # Only kinds that were said are remembered, so the table is bounded by the burst.
        self._not_before = {each: until for each, until in self._not_before.items() if until > now_s}
        self._not_before[kind] = now_s + self._quiet_s
        self._said.append(now_s)
        refused, self._refused = self._refused, 0
        return refused
