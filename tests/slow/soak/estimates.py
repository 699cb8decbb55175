"""Every estimate PDO of a soak, as the bus had it: no torque beside another status, none with an old sequence. Pure."""

from __future__ import annotations

import numpy as np

from jtqd.daemon.core.estimate_pdo import PUBLISHED_STATUSES
from tests.slow.faults.ears import Heard

ESTIMATE = 0x1A0
_LAYOUT = np.dtype(
    [("torque", "<i2", 2), ("sigma", "u1", 2), ("status", "u1"), ("sequence", "u1")]
)  # as jtqd.daemon.core.estimate_pdo.LAYOUT
_NO_TORQUE = -0x8000
_ROUND = 240


class EstimateTally:
    """Feed it with everything heard, in order.

    Attributes:
        count: estimates.
        valid: those with a torque, both joints.
        leaked: torques beside a status that has none.
        old: torques whose sequence is neither that of the last SYNC nor of the one before (it may come just after a SYNC).
    """

    def __init__(self) -> None:
        self.count = self.valid = self.leaked = self.old = 0
        self._last = 0

    def add(self, heard: Heard) -> None:
        """More of them."""
        syncs, at = heard.syncs, heard.at(ESTIMATE)
        counters = np.concatenate([[self._last], heard.data[syncs, 0]]).astype(np.int64)
        self._last = int(counters[-1])
        rows = np.ascontiguousarray(heard.data[at]).view(_LAYOUT).reshape(-1)
        ago = (counters[np.searchsorted(syncs, at)] - rows["sequence"]) % _ROUND
        self.count += len(rows)
        for n, status in enumerate((rows["status"] & 0x0F, rows["status"] >> 4)):
            valid = np.isin(status, list(PUBLISHED_STATUSES))
            self.valid += int(np.count_nonzero(valid))
            self.leaked += int(np.count_nonzero(~valid & (rows["torque"][:, n] != _NO_TORQUE)))
            self.old += int(np.count_nonzero(valid & (ago > 1)))
