"""Friction that is larger in one direction than in the other."""

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


class FrictionAsymmetry(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "friction_asymmetry"
    group = "friction"
    equation = "loss = a |s|"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit 1994, Automatica 30 (levels by direction)"
    tell_tale = (
        "A constant of the motor balance that goes away at rest: a more in the positive, a less in the "
        "negative direction."
    )
    confused_with = {
        "load_dependent_friction": "load_at_both_directions",
        "lost_motion": "load_at_both_directions",
        "sensor_offset": "load_at_both_directions",
        "stribeck_friction": "slow_reversals",
    }
    experiment = "speed_ladder"
    parameters = (Parameter("asymmetry_nm", "Nm", -100.0, 100.0),)
    hooks = ("loss_nm",)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque lost beyond the file's losses, Nm joint side."""
        return p["asymmetry_nm"] * abs(s.direction)

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("asymmetry_nm", 1.0),)
