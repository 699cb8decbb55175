"""What a log holds of jtqd's estimate on the bus, and of the torque sensor it is compared with."""

from __future__ import annotations

import numpy as np

from jtqd.daemon.logs.read import Records
from jtqd.estimator.arrays import FloatArray
from jtqd.estimator.observer import low_pass

_ESTIMATE_COB_ID = 0x1A0
_NO_TORQUE = -0x8000
_TORQUE_UNIT_NM = 0.01
_NS = 1e-9


def published_torque(frames: Records, joint: int) -> FloatArray:
    """Return the torque [Nm] of joint 0 or 1 in the estimate PDO of each cycle [n]; NaN: no PDO, or one without a torque."""
    raw = frames["frames"]
    at = (raw["id"] == _ESTIMATE_COB_ID) & (np.arange(raw.shape[1]) < frames["frame_count"][:, None])
    data = raw["data"][np.arange(len(raw)), np.argmax(at, axis=1)]
    counts = np.ascontiguousarray(data[:, 2 * joint : 2 * joint + 2]).view("<i2")[:, 0]
    return np.where(at.any(axis=1) & (counts != _NO_TORQUE), counts * _TORQUE_UNIT_NM, np.nan)


def sync_time(stamp: Records) -> FloatArray:
    """Return the time of each SYNC since the first [s]."""
    whole = (stamp["sec"].astype(np.int64) - int(stamp["sec"][0])) * 1_000_000_000
    return np.asarray((whole + stamp["nanosec"] - int(stamp["nanosec"][0])) * _NS)


def reference_torque(state: Records, time_s: FloatArray, bandwidth_rad_s: float) -> FloatArray:
    """Return the sensor torque [Nm] as received through the observer's low-pass; NaN where no sensor value came."""
    sensor = state["sensor_torque_nm"]
    there = np.isfinite(sensor)
    result = np.full(len(sensor), np.nan)
    if there.any():
        dt_s = np.diff(time_s[there], prepend=time_s[there][0])
        result[there] = low_pass(sensor[there], dt_s, bandwidth_rad_s)
    return result
