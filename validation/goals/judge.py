"""Every method over one joint of a run, beside the true torque of the gear: now, and as old as each estimate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from jtqd.estimator.arrays import BoolArray, FloatArray, QuadrantArray, StatusArray
from jtqd.estimator.estimator import quadrants
from jtqd.estimator.methods import estimate_columns
from jtqd.estimator.network import load_network
from jtqd.estimator.observer import low_pass
from jtqd.estimator.run import JointColumns
from jtqd.estimator.settings import EstimatorSettings, bandwidth_of, recommended
from jtqd.estimator.status import DEGRADED, STANDSTILL, VALID
from jtqd.sysid.evaluate.methods import OURS, PAPERS, SETTLE_S
from validation.goals.baselines import BASELINES
from validation.goals.identify import OF_BASELINES, Driven, Identified, observed

ZEROS: Final = "ours_zeros"
LOW_PASS: Final = "ours_low_pass"
"""As ZEROS, but with the low pass of the torsion in place of its tracking filter: 1/800 s old."""
TITLES: Final = {
    OURS: "ours",
    ZEROS: "ours, zeros tracked",
    LOW_PASS: "ours, zeros tracked, torsion through the low pass",
    **{name: baseline.title for name, baseline in BASELINES.items()},
    PAPERS: "the paper's chain",
    "efficiency": "TOB with efficiency",
    "tob": "classical TOB, friction of the joint file",
}
"""Methods in the order of the table: ours, the baselines, the paper's."""
OWN: Final = (OURS, ZEROS)
Link = Callable[[FloatArray, FloatArray], FloatArray]


class Result(NamedTuple):
    """A method over a run, arrays [n]: torque, its sigma and status (None where it has none), the true torque as old."""

    torque_nm: FloatArray
    aligned_nm: FloatArray
    sigma_nm: FloatArray | None = None
    status: StatusArray | None = None

    @property
    def error_nm(self) -> FloatArray:
        """Estimate less the true torque of the same age [n]."""
        return self.torque_nm - self.aligned_nm

    def inside(self, sigmas: float) -> BoolArray:
        """Return where value +- sigmas holds the torque [n]."""
        if self.sigma_nm is None:
            raise ValueError("found a method without sigma")
        result: BoolArray = np.abs(self.error_nm) <= sigmas * self.sigma_nm
        return result


@dataclass(frozen=True)
class Judged:
    """One joint in one run, arrays [n]: moving, standing: for all methods alike; beyond: outside of what was driven."""

    run: str
    number: int
    rated_nm: float
    true_nm: FloatArray
    moving: BoolArray
    standing: BoolArray
    beyond: BoolArray
    quadrant: QuadrantArray
    results: Mapping[str, Result]


def judge(
    run: Driven, one: Identified, link: Link | None = None, methods: tuple[str, ...] = tuple(TITLES)
) -> Judged:
    """Estimate one joint of a run by methods of TITLES; link: what is changed in the link's position."""
    joint, time_s = one.joint, run.table.time_s
    columns = _changed(run.columns(one.number, joint), link, joint.gear_ratio)
    dt = np.diff(time_s, prepend=time_s[0])
    true = np.ascontiguousarray(run.true_nm[:, one.number - 1])
    seen = observed(run, columns, joint)
    settled = time_s - time_s[0] >= SETTLE_S
    results = {}
    for name in methods:
        if name in BASELINES:
            baseline = BASELINES[name]
            settings = OF_BASELINES
            rate = settings.own_torsion_bandwidth_rad_s if baseline.young else settings.bandwidth_rad_s
            torque = baseline.estimate(seen, one.baselines[name])
            results[name] = Result(torque, low_pass(true, dt, rate))
            continue
        settings = settings_of(name)
        network = load_network(PAPERS, one.network) if name == PAPERS else None
        found = estimate_columns(joint, settings, network, time_s, columns)
        aligned = low_pass(true, dt, bandwidth_of(joint, settings))
        results[name] = Result(found.torque_nm, aligned, found.sigma_nm, found.status)
    published = settled & np.logical_and.reduce([np.isfinite(each.torque_nm) for each in results.values()])
    return Judged(
        run.name,
        one.number,
        joint.rated_torque_nm,
        true,
        published & (seen.status == VALID),
        published & (seen.status == STANDSTILL),
        _beyond(columns, true, one),
        quadrants(seen.raw_nm, seen.velocity_rad_s),
        results,
    )


def settings_of(name: str) -> EstimatorSettings:
    """Return the settings of a new configuration for a method of the estimator."""
    if name in (*OWN, LOW_PASS):
        return replace(recommended(OURS), track_zeros=name != OURS, track_torsion=name != LOW_PASS)
    return recommended(name)


def _changed(columns: JointColumns, link: Link | None, gear_ratio: float) -> JointColumns:
    position, motor = columns.link_position_rad, columns.motor_position_rad
    if link is None or position is None or motor is None:
        return columns
    return replace(columns, link_position_rad=link(position, motor / gear_ratio))


ROOM: Final = 1.05
ROOM_K: Final = 5.0
"""So far beyond the campaign's range a sample is outside of it."""


def _beyond(columns: JointColumns, true_nm: FloatArray, one: Identified) -> BoolArray:
    """Return which samples [n] lie beyond what the campaign has driven: true torque, speed, temperature of the housing."""
    assert columns.motor_velocity_rad_s is not None
    assert columns.temperature_c is not None
    low, high = one.driven.temperature_c
    speed = np.abs(columns.motor_velocity_rad_s) / one.joint.gear_ratio
    result: BoolArray = (
        (np.abs(true_nm) > ROOM * one.driven.torque_nm)
        | (speed > ROOM * one.driven.velocity_rad_s)
        | (columns.temperature_c > high + ROOM_K)
        | (columns.temperature_c < low - ROOM_K)
    )
    return result


def flagged(result: Result) -> BoolArray:
    """Return where a method says that it is degraded, or has no value [n]."""
    if result.status is None:
        raise ValueError("found a method without status")
    found: BoolArray = (result.status == DEGRADED) | ~np.isfinite(result.torque_nm)
    return found
