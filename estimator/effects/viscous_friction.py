"""Viscous friction: the joint file's value is wrong."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class ViscousFriction(Effect):
    group = "friction"
    equation = "loss = (Fv' - Fv) v"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30"
    tell_tale = "The motor balance is proportional to velocity in both directions, at any load."
    experiment = "speed_ladder"
    parameters = (
        Parameter("viscous_nms_per_rad", "Nms/rad", 0.0, 50000.0, key="friction.viscous_nms_per_rad"),
    )
    columns = (Column("viscous_nms_per_rad", 1.0),)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return (p["viscous_nms_per_rad"] - joint.friction.viscous_nms_per_rad) * s.velocity_rad_s
