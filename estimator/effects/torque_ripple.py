"""Torque ripple of the wave generator: few cycles per motor revolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jtqd.estimator.effects.effect import Effect, Functions, JointValues, Parameter, State, Term, Values, Wave

ORDERS = (1.0, 2.0, 4.0)
"""Shaft, its two lobes, and their second harmonic."""


class TorqueRipple(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "torque_ripple"
    group = "transmission"
    equation = "loss = A cos(n theta_m + phi)"
    source = "Tuttle and Seering 1996, IEEE Trans. Robotics and Automation 12"
    tell_tale = (
        "A line of the motor balance at 1, 2 or 4 cycles per motor revolution whose frequency follows "
        "the speed; none in the torsion."
    )
    experiment = "full_turns"
    parameters = (
        Parameter("amplitude_nm", "Nm", 0.0, 20.0),
        Parameter("order_per_motor_rev", "1/rev", 0.1, 1000.0, default=2.0, fixed=True, neutral=None),
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
