"""Hysteresis of the gear's torsion: a loop of torque over torsion, the same at any rate."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values

TRAVELS_RAD = (3e-5, 5e-5, 1e-4, 2e-4, 3e-4)
"""Grid of the search; the fit refines it."""


class Hysteresis(Effect):
    group = "transmission"
    equation = "tau = K d + H z, dz = dd/travel within -1..1, so that twist = H/K z"
    source = "Al-Bender, Lampaert, Swevers 2005, IEEE Trans. Automatic Control 50 (one Maxwell-slip element)"
    tell_tale = "The torsion balance changes after each reversal of the load, not of the velocity, over a fixed travel."
    confused_with = {"lost_motion": "load_ramp", "nonlinear_stiffness": "load_ramp"}
    experiment = "load_ramp"
    parameters = (Parameter("torque_nm", "Nm", 0.0, 5000.0), Parameter("travel_rad", "rad", 1e-06, 0.01))
    columns = tuple(Column("torque_nm", 1.0, {"travel_rad": travel}) for travel in TRAVELS_RAD)
    needs = ("torsion_rad",)
    follows_torsion = True

    def twist_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return (p["torque_nm"] / joint.stiffness_nm_per_rad) * x.slip(s.torsion_rad, p["travel_rad"])
