"""Friction at no load from plateaus: Coulomb and viscous, and what the zeros of current and sensor add to it.

    G Kt i - tau = Fc s(v) + Fv v + zero          s(v) the estimator's own smooth direction, v = omega_m/G

at plateaus whose motor carries next to no current (the other joint drives it round) or whose output carries next to no
torque. The zero of sensor and current together does not turn round with the direction, so that it can be separated
from friction where both directions are there; with only one it is taken as zero, and the report states that. The Stribeck
peak is the joint file's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.sysid.fit.efficiency import SAME_VELOCITY_RAD_S
from jtqd.sysid.fit.friction import COULOMB, VISCOUS, FitError, Term, student_975
from jtqd.sysid.fit.plateaus import Plateau

NO_LOAD_SHARE: Final = 0.05
"""Share of rated torque that still counts as no load."""
FEWEST_VELOCITIES: Final = 3
ZERO: Final = "zero_nm"


@dataclass(frozen=True)
class NoLoadFit:
    """Friction for the joint file, its terms with the zero, the RMS residual [Nm] and its plateaus."""

    friction: Friction
    terms: tuple[Term, ...]
    rmse_nm: float
    plateaus: int
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the report, one fact per line."""
        lines = [f"{term.name} = {term.value:.4g}  +- {term.ci95:.2g} (95 %)" for term in self.terms]
        lines.append(f"residual {self.rmse_nm:.3f} Nm RMS over {self.plateaus} plateaus at no load")
        return lines + [f"warning: {text}" for text in self.warnings]


def no_load(plateaus: Sequence[Plateau], joint: Joint, current_max_a: float) -> list[Plateau]:
    """Return the plateaus with |i| <= current_max_a [A] or next to no torque."""
    torque_max = NO_LOAD_SHARE * joint.rated_torque_nm
    return [p for p in plateaus if abs(p.current.value) <= current_max_a or abs(p.torque.value) <= torque_max]


def fit_no_load(plateaus: Sequence[Plateau], joint: Joint) -> NoLoadFit:
    """Fit Coulomb and viscous friction to plateaus at no load; gear ratio and torque constant are taken as true.

    Raises:
        FitError: fewer than three velocities, or a friction that would drive the joint.
    """
    velocity = np.array([p.velocity.value for p in plateaus])
    speeds = np.sort(np.abs(velocity))
    distinct = int(np.count_nonzero(np.diff(speeds, prepend=-1.0) > SAME_VELOCITY_RAD_S))
    if distinct < FEWEST_VELOCITIES:
        raise FitError(
            f"found {counted(distinct, 'velocity', 'velocities')} at no load ({counted(len(plateaus), 'plateau')}), "
            f"expected at least {FEWEST_VELOCITIES}: "
            "the other joint drives this joint at zero current"
        )
    nm_per_a = joint.gear_ratio * joint.torque_constant_nm_per_a
    none = replace(joint.friction, coulomb_nm=0.0, viscous_nms_per_rad=0.0)
    peak = FrictionModel(none).torque_many(velocity)
    loss = np.array([nm_per_a * p.current.value - p.torque.value for p in plateaus]) - peak
    columns = {
        COULOMB: FrictionModel(Friction(1.0, 0.0)).torque_many(velocity),
        VISCOUS: FrictionModel(Friction(0.0, 1.0)).torque_many(velocity),
    }
    warnings = []
    if bool(np.any(velocity > 0.0)) and bool(np.any(velocity < 0.0)):
        columns[ZERO] = np.ones_like(velocity)
    else:
        warnings.append(
            "all motion is in one direction: Coulomb friction includes the zeros of current and sensor"
        )
    matrix = np.column_stack(list(columns.values()))
    values = np.linalg.lstsq(matrix, loss, rcond=None)[0]
    residual = loss - matrix @ values
    freedom = max(len(loss) - len(values), 1)
    covariance = float(residual @ residual) / freedom * np.linalg.inv(matrix.T @ matrix)
    widths = student_975(freedom) * np.sqrt(np.diag(covariance))
    terms = tuple(Term(n, float(v), float(w)) for n, v, w in zip(columns, values, widths, strict=True))
    negative = [term for term in terms[:2] if term.value < 0.0]
    if negative:
        raise FitError(
            f"found {negative[0].name} = {negative[0].value:.3g} +- {negative[0].ci95:.2g}, expected a friction >= 0: "
            "swapped sign of current, torque or velocity, or a wrong gear ratio"
        )
    friction = replace(
        joint.friction,
        coulomb_nm=round(terms[0].value, 4),
        viscous_nms_per_rad=round(terms[1].value, 4),
    )
    rmse = math.sqrt(float(np.mean(residual**2)))
    return NoLoadFit(friction, terms, rmse, len(loss), tuple(warnings))
