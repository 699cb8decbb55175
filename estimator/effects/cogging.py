"""Cogging of the motor: the torque of its magnets against its slots."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import (
    PHASE,
    Effect,
    Functions,
    Joint,
    Parameter,
    State,
    Values,
    order,
    waves,
)

ORDERS = (6.0, 12.0, 18.0, 24.0, 36.0, 42.0, 48.0, 60.0, 72.0, 84.0)
"""Usual lcm(poles, slots) and harmonics of the pole pairs."""


class Cogging(Effect):
    group = "actuator"
    equation = "loss = A cos(n theta_m + phi), A joint side"
    source = "Hanselman 2006, Brushless Permanent Magnet Motor Design"
    tell_tale = (
        "A line of the motor balance at a multiple of lcm(poles, slots) cycles per motor revolution, "
        "present without current."
    )
    confused_with = {"torque_ripple": "full_turns", "kinematic_error": "full_turns"}
    experiment = "full_turns"
    parameters = (Parameter("amplitude_nm", "Nm", 0.0, 1000.0), order(5.0, None), PHASE)
    columns = waves("amplitude_nm", 0.1, ORDERS)
    whole_orders = range(5, 101)
    needs = ("motor_position_rad",)

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return p["amplitude_nm"] * x.cos(p["order_per_motor_rev"] * s.motor_position_rad + p["phase_rad"])
