"""`stages`: runs stages.py and prints its table."""

from __future__ import annotations

from typing import Any

from tests.benchmarks import c_program, host
from tests.benchmarks.contender import Process, Task, python
from tests.benchmarks.fixture import Fixture
from tests.benchmarks.measure import SETTLE_CYCLES, Samples
from tests.benchmarks.stages import STAGES
from tests.benchmarks.table import table


def run(fixture: Fixture, *, seconds: float, quiet: bool) -> dict[str, Any]:
    """One round without and one with timers."""
    where = host.cpus()
    traffic = host.traffic(fixture.directory, where)
    task = Task(f"unix:{fixture.directory / 'bus'}", fixture.directory, where.loop)
    process = Process(python("stages", task.to_json()), "the staged loop")
    spinner = host.quiet_core(c_program.build(fixture), where) if quiet else None
    try:
        result = process.run(SETTLE_CYCLES + round(seconds * 1000))
    finally:
        for each in (process, traffic, *([spinner] if spinner else [])):
            each.end()
    whole = Samples()
    whole.add(result["plain"])
    return {"quiet_core": spinner is not None, "stages": result["stages"], "whole": whole.figures()}


def text(result: dict[str, Any]) -> str:
    """Stages, their sum, and what is left of the whole."""
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
