"""The gear is not a spring of the joint file's stiffness: another one, or one that hardens."""

from __future__ import annotations

import math
from typing import Any

from jtqd.estimator.effects.effect import Effect, Functions, Joint, Linear, Parameter, State, Terms, Values


class NonlinearStiffness(Effect):
    group = "transmission"
    equation = "tau = K' d + K3 d^3, so that twist = (K'/K - 1) d + K3/K d^3"
    source = "Tuttle and Seering 1996, IEEE Trans. Robotics and Automation 12"
    tell_tale = (
        "The torsion balance is an odd function of the torque alone: a slope, and a cubic at large loads."
    )
    confused_with = {"sensor_gain": "load_at_both_directions"}
    experiment = "load_ramp"
    parameters = (
        Parameter(
            "stiffness_nm_per_rad",
            "Nm/rad",
            1.0,
            1e9,
            default=math.nan,
            key="stiffness_nm_per_rad",
            prior="stiffness",
        ),
        Parameter("cubic_nm_per_rad3", "Nm/rad3", -1e13, 1e14, default=0.0),
    )
    scales_balance = "torsion"
    needs = ("torsion_rad",)

    def twist_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        own = joint.stiffness_nm_per_rad
        d = s.torsion_rad
        return (p.get("stiffness_nm_per_rad", own) / own - 1.0) * d + (p["cubic_nm_per_rad3"] / own) * (
            d * d * d
        )

    def terms(self, joint: Joint) -> Terms:
        """Return another slope, hardening alone, and both."""
        own = joint.stiffness_nm_per_rad
        # at the rated torque, K3 d^3 is a tenth of the torque
        cubic = 0.1 * own * (own / joint.rated_torque_nm) ** 2
        slope = Linear(("stiffness_nm_per_rad",), (own,), (0.1 * own,), {"cubic_nm_per_rad3": 0.0})
        hardening = Linear(("cubic_nm_per_rad3",), (0.0,), (cubic,), {"stiffness_nm_per_rad": own})
        both = Linear(("stiffness_nm_per_rad", "cubic_nm_per_rad3"), (own, 0.0), (0.1 * own, cubic))
        return slope.term(), hardening.term(), both.term()
