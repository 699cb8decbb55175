"""Viscous friction: the joint file's value is wrong."""

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
    linear,
)


class ViscousFriction(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "viscous_friction"
    group = "friction"
    equation = "loss = (Fv' - Fv) v"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30"
    tell_tale = "The motor balance is proportional to velocity in both directions, at any load."
    experiment = "speed_ladder"
    parameters = (
        Parameter("viscous_nms_per_rad", "Nms/rad", 0.0, 500.0, key="friction.viscous_nms_per_rad"),
    )
    hooks = ("loss_nm",)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        return (p["viscous_nms_per_rad"] - joint.friction.viscous_nms_per_rad) * s.velocity_rad_s

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("viscous_nms_per_rad", 1.0, joint.friction.viscous_nms_per_rad),)
