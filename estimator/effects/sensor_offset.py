"""Zero of the torque sensor."""

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


class SensorOffset(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "sensor_offset"
    group = "measurement"
    equation = "tau_s = TAU_S + b"
    source = "zero signal of a torque transducer, as in DIN 51309"
    tell_tale = "A constant of all balances: both joints, motor and torsion, at rest too."
    confused_with = {
        "unbalance": "full_turns",
    }
    experiment = "zero_reading"
    parameters = (Parameter("offset_nm", "Nm", -100.0, 100.0),)
    hooks = ("sensor_nm",)
    at_sensor = True

    def sensor_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return what the sensor reads above the truth, Nm."""
        return full(p["offset_nm"], s.torque_nm)

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("offset_nm", 0.1),)
