"""Place of a finding: one balance of one joint, and a spectral line in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class Channel(NamedTuple):
    """One balance ("motor" or "torsion") of one joint."""

    joint: int
    balance: str


@dataclass(frozen=True)
class Line:
    """A line in a residual: at `order` per motor revolution, or at `order` Hz by the unit; ratio: its power
    against the median of the neighbourhood.
    """

    channel: Channel
    order: float
    amplitude_nm: float
    ratio: float
    unit: str = "1/rev"
