"""Friction that falls as the grease warms up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jtqd.estimator.effects.effect import (
    REFERENCE,
    SPAN_K,
    Effect,
    Functions,
    Joint,
    Parameter,
    State,
    Term,
    Terms,
    Values,
    above,
    reference_of,
)

_START = {"viscous_per_k": 0.015, "coulomb_per_k": 0.003}
"""Where a search begins: how curved the fall over temperature is."""
_FLAT = 1e-9


@dataclass(frozen=True, slots=True)
class _Exponential:
    """Rates of `names`: c1 (E - 1) + c2 (r E - 1) with E = exp(-k (T - Tp)), r = exp(k SPAN_K), as exp(-b (T - T0)) - 1.

    Value and slope are those at the reference Tp, so that it is exact where a single exponential is meant.
    """

    names: tuple[str, ...]
    rate: float
    reference_c: float

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the rates and the reference; the file's reference where there is no slope."""
        steep = float(c[0]) + float(c[1]) * math.exp(self.rate * SPAN_K)
        value = 1.0 + steep - (float(c[0]) + float(c[1]))
        rate, reference = 0.0, self.reference_c
        if value > 0.0:
            rate = self.rate * steep / value
            if abs(steep) > _FLAT:
                reference += math.log(value) / rate
        elif steep:
            rate = math.copysign(math.inf, steep)  # friction that would feed energy in: out of any range
        return self._values(rate, reference)

    def _values(self, rate: float, reference_c: float) -> dict[str, float]:
        return dict.fromkeys(_START, 0.0) | dict.fromkeys(self.names, rate) | {"reference_c": reference_c}

    def term(self) -> Term:
        """Return the term: columns at the reference and SPAN_K above."""
        return Term(tuple(self._values(self.rate, self.reference_c + span) for span in (0.0, SPAN_K)), self)


class TemperatureDependentFriction(Effect):
    group = "friction"
    equation = "loss = Fv v (exp(-b (T - T0)) - 1) + Fc s (exp(-c (T - T0)) - 1)"
    source = "Bittencourt and Gunnarsson 2012, J. Dynamic Systems, Measurement and Control 134; Wolf and Iskandar 2018, ICRA"
    tell_tale = (
        "The slope of the motor balance over velocity falls as the joint warms up; nothing changes at rest."
    )
    confused_with = {"viscous_friction": "warm_up", "torque_constant_temperature": "warm_up"}
    experiment = "warm_up"
    parameters = (
        Parameter("viscous_per_k", "1/K", -0.005, 0.2),
        Parameter("coulomb_per_k", "1/K", -0.05, 0.1, default=0.0),
        REFERENCE,
    )
    needs = ("temperature_c",)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side; NaN temperature: 0."""
        own = joint.friction
        warmer = above(s.temperature_c, p["reference_c"])
        viscous = x.exp(-p["viscous_per_k"] * warmer) - 1.0
        loss = own.viscous_nms_per_rad * s.velocity_rad_s * viscous
        if p["coulomb_per_k"]:
            coulomb = x.exp(-p["coulomb_per_k"] * warmer) - 1.0
            loss = loss + own.coulomb_nm * s.direction * coulomb
        return loss

    def terms(self, joint: Joint) -> Terms:
        """Return two columns (slope over temperature, constant) of viscous friction, of Coulomb friction, and of both, which
        one grease makes fall alike.
        """
        own = joint.friction
        there = (own.viscous_nms_per_rad, own.coulomb_nm)
        names = tuple(name for name, size in zip(_START, there, strict=True) if size)
        kinds = [(name,) for name in names] + ([names] if len(names) > 1 else [])
        reference = reference_of(joint.provenance)
        return tuple(_Exponential(kind, _START[kind[0]], reference).term() for kind in kinds)
