"""Efficiency map: fit the paper's Eq. (8) to measured plateaus, one polynomial per quadrant of (i, omega_m), and report it.

    eta = p00 + p10 i + p01 v + p20 i^2 + p11 i v + p02 v^2        v = omega_m/G [rad/s], i [A], both signed

eta has two conventions: "joint_over_motor", tau_j/(G Kt i), as in Table I; "motor_over_joint", G Kt i/tau_j, as in Eq. (6).
A point is measured once, as tau_j and i; its eta in either convention follows from these.

At constant velocity the motor's inertia carries nothing, so G Kt i = tau_j + loss, and the loss has the sign of v. Below
the current that overcomes the joint's own friction, (Fc + Fs)/(G Kt), the torque of a driving joint may be of either
sign and eta goes through 0/0: such points are left out and counted.

At every plateau the loss (G Kt i - tau_j) sign(v) is positive: eta = tau_j/(G Kt i) is below 1 when driving, above 1
when back-driven, never negative. A measurement that differs by more than its standard errors and the sensor's offset shows a
wrong number in the joint file or a wrong channel, and is not fitted.

The report has text, plain values, and the paper's Fig. 6 (measured eta and fitted surface per quadrant).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.decoder import plain_values
from jtqd.estimator.files import whole_file
from jtqd.estimator.joint import CONVENTIONS, QUADRANTS, Efficiency, Joint, QuadrantPolynomial
from jtqd.estimator.losses import (
    BACKDRIVING_CURRENT_MAX_A,
    BLEND_CURRENT_A,
    DRIVING_CURRENT_MAX_A,
    VELOCITY_RANGE_RAD_S,
    LossModel,
    static_friction,
)
from jtqd.estimator.text import table_lines
from jtqd.sysid.fit.plateaus import SAME_VELOCITY_RAD_S, Plateau, mean_temperature
from jtqd.sysid.report.page import plain
from jtqd.sysid.runs.channels import RunIssue

COEFFICIENTS: Final = ("p00", "p10", "p01", "p20", "p11", "p02")
FEWEST_DISTINCT: Final = len(COEFFICIENTS) + 1
"""Least operating points per quadrant: six coefficients, and one more to check them."""
HIGHEST_CONDITION: Final = 3000.0
"""Of the columns scaled to unit length: 30 to 60 for the points of section II. Beyond this the data do not span Eq. (8)."""
SAME_CURRENT_A: Final = 0.1
"""Plateaus closer than this and SAME_VELOCITY_RAD_S are the same operating point measured again."""
OFFSET_SHARE: Final = 0.01
"""Largest offset of the sensor from day to day, as a share of rated torque: 0.4 Nm of 40 Nm."""


@dataclass(frozen=True)
class EtaPoint:
    """One plateau with its quadrant. `ratio` is tau_j/(G Kt i) whatever the convention of the fit.

    se: of the ratio by the standard errors of torque and current; motor_nm: G Kt i; loss_nm: energy lost per angle,
    (G Kt i - tau_j) sign(v), positive in every real joint; loss_se: of that.
    """

    plateau: Plateau
    quadrant: str
    ratio: float
    se: float
    motor_nm: float
    loss_nm: float
    loss_se: float

    def eta(self, convention: str) -> float:
        """Eta in the named convention."""
        return self.ratio if convention == "joint_over_motor" else 1.0 / self.ratio

    def eta_se(self, convention: str) -> float:
        """Return its standard error, to first order."""
        return self.se if convention == "joint_over_motor" else self.se / self.ratio**2

    @property
    def driving(self) -> bool:
        """Current and velocity of one sign."""
        return self.quadrant in QUADRANTS[:2]


@dataclass(frozen=True)
class QuadrantFit:
    """One quadrant. rmse = sqrt(SSE/(n - 6)); rmse_nm the same error as joint torque; errors: of the coefficients."""

    polynomial: QuadrantPolynomial
    errors: Mapping[str, float]
    rmse: float
    rmse_nm: float
    plateaus: int
    distinct: int
    condition: float
    current_range_a: tuple[float, float]
    velocity_range_rad_s: tuple[float, float]


@dataclass(frozen=True)
class EfficiencyFit:
    """All quadrants in one convention; those that could not be fitted are in `refused` with the reason."""

    convention: str
    weighted: bool
    quadrants: Mapping[str, QuadrantFit]
    refused: Mapping[str, str]

    def efficiency(self, kept: Efficiency | None = None) -> Efficiency:
        """For the joint file; refused quadrants are those of `kept`, which must be of the same convention.

        Raises:
            ValueError: a quadrant is missing and there is nothing to keep in this convention.
        """
        if self.refused and (kept is None or kept.convention != self.convention):
            have = "no efficiency" if kept is None else f"one in the convention {kept.convention}"
            raise ValueError(
                f"found no fit of {', '.join(self.refused)}, and the joint file has {have}, expected all four "
                f"quadrants or a joint file whose own, in the convention {self.convention}, can be kept"
            )
        polynomials = {
            name: self.quadrants[name].polynomial if name in self.quadrants else getattr(kept, name)
            for name in QUADRANTS
        }
        return Efficiency(self.convention, **polynomials)


def default_current_min(joint: Joint) -> float:
    """The current [A] that overcomes the joint's own static friction; below it the sign of the torque is open."""
    return static_friction(joint.friction) / (joint.gear_ratio * joint.torque_constant_nm_per_a)


