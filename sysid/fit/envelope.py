"""Operating envelope of a fit: speeds, motor torques, temperatures, and the largest difference of torsion and current."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.joint import MAX_CELLS, AdditiveLoss, Envelope, Torsion
from jtqd.estimator.uncertainty import envelope_weights
from jtqd.sysid.fit.residuals import path_residuals
from jtqd.sysid.fit.signals import RunSignals

VELOCITY_STEP_RAD_S: Final = 0.25
VELOCITY_STEP_SHARE: Final = 1.0 / 12.0
"""Of the largest speed of the runs: the same 0.25 rad/s on the shipped joints (3 rad/s)."""
_ROUND: Final = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
"""Steps of speed, times a power of ten: readable, and independent of the noise of the fastest sample."""
TORQUE_STEP_NM: Final = 3.0
TORQUE_STEP_SHARE: Final = 0.075
"""Of rated torque: the same 3 Nm on the shipped joints."""
MARGIN_K: Final = 0.5
FIT_MARGIN_K: Final = 3.0
"""A friction that is known over some days is known 3 K beyond the warmest: 2 to 3 % per kelvin of its viscous part."""
_VISITS: Final = 20
"""Samples at 1 kHz in a cell that make it known."""
BEYOND_SHARE: Final = 0.01
"""Share of a held-out run's samples that may lie beyond the map of the other runs."""
MOST_WIDER: Final = 2
"""Cells of load added on either side, 15 % of rated torque: runs that need more do not show what they cover."""

Table = np.ndarray[tuple[int, int], np.dtype[np.bool_]]
Counts = np.ndarray[tuple[int, int], np.dtype[np.int64]]


def envelope_of(
    velocity_rad_s: FloatArray,
    raw_nm: FloatArray,
    apart_nm: FloatArray,
    temperatures_c: Sequence[float],
    *,
    velocity_step_rad_s: float = VELOCITY_STEP_RAD_S,
    torque_step_nm: float = TORQUE_STEP_NM,
    margin_k: float = MARGIN_K,
) -> Envelope:
    """Return what moving samples [n] covered: cells of velocity and motor torque with enough of them, and cells between.

    apart_nm: torsion less current path [n]. temperatures_c: of the runs, NaN where unknown. margin_k: known beyond them.
    """
    rows = int(np.ceil(np.abs(velocity_rad_s).max() / velocity_step_rad_s)) + 1
    columns = int(np.ceil(np.abs(raw_nm).max() / torque_step_nm)) + 1
    steps = velocity_step_rad_s, torque_step_nm
    known = filled(_visits(velocity_rad_s, raw_nm, steps, (2 * rows + 1, 2 * columns + 1)) >= _VISITS)
    temperatures = [each for each in temperatures_c if np.isfinite(each)]
    return Envelope(
        *steps,
        _as_rows(known),
        1.25 * float(np.quantile(np.abs(apart_nm), 0.999)),
        (min(temperatures) - margin_k, max(temperatures) + margin_k) if temperatures else None,
    )


def _visits(
    velocity_rad_s: FloatArray, raw_nm: FloatArray, steps: tuple[float, float], shape: tuple[int, int]
) -> Counts:
    """Return the samples in each cell of a map of this shape."""
    counts = np.zeros(shape, np.int64)
    at = (
        np.rint(velocity_rad_s / steps[0]).astype(int) + shape[0] // 2,
        np.rint(raw_nm / steps[1]).astype(int) + shape[1] // 2,
    )
    np.add.at(counts, at, 1)
    return counts


def widened(made: Envelope, runs: Sequence[tuple[FloatArray, FloatArray]]) -> Envelope:
    """Return the envelope of runs, each (velocity, motor torque) [n] in motion, with as many more cells of load as needed.

    Needed: on average at most BEYOND_SHARE of the samples of a run lie beyond the map of the other runs. In speed nothing is
    added: the map ends where the runs end, as the load does by `load_nm`.
    """
    steps = made.velocity_step_rad_s, made.torque_step_nm
    counts = [_visits(v, raw, steps, (len(made.known), len(made.known[0]))) for v, raw in runs]
    others = [filled(sum(counts) - own >= _VISITS) for own in counts]
    for cells in range(MOST_WIDER + 1):
        beyond = [
            envelope_weights(replace(made, known=_as_rows(_wider(known, cells))), v, raw) < 0.5
            for known, (v, raw) in zip(others, runs, strict=True)
        ]
        if np.mean([each.mean() for each in beyond]) <= BEYOND_SHARE:
            break
    return replace(made, known=_as_rows(_wider(np.array(made.known, np.bool_), cells)))


def _wider(known: Table, cells: int) -> Table:
    """Add so many cells of load on either side of known ones, on a map as much wider."""
    padded = np.pad(known, ((0, 0), (2 * cells, 2 * cells)))
    width = known.shape[1] + 2 * cells
    result: Table = np.logical_or.reduce([padded[:, k : k + width] for k in range(2 * cells + 1)])
    return result


def _as_rows(known: Table) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(int(cell) for cell in row) for row in known)


def velocity_step(velocity_rad_s: FloatArray) -> float:
    """Return the step of speed for moving samples [n]: a round number near VELOCITY_STEP_SHARE of the largest speed."""
    wanted = VELOCITY_STEP_SHARE * float(np.quantile(np.abs(velocity_rad_s), 0.999))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(f"{power * min(_ROUND, key=lambda each: abs(np.log(each * power / wanted))):.6g}")


def filled(known: Table) -> Table:
    """Add cells that lie between known ones in both directions: holes, not edges."""

    def between(axis: int) -> Table:
        before = np.maximum.accumulate(known, axis=axis)
        after = np.flip(np.maximum.accumulate(np.flip(known, axis), axis=axis), axis)
        return np.logical_and(before, after)

    result: Table = known | (between(0) & between(1))
    return result


def fit_envelope(
    runs: Sequence[RunSignals], loss: AdditiveLoss, torsion: Torsion, rated_nm: float
) -> Envelope | None:
    """Return what the runs covered; None where that takes a larger map than an envelope may have."""
    seen = [path_residuals(run, loss, torsion) for run in runs if run.moving.any()]
    velocity = np.concatenate([run.velocity_rad_s for run in seen])
    made = envelope_of(
        velocity,
        np.concatenate([run.raw_nm for run in seen]),
        np.concatenate([run.apart_nm for run in seen]),
        [run.temperature_c for run in runs],
        velocity_step_rad_s=velocity_step(velocity),
        torque_step_nm=TORQUE_STEP_SHARE * rated_nm,
        margin_k=FIT_MARGIN_K,
    )
    if max(len(made.known), len(made.known[0])) > MAX_CELLS - 2 * MOST_WIDER:
        return None
    load = max(float(np.abs(run.torsion_nm).max()) for run in seen)
    return replace(widened(made, [(run.velocity_rad_s, run.raw_nm) for run in seen]), load_nm=load)
