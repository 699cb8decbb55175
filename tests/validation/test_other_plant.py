"""Whether a joint file of another plant is told: the first flag is counted in time of motion."""

from __future__ import annotations

import numpy as np
import pytest

from jtqd.estimator.status import DEGRADED, VALID
from validation.goals.judge import ZEROS, Judged, Result
from validation.goals.other_plant import first_s, told


def test_time_counts_in_motion() -> None:
    moving = np.array([False] * 500 + [True] * 1500)
    flags = np.zeros(2000, bool)
    assert first_s(flags, moving, 1e-3) == np.inf
    flags[:500] = True
    assert first_s(flags, moving, 1e-3) == np.inf, "at rest it does not count"
    flags[1400:] = True
    assert first_s(flags, moving, 1e-3) == pytest.approx(0.9)


def judged(first: int | None) -> Judged:
    n = 3000
    status = np.full(n, VALID, np.uint8)
    if first is not None:
        status[first:] = DEGRADED
    zero, moving = np.zeros(n), np.ones(n, bool)
    result = Result(np.full(n, 0.5), zero, np.full(n, 1.0), status)
    return Judged("a", 1, 40.0, zero, moving, ~moving, ~moving, np.zeros(n, np.uint8), {ZEROS: result})


def test_joints_in_runs_that_are_told_soon_are_counted() -> None:
    found = told([judged(0), judged(900), judged(1500), judged(None)], 1e-3)
    assert found.within == (50.0, 75.0, 75.0)
    assert found.degraded == pytest.approx(25.0 * (1.0 + 0.7 + 0.5))
    assert found.inside == 100.0
    assert found.rmse_nm == pytest.approx(0.5)