def quadrant_of(current_a: float, velocity_rad_s: float) -> str:
    """Name of the quadrant; neither argument may be zero."""
    return f"i_{'pos' if current_a > 0.0 else 'neg'}_w_{'pos' if velocity_rad_s > 0.0 else 'neg'}"


def eta_points(
    plateaus: Iterable[Plateau], joint: Joint, current_min_a: float
) -> tuple[list[EtaPoint], list[Plateau]]:
    """Split plateaus into points with an eta and those left out because |i| < current_min_a [A] (eta is 0/0 there)."""
    nm_per_a = joint.gear_ratio * joint.torque_constant_nm_per_a
    points, left_out = [], []
    for plateau in plateaus:
        i, v, tau = plateau.current, plateau.velocity, plateau.torque
        if abs(i.value) < current_min_a or i.value == 0.0 or tau.value == 0.0:
            left_out.append(plateau)
            continue
        motor_nm = nm_per_a * i.value
        ratio = tau.value / motor_nm
        se = math.hypot(tau.se / motor_nm, ratio * i.se / i.value)
        loss = math.copysign(1.0, v.value) * (motor_nm - tau.value)
        quadrant = quadrant_of(i.value, v.value)
        loss_se = math.hypot(nm_per_a * i.se, tau.se)
        points.append(EtaPoint(plateau, quadrant, ratio, se, motor_nm, loss, loss_se))
    return points, left_out


def fit_efficiency(
    points: Sequence[EtaPoint], convention: str, joint: Joint, *, weighted: bool = False
) -> EfficiencyFit:
    """Fit Eq. (8) to the points of each quadrant in the named convention.

    weighted: by 1/variance, of the plateau's own standard error and of the sensor's offset (OFFSET_SHARE of rated torque),
    which is the same torque at any load: an error of eta at a small load then counts as the little torque it is.
    Raises ValueError for an unknown convention.
    """
    if convention not in CONVENTIONS:
        raise ValueError(f"convention: found {convention!r}, expected one of {', '.join(CONVENTIONS)}")
    fits, refused = {}, {}
    for name in QUADRANTS:
        own = in_quadrant(points, name)
        try:
            fits[name] = _fit_quadrant(own, convention, joint, weighted)
        except ValueError as error:
            refused[name] = f"{name}: {error}"
    return EfficiencyFit(convention, weighted, fits, refused)


def in_quadrant(points: Iterable[EtaPoint], name: str) -> list[EtaPoint]:
    """Return the points of one quadrant."""
    return [point for point in points if point.quadrant == name]


def distinct_points(points: Sequence[EtaPoint]) -> int:
    """Return the number of different operating points: a plateau measured again near (i, v) of another adds none."""
    seen: list[tuple[float, float]] = []
    for point in points:
        i, v = point.plateau.current.value, point.plateau.velocity.value
        if not any(abs(i - a) < SAME_CURRENT_A and abs(v - b) < SAME_VELOCITY_RAD_S for a, b in seen):
            seen.append((i, v))
    return len(seen)


def design_matrix(current_a: FloatArray, velocity_rad_s: FloatArray) -> FloatArray:
    """Return columns [n, 6] of Eq. (8) in the order of COEFFICIENTS."""
    i, v = current_a, velocity_rad_s
    return np.column_stack((np.ones_like(i), i, v, i * i, i * v, v * v))


