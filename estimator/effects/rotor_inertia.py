"""Rotor inertia: the joint file's value is wrong."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class RotorInertia(Effect):
    group = "actuator"
    equation = "loss = G (Jm' - Jm) alpha"
    source = "Newton-Euler; Swevers, Verdonck, De Schutter 2007, IEEE Control Systems Magazine 27"
    tell_tale = "The motor balance is in phase with the motor's acceleration."
    confused_with = {"viscous_friction": "speed_ladder"}
    experiment = "quick_changes"
    parameters = (Parameter("rotor_inertia_kgm2", "kg m2", 1e-09, 1000.0, key="rotor_inertia_kgm2"),)
    columns = (Column("rotor_inertia_kgm2", 0.1, of="rotor_inertia_kgm2"),)
    needs = ("motor_acceleration_rad_s2",)
    changes_joint = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        more = p["rotor_inertia_kgm2"] - joint.rotor_inertia_kgm2
        return joint.gear_ratio * more * s.motor_acceleration_rad_s2
