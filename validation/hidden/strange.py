"""Parts of the plant that are in no library, for B benches at once; empty unless a case asks for them.

What each is, and which numbers it takes, is said in `unknown`. Arrays are [2, B]: joint, run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from validation.hidden.profiles import STEP_S

Array = np.ndarray

# Numbers of each part; NaN-free neutral values, so that one formula serves the whole batch.
NEUTRAL: Final = {
    "slip_rad": 0.0,
    "slip_above_nm": np.inf,
    "bump_nm": 0.0,
    "bump_at_rad": 0.0,
    "bump_width_rad": 1.0,
    "band_nm": 0.0,
    "band_at_rad_s": 0.0,
    "band_width_rad_s": 1.0,
    "speed_load": 0.0,
    "dead_band_a": 0.0,
    "vibration_nm": 0.0,
    "vibration_hz": 1.0,
    "vibration_rad": 0.0,
}


@dataclass(frozen=True)
class Fault:
    """The sensor reads `value_nm` above the truth, or nothing at all (`dropped`), for `count` samples."""

    start: int
    count: int
    value_nm: float = 0.0
    dropped: bool = False


class Strange:
    """State of what no effect of the library describes."""

    def __init__(self, count: int) -> None:
        self.numbers = {name: np.full((2, count), value) for name, value in NEUTRAL.items()}
        self.waits: dict[
            tuple[int, int], list[int]
        ] = {}  # (joint, run): cycles between slips, the last for ever
        self.bursts: list[tuple[int, int, int, int, float]] = []  # joint, run, first and last cycle, Nm
        self.faults: dict[int, list[Fault]] = {}  # run: faults of the sensor
        self.slips: list[tuple[int, int, int, float]] = []  # joint, run, cycle, rad: what has happened
        self.slipped_rad = np.zeros((2, count))
        self._next = np.full((2, count), np.iinfo(np.int64).max)
        self._burst_nm = np.zeros((2, count))
        self._changes: dict[int, list[tuple[int, int, float]]] = {}
        self.extra_nm: Array | None = None

    def begin(self) -> None:
        """Look at what is there; call it once, before the first cycle."""
        used = {name: bool(np.any(x != NEUTRAL[name])) for name, x in self.numbers.items()}
        self.has_slips = used["slip_rad"]
        self.has_dead_band = used["dead_band_a"]
        self.has_bump = used["bump_nm"]
        self.has_band = used["band_nm"]
        self.has_speed_load = used["speed_load"]
        self.has_vibration = used["vibration_nm"]
        self.has_friction = self.has_bump or self.has_band or self.has_speed_load or bool(self.bursts)
        for (row, run), waits in self.waits.items():
            self._next[row, run] = waits.pop(0)
        for row, run, first, last, size in self.bursts:
            self._changes.setdefault(first, []).append((row, run, size))
            self._changes.setdefault(last, []).append((row, run, -size))

    def at(self, cycle: int, tau: Array) -> None:
        """Take over what happens at this control cycle; tau [2, B]: torque of the gears."""
        if self.has_slips:
            ready = (self._next <= cycle) & (np.abs(tau) > self.numbers["slip_above_nm"])
            for row, run in np.argwhere(ready):
                jump = float(np.sign(tau[row, run]) * self.numbers["slip_rad"][row, run])
                self.slipped_rad[row, run] += jump
                waits = self.waits[row, run]
                self._next[row, run] = cycle + (waits.pop(0) if waits else 10**9)
                self.slips.append((int(row), int(run), cycle, jump))
        for row, run, change in self._changes.get(cycle, ()):
            self._burst_nm[row, run] += change
        if self.has_vibration:
            n = self.numbers
            phase = 2.0 * np.pi * n["vibration_hz"] * (cycle * STEP_S) + n["vibration_rad"]
            self.extra_nm = n["vibration_nm"] * np.sin(phase)

    def dead_band(self, current: Array) -> Array:
        """Return the current that makes torque: below the width it folds back to nothing, above it is whole."""
        x = np.clip(np.abs(current) / np.maximum(self.numbers["dead_band_a"], 1e-9), 0.0, 1.0)
        left: Array = current * (x * x * (3.0 - 2.0 * x))
        return left

    def friction(self, v: Array, link: Array, tau: Array) -> Array:
        """Return friction in addition [Nm], without its direction."""
        n = self.numbers
        total = self._burst_nm
        if self.has_bump:
            away = np.mod(link - n["bump_at_rad"] + np.pi, 2.0 * np.pi) - np.pi
            total = total + n["bump_nm"] * np.exp(-((away / n["bump_width_rad"]) ** 2))
        if self.has_band:
            away = (np.abs(v) - n["band_at_rad_s"]) / n["band_width_rad_s"]
            total = total + n["band_nm"] * np.exp(-away * away)
        if self.has_speed_load:
            total = total + n["speed_load"] * v * v * np.abs(tau)
        return total
