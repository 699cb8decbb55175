"""One step's result, whatever the method."""

from __future__ import annotations

from math import nan
from typing import Final, NamedTuple

from estimator.status import INVALID, OFF, STARTING


class Estimate(NamedTuple):
    """One step's result [Nm, joint side]; NaN where not computed or not to be published.

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
OFF_ESTIMATE: Final = Estimate(nan, nan, OFF, nan, nan, nan)
"""What a joint that is not estimated shows."""
