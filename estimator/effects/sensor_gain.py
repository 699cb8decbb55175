"""Gain of the torque sensor.

The torque of the state is taken for the sensor's reading: a plant that knows the truth evaluates the hook once more
at truth + hook.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jtqd.estimator.effects.effect import Effect, Functions, Joint, Parameter, State, Term, Terms, Values

STEP = 0.01
"""1 - 1/g of the column."""


@dataclass(frozen=True, slots=True)
class _Gain:
    """g with 1 - 1/g = c STEP."""

    def __call__(self, c: Sequence[float]) -> dict[str, float]:
        """Return the gain of a coefficient; infinite where none would do."""
        rest = 1.0 - float(c[0]) * STEP
        return {"gain": 1.0 / rest if rest else math.inf}


class SensorGain(Effect):
    group = "measurement"
    equation = "tau_s = g TAU_S, so that sensor = (1 - 1/g) tau_s of the reading tau_s"
    source = "sensitivity of a torque transducer, as in DIN 51309"
    tell_tale = "All balances of both joints are proportional to the torque by the same factor, whatever the direction."
    confused_with = {"torque_constant": "load_at_both_directions"}
    experiment = "load_at_both_directions"
    parameters = (Parameter("gain", "", 0.5, 2.0, neutral=1.0),)
    scales_all = True
    needs = ("torque_nm",)
    at_sensor = True

    def sensor_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return (1.0 - 1.0 / p["gain"]) * s.torque_nm

    def terms(self, joint: Joint) -> Terms:
        return (Term(({"gain": 1.0 / (1.0 - STEP)},), _Gain()),)
