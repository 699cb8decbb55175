"""Plants for any number of joints: pairs coupled through a torque sensor, side by side, and a single joint against a load.

Each pair is a plant of its own, so that nothing of one reaches another. A last joint that has no partner turns
one that nobody drives: the second joint of its pair, without current and without a node on the bus.
"""

from __future__ import annotations

from collections.abc import Sequence

from jtqd.sim_can.plant_source import PlantSource
from jtqd.sim_can.plants import AnyPlant
from jtqd.sim_can.source import ChannelSignal, DriveRatings, DriveSignals, Source

_SEEDS_APART = 1_000_003
"""Between the seeds of two pairs: noise and days of each are its own."""


class SingleJoint:
    """`Source` of the first joint of a pair; the second one is its load.

    pair: whose drive 0 it is.
    """

    def __init__(self, pair: Source) -> None:
        self._pair = pair
        self.ratings: Sequence[DriveRatings] = tuple(pair.ratings[:1])
        self.drives: Sequence[DriveSignals] = tuple(pair.drives[:1])
        self.channels: Sequence[ChannelSignal] = tuple(pair.channels[:1])

    def advance(self, dt_s: float) -> bool:
        """As `Source.advance`."""
        return self._pair.advance(dt_s)

    def command(self, drive: int, mode: int, target: float) -> None:
        """As `Source.command`; there is drive 0 only."""
        self._pair.command(drive, mode, target)

    def resume(self) -> None:
        """As `Source.resume`."""
        self._pair.resume()

    def interpolate(self, drive: int, period_s: float) -> None:
        """As `Source.interpolate`; there is drive 0 only."""
        self._pair.interpolate(drive, period_s)


def sources_of(parameters: AnyPlant, seed: int, joints: int) -> list[Source]:
    """Return the plants of a bench with so many joints; with two it is the one pair of this seed."""
    sources: list[Source] = []
    for number in range((joints + 1) // 2):
        pair = PlantSource(parameters, seed + number * _SEEDS_APART)
        sources.append(pair if 2 * number + 1 < joints else SingleJoint(pair))
    return sources
