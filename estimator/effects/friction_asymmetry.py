"""Friction that is larger in one direction than in the other."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class FrictionAsymmetry(Effect):
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
    parameters = (Parameter("asymmetry_nm", "Nm", -5000.0, 5000.0),)
    columns = (Column("asymmetry_nm", 1.0),)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return p["asymmetry_nm"] * abs(s.direction)
