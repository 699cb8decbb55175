"""Processor time that a hypervisor took from this machine: no scheduling priority helps against it (proc(5), /proc/stat)."""

from __future__ import annotations

import os
from pathlib import Path

_FIELD = 8  # cpu user nice system idle iowait irq softirq steal


def stolen_s(stat: Path = Path("/proc/stat")) -> float:
    """Taken from all processors since the machine's start [s], in steps of 10 ms; 0 where the kernel does not tell."""
    try:
        return int(stat.read_text().split("\n", 1)[0].split()[_FIELD]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0
