"""Fit only a joint file's friction to one measured run: linear least squares with intervals for coloured residuals.

Model (joint side, w = omega_m/G, s(w) the estimator's own smooth direction):

    G (Kt i - Jm domega_m/dt) - tau = Fc s(w) + Fv w [+ Fs s(w) exp(-(w/vs)^2)]

Left side and regressors pass the same first-order low-pass of bandwidth g [rad/s] as the observer's
estimate, so that its lag cannot be taken for friction; the filtered acceleration is exact without
differentiating: LP(dw/dt) = g (w - LP(w)). Rows at standstill are left out: there the friction torque is
known to an interval only.

A run does not always support every term. A term whose best value is negative (friction would drive the
joint), or that cannot be distinguished from the others in this run, keeps the joint file's value and the report says
so; "at its bound" is not identified. Intervals count independent samples only: n_eff = n / (1 + 2 sum
rho_k), rho the residual's autocorrelation up to its first value below 0.05. At 1 kHz that is hundreds of
times fewer than rows.

Friction at no load from plateaus: Coulomb and viscous, and what the zeros of current and sensor add to it.

    G Kt i - tau = Fc s(v) + Fv v + zero          s(v) the estimator's own smooth direction, v = omega_m/G

at plateaus whose motor carries next to no current (the other joint drives it round) or whose output carries next to no
torque. The zero of sensor and current together does not turn round with the direction, so that it can be separated
from friction where both directions are there; with only one it is taken as zero, and the report states that. The Stribeck
peak is the joint file's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from jtqd.estimator.checked import counted
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.sysid.fit.efficiency import SAME_VELOCITY_RAD_S
from jtqd.sysid.fit.plateaus import Plateau, effective_samples

Array = NDArray[np.float64]

COULOMB = "coulomb_nm"
VISCOUS = "viscous_nms_per_rad"
STRIBECK = "stribeck_nm"
STANDSTILL_RAD_S = 0.02  # joint side; below it the direction is mostly noise and stiction decides
# Condition number of the regressors scaled to unit length. Above it two of them differ by less than a few
# percent of their length over the whole run, and the split between them rests on the model's errors rather
# than on the data.
HIGHEST_CONDITION = 30.0
FEWEST_EFFECTIVE = 2.0  # independent rows per fitted term; fewer leave no interval worth printing


class FitError(ValueError):
    """The run cannot serve for the fit; one line with the reason."""


@dataclass(frozen=True)
class Term:
    """One friction term: value, half width of its 95 % interval, why it kept the file's value (or '')."""

    name: str
    value: float
    ci95: float
    kept: str = ""


@dataclass(frozen=True)
class FrictionFit:
    """The friction for the joint file, and the data behind it. RMSE in Nm over the rows in motion, filtered."""

    friction: Friction
    terms: tuple[Term, ...]
    rmse_before_nm: float
    rmse_after_nm: float
    rows: int
    effective_rows: float
    condition: float
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the report, one fact per line."""
        lines = []
        for term in self.terms:
            how = f"kept: {term.kept}" if term.kept else f"+- {term.ci95:.3g} (95 %)"
            if term.ci95 >= abs(term.value):
                how += ", not distinguished from zero"
            lines.append(f"{term.name} = {term.value:.4g}  {how}")
        lines.append(
            f"residual in this run {self.rmse_before_nm:.3f} -> {self.rmse_after_nm:.3f} Nm "
            f"over {self.rows} rows in motion (effective samples: {self.effective_rows:.0f}); "
            f"condition number {self.condition:.1f}"
        )
        return lines + [f"warning: {text}" for text in self.warnings]


def student_975(freedom: float) -> float:
    """0.975 quantile of Student's t (Abramowitz and Stegun 26.7.5); within 2 % from a freedom of 3 on."""
    z = 1.959964
    return (
        z
        + (z**3 + z) / (4.0 * freedom)
        + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * freedom**2)
        + (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * freedom**3)
    )


def fit_friction(
    time_s: Array, run: JointColumns, joint: Joint, *, stribeck: bool = False, bandwidth_rad_s: float = 200.0
) -> FrictionFit:
    """Fit Coulomb and viscous friction of a joint to a run; Stribeck too, at the file's velocity.

    Needs current, motor velocity and measured torque [n] of the joint; everything in `joint` but its
    friction is taken as true. Raises FitError when the run cannot serve.
    """
    current, omega_m, torque = _needed(run)
    dt_s = np.diff(time_s, prepend=time_s[0])
    speed = omega_m / joint.gear_ratio
    moving = np.abs(speed) > STANDSTILL_RAD_S
    target = loss_torque(dt_s, current, omega_m, torque, joint=joint, bandwidth_rad_s=bandwidth_rad_s)[moving]
    columns = {
        name: low_pass(column, dt_s, bandwidth_rad_s)[moving]
        for name, column in _regressors(speed, joint.friction, stribeck).items()
    }
    if int(np.count_nonzero(moving)) < 10 * len(columns):
        raise FitError(
            f"found {np.count_nonzero(moving)} rows in motion, expected at least {10 * len(columns)}"
        )
    before = {name: float(getattr(joint.friction, name)) for name in columns}
    kept, condition = _unidentified(columns, target, before)
    values, half_widths, effective = _solve(columns, target, before, kept)
    fitted = len(columns) - len(kept)
    if effective < FEWEST_EFFECTIVE * fitted:
        raise FitError(
            f"found {effective:.1f} independent rows for {fitted} terms, expected {FEWEST_EFFECTIVE:.0f} each"
        )
    terms = tuple(Term(name, values[name], half_widths[name], kept.get(name, "")) for name in columns)
    return FrictionFit(
        replace(joint.friction, **{name: values[name] for name in columns}),
        terms,
        _rms(target - _loss(columns, before)),
        _rms(target - _loss(columns, values)),
        len(target),
        effective,
        condition,
        _warnings(speed[moving]),
    )


