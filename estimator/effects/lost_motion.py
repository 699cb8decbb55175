"""Lost motion: play between gear and link, crossed when the torque changes its sign."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values

WIDTHS_RAD = (3e-5, 1e-4, 3e-4, 1e-3)
"""Grid of the search, whose coefficients scale the width (exact beyond the play); the fit refines it."""


class LostMotion(Effect):
    group = "transmission"
    equation = "twist = -clip(d, -w/2, w/2), w the full width"
    source = "Nordin and Gutman 2002, Automatica 38 (dead zone)"
    tell_tale = "The torsion balance jumps by K w where the torque, not the velocity, changes its sign."
    confused_with = {"stribeck_friction": "slow_reversals", "nonlinear_stiffness": "load_ramp"}
    experiment = "load_ramp"
    parameters = (Parameter("width_rad", "rad", 0.0, 0.2),)
    columns = tuple(Column("width_rad", width) for width in WIDTHS_RAD)
    needs = ("torsion_rad",)
    follows_torsion = True

    def twist_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        half = 0.5 * p["width_rad"]
        return -x.clip(s.torsion_rad, -half, half)
