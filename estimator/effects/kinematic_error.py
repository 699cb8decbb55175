"""Kinematic error of the gear: the output is ahead or behind by the motor's angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jtqd.estimator.effects.effect import Effect, Functions, JointValues, Parameter, State, Term, Values, Wave

ORDERS = (1.0, 2.0, 4.0)
"""Shaft, the wave generator's two lobes, and their second harmonic."""


class KinematicError(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "kinematic_error"
    group = "transmission"
    equation = "twist = E sin(k theta_m + psi), loss = tau G E k cos(k theta_m + psi)"
    source = (
        "Tuttle and Seering 1996, IEEE Trans. Robotics and Automation 12; the loss is the virtual work of tau"
    )
    tell_tale = (
        "A line of the torsion at 1, 2 or 4 cycles per motor revolution; in the motor balance only under "
        "load."
    )
    confused_with = {
        "torque_ripple": "full_turns",
    }
    experiment = "full_turns"
    parameters = (
        Parameter("amplitude_rad", "rad", 0.0, 0.005),
        Parameter("order_per_motor_rev", "1/rev", 0.1, 1000.0, default=2.0, fixed=True, neutral=None),
        Parameter("phase_rad", "rad", -2.0 * math.pi, 2.0 * math.pi, default=0.0, neutral=None),
    )
    hooks = ("twist_rad", "loss_nm")
    needs = ("motor_position_rad", "torque_nm")
    geometric = True

    def twist_rad(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return what the spring sees beyond theta_m/G - theta_l, rad."""
        return p["amplitude_rad"] * x.sin(p["order_per_motor_rev"] * s.motor_position_rad + p["phase_rad"])

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        k = p["order_per_motor_rev"]
        slope = joint.gear_ratio * k * p["amplitude_rad"] * x.cos(k * s.motor_position_rad + p["phase_rad"])
        return s.torque_nm * slope

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return a wave (two columns) of each usual order."""
        return tuple(self.term_of_order(order) for order in ORDERS)

    def term_of_order(self, order: float) -> Term:
        """Return the wave (two columns) of any order per motor revolution."""
        return Wave("amplitude_rad", 1e-5, {"order_per_motor_rev": float(order)}).term()
