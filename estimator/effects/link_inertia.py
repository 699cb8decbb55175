"""Link inertia: the joint file's value is wrong."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class LinkInertia(Effect):
    group = "load"
    equation = "load = (Jl' - Jl) alpha_l"
    source = "Newton-Euler; Swevers, Verdonck, De Schutter 2007, IEEE Control Systems Magazine 27"
    tell_tale = "Motor and torsion balance of one joint are in phase with the link's acceleration."
    confused_with = {"rotor_inertia": "quick_changes", "channel_delay": "quick_changes"}
    experiment = "quick_changes"
    parameters = (Parameter("link_inertia_kgm2", "kg m2", 0.0, 1000.0, key="link_inertia_kgm2"),)
    columns = (Column("link_inertia_kgm2", 0.01),)
    rate_based = True
    needs = ("link_acceleration_rad_s2",)
    changes_joint = True

    def load_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return (p["link_inertia_kgm2"] - joint.link_inertia_kgm2) * s.link_acceleration_rad_s2
