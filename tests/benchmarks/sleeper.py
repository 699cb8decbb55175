"""The bare loops beside jtqd: sleep until the slot, look at the clock. Their missed slots are the machine's.

`python -m tests.benchmarks.sleeper TASK once` does nothing else. `... TASK twice` sleeps a second time in each slot and
then computes for as long as a cycle of jtqd takes, without a system call but the clock's. `... TASK waking [CPU]` does in
each slot what the SYNC of jtqd's loop does on a unix bus: it wakes a process on that CPU by one datagram, and takes the
five that answered the last one.
"""

from __future__ import annotations

import gc
import os
import socket
import sys
import time
from functools import partial
from typing import Any

from jtqd.daemon.core.schedule import Grid
from tests.benchmarks.contender import Task, die_with_parent, serve
from tests.benchmarks.measure import CycleMeter, punctual

_PERIOD_NS = 1_000_000
_SECOND_SLEEP_NS = 500_000
_WORK_NS = 60_000
"""What a whole cycle of jtqd takes on the fixture (docs/results.md, stages)."""
_FRAME = bytes(16)
_ANSWERS = 5
_ANSWERING_PRIORITY = 50
"""As the traffic source that answers jtqd."""


class Sleeper:
    """Same grid, same scheduling, same rule for a missed slot as jtqd's loop."""

    def __init__(self, task: Task) -> None:
        punctual(task.cpu, task.priority)
        gc.freeze()
        gc.disable()

    def in_slot(self, slot_ns: int) -> None:
        """Do what belongs to a slot that was begun in time."""

    def run(self, cycles: int, first_slot_ns: int | None = None) -> dict[str, Any]:
        """One round."""
        meter = CycleMeter()
        grid = Grid(first_slot_ns or time.monotonic_ns() + 2 * _PERIOD_NS, _PERIOD_NS)
        end_ns = grid.slot_ns + cycles * _PERIOD_NS
        while grid.slot_ns < end_ns:
            _sleep_until(grid.slot_ns)
            now = time.monotonic_ns()
            if grid.too_late(now):
                grid.missed += 1
            else:
                meter.late_ns.append(now - grid.slot_ns)
                self.in_slot(grid.slot_ns)
            meter.cycle_done()
            grid.advance(time.monotonic_ns())
        return meter.result(grid.missed)


def _sleep_until(until_ns: int) -> None:
    pause = until_ns - time.monotonic_ns()
    if pause > 0:
        time.sleep(pause * 1e-9)


class TwiceSleeper(Sleeper):
    """... and in each slot a second sleep, then work."""

    def in_slot(self, slot_ns: int) -> None:
        """Sleep where jtqd waits for its inputs, and compute for as long as its cycle does."""
        _sleep_until(slot_ns + _SECOND_SLEEP_NS)
        done_ns = time.monotonic_ns() + _WORK_NS
        while time.monotonic_ns() < done_ns:
            pass


class WakingSleeper(Sleeper):
    """... and in each slot one datagram to a process on another core, which answers with five."""

    def __init__(self, task: Task, answering_cpu: int | None) -> None:
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        if os.fork() == 0:
            die_with_parent()
            self._socket.close()
            _answer(other, answering_cpu)
        other.close()
        self._socket.setblocking(False)
        super().__init__(task)

    def in_slot(self, slot_ns: int) -> None:
        """Take what was answered to the datagram of the last slot, and send the next one."""
        try:
            for _ in range(_ANSWERS):
                self._socket.recv(len(_FRAME))
        except BlockingIOError:
            pass  # the other core was away as well: the next slot takes them
        self._socket.send(_FRAME)


def _answer(port: socket.socket, cpu: int | None) -> None:
    """Be the process that answers, until the other end has gone."""
    punctual(cpu, _ANSWERING_PRIORITY)
    while port.recv(len(_FRAME)):
        for _ in range(_ANSWERS):
            port.send(_FRAME)
    os._exit(0)


if __name__ == "__main__":
    kind, *cpu = sys.argv[2:]
    waking = partial(WakingSleeper, answering_cpu=int(cpu[0]) if cpu else None)
    sys.exit(serve({"once": Sleeper, "twice": TwiceSleeper, "waking": waking}[kind]))
