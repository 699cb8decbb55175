"""Contender: jtqd's own loop, the code of jtqd.daemon.loop.process and jtqd.daemon.core.cycle as it ships."""

from __future__ import annotations

import sys
import time
from typing import Any

from jtqd.daemon.config import Config, load_config
from jtqd.daemon.core.cycle import CYCLE_ENDED, Cycle
from jtqd.daemon.core.schedule import Grid
from jtqd.daemon.loop import process as loop
from jtqd.daemon.loop import realtime
from jtqd.daemon.shared.cycle_record import FLAG_COMPLETE, FLAG_PUBLISHED
from jtqd.drivers.frame_socket import FrameSocket, open_frame_socket
from jtqd.estimator.estimator import Estimator
from jtqd.estimator.status import PUBLISHED
from tests.benchmarks.contender import Task, serve
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import CycleMeter


class JtqdLoop:
    """Configuration and estimators, made once; `connect` makes what the loop process makes after the boot."""

    def __init__(self, task: Task) -> None:
        self.task = task
        fixture = Fixture(task.directory)
        self.config: Config = load_config(fixture.config)
        self.estimators: list[Estimator] = [
            loop.build_estimator(self.config, joint) for joint in self.config.joints
        ]
        loop.warm_up(self.estimators)
        real = self.config.realtime
        self.refused = realtime.prepare(real.priority, task.cpu, real.lock_memory)
        realtime.freeze()

    def connect(self) -> tuple[Cycle, Grid, FrameSocket]:
        """A cycle on the bus, as `jtqd.daemon.loop.process.serve` builds it."""
        request = {
            "ring": str(self.task.directory / "jtqd.ring"),
            "snapshot": str(self.task.directory / "jtqd.snapshot"),
            "worst_load": 0.0,
        }
        socket = open_frame_socket(self.task.bus, loop.loop_filters(self.config), receive_own=True)
        for estimator in self.estimators:
            estimator.reset()
        report = Fixture(self.task.directory).report
        cycle, grid = loop.build_cycle(self.config, request, report, socket, self.estimators)
        return cycle, grid, socket

    def run(self, cycles: int, first_slot_ns: int | None = None) -> dict[str, Any]:
        cycle, grid, socket = self.connect()
        meter = CycleMeter()
        grid.slot_ns = first_slot_ns or time.monotonic_ns() + 2 * grid.period_ns
        measured = Measured(cycle, meter)
        loop.run(measured, grid, _never, grid.slot_ns + cycles * grid.period_ns)  # type: ignore[arg-type]
        socket.close()
        return meter.result(grid.missed)


class Measured:
    """A cycle beside which the clocks are read after each slot."""

    def __init__(self, cycle: Cycle, meter: CycleMeter) -> None:
        self.cycle, self._meter = cycle, meter

    def __getattr__(self, name: str) -> Any:
        return getattr(self.cycle, name)

    def go_on(self, slots: int, end_ns: int) -> int:
        cycle, meter = self.cycle, self._meter
        outcome = cycle.go_on(1, end_ns)
        if outcome == CYCLE_ENDED:
            meter.answer_ns.append(cycle.sent_ns - cycle.sync_ns)
            intake, after_ns = cycle.intake, -1
            if cycle.flags & FLAG_COMPLETE and intake.sync_stamp_ns:
                offset_ns = time.time_ns() - time.monotonic_ns()
                after_ns = cycle.sent_ns + offset_ns - (intake.sync_stamp_ns + intake.last_delay_ns)
            meter.after_last_ns.append(after_ns)
            one, two = cycle.joints
            if cycle.flags & FLAG_PUBLISHED and one.status in PUBLISHED and two.status in PUBLISHED:
                meter.published += 1
            meter.late_ns.append(cycle.late_ns)
            meter.cycle_done()
        return outcome


def _never() -> bool:
    return False


if __name__ == "__main__":
    sys.exit(serve(JtqdLoop))
