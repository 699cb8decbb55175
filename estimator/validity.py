"""How far an estimate can be trusted: standard deviations, standstill, the network's envelope.

Everything exists twice: plain floats for the loop, arrays (suffix _many) for whole runs.

    physics, moving   sigma^2 = load^2 + (u_f tau_f(v))^2 + floor^2
                      load: the efficiency table's RMSE as a torque; for the classical observer u_l |tau_raw|
    standstill        tau_j in [tau_raw - loss(+), tau_raw - loss(-)]
                      value: the middle; sigma: half the width, wider by u_f, + floor
    network           weight w from the envelope and from its distance to physics; value and sigma are blended by w
"""

from __future__ import annotations

from math import sqrt
from typing import Final

import numpy as np

from estimator.friction import FloatArray, FrictionModel
from estimator.losses import LossModel
from estimator.parameters import Joint
from estimator.settings import EstimatorSettings

FADE_START: Final = 0.75
"""Part of the network's limit from which it fades into physics; at the limit nothing of it is left."""


class Uncertainty:
    """Standard deviations and standstill intervals of the physics estimates of one joint [Nm, joint side]."""

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
