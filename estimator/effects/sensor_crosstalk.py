"""The torque sensor reads bending too: once per revolution of the coupling."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import PHASE, Column, Effect, Functions, Joint, Parameter, State, Values


class SensorCrosstalk(Effect):
    group = "measurement"
    equation = "sensor = (A + share tau) cos(theta_c + phi), theta_c link position of joint 1"
    source = "parasitic bending moment of a torque transducer, fixed in space, first order"
    tell_tale = "All balances of both joints swing once per revolution of the coupling; with the load where the load bends."
    confused_with = {"unbalance": "full_turns", "sensor_offset": "full_turns"}
    experiment = "full_turns"
    by_hand = {
        "unbalance": "If the class remains, turn the coupling by a quarter and repeat the campaign: crosstalk turns with "
        "the sensor, unbalance does not."
    }
    parameters = (
        Parameter("amplitude_nm", "Nm", 0.0, 1000.0, default=0.0),
        Parameter("share", "", 0.0, 0.5, default=0.0, prior="sensor_crosstalk.share"),
        PHASE,
    )
    columns = (Column("amplitude_nm", 0.1, {"share": 0.0}), Column("share", 0.01, {"amplitude_nm": 0.0}))
    needs = ("coupling_position_rad", "torque_nm")
    at_sensor = True

    def sensor_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        size = p["amplitude_nm"] + p["share"] * s.torque_nm
        return size * x.cos(s.coupling_position_rad + p["phase_rad"])
