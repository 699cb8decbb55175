"""What a soak has done and found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

SLOPE_KB_S = 10.0
"""A process that grows faster, with the lower end of the interval, leaks: 36 MB in an hour."""


@dataclass
class SoakReport:
    """Seconds until all was well again by kind of fault; slopes of memory (kB/s, half of its interval, kB at the end)."""

    seed: int
    seconds: float = 0.0
    faults: dict[str, list[float]] = field(default_factory=dict)
    slopes: dict[str, tuple[float, float, int]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)

    def add_slopes(self, slopes: dict[str, tuple[float, float, int]]) -> None:
        """Memory; a process that grows is a finding. The bench is not jtqd."""
        self.slopes = slopes
        for name, (slope, half, _) in slopes.items():
            if slope - half > SLOPE_KB_S and name != "bench":
                self.findings.append(f"{name} grows by {slope:.1f} +- {half:.1f} kB/s")

    def as_json(self) -> dict[str, Any]:
        """All of it."""
        return dict(vars(self))

    def text(self) -> str:
        """A table."""
        lines = [
            f"seed {self.seed}, {self.seconds:.0f} s, {sum(map(len, self.faults.values()))} faults",
            f"{'fault':20}{'times':>6}{'recovered after s: median':>27}{'max':>7}",
        ]
        for name, times in sorted(self.faults.items()):
            lines.append(f"{name:20}{len(times):6}{np.median(times):27.2f}{max(times):7.2f}")
        if self.slopes:
            lines.append(f"{'process':20}{'kB/s':>8}{'+- (95 %)':>11}{'end kB':>9}")
        for name, (slope, half, end) in sorted(self.slopes.items()):
            lines.append(f"{name:20}{slope:8.2f}{half:11.2f}{end:9}")
        lines += [f"{name:28}{count:10}" for name, count in self.counts.items()]
        lines += [f"FINDING {each}" for each in self.findings] or ["no finding"]
        return "\n".join(lines)
