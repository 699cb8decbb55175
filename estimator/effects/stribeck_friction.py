"""Stribeck friction: additional friction near standstill."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jtqd.estimator.effects.effect import (
    Effect,
    Functions,
    Joint,
    Parameter,
    State,
    Term,
    Terms,
    Values,
    linear,
)

VELOCITIES_RAD_S = (0.02, 0.035, 0.05, 0.08, 0.12, 0.2)
"""Grid of the search, the joint file's own beside it; the fit refines it."""

_LOW, _HIGH = 1e-3, 3.0


@dataclass(frozen=True, slots=True)
class _Merged:
    """Two peaks, the file's and one of the grid, as one of equal sum and equal integral over velocity."""

    own_nm: float
    own_rad_s: float
    grid_rad_s: float

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return height and velocity; the file's velocity where the two cancel."""
        other = float(c[1])
        own = self.own_nm * (1.0 - other) + float(c[0])
        height = own + other
        velocity = self.own_rad_s
        if height:
            velocity = (own * self.own_rad_s + other * self.grid_rad_s) / height
        return {"stribeck_nm": height, "stribeck_velocity_rad_s": min(max(velocity, _LOW), _HIGH)}


class StribeckFriction(Effect):
    group = "friction"
    equation = "loss = (Fs' exp(-(v/vs')^2) - Fs exp(-(v/vs)^2)) s"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30"
    tell_tale = "A peak of the motor balance at small velocities, odd in velocity, gone beyond twice vs."
    confused_with = {"viscous_friction": "slow_reversals", "hysteresis": "slow_reversals"}
    experiment = "slow_reversals"
    parameters = (
        Parameter("stribeck_nm", "Nm", 0.0, 5000.0, key="friction.stribeck_nm"),
        Parameter(
            "stribeck_velocity_rad_s",
            "rad/s",
            _LOW,
            _HIGH,
            default=math.nan,
            key="friction.stribeck_velocity_rad_s",
        ),
    )
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        own = joint.friction
        v = s.velocity_rad_s
        new = v / p.get("stribeck_velocity_rad_s", own.stribeck_velocity_rad_s)
        peak = p["stribeck_nm"] * x.exp(-new * new)
        if own.stribeck_nm:
            old = v / own.stribeck_velocity_rad_s
            peak = peak - own.stribeck_nm * x.exp(-old * old)
        return peak * s.direction

    def terms(self, joint: Joint) -> Terms:
        """Return one column per velocity; where the file has a peak itself, its height and a second peak."""
        own_nm, own = joint.friction.stribeck_nm, joint.friction.stribeck_velocity_rad_s
        height = linear("stribeck_nm", 1.0, own_nm, stribeck_velocity_rad_s=own)
        others = [v for v in VELOCITIES_RAD_S if abs(v - own) > 1e-9]
        if not own_nm:
            return (height, *(linear("stribeck_nm", 1.0, stribeck_velocity_rad_s=v) for v in others))
        return (
            height,
            *(
                Term(
                    (height.basis[0], {"stribeck_nm": 1.0, "stribeck_velocity_rad_s": v}),
                    _Merged(own_nm, own, v),
                )
                for v in others
            ),
        )
