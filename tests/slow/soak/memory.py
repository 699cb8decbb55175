"""Resident memory of the processes of a soak over time, and how fast each grows."""

from __future__ import annotations

import numpy as np

from tests.slow.fuzz.memory import rss_kb
from tests.slow.soak.rig import Rig

_SETTLED = 0.3
"""Share of the run after which memory is looked at: caches and histories are full by then."""
_YOUNG_S = 30.0
"""A process fills its buffers for so long after its start; of one that never gets older nothing is said."""


class MemoryWatch:
    """Call `look` now and then; one that was started anew begins again."""

    def __init__(self) -> None:
        self._samples: dict[tuple[str, int], list[tuple[float, int]]] = {}

    def look(self, rig: Rig, now_s: float) -> None:
        """One sample of each process."""
        for name, pid in rig.processes().items():
            try:
                self._samples.setdefault((name, pid), []).append((now_s, rss_kb(pid)))
            except OSError:
                continue

    def slopes(self, begun_s: float, end_s: float) -> dict[str, tuple[float, float, int]]:
        """kB/s, half of its 95 % interval and the last value, of the process of each name that lived longest."""
        found: dict[str, tuple[float, tuple[float, float, int]]] = {}
        for (name, _), samples in self._samples.items():
            first_s = max(begun_s + _SETTLED * (end_s - begun_s), samples[0][0] + _YOUNG_S)
            late = np.array([each for each in samples if each[0] > first_s], float)
            if len(late) < 10 or late[-1, 0] - late[0, 0] <= found.get(name, (0.0,))[0]:
                continue
            t, y = late[:, 0] - late[:, 0].mean(), late[:, 1]
            slope = float(t @ y / (t @ t))
            rest = y - y.mean() - slope * t
            half = 1.96 * float(np.sqrt(rest @ rest / (len(y) - 2) / (t @ t)))
            found[name] = (late[-1, 0] - late[0, 0], (slope, half, int(y[-1])))
        return {name: value for name, (_, value) in found.items()}
