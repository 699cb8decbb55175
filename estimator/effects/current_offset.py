"""Zero of the current measurement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jtqd.estimator.effects.effect import (
    Effect,
    Functions,
    JointValues,
    Parameter,
    State,
    Term,
    Values,
    full,
    linear,
)


class CurrentOffset(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "current_offset"
    group = "actuator"
    equation = "i = I + i0"
    source = "zero error of a shunt or Hall current sensor"
    tell_tale = (
        "A constant of the motor balance of one joint, at rest too, whatever speed, direction and load."
    )
    confused_with = {
        "sensor_offset": "load_at_both_directions",
        "sensor_drift": "warm_up",
        "friction_asymmetry": "zero_reading",
    }
    experiment = "zero_reading"
    parameters = (Parameter("offset_a", "A", -5.0, 5.0),)
    hooks = ("current_a",)

    def current_a(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return what the current reads above the truth, A."""
        return full(p["offset_a"], s.current_a)

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("offset_a", 0.01),)
