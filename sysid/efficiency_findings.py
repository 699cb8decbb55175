"""What cannot be: a joint that gives energy instead of losing it, and coefficients written under the wrong name.

At every plateau the loss (G Kt i - tau_j) sign(v) is positive: eta = tau_j/(G Kt i) is below 1 when driving, above 1
when back-driven, never negative. A measurement that says otherwise by more than its standard errors and the sensor's
zero is not a joint with odd friction but a wrong number in the joint file or a wrong channel, and is not fitted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from estimator.losses import (
    BACKDRIVING_CURRENT_MAX_A,
    BLEND_CURRENT_A,
    DRIVING_CURRENT_MAX_A,
    VELOCITY_RANGE_RAD_S,
    LossModel,
)
from estimator.parameters import Joint
from sysid.efficiency_fit import ZERO_SHARE, EfficiencyFit, EtaPoint, operating_points
from sysid.findings import Finding

STANDARD_ERRORS: Final = 3.0
"""How many of them a plateau may be beyond the border, besides the sensor's zero."""


def efficiency_findings(points: Sequence[EtaPoint], joint: Joint) -> list[Finding]:
    """Return what the plateaus say against the joint file or the channels; an empty list is good."""
    zero_nm = ZERO_SHARE * joint.rated_torque_nm
    against = [
        p
        for p in points
        if p.ratio < 0.0 and abs(p.plateau.torque.value) > _reach(p.plateau.torque.se, zero_nm)
    ]
    if against:
        return [_against_current(against, points)]
    kinds = {driving: [p for p in points if p.driving is driving] for driving in (True, False)}
    gaining = {
        driving: [p for p in own if p.loss_nm < -_reach(p.loss_se, zero_nm)] for driving, own in kinds.items()
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


def written_findings(written: Joint, points: Sequence[EtaPoint], fit: EfficiencyFit) -> list[Finding]:
    """Compare the joint as it will be written, through the estimator's own loss law, with the measured torque.

    The law holds eta outside its range and inside its bounds, so only points in its range are asked. Coefficients
    of one convention under the name of the other give another torque altogether.
    """
    model = LossModel(written)
    asked = [p for p in points if p.quadrant in fit.quadrants and _in_range(p)]
    if not asked:
        return []
    current, velocity = operating_points(asked)
    motor = np.array([p.motor_nm for p in asked])
    measured = np.array([p.plateau.torque.value for p in asked])
    by_law = motor - model.loss_many(current, velocity)
    rms_nm = math.sqrt(float(np.mean((by_law - measured) ** 2)))
    fitted_nm = max(fit.quadrants[p.quadrant].rmse_nm for p in asked)
    if rms_nm <= 2.0 * fitted_nm + ZERO_SHARE * written.rated_torque_nm:
        return []
    convention = "no efficiency" if written.efficiency is None else written.efficiency.convention
    return [
        Finding(
            "convention",
            f"{written.name}: the coefficients under the name '{convention}' miss the measured torque by {rms_nm:.2f} Nm "
            f"(RMS of {len(asked)} plateaus), expected about {fitted_nm:.2f} Nm as in the fit: wrong convention of eta",
        )
    ]


def _in_range(point: EtaPoint) -> bool:
    i, v = abs(point.plateau.current.value), abs(point.plateau.velocity.value)
    most = DRIVING_CURRENT_MAX_A if point.driving else BACKDRIVING_CURRENT_MAX_A
    slack = 1e-3  # a commanded 0.2 rad/s may come out as 0.1999
    return 3.0 * BLEND_CURRENT_A < i <= most and (
        VELOCITY_RANGE_RAD_S[0] - slack <= v <= VELOCITY_RANGE_RAD_S[1] + slack
    )


def _reach(standard_error_nm: float, zero_nm: float) -> float:
    return STANDARD_ERRORS * standard_error_nm + zero_nm


def _against_current(points: Sequence[EtaPoint], of: Sequence[EtaPoint]) -> Finding:
    worst = max(points, key=lambda p: abs(p.plateau.torque.value))
    # Losses are positive: with the sign of the swapped channel put right the energy balance comes out so.
    if_torque = sum(
        math.copysign(1.0, p.plateau.velocity.value) * (p.motor_nm + p.plateau.torque.value) for p in points
    )
    swapped = "torque" if if_torque > 0.0 else "current"
    cause = f"swapped sign of the {swapped} (then the joint loses energy, as it must)"
    return _finding("torque_against_current", points, of, worst, expected="a positive eta", cause=cause)


def _finding(
    kind: str,
    points: Sequence[EtaPoint],
    of: Sequence[EtaPoint],
    worst: EtaPoint,
    *,
    expected: str,
    cause: str,
) -> Finding:
    p = worst.plateau
    return Finding(
        kind,
        f"{len(points)} of {len(of)} plateaus: found eta {worst.ratio:.3f} +- {worst.se:.3f} at i = "
        f"{p.current.value:.2f} A, v = {p.velocity.value:.2f} rad/s ({p.run} at {p.start_s:.1f} s), expected {expected}. "
        f"Likely: {cause}",
    )
