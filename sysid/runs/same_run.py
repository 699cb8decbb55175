"""Whether two run tables are of one and the same run: a log and the table exported of it, or a part of it. Pure.

Two runs of one motion never agree in the noise of position and current over many samples in a row; the same samples do,
whatever file they are in. Stamps are not compared: an export begins at zero. A joint at rest without noise is the same in
every run: stretches count once, and a run of few different ones is not judged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.run import JointColumns, RunTable

_ROWS: Final = 64
"""Samples in a row that must agree."""
_KEPT: Final = np.uint64(0xFFFF_FFF0_0000_0000)
"""Bits of a number that are compared: five digits, as a table may have fewer than a log."""
_LEAST: Final = 50
_OF_ALL: Final = 0.2
"""Different stretches that a run must have to be judged: their number, and part of all its stretches."""
_SAMPLE: Final = 400
_SHARE: Final = 0.5
"""Part of the stretches of the shorter run that must be in the longer one."""
_FACTOR: Final = 0x9E37_79B9_7F4A_7C15
"""Odd, so that it has an inverse modulo 2^64; the fractional part of the golden ratio."""
_INVERSE: Final = pow(_FACTOR, -1, 2**64)

Stretches = Mapping[int, npt.NDArray[np.uint64]]


def stretches(table: RunTable) -> Stretches:
    """Return the different stretches of each joint as sorted numbers [n]; a joint that cannot be judged is left out."""
    found = {number: _of_joint(columns) for number, columns in table.joints.items()}
    return {number: each for number, each in found.items() if each is not None}


def same_run(one: Stretches, two: Stretches) -> bool:
    """Return whether most of the shorter run is in the other one, for every joint that both have."""
    joints = one.keys() & two.keys()
    return bool(joints) and all(_share(one[joint], two[joint]) > _SHARE for joint in joints)


def _of_joint(columns: JointColumns) -> npt.NDArray[np.uint64] | None:
    position, current = columns.motor_position_rad, columns.current_a
    if position is None or current is None or len(position) < _ROWS + _LEAST:
        return None
    rows = _kept(position) * np.uint64(_FACTOR) ^ (_kept(current) >> np.uint64(7)) * np.uint64(_INVERSE)
    # stretch i = sum of rows[i + j] FACTOR^j over j, by the difference of two sums from the beginning
    powers = _powers(_FACTOR, len(rows))
    sums = np.concatenate([np.zeros(1, np.uint64), np.cumsum(rows * powers, dtype=np.uint64)])
    every = (sums[_ROWS:] - sums[:-_ROWS]) * _powers(_INVERSE, len(sums) - _ROWS)
    different = np.unique(every)
    return different if len(different) >= max(_LEAST, _OF_ALL * len(every)) else None


def _kept(numbers: FloatArray) -> npt.NDArray[np.uint64]:
    return (numbers + 0.0).view(np.uint64) & _KEPT  # + 0.0: no negative zero


def _powers(factor: int, count: int) -> npt.NDArray[np.uint64]:
    factors = np.full(count, factor, np.uint64)
    factors[0] = 1
    return np.cumprod(factors, dtype=np.uint64)


def _share(one: npt.NDArray[np.uint64], two: npt.NDArray[np.uint64]) -> float:
    """Of a sample of the shorter one: the first ones, as their order is no order in time."""
    short, long = sorted((one, two), key=len)
    sample = short[:_SAMPLE]
    at = np.minimum(np.searchsorted(long, sample), len(long) - 1)
    return float(np.mean(long[at] == sample))
