"""Torque ripple of the wave generator: few cycles per motor revolution."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import (
    PHASE,
    SHAFT_ORDERS,
    Effect,
    Functions,
    Joint,
    Parameter,
    State,
    Values,
    order,
    waves,
)


class TorqueRipple(Effect):
    group = "transmission"
    equation = "loss = A cos(n theta_m + phi)"
    source = "Tuttle and Seering 1996, IEEE Trans. Robotics and Automation 12"
    tell_tale = (
        "A line of the motor balance at 1, 2 or 4 cycles per motor revolution whose frequency follows "
        "the speed; none in the torsion."
    )
    experiment = "full_turns"
    parameters = (Parameter("amplitude_nm", "Nm", 0.0, 1000.0), order(), PHASE)
    columns = waves("amplitude_nm", 0.1, SHAFT_ORDERS)
    needs = ("motor_position_rad",)

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return p["amplitude_nm"] * x.cos(p["order_per_motor_rev"] * s.motor_position_rad + p["phase_rad"])
