"""Fit section `fused.agreement` of a joint file: how far the two paths differ on runs that the fit had not seen.

Levels of samples, not of runs: what is beyond is doubt that grows from zero, so a run that is a little beyond costs little
(estimator/agreement.pyx).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Agreement

QUANTILE: Final = 0.85
"""Of the blocks of all runs: the rest of ordinary days has a little doubt. Chosen on runs that no figure is reported on."""
_FEWEST: Final = 200
"""Blocks, 3 s of motion at 1 kHz: from less no level can be told."""
_FLOOR_NM: Final = 1e-3


def fit_agreement(runs: Iterable[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]) -> Agreement | None:
    """Return the levels of runs, each as `estimator.agreement.levels` returns it; None for too little motion."""
    slow, fast, gain, left = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    if len(slow) < _FEWEST:
        return None

    def level(values: FloatArray) -> float:
        return float(np.quantile(values, QUANTILE))

    return Agreement(
        slow_nm=max(level(np.sqrt(slow)), _FLOOR_NM),
        fast_nm=max(level(np.sqrt(fast)), _FLOOR_NM),
        gain=level(gain),
        zero_nm=level(left),
    )
