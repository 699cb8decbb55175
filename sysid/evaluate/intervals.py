"""Does the interval of an estimate hold the sensor as often as it says? Moving samples and standstill. Pure.

Moving: value +- z sigma, z of the normal distribution (sysid.sigma_fit: sigma is calibrated for z = 1.645, 90 %).
Standing: value +- sigma, which is an interval and not a standard deviation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.parameters import QUADRANTS
from sysid.evaluate.methods import OURS
from sysid.evaluate.samples import Samples
from sysid.evaluate.score import LEVELS, Coverage, coverage
from sysid.evaluate.variable import Keep, common_methods

NOMINAL: Final = 0.9
ALLOWED: Final = (0.87, 0.93)
"""Coverage that counts as 90 %."""


@dataclass(frozen=True)
class IntervalTables:
    """Coverage of the intervals of `method`. overall, joints, quadrants: at 90 %; curve: nominal -> observed, by joint
    and, under None, of all joints.
    """

    method: str
    overall: Coverage
    joints: Mapping[int, Coverage]
    quadrants: Mapping[int, Mapping[str, Coverage]]
    curve: Mapping[int | None, Mapping[float, Coverage]]


def interval_tables(samples: Sequence[Samples], method: str = OURS) -> IntervalTables | None:
    """Return the coverage of a method over runs; None where it has no scored sample."""
    own = [each for each in samples if method in each.estimate_nm]
    overall = covered(own, method, NOMINAL)
    if overall is None:
        return None
    joints: dict[int, Coverage] = {}
    quadrants: dict[int, dict[str, Coverage]] = {}
    curve: dict[int | None, dict[float, Coverage]] = {None: _curve(own, method)}
    for number in sorted({each.number for each in own}):
        part = [each for each in own if each.number == number]
        one = covered(part, method, NOMINAL)
        if one is None:
            continue
        joints[number], curve[number] = one, _curve(part, method)
        by_quadrant = {name: covered(part, method, NOMINAL, _quadrant(k)) for k, name in enumerate(QUADRANTS)}
        quadrants[number] = {name: value for name, value in by_quadrant.items() if value is not None}
    return IntervalTables(method, overall, joints, quadrants, curve)


def covered(
    samples: Sequence[Samples], method: str, level: float, keep: Keep | None = None
) -> Coverage | None:
    """Return how often value +- z(level) sigma holds the sensor, over scored samples (of which `keep` chooses)."""
    inside = []
    for each in samples:
        mask = each.scored if keep is None else each.scored & keep(each)
        inside.append(np.abs(each.error_nm(method)[mask]) <= LEVELS[level] * each.sigma_nm[method][mask])
    return coverage(inside)


@dataclass(frozen=True)
class Standstill:
    """Standing samples of one joint: their share of all samples; coverage and mean half width [Nm] by method."""

    share: float
    coverage: Mapping[str, Coverage]
    half_width_nm: Mapping[str, float]


def standstill(samples: Sequence[Samples]) -> dict[int, Standstill]:
    """Return what the intervals of a standing joint were worth, by joint."""
    found = {}
    for number in sorted({each.number for each in samples}):
        own = [each for each in samples if each.number == number]
        total = sum(len(each.standing) for each in own)
        inside: dict[str, Coverage] = {}
        width: dict[str, float] = {}
        for method in common_methods(own):
            one = coverage(
                [
                    np.abs(each.error_nm(method)[each.standing]) <= each.sigma_nm[method][each.standing]
                    for each in own
                ]
            )
            if one is not None:
                inside[method] = one
                width[method] = float(
                    np.mean(np.concatenate([each.sigma_nm[method][each.standing] for each in own]))
                )
        count = sum(int(np.count_nonzero(each.standing)) for each in own)
        found[number] = Standstill(count / total, inside, width)
    return found


def _curve(samples: Sequence[Samples], method: str) -> dict[float, Coverage]:
    points = {level: covered(samples, method, level) for level in LEVELS}
    return {level: point for level, point in points.items() if point is not None}


def _quadrant(index: int) -> Keep:
    return lambda each: each.quadrant == index
