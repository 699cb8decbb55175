"""What the operator is told while the loop runs: lost inputs, faults of the joints, estimates far from the sensor."""

from __future__ import annotations

from daemon.config import Config
from daemon.shared.snapshot import View
from daemon.supervisor.deviation_watch import DeviationWatch
from daemon.supervisor.fault_watch import FaultWatch
from daemon.supervisor.input_watch import InputWatch
from daemon.supervisor.teller import Teller


class Watches:
    """Call `turn` with each reading of the snapshot; lines go to `tell`."""

    def __init__(self, config: Config, tell: Teller) -> None:
        self._tell = tell
        self._inputs, self._faults, self._deviation = InputWatch(config), FaultWatch(), DeviationWatch()

    @property
    def deviations(self) -> tuple[int, int]:
        """How often the estimate of joint 1 and 2 stayed far from the sensor."""
        one, two = self._deviation.episodes
        return one, two

    def turn(self, view: View, now_s: float) -> None:
        """Say what has changed; `now_s` is CLOCK_MONOTONIC."""
        for line in self._inputs.lines(view, now_s):
            self._tell("input", 0, line, line.split(":")[0])
        for line in self._faults.lines(view, now_s):
            self._tell("fault", 0, line, line.split(":")[0])
        for line in self._deviation.lines(view, now_s):
            self._tell("input", 0, line, "deviation")
