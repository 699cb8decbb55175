"""Cogging of the motor: the torque of its magnets against its slots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jtqd.estimator.effects.effect import Effect, Functions, JointValues, Parameter, State, Term, Values, Wave

ORDERS = (6.0, 12.0, 18.0, 24.0, 36.0, 42.0, 48.0, 60.0, 72.0, 84.0)
"""Usual lcm(poles, slots) and harmonics of the pole pairs; any other order: `term_of_order`."""


class Cogging(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "cogging"
    group = "actuator"
    equation = "loss = A cos(n theta_m + phi), A joint side"
    source = "Hanselman 2006, Brushless Permanent Magnet Motor Design"
    tell_tale = (
        "A line of the motor balance at a multiple of lcm(poles, slots) cycles per motor revolution, "
        "present without current."
    )
    confused_with = {
        "torque_ripple": "full_turns",
        "kinematic_error": "full_turns",
    }
    experiment = "full_turns"
    parameters = (
        Parameter("amplitude_nm", "Nm", 0.0, 20.0),
        Parameter("order_per_motor_rev", "1/rev", 5.0, 1000.0, fixed=True, neutral=None),
        Parameter("phase_rad", "rad", -2.0 * math.pi, 2.0 * math.pi, default=0.0, neutral=None),
    )
    hooks = ("loss_nm",)
    needs = ("motor_position_rad",)

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        return p["amplitude_nm"] * x.cos(p["order_per_motor_rev"] * s.motor_position_rad + p["phase_rad"])

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return a wave (two columns) of each usual order."""
        return tuple(self.term_of_order(order) for order in ORDERS)

    def term_of_order(self, order: float) -> Term:
        """Return the wave (two columns) of any order per motor revolution."""
        return Wave("amplitude_nm", 0.1, {"order_per_motor_rev": float(order)}).term()
