"""Kinematic error of the gear: the output is ahead or behind by the motor's angle."""

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


class KinematicError(Effect):
    group = "transmission"
    equation = "twist = E sin(k theta_m + psi), loss = tau G E k cos(k theta_m + psi)"
    source = (
        "Tuttle and Seering 1996, IEEE Trans. Robotics and Automation 12; the loss is the virtual work of tau"
    )
    tell_tale = "A line of the torsion at 1, 2 or 4 cycles per motor revolution; in the motor balance only under load."
    confused_with = {"torque_ripple": "full_turns"}
    experiment = "full_turns"
    parameters = (Parameter("amplitude_rad", "rad", 0.0, 0.05), order(), PHASE)
    columns = waves("amplitude_rad", 1e-5, SHAFT_ORDERS)
    needs = ("motor_position_rad", "torque_nm")
    geometric = True

    def twist_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return p["amplitude_rad"] * x.sin(p["order_per_motor_rev"] * s.motor_position_rad + p["phase_rad"])

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        k = p["order_per_motor_rev"]
        slope = joint.gear_ratio * k * p["amplitude_rad"] * x.cos(k * s.motor_position_rad + p["phase_rad"])
        return s.torque_nm * slope
