"""How far an estimate can be trusted: standard deviations, standstill, and where a network was trained.

| class | gives | method |
|---|---|---|
| `Uncertainty` | sigma of the physics in motion, value and sigma at standstill | `tob`, `efficiency`, `network` |
| `Trust` | weight of the network: a range per feature, and the distance to physics | `network` |
| `FusedTrust` | weight of the network: a map over speed and motor torque (`Envelope`) | `fused` |

A weight is 1 where the network is alone in charge and 0 where nothing of it is left. Everything exists twice: plain floats
for the loop, arrays (suffix _many) for whole runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, sqrt
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Joint
from jtqd.estimator.losses import FrictionModel, LossModel
from jtqd.estimator.onnx_graph import finite
from jtqd.estimator.settings import EstimatorSettings

FADE_START: Final = 0.75
"""Part of the network's limit from which it fades into physics; at the limit nothing of it is left."""


class Uncertainty:
    """Standard deviations and standstill intervals of the physics estimates of one joint [Nm, joint side].

    moving        sigma^2 = load^2 + (u_f tau_f(v))^2 + floor^2
                  load: the efficiency table's RMSE as a torque; for the classical observer u_l |tau_raw|
    standstill    tau_j in [tau_raw - loss(+), tau_raw - loss(-)]
                  value: the middle; sigma: half the width, wider by u_f, + floor
    """

    __slots__ = (
        "_floor",
        "_friction",
        "_load",
        "_losses",
        "_static",
        "_u_friction",
        "_widened",
        "_with_efficiency",
    )

    def __init__(self, joint: Joint, settings: EstimatorSettings, losses: LossModel) -> None:
        self._friction: Final = FrictionModel(joint.friction)
        self._static: Final = self._friction.static
        self._losses: Final = losses
        self._floor: Final = settings.sigma_floor * joint.rated_torque_nm
        self._u_friction: Final = settings.friction_uncertainty
        # what friction can hold is itself known to that part only
        self._widened: Final = 1.0 + settings.friction_uncertainty
        self._load: Final = settings.load_uncertainty
        # without an efficiency the physics is the classical observer's whatever the method
        self._with_efficiency: Final = settings.method != "tob" and losses.has_efficiency

    def moving(self, raw_nm: float, current_a: float, velocity_rad_s: float) -> float:
        """Return sigma of a moving joint; current_a is the acceleration-corrected current tau_raw/(G Kt)."""
        load = self._load * raw_nm
        if self._with_efficiency:
            load = self._losses.rmse_torque(current_a, velocity_rad_s)
        friction = self._u_friction * self._friction.torque(velocity_rad_s)
        return sqrt(load * load + friction * friction + self._floor * self._floor)

    def moving_many(
        self, raw_nm: FloatArray, current_a: FloatArray, velocity_rad_s: FloatArray
    ) -> FloatArray:
        """Vectorised twin of `moving`."""
        load = self._load * raw_nm
        if self._with_efficiency:
            load = self._losses.rmse_torque_many(current_a, velocity_rad_s)
        friction = self._u_friction * self._friction.torque_many(velocity_rad_s)
        result: FloatArray = np.sqrt(load * load + friction * friction + self._floor * self._floor)
        return result

    def standing(self, raw_nm: float, current_a: float) -> tuple[float, float]:
        """Return (value, sigma) of a standing joint: middle and half width of what friction can hold."""
        if not self._with_efficiency:
            return raw_nm, self._widened * self._static + self._floor
        forward, backward = self._losses.standstill_bounds(current_a)
        return raw_nm - 0.5 * (forward + backward), 0.5 * self._widened * (forward - backward) + self._floor

    def standing_many(self, raw_nm: FloatArray, current_a: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Vectorised twin of `standing`."""
        if not self._with_efficiency:
            return raw_nm, np.full_like(raw_nm, self._widened * self._static + self._floor)
        forward, backward = self._losses.standstill_bounds_many(current_a)
        return raw_nm - 0.5 * (forward + backward), 0.5 * self._widened * (forward - backward) + self._floor


class Trust:
    """Weight of the network in [0, 1]: 1 inside its envelope and near physics, 0 far from either, continuous.

    low, high: training range per feature (6 each); margin: part of the span over which the weight falls to
    0 outside; limit_nm: largest |network - physics|; the weight falls from FADE_START of it.
    """

    __slots__ = ("_fade", "_inverse_fade", "_inverse_margin", "_limit", "_sides")

    def __init__(
        self, low: tuple[float, ...], high: tuple[float, ...], margin: float, limit_nm: float
    ) -> None:
        self._sides: Final = tuple(side for pair in zip(low, high, strict=True) for side in pair)
        # a feature that was constant in training, or no margin at all: a step of rounding size instead of 1/0
        self._inverse_margin: Final = tuple(
            1.0 / max(margin * (b - a), 1e-9 * max(1.0, abs(a), abs(b)))
            for a, b in zip(low, high, strict=True)
        )
        self._limit: Final = limit_nm
        self._fade: Final = FADE_START * limit_nm
        self._inverse_fade: Final = 1.0 / max(limit_nm - self._fade, 1e-12)

    def weight(  # noqa: PLR0917 - the six features, positional for speed
        self, x0: float, x1: float, x2: float, x3: float, x4: float, x5: float, difference_nm: float
    ) -> float:
        """Return the weight for FEATURES x0..x5 and network minus physics; a difference of NaN gives 0."""
        l0, h0, l1, h1, l2, h2, l3, h3, l4, h4, l5, h5 = self._sides
        if (
            l0 <= x0 <= h0
            and l1 <= x1 <= h1
            and l2 <= x2 <= h2
            and l3 <= x3 <= h3
            and l4 <= x4 <= h4
            and l5 <= x5 <= h5
        ):
            weight = 1.0
        else:
            weight = self._outside(x0, x1, x2, x3, x4, x5)
        distance = abs(difference_nm)
        if distance <= self._fade:
            return weight
        if distance < self._limit:
            near = (self._limit - distance) * self._inverse_fade
            return near if near < weight else weight
        return 0.0

    def _outside(self, *x: float) -> float:
        sides = self._sides
        weight = 1.0
        for n, inverse in enumerate(self._inverse_margin):
            part = 1.0 - max(sides[2 * n] - x[n], x[n] - sides[2 * n + 1]) * inverse
            if not part > 0.0:  # NaN included
                return 0.0
            weight = min(weight, part)
        return weight

    def weight_many(self, features: FloatArray, difference_nm: FloatArray) -> FloatArray:
        """Vectorised twin of `weight`: features [n, 6], difference [n] -> [n]."""
        sides = np.array(self._sides).reshape(-1, 2)
        excess = np.maximum(sides[:, 0] - features, features - sides[:, 1])
        weight = np.min(1.0 - excess * np.array(self._inverse_margin), axis=1)
        near = (self._limit - np.abs(difference_nm)) * self._inverse_fade
        result: FloatArray = np.clip(np.minimum(weight, near), 0.0, 1.0)
        result[np.isnan(result)] = 0.0
        return result


TEMPERATURE_MARGIN_K: Final = 1.0
"""Beside the range of temperatures over which trust is lost."""

DISTANCE_MARGIN: Final = 0.25
"""Part of the range beyond which a larger distance between torsion and current counts as unknown."""

_LEAST: Final = 1e-6
_MOST: Final = 1e6
"""Limits of steps and distance, far beyond any joint: their reciprocals stay numbers."""


@dataclass(frozen=True, slots=True)
class Envelope:
    """What the training data of a fused network covered.

    velocity_step_rad_s, torque_step_nm: distance of cell centres; known: [2 nv + 1][2 nt + 1] of 0 and 1 over velocity
    and motor torque, its middle cell at zero; distance_nm: largest |torsion - current path|; temperature_c: lowest
    and highest, None where the joint reports none.
    """

    velocity_step_rad_s: float
    torque_step_nm: float
    known: tuple[tuple[int, ...], ...]
    distance_nm: float
    temperature_c: tuple[float, float] | None

    @classmethod
    def from_mapping(cls, mapping: Any) -> Envelope:
        """Build from the network's metadata; raises ValueError with what was found and expected."""
        keys = ("velocity_step_rad_s", "torque_step_nm", "known", "distance_nm", "temperature_c")
        if not isinstance(mapping, dict) or set(mapping) != set(keys):
            raise ValueError(f"found {str(mapping)[:80]}, expected the keys {', '.join(keys)}")
        for key in ("velocity_step_rad_s", "torque_step_nm", "distance_nm"):
            if not finite(mapping[key]) or not _LEAST <= mapping[key] <= _MOST:
                raise ValueError(f"{key}: found {mapping[key]!r}, expected {_LEAST:g} to {_MOST:g}")
        return cls(
            float(mapping["velocity_step_rad_s"]),
            float(mapping["torque_step_nm"]),
            _checked_map(mapping["known"]),
            float(mapping["distance_nm"]),
            _checked_range(mapping["temperature_c"]),
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


def _checked_map(known: Any) -> tuple[tuple[int, ...], ...]:
    """Return the map; ValueError unless it is a table with a middle cell, of 0 and 1."""
    if not (isinstance(known, list) and known and all(isinstance(row, list) for row in known)):
        raise ValueError(f"known: found {str(known)[:40]}, expected a list of rows")
    widths = {len(row) for row in known}
    if len(widths) != 1 or len(known) % 2 == 0 or min(widths) % 2 == 0:
        found = f"{len(known)} rows of {', '.join(map(str, sorted(widths)))} cells"
        raise ValueError(f"known: found {found}, expected odd numbers of rows and of cells in each row")
    if not all(finite(cell) and cell in (0, 1) for row in known for cell in row):
        raise ValueError("known: found other cells, expected 0 and 1")
    return tuple(tuple(int(cell) for cell in row) for row in known)


def _checked_range(value: Any) -> tuple[float, float] | None:
    """Return the range of temperatures; ValueError unless it is None or two numbers that do not fall."""
    if value is None:
        return None
    if isinstance(value, list) and len(value) == 2 and all(map(finite, value)) and value[0] <= value[1]:
        return float(value[0]), float(value[1])
    raise ValueError(f"temperature_c: found {str(value)[:40]}, expected null or [lowest, highest]")


class FusedTrust:
    """Weight of a fused network in [0, 1], continuous in all arguments.

    A box per feature would count fast and heavy as known when the data has only fast or heavy. So the weight is a table
    over (v, tau_raw), 1 in cells that several training runs have visited and 0 in others, bilinear between cell centres;
    times 1 inside the training range of temperature and of the distance between torsion and current, falling to 0 beside
    it.
    """

    __slots__ = (
        "_distance",
        "_high",
        "_inverse_fade",
        "_inverse_torque",
        "_inverse_velocity",
        "_low",
        "_map",
        "_table",
        "_torque_0",
        "_torque_last",
        "_velocity_0",
        "_velocity_last",
        "_with_temperature",
    )

    def __init__(self, envelope: Envelope) -> None:
        self._inverse_velocity: Final = 1.0 / envelope.velocity_step_rad_s
        self._inverse_torque: Final = 1.0 / envelope.torque_step_nm
        # a frame of zeros: the interpolation needs no border, and beyond the map nothing is known
        self._table: Final = np.pad(np.array(envelope.known, np.float64), 1)
        rows: list[list[float]] = self._table.tolist()
        self._map: Final = tuple(tuple(row) for row in rows)
        self._velocity_last: Final = len(rows) - 1
        self._torque_last: Final = len(rows[0]) - 1
        self._velocity_0: Final = self._velocity_last / 2
        self._torque_0: Final = self._torque_last / 2
        self._distance: Final = envelope.distance_nm
        self._inverse_fade: Final = 1.0 / (DISTANCE_MARGIN * envelope.distance_nm)
        self._with_temperature: Final = envelope.temperature_c is not None
        self._low, self._high = envelope.temperature_c or (0.0, 0.0)

    def weight(self, velocity_rad_s: float, raw_nm: float, distance_nm: float, temperature_c: float) -> float:
        """Return the weight; a temperature of NaN is unknown, hence 0 where the data had one.

        raw_nm: motor torque; distance_nm: torsion less current path; finite both, as is the velocity.
        """
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
        if self._low <= temperature_c <= self._high or not self._with_temperature:
            return weight
        if isnan(temperature_c):
            return 0.0
        beyond = max(self._low - temperature_c, temperature_c - self._high)
        return weight * max(0.0, 1.0 - beyond * (1.0 / TEMPERATURE_MARGIN_K))

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
        width = self._table.shape[1]
        table, at = self._table.ravel(), m * width + n
        a, b = table[at], table[at + width]
        a += y * (table[at + 1] - a)
        b += y * (table[at + width + 1] - b)
        weight: FloatArray = np.where(inside, a + x * (b - a), 0.0)
        excess = np.maximum(np.abs(distance) - self._distance, 0.0)
        weight = weight * np.maximum(0.0, 1.0 - excess * self._inverse_fade)
        if not self._with_temperature:
            return weight
        beyond = np.maximum(np.maximum(self._low - temperature, temperature - self._high), 0.0)
        share = np.maximum(0.0, 1.0 - beyond * (1.0 / TEMPERATURE_MARGIN_K))
        result: FloatArray = weight * np.where(np.isnan(share), 0.0, share)
        return result