def operating_points(points: Sequence[EtaPoint]) -> tuple[FloatArray, FloatArray]:
    """Current [A] and velocity [rad/s] of the points, each [n]."""
    current = np.array([point.plateau.current.value for point in points])
    return current, np.array([point.plateau.velocity.value for point in points])


def _fit_quadrant(points: Sequence[EtaPoint], convention: str, joint: Joint, weighted: bool) -> QuadrantFit:
    """Raises ValueError with the reason why these points carry no fit."""
    distinct = distinct_points(points)
    if distinct < FEWEST_DISTINCT:
        raise ValueError(
            f"found {distinct} distinct operating points ({len(points)} plateaus), expected at least {FEWEST_DISTINCT}"
        )
    current, velocity = operating_points(points)
    eta = np.array([point.eta(convention) for point in points])
    columns = design_matrix(current, velocity)
    lengths = np.linalg.norm(columns, axis=0)
    condition = float(np.linalg.cond(columns / lengths))
    if not condition < HIGHEST_CONDITION:
        raise ValueError(
            f"found a condition number of {condition:.0f} (currents {_span(current)} A, velocities {_span(velocity)} "
            f"rad/s), expected below {HIGHEST_CONDITION:.0f}: at least three currents at three velocities"
        )
    weights = np.ones_like(eta)
    if weighted:
        offset_nm = OFFSET_SHARE * joint.rated_torque_nm
        spread = [
            math.hypot(p.se, offset_nm / p.motor_nm) * (1.0 if p.eta(convention) == p.ratio else p.ratio**-2)
            for p in points
        ]
        weights = 1.0 / np.array(spread)
        weights /= math.sqrt(float(np.mean(weights**2)))
    scaled = columns * weights[:, None]
    values = np.linalg.lstsq(scaled / lengths, eta * weights, rcond=None)[0] / lengths
    residual = eta - columns @ values
    freedom = len(points) - len(values)
    variance = float(np.sum((weights * residual) ** 2)) / freedom
    covariance = (
        variance * np.linalg.inv((scaled / lengths).T @ (scaled / lengths)) / np.outer(lengths, lengths)
    )
    rmse = math.sqrt(float(residual @ residual) / freedom)
    return QuadrantFit(
        QuadrantPolynomial(
            **dict(zip(COEFFICIENTS, np.round(values, 6).tolist(), strict=True)), rmse=round(rmse, 6)
        ),
        dict(zip(COEFFICIENTS, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        rmse,
        math.sqrt(float(np.mean(_torque_error(points, columns @ values, convention) ** 2))),
        len(points),
        distinct,
        condition,
        (float(current.min()), float(current.max())),
        (float(velocity.min()), float(velocity.max())),
    )


def _torque_error(points: Sequence[EtaPoint], eta: FloatArray, convention: str) -> FloatArray:
    """Fitted minus measured joint torque [n] in Nm."""
    ratio = eta if convention == "joint_over_motor" else 1.0 / eta
    motor = np.array([point.motor_nm for point in points])
    error: FloatArray = ratio * motor - np.array([point.plateau.torque.value for point in points])
    return error


def _span(values: FloatArray) -> str:
    return f"{float(values.min()):.3g} to {float(values.max()):.3g}"


TABLE_I: Final = Efficiency(
    convention="joint_over_motor",
    i_pos_w_pos=QuadrantPolynomial(0.2530, 0.1493, -0.0820, -0.0117, 0.0060, 0.0066, rmse=0.01963),
    i_neg_w_neg=QuadrantPolynomial(0.2850, -0.1430, 0.0839, -0.0114, 0.0059, 0.0060, rmse=0.01719),
    i_neg_w_pos=QuadrantPolynomial(1.8830, 0.4870, 0.2602, 0.0658, 0.0435, -0.0168, rmse=0.05599),
    i_pos_w_neg=QuadrantPolynomial(1.8660, -0.4769, -0.2342, 0.0645, 0.04295, -0.0101, rmse=0.05504),
)
"""The paper's fitted efficiency of its integrated joint: eta = tau_j/(G Kt i), below 1 when driving, the reciprocal of its
Eq. (6), so that its Eq. (7) must multiply by it. Velocity omega_m/G 0.2 to 3 rad/s, current in A."""


STANDARD_ERRORS: Final = 3.0
"""How many of them a plateau may be beyond the border, besides the sensor's offset."""


def efficiency_findings(points: Sequence[EtaPoint], joint: Joint) -> list[RunIssue]:
    """Return where the plateaus contradict the joint file or the channels; an empty list is good."""
    offset_nm = OFFSET_SHARE * joint.rated_torque_nm
    against = [
        p
        for p in points
        if p.ratio < 0.0 and abs(p.plateau.torque.value) > _reach(p.plateau.torque.se, offset_nm)
    ]
    if against:
        return [_against_current(against, points)]
    kinds = {driving: [p for p in points if p.driving is driving] for driving in (True, False)}
    gaining = {
        driving: [p for p in own if p.loss_nm < -_reach(p.loss_se, offset_nm)]
        for driving, own in kinds.items()
    }
    # More than half of both: then it is not a scale, which moves eta of both kinds the same way.
    mirrored = all(2 * len(gaining[driving]) > len(own) for driving, own in kinds.items())
    found = []
    if gaining[True]:
        worst = max(gaining[True], key=lambda p: p.ratio)
        cause = _MIRRORED if mirrored else _SCALE.format("small", 100.0 * (worst.ratio - 1.0), "much")
        expected = "at most 1 when driving"
        found.append(
            _finding("eta_above_1_driving", gaining[True], kinds[True], worst, expected=expected, cause=cause)
        )
    if gaining[False]:
        worst = min(gaining[False], key=lambda p: p.ratio)
        cause = _MIRRORED if mirrored else _SCALE.format("large", 100.0 * (1.0 / worst.ratio - 1.0), "little")
        expected = "at least 1 when back-driven"
        found.append(
            _finding(
                "eta_below_1_back_driven", gaining[False], kinds[False], worst, expected=expected, cause=cause
            )
        )
    return found


_MIRRORED: Final = (
    "swapped sign of the velocity (or of current and torque together), or torque and motor torque exchanged, as eta in "
    "the wrong convention would be"
)
_SCALE: Final = (
    "G Kt of the joint file is too {} by {:.0f} % or more (gear ratio, torque constant), or the torque channel reads too "
    "{} (gain, unit)"
)


def written_findings(written: Joint, points: Sequence[EtaPoint], fit: EfficiencyFit) -> list[RunIssue]:
    """Compare the joint as it will be written, through the estimator's own loss law, with the measured torque.

    The law clamps eta outside its range, so only points in its range are compared. Coefficients of one convention under the
    name of the other give another torque altogether.
    """
    model = LossModel(written)
    compared = [p for p in points if p.quadrant in fit.quadrants and _in_range(p)]
    if not compared:
        return []
    current, velocity = operating_points(compared)
    motor = np.array([p.motor_nm for p in compared])
    measured = np.array([p.plateau.torque.value for p in compared])
    by_law = motor - model.loss_many(current, velocity)
    rms_nm = math.sqrt(float(np.mean((by_law - measured) ** 2)))
    fitted_nm = max(fit.quadrants[p.quadrant].rmse_nm for p in compared)
    if rms_nm <= 2.0 * fitted_nm + OFFSET_SHARE * written.rated_torque_nm:
        return []
    convention = "no efficiency" if written.efficiency is None else written.efficiency.convention
    return [
        RunIssue(
            "convention",
            f"{written.name}: the coefficients under the name '{convention}' miss the measured torque by {rms_nm:.2f} Nm "
            f"(RMS of {len(compared)} plateaus), expected about {fitted_nm:.2f} Nm as in the fit: wrong convention of eta",
        )
    ]


def _in_range(point: EtaPoint) -> bool:
    i, v = abs(point.plateau.current.value), abs(point.plateau.velocity.value)
    most = DRIVING_CURRENT_MAX_A if point.driving else BACKDRIVING_CURRENT_MAX_A
    slack = 1e-3  # a commanded 0.2 rad/s may come out as 0.1999
    return 3.0 * BLEND_CURRENT_A < i <= most and (
        VELOCITY_RANGE_RAD_S[0] - slack <= v <= VELOCITY_RANGE_RAD_S[1] + slack
    )


def _reach(standard_error_nm: float, offset_nm: float) -> float:
    return STANDARD_ERRORS * standard_error_nm + offset_nm


def _against_current(points: Sequence[EtaPoint], of: Sequence[EtaPoint]) -> RunIssue:
    worst = max(points, key=lambda p: abs(p.plateau.torque.value))
    # Losses are positive: with the sign of the swapped channel put right the energy balance comes out so.
    if_torque = sum(
        math.copysign(1.0, p.plateau.velocity.value) * (p.motor_nm + p.plateau.torque.value) for p in points
    )
    swapped = "torque" if if_torque > 0.0 else "current"
    cause = f"swapped sign of the {swapped} (with the other sign the joint loses energy)"
    return _finding("torque_against_current", points, of, worst, expected="a positive eta", cause=cause)


def _finding(
    kind: str,
    points: Sequence[EtaPoint],
    of: Sequence[EtaPoint],
    worst: EtaPoint,
    *,
    expected: str,
    cause: str,
) -> RunIssue:
    p = worst.plateau
    return RunIssue(
        kind,
        f"{len(points)} of {len(of)} plateaus: found eta {worst.ratio:.3f} +- {worst.se:.3f} at i = "
        f"{p.current.value:.2f} A, v = {p.velocity.value:.2f} rad/s ({p.run} at {p.start_s:.1f} s), expected {expected}. "
        f"Likely: {cause}",
    )


SCHEMA: Final = "jtq.efficiency/1"
QUADRANT_TITLES: Final = {
    "i_pos_w_pos": "i > 0, w > 0: driving",
    "i_neg_w_neg": "i < 0, w < 0: driving",
    "i_neg_w_pos": "i < 0, w > 0: back-driven",
    "i_pos_w_neg": "i > 0, w < 0: back-driven",
}


@dataclass(frozen=True)
class EfficiencyResult:
    """Result of one `jtq fit efficiency`; `fits`: the one to be written first, then those for comparison."""

    joint: str
    number: int
    runs: Mapping[str, str]
    current_min_a: float
    points: tuple[EtaPoint, ...] = ()
    left_out: tuple[Plateau, ...] = ()
    fits: tuple[EfficiencyFit, ...] = ()
    findings: tuple[RunIssue, ...] = ()

    @property
    def temperature_c(self) -> float:
        """Mean over the plateaus, NaN where it was not measured."""
        return mean_temperature([point.plateau for point in self.points])


def difference_from_table(
    points: Sequence[EtaPoint], name: str, polynomial: QuadrantPolynomial
) -> FloatArray:
    """Fitted minus Table I's eta (joint over motor) at the measured points of one quadrant, [n]."""
    own = in_quadrant(points, name)
    paper: QuadrantPolynomial = getattr(TABLE_I, name)
    pairs = zip(*(column.tolist() for column in operating_points(own)), strict=True)
    return np.array([polynomial.value(i, v) - paper.value(i, v) for i, v in pairs])


def report_lines(result: EfficiencyResult) -> list[str]:
    """Return the report, ready to print."""
    warm = "" if math.isnan(result.temperature_c) else f", {result.temperature_c:.1f} degC on average"
    lines = [
        f"{result.joint} (j{result.number}): {len(result.points)} plateaus in {len(result.runs)} runs{warm}",
        "",
        "measured eta (lowest to highest, with the largest standard error)",
        *_indented(_measured_lines(result)),
    ]
    for fit in result.fits:
        kind = "weighted least squares" if fit.weighted else "least squares"
        lines += ["", f"Eq. (8) in the convention {fit.convention}, {kind}", *_indented(_summary_lines(fit))]
        if fit.weighted == result.fits[0].weighted:  # of the other weighting the figures are enough
            lines += _indented(_coefficient_lines(fit, result.points))
    if result.left_out:
        lines += [
            "",
            f"left out, {len(result.left_out)} plateaus with |i| < {result.current_min_a:.2f} A "
            "(the motor does not overcome its own friction, so eta is undefined):",
            *(
                f"  {p.run} {p.start_s:.2f} to {p.end_s:.2f} s: i = {p.current.value:.3f} A, "
                f"v = {p.velocity.value:.3f} rad/s, tau_j = {p.torque.value:.2f} Nm"
                for p in result.left_out
            ),
        ]
    if result.findings:
        lines += ["", "findings:", *(f"  {item.kind}: {item.text}" for item in result.findings)]
    return lines


def _indented(lines: Iterable[str]) -> list[str]:
    return [f"  {line}" for line in lines]


def _measured_lines(result: EfficiencyResult) -> list[str]:
    rows = [["quadrant", "plateaus", "tau_j/(G Kt i)", "G Kt i/tau_j"]]
    for name in QUADRANTS:
        own = in_quadrant(result.points, name)
        cells = []
        for convention in CONVENTIONS:
            etas = [point.eta(convention) for point in own]
            errors = [point.eta_se(convention) for point in own]
            cells.append(f"{min(etas):.3f} to {max(etas):.3f} +- {max(errors):.3f}" if own else "none")
        rows.append([QUADRANT_TITLES[name], str(len(own)), *cells])
    return table_lines(rows)


def _summary_lines(fit: EfficiencyFit) -> list[str]:
    """Return one line per quadrant, with the paper's RMSE where the convention is Table I's."""
    like_paper = fit.convention == TABLE_I.convention
    paper = ["paper"] if like_paper else []
    rows = [["quadrant", "plateaus", "distinct", "RMSE", *paper, "RMSE Nm", "condition"]]
    for name, one in fit.quadrants.items():
        beside = [f"{getattr(TABLE_I, name).rmse:.4f}"] if like_paper else []
        errors = [f"{one.rmse:.4f}", *beside, f"{one.rmse_nm:.3f}", f"{one.condition:.0f}"]
        rows.append([QUADRANT_TITLES[name], str(one.plateaus), str(one.distinct), *errors])
    return table_lines(rows) + list(fit.refused.values())


def _coefficient_lines(fit: EfficiencyFit, points: Sequence[EtaPoint]) -> list[str]:
    """Coefficients with standard errors, beside Table I where the convention is the table's."""
    like_paper = fit.convention == TABLE_I.convention
    lines = []
    for name, quadrant in fit.quadrants.items():
        rows = [["", "fitted", "std err", *(["Table I", "difference"] if like_paper else [])]]
        for key in COEFFICIENTS:
            value, table = getattr(quadrant.polynomial, key), getattr(getattr(TABLE_I, name), key)
            beside = [f"{table:.4f}", f"{value - table:.4f}"] if like_paper else []
            rows.append([key, f"{value:.4f}", f"{quadrant.errors[key]:.4f}", *beside])
        lines += [QUADRANT_TITLES[name], *_indented(table_lines(rows))]
        if like_paper:
            off = difference_from_table(points, name, quadrant.polynomial)
            lines.append(
                f"  eta against Table I at these points: {float(np.sqrt(np.mean(off**2))):.4f} RMS, "
                f"{float(np.max(np.abs(off))):.4f} at most"
            )
    return lines


def as_mapping(result: EfficiencyResult) -> dict[str, Any]:
    """Return the same for a program (schema jtq.efficiency/1)."""
    mapping: dict[str, Any] = plain_values(
        {
            "schema": SCHEMA,
            "joint": result.joint,
            "number": result.number,
            "runs": result.runs,
            "temperature_c": result.temperature_c,
            "current_min_a": result.current_min_a,
            "fits": result.fits,
            "plateaus": [
                plain_values(p.plateau)
                | {"quadrant": p.quadrant, "joint_over_motor": p.ratio, "joint_over_motor_se": p.se}
                for p in result.points
            ],
            "left_out": result.left_out,
            "findings": [item._asdict() for item in result.findings],
        }
    )
    for fit, values in zip(result.fits, mapping["fits"], strict=True):
        for name, entry in values["quadrants"].items():
            del entry["polynomial"]["rmse"]  # that of the entry, rounded
            if fit.convention == TABLE_I.convention:
                off = difference_from_table(result.points, name, fit.quadrants[name].polynomial)
                entry["paper_rmse"] = getattr(TABLE_I, name).rmse
                entry["table_i_rms"] = float(np.sqrt(np.mean(off**2)))
    return mapping


_RATIOS: Final = {"joint_over_motor": "τ_j / (G Kt i)", "motor_over_joint": "G Kt i / τ_j"}
MOST_CURVES: Final = 8
"""As many velocities as the paper has; of more, this many are drawn as curves, evenly chosen. Points are all drawn."""

_TICK: Final = 0.04
"""Of the bar's length: room of one velocity."""


def draw_fit(points: Sequence[EtaPoint], fit: EfficiencyFit, title: str, path: Path) -> None:
    """Draw the measured points and the fit to `path` (png, svg, pdf by its ending). Needs matplotlib."""
    import matplotlib as mpl

    mpl.use("Agg")  # files only; a display is not needed
    from matplotlib import pyplot as plt

    figure = fit_figure(points, fit, title)
    with whole_file(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), dpi=100)
    plt.close(figure)


def fit_figure(points: Sequence[EtaPoint], fit: EfficiencyFit, title: str) -> Any:
    """Return the figure of `draw_fit`: a panel per quadrant, of two lines each above it."""
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    speeds = [abs(point.plateau.velocity.value) for point in points]
    norm = mpl.colors.Normalize(0.0, max(speeds))
    colours = mpl.colors.LinearSegmentedColormap.from_list(
        "speed", plt.get_cmap("viridis")(np.linspace(0.0, 0.9, 64))
    )
    figure, axes = plt.subplots(2, 2, figsize=(12.0, 8.4), layout="constrained")
    for letter, name, axis in zip("abcd", QUADRANTS, axes.flat, strict=True):
        own = in_quadrant(points, name)
        _panel(axis, own, fit, name, lambda speed: colours(norm(speed)))
        axis.set_title(f"({letter}) {_panel_title(fit, name, len(own))}", fontsize=10, loc="left")
        plain(axis)
    for axis in axes[1]:
        axis.set_xlabel("motor current i [A]")
    for axis in axes[:, 0]:
        axis.set_ylabel(f"η = {_RATIOS[fit.convention]}")
    bar = figure.colorbar(
        mpl.cm.ScalarMappable(norm, colours), ax=axes, label="|ω_m| / G [rad/s]", pad=0.015, aspect=40
    )
    groups = _groups(speeds)
    if float(np.min(np.diff([0.0, *groups]))) >= _TICK * max(groups):
        bar.set_ticks(groups, labels=[f"{speed:.1f}" for speed in groups])
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    return figure


def _panel(axis: Any, points: Sequence[EtaPoint], fit: EfficiencyFit, name: str, colour: Any) -> None:
    """Points with error bars of two standard errors; curves over the currents measured at each velocity."""
    if not points:
        axis.text(0.5, 0.5, "no plateau", transform=axis.transAxes, ha="center", va="center", color="#777777")
        axis.set(xticks=[], yticks=[])
        return
    speeds = _groups([abs(point.plateau.velocity.value) for point in points])
    drawn = np.linspace(0, len(speeds) - 1, min(MOST_CURVES, len(speeds))).round().astype(int)
    chosen = {speeds[k] for k in drawn}
    for speed in speeds:
        own = [p for p in points if abs(abs(p.plateau.velocity.value) - speed) <= SAME_VELOCITY_RAD_S]
        current = np.array([p.plateau.current.value for p in own])
        shade = colour(speed)
        if speed in chosen and name in fit.quadrants:
            velocity = float(np.mean([p.plateau.velocity.value for p in own]))
            polynomial = fit.quadrants[name].polynomial
            along = np.linspace(current.min(), current.max(), 60)
            curve = [polynomial.value(i, velocity) for i in along.tolist()]
            axis.plot(along, curve, color=shade, linewidth=1.3, zorder=2)
        axis.errorbar(
            current,
            [p.eta(fit.convention) for p in own],
            yerr=[2.0 * p.eta_se(fit.convention) for p in own],
            fmt="o",
            color=shade,
            markeredgecolor="white",
            markeredgewidth=0.6,
            markersize=6.0,
            elinewidth=1.0,
            zorder=3,
        )


def _panel_title(fit: EfficiencyFit, name: str, count: int) -> str:
    text = QUADRANT_TITLES[name].replace("w", "ω_m", 1)
    if name in fit.quadrants:
        paper = f" (paper {getattr(TABLE_I, name).rmse:.4f})" if fit.convention == TABLE_I.convention else ""
        return f"{text}\n{count} plateaus, RMSE {fit.quadrants[name].rmse:.4f}{paper}"
    return f"{text}\n{count} plateaus, not fitted"


def _groups(speeds: Sequence[float]) -> list[float]:
    """Distinct velocities, rising; each the mean of those that are the same within SAME_VELOCITY_RAD_S."""
    groups: list[list[float]] = []
    for speed in sorted(speeds):
        if groups and speed - groups[-1][0] <= SAME_VELOCITY_RAD_S:
            groups[-1].append(speed)
        else:
            groups.append([speed])
    return [float(np.mean(group)) for group in groups]
