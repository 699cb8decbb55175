"""Torque constant: the joint file's value is wrong."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class TorqueConstant(Effect):
    group = "actuator"
    equation = "loss = -G (Kt' - Kt) i"
    source = "definition of Kt; Hanselman 2006, Brushless Permanent Magnet Motor Design"
    tell_tale = (
        "The motor balance is proportional to the current, in both directions of motion alike; the other "
        "joint does not see it."
    )
    confused_with = {
        "torque_constant_saturation": "load_at_both_directions",
        "viscous_friction": "load_at_both_directions",
        "torque_constant_temperature": "warm_up",
    }
    experiment = "load_at_both_directions"
    parameters = (
        Parameter("torque_constant_nm_per_a", "Nm/A", 0.0001, 100.0, key="torque_constant_nm_per_a"),
    )
    columns = (Column("torque_constant_nm_per_a", 0.01, of="torque_constant_nm_per_a"),)
    scales_balance = "motor"

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return (
            -joint.gear_ratio * (p["torque_constant_nm_per_a"] - joint.torque_constant_nm_per_a) * s.current_a
        )
