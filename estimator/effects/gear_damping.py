"""Gear damping: the damper beside the gear's spring is not the joint file's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

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

_USUAL_S: Final = 1e-3
"""Damping by stiffness that a column is made for; a fit takes any."""


class GearDamping(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "gear_damping"
    group = "transmission"
    equation = "twist = (D' - D) / K d(theta_m/G - theta_l)/dt"
    source = "Kelvin-Voigt model; Spong 1987, ASME J. Dynamic Systems, Measurement and Control 109"
    tell_tale = "The torsion balance follows the rate of the torque, the motor balance does not."
    confused_with = {
        "hysteresis": "load_ramp",
        "channel_delay": "quick_changes",
        "link_inertia": "quick_changes",
    }
    experiment = "quick_changes"
    parameters = (Parameter("damping_nms_per_rad", "Nms/rad", 0.0, 1e6, key="damping_nms_per_rad"),)
    rate_based = True
    hooks = ("twist_rad",)
    needs = ("torsion_rate_rad_s",)
    changes_joint = True

    def twist_rad(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the twist that gives the additional damper's torque, rad."""
        more = p["damping_nms_per_rad"] - joint.damping_nms_per_rad
        return more / joint.stiffness_nm_per_rad * s.torsion_rate_rad_s

    def joint(self, p: Values, joint: AnyJoint) -> AnyJoint:
        """Return the joint with this damping."""
        return replace(joint, damping_nms_per_rad=p["damping_nms_per_rad"])

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one column."""
        step = _USUAL_S * joint.stiffness_nm_per_rad
        return (linear("damping_nms_per_rad", step, joint.damping_nms_per_rad),)
