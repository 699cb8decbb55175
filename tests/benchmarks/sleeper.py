"""The bare loop beside jtqd: sleep until the slot, look at the clock, nothing else. Its missed slots are the machine's."""

from __future__ import annotations

import gc
import sys
import time
from typing import Any

from jtqd.daemon.core.schedule import Grid
from tests.benchmarks.contender import Task, serve
from tests.benchmarks.measure import CycleMeter, punctual

_PERIOD_NS = 1_000_000
_OFFSET_NS = 750_000
"""jtqd wakes up at 0 and 500 us of its grid; this one stays out of its way as far as it can."""


class Sleeper:
    """Same grid, same scheduling, same rule for a missed slot as jtqd's loop."""

    def __init__(self, task: Task) -> None:
        punctual(task.cpu, task.priority)
        gc.freeze()
        gc.disable()

    def run(self, cycles: int) -> dict[str, Any]:
        """One round."""
        meter = CycleMeter()
        grid = Grid(time.monotonic_ns() + 2 * _PERIOD_NS + _OFFSET_NS, _PERIOD_NS)
        end_ns = grid.slot_ns + cycles * _PERIOD_NS
        while grid.slot_ns < end_ns:
            pause = grid.slot_ns - time.monotonic_ns()
            if pause > 0:
                time.sleep(pause * 1e-9)
            now = time.monotonic_ns()
            if grid.too_late(now):
                grid.missed += 1
            else:
                meter.late_ns.append(now - grid.slot_ns)
            meter.cycle_done()
            grid.advance(now)
        return meter.result(grid.missed)


if __name__ == "__main__":
    sys.exit(serve(Sleeper))
