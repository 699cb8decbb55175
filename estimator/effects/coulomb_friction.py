"""Coulomb friction: the joint file's value is wrong."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class CoulombFriction(Effect):
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
    parameters = (Parameter("coulomb_nm", "Nm", 0.0, 5000.0, key="friction.coulomb_nm"),)
    columns = (Column("coulomb_nm", 1.0),)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return (p["coulomb_nm"] - joint.friction.coulomb_nm) * s.direction
