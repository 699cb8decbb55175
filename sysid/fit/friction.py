"""Fit Coulomb and viscous friction of a joint to plateaus at no load.

    G Kt i - tau = Fc s(v) + Fv v + offset          s(v): the estimator's smooth direction, v = omega_m/G

A plateau is at no load when the motor carries next to no current (the other joint drives) or the output next to no torque.
The offset of current and sensor does not change sign with the direction, which separates it from friction when the joint
moved both ways. With one direction the offset is taken as 0 and the report has a warning. The Stribeck peak is the joint
file's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.text import counted
from jtqd.sysid.fit.efficiency import SAME_VELOCITY_RAD_S
from jtqd.sysid.fit.plateaus import Plateau

COULOMB: Final = "coulomb_nm"
VISCOUS: Final = "viscous_nms_per_rad"
OFFSET: Final = "zero_nm"
NO_LOAD_SHARE: Final = 0.05
"""Share of rated torque that still counts as no load."""
FEWEST_VELOCITIES: Final = 3


class FitError(ValueError):
    """The run cannot serve for the fit; one line with the reason."""


@dataclass(frozen=True)
class Term:
    """One term of the fit: value and half width of its 95 % interval."""

    name: str
    value: float
    ci95: float


def student_975(freedom: float) -> float:
    """0.975 quantile of Student's t (Abramowitz and Stegun 26.7.5); within 2 % from a freedom of 3 on."""
    z = 1.959964
    return (
        z
        + (z**3 + z) / (4.0 * freedom)
        + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * freedom**2)
        + (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * freedom**3)
    )


@dataclass(frozen=True)
class NoLoadFit:
    """Friction for the joint file, its terms with the offset, RMS residual [Nm], number of plateaus."""

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
            f"expected at least {FEWEST_VELOCITIES}: the other joint drives this joint at zero current"
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
        columns[OFFSET] = np.ones_like(velocity)
    else:
        warnings.append(
            "all motion is in one direction: Coulomb friction includes the offsets of current and sensor"
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
