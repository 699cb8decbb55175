"""A histogram of times that may run for hours: bins of fixed width, exact maximum. Pure."""

from __future__ import annotations

_BIN_NS = 2_000
_BINS = 5_000


class Tally:
    """Times in ns, below zero counted as zero; above 10 ms the bins are exact to their maximum only."""

    __slots__ = ("_bins", "count", "largest_ns")

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count = 0
        self.largest_ns = 0

    def add(self, ns: int) -> None:
        """One more."""
        self.count += 1
        self.largest_ns = max(self.largest_ns, ns)
        self._bins[min(max(ns, 0) // _BIN_NS, _BINS - 1)] += 1

    def quantile_us(self, share: float) -> float:
        """Upper edge of the bin that holds this share of them [us], at most the maximum; NaN without data."""
        wanted, seen = share * self.count, 0
        for n, count in enumerate(self._bins):
            seen += count
            if count and seen >= wanted:
                edge_ns = self.largest_ns if n == _BINS - 1 else (n + 1) * _BIN_NS
                return min(edge_ns, max(self.largest_ns, 0)) / 1000.0
        return float("nan")
