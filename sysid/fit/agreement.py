"""Fit section `fused.agreement` of a joint file: how far the two paths differ on runs that the fit had not seen.

Levels of samples, not of runs: what is beyond is doubt that grows from zero, so a run that is a little beyond costs little
(estimator/agreement.pyx).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import Agreement

QUANTILE: Final = 0.75
"""Of the blocks of all runs: the rest of ordinary days has a little doubt. Chosen on runs that no figure is reported on."""
LOWERED: Final = 0.99
"""Of the blocks of all runs: a doubt beyond it is none of ordinary days. What is left, and as much by the envelope
(`envelope.BEYOND_SHARE`), is the 2 % that may be flagged without need."""
LEVEL_FACTOR: Final = 2.8
GAIN_FACTOR: Final = 4.0
"""Of `agreement.pyx`, chosen with QUANTILE: larger ones cover what has changed no better."""
_FEWEST: Final = 200
"""Blocks, 3 s of motion at 1 kHz: from less no level can be told."""
_FLOOR_NM: Final = 1e-3

Levels = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Of one run, as `estimator.agreement.levels` returns it."""


def fit_agreement(levels: Callable[[Agreement | None], Sequence[Levels]]) -> Agreement | None:
    """Return the levels of runs; None for too little motion. levels: of all runs, their doubt beyond a section."""
    slow, fast, gain, left, _ = (np.concatenate(parts) for parts in zip(*levels(None), strict=True))
    if len(slow) < _FEWEST:
        return None

    def level(values: FloatArray) -> float:
        return float(np.quantile(values, QUANTILE))

    found = Agreement(
        slow_nm=max(level(np.sqrt(slow)), _FLOOR_NM),
        fast_nm=max(level(np.sqrt(fast)), _FLOOR_NM),
        gain=level(gain),
        zero_nm=level(left),
        level_factor=LEVEL_FACTOR,
        gain_factor=GAIN_FACTOR,
    )
    doubt = np.concatenate([run[-1] for run in levels(found)])
    return replace(found, lowered_nm=max(float(np.quantile(doubt, LOWERED)), _FLOOR_NM))
