"""Link inertia: the joint file's value is wrong."""

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


class LinkInertia(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "link_inertia"
    group = "load"
    equation = "load = (Jl' - Jl) alpha_l"
    source = "Newton-Euler; Swevers, Verdonck, De Schutter 2007, IEEE Control Systems Magazine 27"
    tell_tale = "Motor and torsion balance of one joint are in phase with the link's acceleration."
    confused_with = {
        "rotor_inertia": "quick_changes",
        "channel_delay": "quick_changes",
    }
    experiment = "quick_changes"
    parameters = (Parameter("link_inertia_kgm2", "kg m2", 0.0, 1000.0, key="link_inertia_kgm2"),)
    rate_based = True
    hooks = ("load_nm",)
    needs = ("link_acceleration_rad_s2",)
    changes_joint = True

    def load_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque taken before the sensor, Nm."""
        return (p["link_inertia_kgm2"] - joint.link_inertia_kgm2) * s.link_acceleration_rad_s2

    def joint(self, p: Values, joint: AnyJoint) -> AnyJoint:
        """Return the joint with this inertia."""
        return replace(joint, link_inertia_kgm2=p["link_inertia_kgm2"])

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        return (linear("link_inertia_kgm2", 0.01, joint.link_inertia_kgm2),)
