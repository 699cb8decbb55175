"""Score estimates against the true torque of emulated runs, which no instrument knows.

Runs of `python -m jtqd.sysid.campaign.emulated` have the torque of each gear beside them (`sysid/runs/truth.py`). The sensor
has noise, a zero of the day and the links' inertia in it; an interval that holds the sensor may be too wide for the torque.

`now`: the estimate against the torque at the same instant, with the estimate's own age as an error, as a controller sees it.
Intervals are scored against the torque where a run has it: sigma is that of the torque (`for_intervals`).

`aligned`: against the torque passed through the filter of the method's age, as the tables against the sensor do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from jtqd.estimator.observer import low_pass
from jtqd.sysid.evaluate.methods import PAPERS_BANDWIDTH, Samples
from jtqd.sysid.evaluate.scores import IntervalTables, Row, Standstill, interval_tables, row, standstill

_OURS: Final = ("physics", "fused")
"""Methods whose sigma is that of the torque, without the sensor's zero."""


def for_intervals(samples: Samples) -> Samples:
    """Return samples whose `sensor_of` an interval is to hold: the true torque, aligned, where the run has it.

    Else the sensor, and sigma of ours grows by the sensor's zero, which the comparison contains: at standstill, where sigma
    is a half width of so many standard deviations, by as many.
    """
    if samples.true_nm is not None:
        dt = np.diff(samples.time_s, prepend=samples.time_s[0])
        young = {
            method: low_pass(samples.true_nm, dt, samples.bandwidth_rad_s[method])
            for method in samples.sensors_nm
        }
        return replace(samples, sensor_nm=low_pass(samples.true_nm, dt, PAPERS_BANDWIDTH), sensors_nm=young)
    wider = samples.reference_nm * np.where(samples.standing, samples.standstill_sigmas, 1.0)
    sigma = {
        method: np.hypot(values, wider) if method in _OURS else values
        for method, values in samples.sigma_nm.items()
    }
    return replace(samples, sigma_nm=sigma)


@dataclass(frozen=True)
class TruthTables:
    """Scores of all methods by joint, now and aligned; intervals of ours, standstill by joint: aligned."""

    now: Mapping[int, Row]
    aligned: Mapping[int, Row]
    intervals: IntervalTables | None
    standstill: Mapping[int, Standstill]


def truth_tables(samples: Sequence[Samples]) -> TruthTables | None:
    """Return the scores of the samples that have the truth; None where none has."""
    now, aligned = [], []
    for each in samples:
        if each.true_nm is None:
            continue
        now.append(replace(each, sensor_nm=each.true_nm, sensors_nm={}))
        aligned.append(for_intervals(each))
    if not now:
        return None
    numbers = sorted({each.number for each in now})

    def of(part: list[Samples]) -> dict[int, Row]:
        return {number: row([each for each in part if each.number == number]) for number in numbers}

    return TruthTables(of(now), of(aligned), interval_tables(aligned), standstill(aligned))
