"""Zero of the current measurement."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values, full


class CurrentOffset(Effect):
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
    parameters = (Parameter("offset_a", "A", -50.0, 50.0),)
    columns = (Column("offset_a", 0.01),)

    def current_a(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return full(p["offset_a"], s.current_a)
