"""The machine the benchmark runs on: which CPU does what, how much of it others use, and a core that is left alone.

A virtual machine makes sleeping dear: the idle CPU is given back to the host, waking it up goes through the hypervisor
and finds cold caches. "Quiet core" here means a core that never goes idle, as with idle=poll on a real-time system: a
spinner of class SCHED_IDLE runs there whenever nobody else does. Everything else preempts it at once, and only the CPU of
the contender's own process is counted. It cannot keep others away: how busy the machine was is part of the result.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.contender import Process, python


@dataclass(frozen=True)
class Cpus:
    """Which CPU runs the contender and which the traffic; None where there is only one."""

    loop: int | None
    traffic: int | None


def cpus() -> Cpus:
    """The last CPU for the contender, the first for the traffic."""
    allowed = sorted(os.sched_getaffinity(0))
    return Cpus(allowed[-1], allowed[0]) if len(allowed) > 1 else Cpus(None, None)


def description() -> str:
    """One line: processor, CPUs, kernel."""
    model = "unknown processor"
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    hypervisor = (
        ", virtual machine" if "hypervisor" in Path("/proc/cpuinfo").read_text(encoding="utf-8") else ""
    )
    count = len(os.sched_getaffinity(0))
    return (
        f"{model}, {count} CPUs{hypervisor}, Linux {platform.release()}, Python {platform.python_version()}"
    )


class OtherLoad:
    """CPU time that everything on the machine takes, so that a reader can see how quiet it was."""

    def __init__(self) -> None:
        self._start = _ticks()

    def cpus_busy(self) -> float:
        """CPUs in use on average since the start, ours included."""
        before, after = self._start, _ticks()
        total = after[1] - before[1]
        return (after[0] - before[0]) / total * (os.cpu_count() or 1) if total else 0.0


def _ticks() -> tuple[int, int]:
    fields = [
        int(each) for each in Path("/proc/stat").read_text(encoding="utf-8").split("\n")[0].split()[1:9]
    ]
    idle = fields[3] + fields[4]
    return sum(fields) - idle, sum(fields)


def traffic(directory: Path, where: Cpus, bitrate: int | None = None, period_us: int = 1000) -> Process:
    """Start the bench's traffic on `directory`/bus; with a bit rate its frames come as far apart as on a wire."""
    arguments = ["" if each is None else str(each) for each in (where.traffic, bitrate, period_us)]
    return Process(python("traffic", str(directory / "bus"), *arguments), "the traffic source")


def quiet_core(program: Path, where: Cpus) -> Process | None:
    """Keep the contender's CPU awake; None when there is only one CPU, which the traffic needs too."""
    if where.loop is None:
        return None
    return Process([str(program), "awake", str(where.loop)], "the spinner")
