"""Gear damping: the damper beside the gear's spring is not the joint file's."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class GearDamping(Effect):
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
    columns = (Column("damping_nms_per_rad", 1e-3, of="stiffness_nm_per_rad"),)
    rate_based = True
    needs = ("torsion_rate_rad_s",)
    changes_joint = True

    def twist_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        more = p["damping_nms_per_rad"] - joint.damping_nms_per_rad
        return more / joint.stiffness_nm_per_rad * s.torsion_rate_rad_s
