"""Coulomb friction: the joint file's value is wrong."""

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


class CoulombFriction(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "coulomb_friction"
    group = "friction"
    equation = "loss = (Fc' - Fc) s"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30"
    tell_tale = "A step of the motor balance at every reversal, the same at any speed, load and angle."
    confused_with = {
        "load_dependent_friction": "load_at_both_directions",
        "viscous_friction": "speed_ladder",
        "current_offset": "speed_ladder",
        "friction_asymmetry": "speed_ladder",
        "sensor_offset": "speed_ladder",
        "stribeck_friction": "slow_reversals",
        "temperature_dependent_friction": "warm_up",
    }
    experiment = "speed_ladder"
    parameters = (Parameter("coulomb_nm", "Nm", 0.0, 500.0, key="friction.coulomb_nm"),)
    hooks = ("loss_nm",)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        return (p["coulomb_nm"] - joint.friction.coulomb_nm) * s.direction

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("coulomb_nm", 1.0, joint.friction.coulomb_nm),)
