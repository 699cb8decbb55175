"""A contender is a process that makes all ready, then runs a round per line "run CYCLES [FIRST_SLOT_NS]" of its input."""

from __future__ import annotations

import ctypes
import json
import os
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
