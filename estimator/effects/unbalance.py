"""An unbalanced link: its weight turns with the link's angle."""

from __future__ import annotations

from typing import Any

from jtqd.estimator.effects.effect import PHASE, Column, Effect, Functions, Joint, Parameter, State, Values


class Unbalance(Effect):
    group = "load"
    equation = "load = U sin(theta_l + phi)"
    source = "gravity of an eccentric mass, U = m g r"
    tell_tale = "Motor and torsion balance of one joint swing once per revolution of the link, whatever load and speed."
    experiment = "full_turns"
    parameters = (Parameter("moment_nm", "Nm", 0.0, 10000.0), PHASE)
    columns = (Column("moment_nm", 0.1),)
    needs = ("link_position_rad",)

    def load_nm(self, p: Values, s: State, joint: Joint, x: Functions) -> Any:
        return p["moment_nm"] * x.sin(s.link_position_rad + p["phase_rad"])
