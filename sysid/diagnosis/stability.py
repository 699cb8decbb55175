"""Stability of an effect over operating conditions: a requirement in the presence of an unexplained residual.

The unexplained residual is no noise: it depends on the condition and on the sample before. An effect that imitates a part of
it therefore changes its size with the condition. No noise model is used: runs are left out one by one, and in each operating
condition (velocity, load, current, angles, time) one of six slices that hold the same information on the effect. The changes
of its size give a standard error (jackknife). The size must exceed it by the factor of Student's t for so few parts.
Source: a cause has one size under all conditions, an imitation has not (Peters, Buehlmann and Meinshausen 2016, J. R. Stat.
Soc. B 78).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.effects import EFFECTS
from jtqd.sysid.diagnosis.findings import shows_at
from jtqd.sysid.diagnosis.gain import left_out_steps
from jtqd.sysid.diagnosis.mixed_model import solve
from jtqd.sysid.diagnosis.noise import Noise, whitened_rows
from jtqd.sysid.diagnosis.refine import PresentEffect, Refined, places
from jtqd.sysid.diagnosis.regressors import Index
from jtqd.sysid.diagnosis.structure import axis_values

CHANCE: Final = 0.01
"""Of naming any effect of the library by chance; each has its part of it."""
RUNS: Final = "run"
CONDITIONS: Final = ("velocity", "load", "current", "link_angle", "motor_angle", "time")
_SLICES: Final = 6
_FEWEST_SLICES: Final = 4
_CELLS: Final = 240
"""Of as many samples each, of which the slices are made."""
_NO_SIZE: Final = ("phase_rad", "reference_c")


@dataclass(frozen=True)
class Stability:
    """ratio: size of an effect in standard errors, of what is left out where that is least; needed: ratio from which it is
    certain; left_out: `RUNS` or one of `CONDITIONS`.
    """

    ratio: float
    needed: float
    left_out: str

    @property
    def margin(self) -> float:
        """Ratio over what is needed: 1 or more is certain."""
        return self.ratio / self.needed


def needed(count: int) -> float:
    """Return the ratio from which an effect is certain when one of `count` parts is left out in turn."""
    return float(stats.t.isf(0.5 * CHANCE / len(EFFECTS), max(count - 1, 1)))


def jackknife(steps: FloatArray) -> FloatArray:
    """Return the standard errors [p] of parameters that are steps [count, p] off when one part in turn is left out."""
    count = len(steps)
    result: FloatArray = np.sqrt((count - 1.0) / count * np.sum((steps - steps.mean(axis=0)) ** 2, axis=0))
    return result


def stability(refined: Refined, noise: Noise, nothing: Sequence[Mapping[str, float]]) -> list[Stability]:
    """Return how steady each cause is where it is least; nothing: per cause the values at which it is none."""
    first_piece = np.unique(refined.mixed.pieces, return_index=True)[1]
    steps = np.array(left_out_steps(refined))[first_piece]
    out, own = [], places(refined.present)
    for p, none, mine in zip(refined.present, nothing, own, strict=True):
        ratio = _ratio(p, none, jackknife(steps)[mine]) if len(steps) > 1 else 0.0
        out.append(Stability(ratio, needed(len(steps)), RUNS))
    if not refined.present:
        return out
    rows = [whitened_rows(run, noise, refined.mixed.columns, len(refined.variances)) for run in refined.runs]
    for joint in refined.runs[0].axes:
        acting = [k for k, p in enumerate(refined.present) if shows_at(p.joint, joint)]
        for axis in CONDITIONS if acting else ():
            cells = _cells(refined, rows, joint, axis)
            if cells is None:
                continue
            for k in acting:
                left = _slices_left_out(refined, cells, own[k])
                if len(left) >= _FEWEST_SLICES:
                    ratio = _ratio(refined.present[k], nothing[k], jackknife(left)[own[k]])
                    found = Stability(ratio, needed(len(left)), axis)
                    out[k] = min(out[k], found, key=lambda s: s.margin)
    return out


def _ratio(present: PresentEffect, nothing: Mapping[str, float], errors: FloatArray) -> float:
    """Return the size of an effect over its standard error, of the parameter that shows it best."""
    return max(
        (
            abs(present.values[name] - nothing.get(name, 0.0)) / max(float(error), 1e-30)
            for name, error in zip(present.free, errors, strict=True)
            if name not in _NO_SIZE
        ),
        default=0.0,
    )


def _cells(
    refined: Refined, rows: Sequence[tuple[FloatArray, Index]], joint: int, axis: str
) -> FloatArray | None:
    """Return the normal equations of every run in cells of a condition [r, cells, w, w], None where it does not vary."""
    values = [axis_values(run.axes[joint], axis)[at] for run, (_, at) in zip(refined.runs, rows, strict=True)]
    everything = np.concatenate(values)
    everything = everything[np.isfinite(everything)]
    if not len(everything):
        return None
    edges = np.unique(np.quantile(everything, np.arange(1, _CELLS) / _CELLS))
    if len(edges) < _FEWEST_SLICES:
        return None
    width = rows[0][0].shape[1]
    out = np.zeros((len(rows), len(edges) + 1, width, width))
    for grams, x, (block, _) in zip(out, values, rows, strict=True):
        place = np.where(np.isfinite(x), np.searchsorted(edges, x, side="right"), len(edges) + 1)
        order = np.argsort(place, kind="stable")
        ends = np.searchsorted(place[order], np.arange(len(edges) + 2))
        ordered = block[order]
        for k in range(len(edges) + 1):
            here = ordered[ends[k] : ends[k + 1]]
            grams[k] = here.T @ here
    return out


def _slices_left_out(refined: Refined, cells: FloatArray, mine: slice) -> FloatArray:
    """Return the steps of all parameters [slices, p] when a slice of a condition is left out in turn; each holds as much of
    the information on the parameters `mine`.
    """
    per_cell = np.diagonal(cells.sum(axis=0), axis1=1, axis2=2)[:, mine]
    share = (per_cell / np.maximum(per_cell.sum(axis=0), 1e-300)).mean(axis=1)
    middle = np.cumsum(share) - 0.5 * share
    slice_of = np.minimum((middle * _SLICES).astype(np.intp), _SLICES - 1)
    k = refined.mixed.columns
    steps = [
        solve(refined.mixed.less(cells[:, slice_of == s].sum(axis=1)).marginal(refined.variances)[0], k)[0]
        for s in np.unique(slice_of)
    ]
    return np.array(steps)
