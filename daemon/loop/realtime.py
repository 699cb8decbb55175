"""Requests to the kernel: FIFO scheduling, locked memory, one CPU, no garbage collection, precise timers; and stolen time.

Everything is asked for and nothing is assumed: `prepare` returns a line for each thing that was refused, and jtqd prints it.
"""

from __future__ import annotations

import ctypes
import gc
import os
from pathlib import Path

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_TIMERSLACK = 29


def prepare(priority: int, cpu: int | None, lock_memory: bool) -> list[str]:
    """Request the real-time settings of this process; return one line for each that the system did not grant.

    priority: of SCHED_FIFO, 0 leaves the default scheduling class. cpu: to stay on, None for any. lock_memory: lock every
    page once it has been touched; the runtime libraries reserve far more than they use, and the warm-up touches what a
    cycle needs.
    """
    refused = []
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # 1 ns instead of 50 us: only matters without SCHED_FIFO
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:
            refused.append(f"CPU {cpu}: {error.strerror}: the loop runs on any CPU")
    if lock_memory and libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        reason = os.strerror(ctypes.get_errno())
        refused.append(
            f"memory lock: {reason}: a page fault may delay a cycle (LimitMEMLOCK=infinity grants it)"
        )
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except OSError as error:
            refused.append(
                f"SCHED_FIFO priority {priority}: {error.strerror}: other processes may delay a cycle "
                "(LimitRTPRIO grants it)"
            )
    return refused


def freeze() -> None:
    """Disable garbage collection: existing objects stay, and the loop creates no reference cycles."""
    gc.collect()
    gc.freeze()
    gc.disable()


_FIELD = 8  # cpu user nice system idle iowait irq softirq steal


def stolen_s(stat: Path = Path("/proc/stat")) -> float:
    """Read the time that a hypervisor stole from all processors since the machine's start [s], in steps of 10 ms.

    From proc(5), /proc/stat; 0 where the kernel does not report it. No scheduling priority helps against it.
    """
    try:
        return int(stat.read_text().split("\n", 1)[0].split()[_FIELD]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0
