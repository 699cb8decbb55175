"""A 32-bit position that rolls over, made continuous."""

from __future__ import annotations

_HALF_RANGE, _FULL_RANGE = 1 << 31, 1 << 32


class Unwrap:
    """Counts of a 32-bit position without its wrap at 2^31 (object 6064h is an INTEGER32 that rolls over).

    Args:
        offset: whole ranges that it had rolled over before the first sample [counts].
    """

    __slots__ = ("_last", "_offset")

    def __init__(self, offset: int = 0) -> None:
        self._last = 0
        self._offset = offset

    def counts(self, raw: int) -> int:
        """Continuous counts; right as long as two samples lie less than 2^31 counts apart."""
        step = raw - self._last
        if not -_HALF_RANGE <= step < _HALF_RANGE:
            self._offset += -_FULL_RANGE if step > 0 else _FULL_RANGE
        self._last = raw
        return raw + self._offset
