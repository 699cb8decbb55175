"""Baseline of friction alone: linear least squares on one measured run, with intervals for coloured residuals.

Model (joint side, w = omega_m/G, s(w) the estimator's own smooth direction):

    G (Kt i - Jm domega_m/dt) - tau = Fc s(w) + Fv w [+ Fs s(w) exp(-(w/vs)^2)]

Left side and regressors pass the same first-order low-pass of bandwidth g [rad/s] as the observer's
estimate, so that its lag cannot be taken for friction; the filtered acceleration is exact without
differentiating: LP(dw/dt) = g (w - LP(w)). Rows at standstill are left out: there the friction torque is
known to an interval only.

A run does not always support every term. A term whose best value is negative (friction would drive the
joint), or that cannot be distinguished from the others in this run, keeps the joint file's value, and the report
names it; "at its bound" is not identified. Intervals count independent samples only: n_eff = n / (1 + 2 sum
rho_k), rho the residual's autocorrelation up to its first value below 0.05. At 1 kHz that is hundreds of
times fewer than rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Friction, Joint
from jtqd.estimator.losses import FrictionModel
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.sysid.fit.plateaus import COULOMB, VISCOUS, FitError, effective_samples, student_975

STRIBECK = "stribeck_nm"
STANDSTILL_RAD_S = 0.02  # joint side; below it the direction is mostly noise and stiction decides
# Condition number of the regressors scaled to unit length. Above it two of them differ by less than a few
# percent of their length over the whole run, and the split between them rests on the model's errors rather
# than on the data.
HIGHEST_CONDITION = 30.0
FEWEST_EFFECTIVE = 2.0  # independent rows per fitted term; fewer leave no interval worth printing


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


def fit_friction(
    time_s: FloatArray,
    run: JointColumns,
    joint: Joint,
    *,
    stribeck: bool = False,
    bandwidth_rad_s: float = 200.0,
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
    dt_s: FloatArray,
    current: FloatArray,
    omega_m: FloatArray,
    torque: FloatArray,
    *,
    joint: Joint,
    bandwidth_rad_s: float,
) -> FloatArray:
    """Return what the friction must explain [n] in Nm: LP(G (Kt i - Jm domega_m/dt) - tau)."""
    momentum = joint.rotor_inertia_kgm2 * bandwidth_rad_s * omega_m
    motor = low_pass(joint.torque_constant_nm_per_a * current + momentum, dt_s, bandwidth_rad_s) - momentum
    return joint.gear_ratio * motor - low_pass(torque, dt_s, bandwidth_rad_s)


def _needed(run: JointColumns) -> tuple[FloatArray, FloatArray, FloatArray]:
    if run.current_a is None or run.motor_velocity_rad_s is None or run.torque_nm is None:
        missing = [n for n in ("current_a", "motor_velocity_rad_s", "torque_nm") if getattr(run, n) is None]
        raise FitError(f"found no {', '.join(missing)}, expected current, motor velocity and measured torque")
    return run.current_a, run.motor_velocity_rad_s, run.torque_nm


def _regressors(speed: FloatArray, friction: Friction, stribeck: bool) -> dict[str, FloatArray]:
    """Return the estimator's own friction torque at unit value of each term: the model is linear in them."""
    names = (COULOMB, VISCOUS, STRIBECK) if stribeck else (COULOMB, VISCOUS)
    none = replace(friction, coulomb_nm=0.0, viscous_nms_per_rad=0.0, stribeck_nm=0.0)
    return {name: FrictionModel(replace(none, **{name: 1.0})).torque_many(speed) for name in names}


def _unidentified(
    columns: Mapping[str, FloatArray], target: FloatArray, before: Mapping[str, float]
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


def _condition(columns: list[FloatArray]) -> float:
    if not columns:
        return 1.0
    return float(
        np.linalg.cond(np.column_stack([c / max(float(np.linalg.norm(c)), 1e-300) for c in columns]))
    )


def _solve(
    columns: Mapping[str, FloatArray],
    target: FloatArray,
    before: Mapping[str, float],
    kept: Mapping[str, str],
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


def _loss(columns: Mapping[str, FloatArray], values: Mapping[str, float]) -> FloatArray | float:
    return sum((values[name] * column for name, column in columns.items()), start=0.0)


def _rms(values: FloatArray) -> float:
    return math.sqrt(float(values @ values) / len(values))


def _warnings(speed: FloatArray) -> tuple[str, ...]:
    share = float(np.mean(speed > 0.0))
    if min(share, 1.0 - share) >= 0.1:
        return ()
    way = "positive" if share > 0.5 else "negative"
    return (
        f"nearly all motion is in {way} direction: Coulomb friction is not distinguished from an offset "
        "of current or sensor",
    )
