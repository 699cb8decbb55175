"""What an engineer would try first: least squares with a handful of coefficients, on the runs that ours is fitted to.

    torsion and current   tau = a0 + a1 d + a2 d^3 + a3 tau_raw + a4 s + a5 v + a6 s |tau_raw|
    TOB, fitted friction  tau = tau_raw - (c0 + c1 s + c2 v)
    TOB, load friction    tau = tau_raw - (c0 + c1 s + c2 v + c3 s |tau_raw| + c4 s tau_raw^2 + c5 v |tau_raw| + c6 tau_raw)

d: torsion angle of both encoders, s: direction (-1 to 1), v: velocity, tau_raw: motor torque less the rotor's share, joint
side, all of the observer (`estimator.observer`). The torsion is as young as ours; what comes of the current alone is as old
as the motor path.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import ObservedRun

EVERY: Final = 5
"""Neighbours at 1 kHz are alike."""


class Baseline(NamedTuple):
    """A linear model: its regressors [n, k] of an observed run; young: whether its age is the torsion's.

    residual: it models tau_raw - tau, not tau.
    """

    title: str
    young: bool
    residual: bool
    regressors: Callable[[ObservedRun], FloatArray]

    def estimate(self, seen: ObservedRun, coefficients: FloatArray) -> FloatArray:
        """Return the torque [n]; NaN where nothing was observed."""
        modelled: FloatArray = self.regressors(seen) @ coefficients
        return seen.raw_nm - modelled if self.residual else modelled


def _torsion_and_current(seen: ObservedRun) -> FloatArray:
    d = seen.torsion_nm + seen.ahead_nm  # observed with a torsion of 1 Nm/rad: the angle itself
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(d), d, d**3, raw, s, v, s * np.abs(raw)))


def _friction(seen: ObservedRun) -> FloatArray:
    return np.column_stack((np.ones_like(seen.raw_nm), seen.direction, seen.velocity_rad_s))


def _load_friction(seen: ObservedRun) -> FloatArray:
    raw, s, v = seen.raw_nm, seen.direction, seen.velocity_rad_s
    return np.column_stack((np.ones_like(raw), s, v, s * np.abs(raw), s * raw * raw, v * np.abs(raw), raw))


BASELINES: Final = {
    "regression": Baseline(
        "least squares on torsion and current, 7 coefficients", True, False, _torsion_and_current
    ),
    "tob_load": Baseline("TOB, friction by load fitted, 7 coefficients", False, True, _load_friction),
    "tob_fitted": Baseline("TOB, friction fitted, 3 coefficients", False, True, _friction),
}


class Example(NamedTuple):
    """A run to fit to: observed with a torsion of 1 Nm/rad; sensor [n] as old as the motor path, and as the torsion;
    moving [n]: which samples count.
    """

    seen: ObservedRun
    sensor_nm: FloatArray
    young_sensor_nm: FloatArray
    moving: np.ndarray[tuple[int], np.dtype[np.bool_]]


def fit_baseline(baseline: Baseline, examples: Sequence[Example], rcond: float | None = None) -> FloatArray:
    """Return the coefficients [k] of ordinary least squares over the moving samples of all runs; ValueError without any.

    rcond: singular values below this part of the largest one count as 0, None: those of rounding size alone.
    """
    rows, targets = [], []
    for each in examples:
        keep = np.flatnonzero(each.moving)[::EVERY]
        sensor = each.young_sensor_nm if baseline.young else each.sensor_nm
        rows.append(baseline.regressors(each.seen)[keep])
        targets.append((each.seen.raw_nm - sensor if baseline.residual else sensor)[keep])
    if not sum(map(len, rows)):
        raise ValueError("found no samples in motion, expected some to fit a baseline to")
    x, y = np.concatenate(rows), np.concatenate(targets)
    size = np.sqrt(np.mean(x * x, axis=0))
    found: FloatArray = np.linalg.lstsq(x / size, y, rcond=rcond)[0] / size
    return found
