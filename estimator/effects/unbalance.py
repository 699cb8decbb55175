"""An unbalanced link: its weight turns with the link's angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from jtqd.estimator.effects.effect import Effect, Functions, JointValues, Parameter, State, Term, Values, Wave


class Unbalance(Effect):
    """Symbols as in `jtqd.estimator.effects.effect`."""

    name = "unbalance"
    group = "load"
    equation = "load = U sin(theta_l + phi)"
    source = "gravity of an eccentric mass, U = m g r"
    tell_tale = (
        "Motor and torsion balance of one joint swing once per revolution of the link, whatever load and "
        "speed."
    )
    experiment = "full_turns"
    parameters = (
        Parameter("moment_nm", "Nm", 0.0, 100.0),
        Parameter("phase_rad", "rad", -2.0 * math.pi, 2.0 * math.pi, default=0.0, neutral=None),
    )
    hooks = ("load_nm",)
    needs = ("link_position_rad",)

    def load_nm(self, p: Values, s: State, joint: JointValues, x: Functions) -> Any:
        """Return the torque taken before the sensor, Nm."""
        return p["moment_nm"] * x.sin(s.link_position_rad + p["phase_rad"])

    def terms(self, joint: JointValues) -> Sequence[Term]:
        """Return one wave (two columns)."""
        return (Wave("moment_nm", 0.1).term(),)
