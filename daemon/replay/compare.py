"""How far a replay is from what was logged, and each of them from the torque sensor. Pure, in arrays."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from daemon.replay.whole import fields
from estimator.status import NAMES

Records = npt.NDArray[np.void]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class StatusChange:
    """So many cycles had status `logged` in the log and have `replayed` now."""

    logged: str
    replayed: str
    cycles: int


@dataclass(frozen=True)
class Comparison:
    """One joint over n cycles; NaN where nothing was to be compared.

    Attributes:
        joint: 1 or 2.
        cycles: compared.
        pdo_equal: cycles whose torque, sigma and status in the estimate PDO are the same.
        both: cycles with a torque in log and replay.
        rms_nm, max_nm, max_cycle: of the difference of the two, and where it is largest.
        sensor_cycles: cycles of these with a torque sensor beside them.
        sensor_logged_nm, sensor_replayed_nm: RMSE against the sensor, over the same cycles.
        sigma_logged_nm, sigma_replayed_nm: mean of sigma over `both`.
        status_changed: cycles whose status is another.
        changes: largest first.
    """

    joint: int
    cycles: int
    pdo_equal: int
    both: int
    rms_nm: float
    max_nm: float
    max_cycle: int | None
    sensor_cycles: int
    sensor_logged_nm: float
    sensor_replayed_nm: float
    sigma_logged_nm: float
    sigma_replayed_nm: float
    status_changed: int
    changes: tuple[StatusChange, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Plain values for JSON, None in place of NaN."""
        return {
            key: None if isinstance(value, float) and np.isnan(value) else value
            for key, value in asdict(self).items()
        }


def compare(number: int, logged: Records, replayed: Records, taken: Flags) -> Comparison:
    """Compare joint `number` (1 or 2) over the cycles `taken` [n]."""
    logged, replayed = logged[taken], replayed[taken]
    both = np.isfinite(logged["torque_nm"]) & np.isfinite(replayed["torque_nm"])
    apart = np.abs(replayed["torque_nm"][both] - logged["torque_nm"][both])
    beside = both & np.isfinite(logged["sensor_torque_nm"])
    sensor = logged["sensor_torque_nm"][beside]
    at = int(np.argmax(apart)) if len(apart) else None
    changed = logged["status"] != replayed["status"]
    return Comparison(
        number,
        len(logged),
        int(pdo_equal(logged, replayed).sum()),
        int(both.sum()),
        _rms(apart),
        float(apart[at]) if at is not None else np.nan,
        int(logged["cycle"][both][at]) if at is not None else None,
        len(sensor),
        _rms(logged["torque_nm"][beside] - sensor),
        _rms(replayed["torque_nm"][beside] - sensor),
        float(logged["sigma_nm"][both].mean()) if both.any() else np.nan,
        float(replayed["sigma_nm"][both].mean()) if both.any() else np.nan,
        int(changed.sum()),
        _changes(logged["status"][changed], replayed["status"][changed]),
    )


def pdo_equal(logged: Records, replayed: Records) -> Flags:
    """Whether a joint's fields of the estimate PDO are the same [n]."""
    one, two = (
        fields(each["torque_nm"], each["sigma_nm"], each["status"].astype(np.uint16))
        for each in (logged, replayed)
    )
    equal: Flags = np.ones(len(logged), np.bool_)
    for a, b in zip(one, two, strict=True):
        equal &= a == b
    return equal


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else np.nan


def _changes(before: npt.NDArray[np.uint16], after: npt.NDArray[np.uint16]) -> tuple[StatusChange, ...]:
    pairs, counts = np.unique(
        np.column_stack((before, after)).astype(np.int64).reshape(-1, 2), axis=0, return_counts=True
    )
    found = [
        StatusChange(NAMES.get(a, str(a)), NAMES.get(b, str(b)), int(count))
        for (a, b), count in zip(pairs.tolist(), counts.tolist(), strict=True)
    ]
    return tuple(sorted(found, key=lambda each: -each.cycles))
