"""Joints that have a torque sensor each: diagnosed one by one, reported together. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from estimator.run import RunTable
from sysid.diagnosis.findings import (
    AMBIGUOUS,
    CAUSE,
    INSUFFICIENT,
    NO_GAP,
    UNEXPLAINED,
    Findings,
)

_WORST_FIRST: Final = (UNEXPLAINED, AMBIGUOUS, CAUSE, INSUFFICIENT, NO_GAP)


def one_sensor(runs: Sequence[tuple[str, RunTable]], numbers: Sequence[int]) -> bool:
    """Return whether the joints' torque columns are the same measurement in every run that has them all."""
    for _, table in runs:
        columns = [table.joints[n].torque_nm for n in numbers if n in table.joints]
        there = [c for c in columns if c is not None]
        for other in there[1:]:
            scale = max(float(np.abs(there[0]).max()), 1e-9)
            if float(np.abs(there[0] - other).max()) > 1e-6 * scale:
                return False
    return True


def together(parts: Sequence[Findings]) -> Findings:
    """Return the findings of several joints as one: the verdict that asks for most, the gain of the largest cause."""
    verdict = min((f.verdict for f in parts), key=_WORST_FIRST.index)
    with_gain = [f for f in parts if f.gain is not None]
    leading = max(with_gain, key=lambda f: f.causes[0].rms_nm) if with_gain else None
    plans = [f.next_experiment for f in parts if f.next_experiment is not None]
    return Findings(
        verdict,
        tuple(f"joint {n}: {reason}" for f in parts for n in f.joints[:1] for reason in f.reasons),
        parts[0].runs,
        tuple(n for f in parts for n in f.joints),
        tuple(sorted((g for f in parts for g in f.gaps), key=lambda g: g.noise_floor_nm**2 - g.rmse_nm**2)),
        tuple(sorted((c for f in parts for c in f.causes), key=lambda c: -c.rms_nm)),
        tuple(sorted((c for f in parts for c in f.candidates), key=lambda c: -c.delta_bic)),
        None if leading is None else leading.gain,
        channel_notes=tuple(dict.fromkeys(note for f in parts for note in f.channel_notes)),
        next_experiment=plans[0] if plans else None,
        traces=tuple(t for f in parts for t in f.traces),
    )
