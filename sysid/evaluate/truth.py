"""Score estimates against the true torque of emulated runs, which no instrument knows.

Runs of `python -m jtqd.sysid.campaign.emulated` have the torque of each gear beside them (`sysid/runs/truth.py`). The sensor
has noise, a zero of the day and the links' inertia in it; an interval that holds the sensor may be too wide for the torque.

`now`: the estimate against the torque at the same instant, with the estimate's own age as an error, as a controller sees it.
`aligned`: against the torque passed through the filter of the method's age, as the tables against the sensor do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jtqd.estimator.observer import low_pass
from jtqd.sysid.evaluate.methods import PAPERS_BANDWIDTH, Samples
from jtqd.sysid.evaluate.scores import IntervalTables, Row, Standstill, interval_tables, row, standstill


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
        dt = np.diff(each.time_s, prepend=each.time_s[0])
        young = {
            method: low_pass(each.true_nm, dt, each.bandwidth_rad_s[method]) for method in each.sensors_nm
        }
        now.append(replace(each, sensor_nm=each.true_nm, sensors_nm={}))
        passed = low_pass(each.true_nm, dt, PAPERS_BANDWIDTH)
        aligned.append(replace(each, sensor_nm=passed, sensors_nm=young))
    if not now:
        return None
    numbers = sorted({each.number for each in now})

    def of(part: list[Samples]) -> dict[int, Row]:
        return {number: row([each for each in part if each.number == number]) for number in numbers}

    return TruthTables(of(now), of(aligned), interval_tables(aligned), standstill(aligned))
