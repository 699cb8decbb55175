"""Saturation: at large currents the motor gives less torque per ampere."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class TorqueConstantSaturation(Effect):
    group = "actuator"
    equation = "tau_motor = Kt i (1 - k |i|), so that loss = G Kt k i |i|"
    source = "Hanselman 2006, Brushless Permanent Magnet Motor Design (iron saturation, first order)"
    tell_tale = "The motor balance bends with the current: nothing at small currents, odd and quadratic at large ones."
    confused_with = {"sensor_gain": "load_at_both_directions"}
    experiment = "load_at_both_directions"
    parameters = (Parameter("saturation_per_a", "1/A", 0.0, 0.5),)
    columns = (Column("saturation_per_a", 0.01),)

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        scale = joint.gear_ratio * joint.torque_constant_nm_per_a * p["saturation_per_a"]
        return scale * s.current_a * abs(s.current_a)
