"""Memory of a process, from /proc."""

from __future__ import annotations

from pathlib import Path


def rss_kb(pid: int | str = "self") -> int:
    """Resident memory of its own [kB]: without pages of files and shared memory, which are others' too."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1])
    return 0