def loss_torque(
    dt_s: Array, current: Array, omega_m: Array, torque: Array, *, joint: Joint, bandwidth_rad_s: float
) -> Array:
    """Return what the friction must explain [n] in Nm: LP(G (Kt i - Jm domega_m/dt) - tau)."""
    momentum = joint.rotor_inertia_kgm2 * bandwidth_rad_s * omega_m
    motor = low_pass(joint.torque_constant_nm_per_a * current + momentum, dt_s, bandwidth_rad_s) - momentum
    return joint.gear_ratio * motor - low_pass(torque, dt_s, bandwidth_rad_s)


def _needed(run: JointColumns) -> tuple[Array, Array, Array]:
    if run.current_a is None or run.motor_velocity_rad_s is None or run.torque_nm is None:
        missing = [n for n in ("current_a", "motor_velocity_rad_s", "torque_nm") if getattr(run, n) is None]
        raise FitError(f"found no {', '.join(missing)}, expected current, motor velocity and measured torque")
    return run.current_a, run.motor_velocity_rad_s, run.torque_nm


def _regressors(speed: Array, friction: Friction, stribeck: bool) -> dict[str, Array]:
    """Return the estimator's own friction torque at unit value of each term: the model is linear in them."""
    names = (COULOMB, VISCOUS, STRIBECK) if stribeck else (COULOMB, VISCOUS)
    none = replace(friction, coulomb_nm=0.0, viscous_nms_per_rad=0.0, stribeck_nm=0.0)
    return {name: FrictionModel(replace(none, **{name: 1.0})).torque_many(speed) for name in names}


def _unidentified(
    columns: Mapping[str, Array], target: Array, before: Mapping[str, float]
) -> tuple[dict[str, str], float]:
    """Terms to keep at the file's value, each with its reason, and the condition number of the others."""
    kept: dict[str, str] = {}
    while True:
        condition = _condition([column for name, column in columns.items() if name not in kept])
        free = [name for name in columns if name not in kept]
        if condition > HIGHEST_CONDITION and len(free) > 1:
            kept[free[-1]] = (
                f"cannot be distinguished from {free[0]} in this run (condition number {condition:.0f})"
            )
            continue
        values, half_widths, _ = _solve(columns, target, before, kept)
        negative = [name for name in free if values[name] < 0.0]
        if not negative:
            return kept, condition
        worst = min(negative, key=lambda name: values[name] / max(half_widths[name], 1e-12))
        kept[worst] = (
            f"best value {values[worst]:.3g} +- {half_widths[worst]:.2g} is negative, which is impossible for friction"
        )


def _condition(columns: list[Array]) -> float:
    if not columns:
        return 1.0
    return float(
        np.linalg.cond(np.column_stack([c / max(float(np.linalg.norm(c)), 1e-300) for c in columns]))
    )


def _solve(
    columns: Mapping[str, Array], target: Array, before: Mapping[str, float], kept: Mapping[str, str]
) -> tuple[dict[str, float], dict[str, float], float]:
    """Least squares of the terms not kept: values, 95 % half widths (NaN where kept), effective samples."""
    free = [name for name in columns if name not in kept]
    values = dict(before)
    half_widths = dict.fromkeys(columns, math.nan)
    rest = target - _loss({name: columns[name] for name in kept}, before)
    if free:
        matrix = np.column_stack([columns[name] for name in free])
        solution = np.linalg.lstsq(matrix, rest, rcond=None)[0]
        rest = rest - matrix @ solution
    effective = effective_samples(rest)
    if free:
        # Variance of the estimate as if only n_eff of the n rows were there: s^2 (X'X)^-1 n/n_eff.
        freedom = max(effective - len(free), 1.0)
        variance = float(rest @ rest) / len(rest) * effective / freedom
        inverse = np.linalg.pinv(matrix.T @ matrix) * (len(rest) / effective)
        for index, name in enumerate(free):
            values[name] = float(solution[index])
            half_widths[name] = student_975(freedom) * math.sqrt(variance * float(inverse[index, index]))
    return values, half_widths, effective


def _loss(columns: Mapping[str, Array], values: Mapping[str, float]) -> Array | float:
    return sum((values[name] * column for name, column in columns.items()), start=0.0)


def _rms(values: Array) -> float:
    return math.sqrt(float(values @ values) / len(values))


def _warnings(speed: Array) -> tuple[str, ...]:
    share = float(np.mean(speed > 0.0))
    if min(share, 1.0 - share) >= 0.1:
        return ()
    way = "positive" if share > 0.5 else "negative"
    return (
        f"nearly all motion is in {way} direction: Coulomb friction is not told from an offset "
        "of current or sensor",
    )


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
