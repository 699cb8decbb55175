"""Zero of the torque sensor."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values, full


class SensorOffset(Effect):
    group = "measurement"
    equation = "tau_s = TAU_S + b"
    source = "zero signal of a torque transducer, as in DIN 51309"
    tell_tale = "A constant of all balances: both joints, motor and torsion, at rest too."
    confused_with = {"unbalance": "full_turns"}
    experiment = "zero_reading"
    parameters = (Parameter("offset_nm", "Nm", -1000.0, 1000.0),)
    columns = (Column("offset_nm", 0.1),)
    at_sensor = True

    def sensor_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return full(p["offset_nm"], s.torque_nm)
