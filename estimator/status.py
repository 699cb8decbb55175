"""Result of one estimate: torque, standard deviation and status.

The status codes are those published on the bus (low or high nibble of the estimate PDO).
"""

from __future__ import annotations

from math import nan
from typing import Final, NamedTuple

OFF: Final = 0
STARTING: Final = 1
VALID: Final = 2
# the network is not fully used: outside its envelope, far from physics, or no time for it
DEGRADED: Final = 3
STALE: Final = 4  # an input of this cycle is missing (set by the loop, never by the estimator)
DRIVE_FAULT: Final = 5  # set by the loop, never by the estimator
STANDSTILL: Final = 6  # known to an interval only; sigma is its half width
INVALID: Final = 15

NAMES: Final = {
    OFF: "off",
    STARTING: "starting",
    VALID: "valid",
    DEGRADED: "degraded",
    STALE: "stale",
    DRIVE_FAULT: "drive_fault",
    STANDSTILL: "standstill",
    INVALID: "invalid",
}

PUBLISHED: Final = frozenset((VALID, DEGRADED, STANDSTILL))
"""Only with these may a torque number leave the estimator."""

MOTOR_JUMP: Final = 0x04
LINK_JUMP: Final = 0x08
VELOCITY_MISMATCH: Final = 0x10
TORSION: Final = 0x20
CURRENT_FROZEN: Final = 0x40
"""Bits of faults that `jtqd.estimator.plausibility` finds."""


CONTACT_CODES: Final = (0, 1, 2, 3)
"""Of a contact: not watched, not known, none, there (docs/estimator.md)."""


class Estimate(NamedTuple):
    """Result of one step, whatever the method [Nm, joint side]; NaN where not computed or not to be published.

    torque_nm, sigma_nm are numbers with status VALID, DEGRADED and STANDSTILL only; tob_nm (classical
    observer), physics_nm (with losses, before any network) and network_nm are stages, for the record.
    """

    torque_nm: float
    sigma_nm: float
    status: int
    tob_nm: float
    physics_nm: float
    network_nm: float


STARTING_ESTIMATE: Final = Estimate(nan, nan, STARTING, nan, nan, nan)
INVALID_ESTIMATE: Final = Estimate(nan, nan, INVALID, nan, nan, nan)
"""What a joint that is not estimated shows."""
