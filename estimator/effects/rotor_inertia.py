"""Rotor inertia: the joint file's value is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from jtqd.estimator.effects.effect import (
    AnyJoint,
    Effect,
    Functions,
    JointValues,
    Parameter,
    State,
    Term,
    Values,
    linear,
)


class RotorInertia(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "rotor_inertia"
    group = "actuator"
    equation = "loss = G (Jm' - Jm) alpha"
    source = "Newton-Euler; Swevers, Verdonck, De Schutter 2007, IEEE Control Systems Magazine 27"
    tell_tale = "The motor balance is in phase with the motor's acceleration."
    confused_with = {
        "viscous_friction": "speed_ladder",
    }
    experiment = "quick_changes"
    parameters = (Parameter("rotor_inertia_kgm2", "kg m2", 1e-09, 1.0, key="rotor_inertia_kgm2"),)
    hooks = ("loss_nm",)
    needs = ("motor_acceleration_rad_s2",)
    changes_joint = True

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        more = p["rotor_inertia_kgm2"] - joint.rotor_inertia_kgm2
        return joint.gear_ratio * more * s.motor_acceleration_rad_s2

    def joint(self, p: Values, joint: AnyJoint) -> AnyJoint:
        """Return the joint with this inertia."""
        return replace(joint, rotor_inertia_kgm2=p["rotor_inertia_kgm2"])

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        own = joint.rotor_inertia_kgm2
        return (linear("rotor_inertia_kgm2", 0.1 * own, own),)
