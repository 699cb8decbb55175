"""Runs as the statistics see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from estimator.friction import FloatArray
from estimator.parameters import Joint
from sysid.diagnosis.channel import Channel, Line
from sysid.diagnosis.columns import Candidate, Family, RunData
from sysid.diagnosis.powerless import Readings
from sysid.diagnosis.signals import BoolArray, JointSignals


@dataclass(frozen=True)
class Prepared:
    """signals [run][joint]; runs: the same binned, `samples` to a bin of step_s seconds; the library's candidates;
    unexplained: what none of them explains, per channel and run [n]; groups: nuisances; lines: those among them that are
    lines at orders or frequencies of no effect; readings: per run what the current reads without power; events: what is not
    valid in `runs` only because it is an event, per channel and run [n].
    """

    signals: list[list[JointSignals]]
    runs: list[RunData]
    candidates: list[Candidate]
    samples: int
    step_s: float
    unexplained: dict[Channel, list[FloatArray]]
    groups: list[Family]
    lines: list[Line]
    readings: Sequence[Readings] = ()
    events: Mapping[Channel, Sequence[BoolArray]] = field(default_factory=dict)

    @property
    def joints(self) -> dict[int, Joint]:
        """The joint files by number, their own effects taken off the residuals already."""
        return {s.number: s.joint for s in self.signals[0]}

    def seen(self, run: int, channel: Channel) -> BoolArray:
        """Return where a channel of a run is valid or in an event [n]."""
        valid = self.runs[run].channels[channel].valid
        return valid | self.events[channel][run] if channel in self.events else valid
