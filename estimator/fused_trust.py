"""Where the fused estimator's network was trained: a map over speed and motor torque, and two simple ranges.

A box per feature would count fast and heavy as known when the data has only fast or heavy. So the share of
trust is a table over (v, tau_raw), 1 in cells that several training runs have visited and 0 in others, bilinear
between cell centres; times 1 inside the training range of temperature and of the distance between torsion and
current, falling to 0 beside it. Outside of all this nothing of the network is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from estimator.friction import FloatArray

TEMPERATURE_MARGIN_K: Final = 1.0
DISTANCE_MARGIN: Final = 0.25
"""Part of the range beyond which a larger distance between torsion and current counts as unknown."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """What the training data covered.

    velocity_step_rad_s, torque_step_nm: cells; counts: [2 nv + 1][2 nt + 1] of 0 and 1, centred on zero; distance_nm:
    largest |torsion - current path|; temperature_c: lowest and highest, None where the joint reports none.
    """

    velocity_step_rad_s: float
    torque_step_nm: float
    known: tuple[tuple[int, ...], ...]
    distance_nm: float
    temperature_c: tuple[float, float] | None

    @classmethod
    def from_mapping(cls, mapping: Any) -> Envelope:
        """Build from the network's metadata; raises ValueError with what was found and expected."""
        keys = ["velocity_step_rad_s", "torque_step_nm", "known", "distance_nm", "temperature_c"]
        if not isinstance(mapping, dict) or sorted(mapping) != sorted(keys):
            raise ValueError(f"found {str(mapping)[:80]}, expected the keys {', '.join(keys)}")
        steps = [mapping[key] for key in ("velocity_step_rad_s", "torque_step_nm", "distance_nm")]
        if not all(isinstance(x, int | float) and 0.0 < x < 1e6 for x in steps):
            raise ValueError(f"found steps and distance {steps}, expected numbers > 0")
        known = mapping["known"]
        good = isinstance(known, list) and known and all(isinstance(row, list) and row for row in known)
        if not good or len({len(row) for row in known}) != 1 or len(known) % 2 == 0 or len(known[0]) % 2 == 0:
            raise ValueError("found a map that is no table with odd numbers of rows and columns")
        if not all(cell in (0, 1) for row in known for cell in row):
            raise ValueError("found a map with other cells than 0 and 1")
        t = mapping["temperature_c"]
        if t is not None and not (
            isinstance(t, list) and len(t) == 2 and all(isinstance(x, int | float) for x in t) and t[0] <= t[1]
        ):
            raise ValueError(f"found temperature_c {t}, expected null or two rising numbers")
        return cls(
            float(steps[0]),
            float(steps[1]),
            tuple(tuple(int(cell) for cell in row) for row in known),
            float(steps[2]),
            None if t is None else (float(t[0]), float(t[1])),
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "velocity_step_rad_s": self.velocity_step_rad_s,
            "torque_step_nm": self.torque_step_nm,
            "known": [list(row) for row in self.known],
            "distance_nm": self.distance_nm,
            "temperature_c": None if self.temperature_c is None else list(self.temperature_c),
        }


class FusedTrust:
    """Weight of the network in [0, 1], continuous in all arguments."""

    __slots__ = (
        "_distance",
        "_high",
        "_inverse_fade",
        "_inverse_margin",
        "_inverse_torque",
        "_inverse_velocity",
        "_low",
        "_map",
        "_table",
        "_torque_0",
        "_torque_last",
        "_velocity_0",
        "_velocity_last",
    )

    def __init__(self, envelope: Envelope) -> None:
        self._inverse_velocity: Final = 1.0 / envelope.velocity_step_rad_s
        self._inverse_torque: Final = 1.0 / envelope.torque_step_nm
        # a frame of zeros: the interpolation needs no border, and beyond the map nothing is known
        self._table: Final = np.pad(np.array(envelope.known, np.float64), 1)
        self._map: Final = tuple(tuple(row) for row in self._table.tolist())
        self._velocity_0: Final = (self._table.shape[0] - 1) / 2
        self._torque_0: Final = (self._table.shape[1] - 1) / 2
        self._velocity_last: Final = self._table.shape[0] - 1
        self._torque_last: Final = self._table.shape[1] - 1
        self._distance: Final = envelope.distance_nm
        self._inverse_fade: Final = 1.0 / (DISTANCE_MARGIN * envelope.distance_nm)
        t = envelope.temperature_c
        self._low: Final = -1e9 if t is None else t[0]
        self._high: Final = 1e9 if t is None else t[1]
        self._inverse_margin: Final = 0.0 if t is None else 1.0 / TEMPERATURE_MARGIN_K

    def weight(self, velocity_rad_s: float, raw_nm: float, distance_nm: float, temperature_c: float) -> float:
        """Return the share of trust; a temperature of NaN is unknown, hence 0 where the data had one."""
        x = velocity_rad_s * self._inverse_velocity + self._velocity_0
        y = raw_nm * self._inverse_torque + self._torque_0
        if not (0.0 <= x < self._velocity_last and 0.0 <= y < self._torque_last):
            return 0.0
        m = int(x)
        n = int(y)
        x -= m
        y -= n
        near, far = self._map[m], self._map[m + 1]
        a = near[n]
        a += y * (near[n + 1] - a)
        b = far[n]
        b += y * (far[n + 1] - b)
        weight = a + x * (b - a)
        distance = distance_nm if distance_nm >= 0.0 else -distance_nm
        if distance > self._distance:
            weight *= max(0.0, 1.0 - (distance - self._distance) * self._inverse_fade)
        if self._low <= temperature_c <= self._high:
            return weight
        beyond = max(self._low - temperature_c, temperature_c - self._high)
        if beyond != beyond:
            return weight if self._inverse_margin == 0.0 else 0.0
        return weight * max(0.0, 1.0 - beyond * self._inverse_margin)

    def weight_many(
        self, velocity: FloatArray, raw: FloatArray, distance: FloatArray, temperature: FloatArray
    ) -> FloatArray:
        """Vectorised twin of `weight`, arrays [n] without NaN but in temperature."""
        x = velocity * self._inverse_velocity + self._velocity_0
        y = raw * self._inverse_torque + self._torque_0
        inside = (x >= 0.0) & (x < self._velocity_last) & (y >= 0.0) & (y < self._torque_last)
        x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
        m, n = x.astype(np.intp), y.astype(np.intp)
        x, y = x - m, y - n
        table = self._table
        a = table[m, n] + y * (table[m, n + 1] - table[m, n])
        b = table[m + 1, n] + y * (table[m + 1, n + 1] - table[m + 1, n])
        weight = np.where(inside, a + x * (b - a), 0.0)
        excess = np.maximum(np.abs(distance) - self._distance, 0.0)
        weight = weight * np.maximum(0.0, 1.0 - excess * self._inverse_fade)
        beyond = np.maximum(np.maximum(self._low - temperature, temperature - self._high), 0.0)
        share = np.maximum(0.0, 1.0 - beyond * self._inverse_margin)
        unknown = 1.0 if self._inverse_margin == 0.0 else 0.0
        result: FloatArray = weight * np.where(np.isnan(share), unknown, share)
        return result
