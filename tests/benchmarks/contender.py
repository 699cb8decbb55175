"""A contender is a process that makes all ready, then runs a round per line "run CYCLES [FIRST_SLOT_NS]" of its input.

A virtual machine makes sleeping dear: the idle CPU is given back to the host, waking it up goes through the hypervisor
and finds cold caches. "Quiet core" here means a core that never goes idle, as with idle=poll on a real-time system: a
spinner of class SCHED_IDLE runs there whenever nobody else does. Everything else preempts it at once, and only the CPU of
the contender's own process is counted. It cannot keep others away: how busy the machine was is part of the result.
"""

from __future__ import annotations

import ctypes
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from tests.paths import ROOT


@dataclass(frozen=True)
class Task:
    """Where to run: bus, directory of the fixture, CPU (None: any) and SCHED_FIFO priority to ask for."""

    bus: str
    directory: Path
    cpu: int | None
    priority: int = 80

    def to_json(self) -> str:
        return json.dumps(asdict(self) | {"directory": str(self.directory)})


class Runner(Protocol):
    """What a contender's process holds."""

    def run(self, cycles: int, first_slot_ns: int | None = None) -> dict[str, Any]:
        """Run one round and return `CycleMeter.result`; first_slot_ns: CLOCK_MONOTONIC, None: in two periods."""


_ASIDE_S = 0.2
"""Results are encoded when every contender of a round has ended: it takes a core for tens of milliseconds."""


def serve(make: Callable[[Task], Runner]) -> int:
    content = json.loads(sys.argv[1])
    runner = make(Task(content["bus"], Path(content["directory"]), content["cpu"], content["priority"]))
    print("ready", flush=True)
    for line in sys.stdin:
        result = runner.run(*map(int, line.split()[1:]))
        time.sleep(_ASIDE_S)
        print(json.dumps(result), flush=True)
    return 0


_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """However the benchmark ends, no process of it goes on: some of them hold a core at a real-time priority."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


class Process:
    """A contender or helper process as the benchmark sees it."""

    def __init__(self, command: list[str], name: str) -> None:
        self.name = name
        environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=environment,
            preexec_fn=die_with_parent,  # noqa: PLW1509 - the benchmark has no threads
        )
        self.pid = self._process.pid
        self._line()

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.name} ended with exit status {self._process.wait()}")
        return line

    def start(self, cycles: int, first_slot_ns: int | None = None) -> None:
        assert self._process.stdin is not None
        first = "" if first_slot_ns is None else f" {first_slot_ns}"
        self._process.stdin.write(f"run {cycles}{first}\n")
        self._process.stdin.flush()

    def result(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads(self._line())
        return content

    def run(self, cycles: int) -> dict[str, Any]:
        self.start(cycles)
        return self.result()

    def end(self) -> None:
        """End it; SIGKILL, because a shell may have made its children ignore SIGTERM, and nothing is to be saved."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.kill()
        self._process.wait()
        self._process.stdin.close()
        self._process.stdout.close()


def python(module: str, *arguments: str) -> list[str]:
    return [sys.executable, "-P", "-m", f"tests.benchmarks.{module}", *arguments]


# The machine: which CPU does what, how much of it others use, and a core that is left alone.


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
