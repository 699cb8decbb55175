"""Friction that grows with the torque that the gear transmits."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import Column, Effect, Functions, Joint, Parameter, State, Values


class LoadDependentFriction(Effect):
    group = "friction"
    equation = "loss = mu |tau| s"
    source = "Bittencourt, Wernholt, Sander-Tavallaey, Brogardh 2010, IROS; model M3 of BAM, arXiv:2410.08650"
    tell_tale = (
        "Steps at reversals that grow with the load: half the difference of both directions at equal torque."
    )
    confused_with = {
        "torque_constant": "load_at_both_directions",
        "sensor_gain": "load_at_both_directions",
        "viscous_friction": "load_at_both_directions",
        "torque_constant_saturation": "load_at_both_directions",
    }
    experiment = "load_at_both_directions"
    parameters = (Parameter("load_coefficient", "", 0.0, 0.9),)
    columns = (Column("load_coefficient", 0.1),)
    needs = ("torque_nm",)
    dissipative = True

    def loss_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return p["load_coefficient"] * abs(s.torque_nm) * s.direction
