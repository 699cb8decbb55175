"""Processes of this machine, as /proc shows them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path


def family(root: int) -> dict[int, list[str]]:
    """Return the words of the command line of a process and of all its descendants by process-ID, the process first."""
    parents, words = {}, {}
    for entry in Path("/proc").glob("[0-9]*"):  # a kernel may have no /proc/PID/task/TID/children
        with suppress(OSError):  # it has just ended
            parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            words[int(entry.name)] = (entry / "cmdline").read_bytes().decode().split("\0")
    found = [root]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return {pid: words.get(pid, []) for pid in found}


def of_module(root: int, module: str) -> int | None:
    """Return the process-ID of the descendant that runs a module, None where there is none."""
    return next((pid for pid, words in family(root).items() if module in words and pid != root), None)


def state(pid: int) -> str:
    """Return the state letter of a process; "" where there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""
