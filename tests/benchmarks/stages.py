"""`stages`: where the time of jtqd's cycle goes, by timing its stages from outside; product code is not changed.

What is no stage (falling asleep and waking up, the loop between the stages) is the rest of a round of the same process
without any timer.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.loop import process as loop
from tests.benchmarks.contender import serve
from tests.benchmarks.contender_jtqd import JtqdLoop, Measured, _never, loop_start
from tests.benchmarks.measure import SETTLE_CYCLES, CycleMeter, quantile

STAGES = {
    "begin": "what came late, SYNC",
    "gather": "all inputs at once, decide what is of this cycle",
    "observe": "scaling, observer, loss, network, status of both joints",
    "publish": "estimate PDO, every 100th cycle the heartbeat",
    "record": "record of the cycle with its raw frames into the ring, counters, every 8th cycle the snapshot",
    "sleep": "wall time asleep until the inputs are due (not part of the sum)",
}


class Staged(Measured):
    """A cycle whose stages are timed."""

    def __init__(self, cycle: Cycle, meter: CycleMeter) -> None:
        super().__init__(cycle, meter)
        self.cycles: list[dict[str, int]] = []
        self._now = dict.fromkeys(STAGES, 0)

    def _timed(self, stage: str) -> None:
        began = time.monotonic_ns()
        getattr(self.cycle, stage)()
        self._now[stage] = time.monotonic_ns() - began
        if stage == "gather":
            asleep = max(0, self.cycle.work_start_ns - began)
            self._now["sleep"], self._now[stage] = asleep, self._now[stage] - asleep

    def begin(self) -> None:
        """Timed."""
        self._timed("begin")

    def gather(self) -> None:
        """Timed, without the time asleep."""
        self._timed("gather")

    def observe(self) -> None:
        """Timed."""
        self._timed("observe")

    def publish(self) -> None:
        """Timed."""
        self._timed("publish")

    def record(self) -> None:
        """Timed; the cycle's times are kept."""
        self._timed("record")
        self.cycles.append(self._now)
        self._now = dict.fromkeys(STAGES, 0)


class StagedLoop(JtqdLoop):
    """jtqd's loop with timers around its stages."""

    def run(self, cycles: int) -> dict[str, Any]:
        """One plain round for the whole, one with timers for the parts."""
        plain = super().run(cycles)
        cycle, grid, socket = self.connect()
        staged = Staged(cycle, CycleMeter())
        loop_start(grid)
        loop.run(staged, grid, _never, grid.slot_ns + cycles * grid.period_ns)  # type: ignore[arg-type]
        socket.close()
        kept = staged.cycles[SETTLE_CYCLES:]
        parts = {
            name: {
                "median_us": quantile([each[name] * 1e-3 for each in kept], 0.5),
                "p99_us": quantile([each[name] * 1e-3 for each in kept], 0.99),
            }
            for name in STAGES
        }
        return {"stages": parts, "plain": plain}


if __name__ == "__main__":
    sys.exit(serve(StagedLoop))
