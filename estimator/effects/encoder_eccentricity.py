"""An encoder whose scale does not turn about its axis: one wave per revolution of that encoder."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import PHASE, Column, Effect, Functions, Joint, Parameter, State, Values


class EncoderEccentricity(Effect):
    group = "measurement"
    equation = "link = A sin(theta_l + phi); motor_side=1: link = -A/G sin(theta_m + phi), A motor side"
    source = "one-per-revolution error e/r of an eccentric scale; Slocum 1992, Precision Machine Design"
    tell_tale = (
        "The torsion swings once per revolution of the link (or of the motor), whatever the load. Of the link: nothing "
        "in the motor balance; of the motor: an acceleration there that grows with the square of the velocity."
    )
    confused_with = {
        "nonlinear_stiffness": "load_ramp",
        "kinematic_error": "full_turns",
        "torque_ripple": "full_turns",
        "sensor_crosstalk": "full_turns",
        "unbalance": "full_turns",
    }
    experiment = "full_turns"
    parameters = (
        Parameter("amplitude_rad", "rad", 0.0, 0.1),
        PHASE,
        Parameter(
            "motor_side",
            "",
            0.0,
            1.0,
            default=0.0,
            fixed=True,
            whole=True,
            prior="encoder_eccentricity.motor",
        ),
    )
    columns = (
        Column("amplitude_rad", 1e-5, {"motor_side": 0.0}),
        Column("amplitude_rad", 1e-3, {"motor_side": 1.0}),
    )
    needs = ("torsion_rad",)

    def link_rad(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        if p["motor_side"]:
            return (-p["amplitude_rad"] / joint.gear_ratio) * x.sin(s.motor_position_rad + p["phase_rad"])
        return p["amplitude_rad"] * x.sin(s.link_position_rad + p["phase_rad"])

    def at_motor_of(self, p: Values) -> bool:
        return bool(p["motor_side"])
