"""What the runs of a fit covered: speeds, motor torques, temperatures, and how far torsion and current were apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.envelope import Envelope

VELOCITY_STEP_RAD_S: Final = 0.25
VELOCITY_STEP_SHARE: Final = 1.0 / 12.0
"""Of the largest speed of the runs: the same 0.25 rad/s on the shipped joints (3 rad/s)."""
_ROUND: Final = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
"""Steps of speed, times a power of ten: a file is to be read, and the same whatever the noise of the fastest sample."""
TORQUE_STEP_NM: Final = 3.0
TORQUE_STEP_SHARE: Final = 0.075
"""Of rated torque: the same 3 Nm on the shipped joints."""
ROOM_K: Final = 0.5
FIT_ROOM_K: Final = 3.0
"""A friction that is known over some days is known 3 K beyond the warmest: 2 to 3 % per kelvin of its viscous part."""
_VISITS: Final = 20
"""Samples at 1 kHz in a cell that make it known."""

Table = np.ndarray[tuple[int, int], np.dtype[np.bool_]]


def envelope_of(
    velocity_rad_s: FloatArray,
    raw_nm: FloatArray,
    apart_nm: FloatArray,
    temperatures_c: Sequence[float],
    *,
    velocity_step_rad_s: float = VELOCITY_STEP_RAD_S,
    torque_step_nm: float = TORQUE_STEP_NM,
    room_k: float = ROOM_K,
) -> Envelope:
    """Return what moving samples [n] covered: cells of velocity and motor torque with enough of them, and cells between.

    apart_nm: torsion less current path [n]; temperatures_c: of the runs, NaN where one has none; room_k: known beside them.
    """
    rows = int(np.ceil(np.abs(velocity_rad_s).max() / velocity_step_rad_s)) + 1
    columns = int(np.ceil(np.abs(raw_nm).max() / torque_step_nm)) + 1
    counts = np.zeros((2 * rows + 1, 2 * columns + 1), np.int64)
    at = (
        np.rint(velocity_rad_s / velocity_step_rad_s).astype(int) + rows,
        np.rint(raw_nm / torque_step_nm).astype(int) + columns,
    )
    np.add.at(counts, at, 1)
    known = filled(counts >= _VISITS)
    temperatures = [each for each in temperatures_c if np.isfinite(each)]
    return Envelope(
        velocity_step_rad_s,
        torque_step_nm,
        tuple(tuple(int(cell) for cell in row) for row in known),
        1.25 * float(np.quantile(np.abs(apart_nm), 0.999)),
        (min(temperatures) - room_k, max(temperatures) + room_k) if temperatures else None,
    )


def velocity_step(velocity_rad_s: FloatArray) -> float:
    """Return the step of speed for moving samples [n]: a round number near VELOCITY_STEP_SHARE of the largest speed."""
    wanted = VELOCITY_STEP_SHARE * float(np.quantile(np.abs(velocity_rad_s), 0.999))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(f"{power * min(_ROUND, key=lambda each: abs(np.log(each * power / wanted))):.6g}")


def filled(known: Table) -> Table:
    """Also call a cell known that lies between known cells in both directions: a hole, not an edge."""

    def between(axis: int) -> Table:
        before = np.maximum.accumulate(known, axis=axis)
        after = np.flip(np.maximum.accumulate(np.flip(known, axis), axis=axis), axis)
        return np.logical_and(before, after)

    result: Table = known | (between(0) & between(1))
    return result
