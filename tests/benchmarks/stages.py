"""`stages`: where the time of jtqd's cycle goes, by timing its stages from outside; product code is not changed.

What is no stage (falling asleep and waking up, the loop between the stages) is the rest of a round of the same process
without any timer.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from jtqd.daemon.core.cycle import Cycle
from jtqd.daemon.core.schedule import Grid
from tests.benchmarks import c_program, contender
from tests.benchmarks.contender import Process, Task, python, serve
from tests.benchmarks.contender_jtqd import JtqdLoop
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import SETTLE_CYCLES, Samples, quantile, table

STAGES = {
    "begin": "what came late, SYNC",
    "gather": "all inputs at once, decide what is of this cycle",
    "observe": "scaling, observer, loss, network, status of both joints",
    "publish": "estimate PDO, every 100th cycle the heartbeat",
    "record": "record of the cycle with its raw frames into the ring, counters, every 8th cycle the snapshot",
    "sleep": "wall time asleep until the inputs are due (not part of the sum)",
}


class Staged:
    """A cycle whose stages are timed one by one."""

    def __init__(self, cycle: Cycle, grid: Grid) -> None:
        self.cycle, self.grid = cycle, grid
        self.cycles: list[dict[str, int]] = []

    def run(self, end_ns: int) -> None:
        """Go from slot to slot until end_ns (CLOCK_MONOTONIC); slots that come too late are skipped."""
        cycle, grid = self.cycle, self.grid
        while grid.slot_ns < end_ns:
            time.sleep(max(0, grid.slot_ns - time.monotonic_ns()) * 1e-9)
            if not (grid.too_late(time.monotonic_ns()) or cycle.pass_slot()):
                self.cycles.append({stage: self._timed(stage) for stage in STAGES if stage != "sleep"})
                asleep = max(0, cycle.work_start_ns - self._gather_ns)
                self.cycles[-1]["gather"] -= asleep
                self.cycles[-1]["sleep"] = asleep
            cycle.skip(grid.advance(time.monotonic_ns()))

    def _timed(self, stage: str) -> int:
        began = time.monotonic_ns()
        if stage == "gather":
            self._gather_ns = began
        getattr(self.cycle, stage)()
        return time.monotonic_ns() - began


class StagedLoop(JtqdLoop):
    """jtqd's loop with timers around its stages."""

    def run(self, cycles: int, first_slot_ns: int | None = None) -> dict[str, Any]:
        """One plain round for the whole, one with timers for the parts."""
        plain = super().run(cycles)
        cycle, grid, socket = self.connect()
        staged = Staged(cycle, grid)
        grid.slot_ns = first_slot_ns or time.monotonic_ns() + 2 * grid.period_ns
        staged.run(grid.slot_ns + cycles * grid.period_ns)
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


def run(fixture: Fixture, *, seconds: float, quiet: bool) -> dict[str, Any]:
    where = contender.cpus()
    traffic = contender.traffic(fixture.directory, where)
    task = Task(f"unix:{fixture.directory / 'bus'}", fixture.directory, where.loop)
    process = Process(python("stages", task.to_json()), "the staged loop")
    spinner = contender.quiet_core(c_program.build(fixture), where) if quiet else None
    try:
        result = process.run(SETTLE_CYCLES + round(seconds * 1000))
    finally:
        for each in (process, traffic, *([spinner] if spinner else [])):
            each.end()
    whole = Samples()
    whole.add(result["plain"])
    return {"quiet_core": spinner is not None, "stages": result["stages"], "whole": whole.figures()}


def text(result: dict[str, Any]) -> str:
    stages = result["stages"]
    rows = [
        [name, f"{stages[name]['median_us']:.1f}", f"{stages[name]['p99_us']:.1f}", what]
        for name, what in STAGES.items()
    ]
    total = sum(stages[name]["median_us"] for name in STAGES if name != "sleep")
    whole = result["whole"]["cpu_median_us"]
    rows.append(["stages", f"{total:.1f}", "", "sum of the medians above, without sleep"])
    rows.append(
        ["rest", f"{whole - total:.1f}", "", "falling asleep and waking up twice, the loop around the stages"]
    )
    rows.append(
        [
            "whole cycle",
            f"{whole:.1f}",
            f"{result['whole']['cpu_p99_us']:.1f}",
            "CPU of the process, no timers",
        ]
    )
    rows = [[row[0], row[1], row[2], "  " + row[3]] for row in rows]
    core = "quiet core" if result["quiet_core"] else "core shared with the system"
    width = max(len(row[3]) for row in rows)
    return f"Stages of jtqd's cycle, {core} [us]\n\n" + table(
        ["stage", "median", "p99", "  what".ljust(width)], [[*row[:3], row[3].ljust(width)] for row in rows]
    )


if __name__ == "__main__":
    sys.exit(serve(StagedLoop))
