"""Names of log files: PREFIX-RUN-PART.mcap, and `.active` behind it while it is being written.

RUN is the time at which the run began, `YYYYmmddTHHMMSSZ` (UTC), with `_2`, `_3` ... where another run of that prefix has
it already; PART counts from 0001. Nothing else in a directory is ours: it is neither repaired nor removed.
"""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import NamedTuple

ACTIVE = ".active"
_RUN = r"(?P<stamp>\d{8}T\d{6}Z)(?:_(?P<again>[1-9]\d*))?"
RUN_PATTERN = re.compile(_RUN, re.ASCII)
PART_PATTERN = re.compile(
    rf"(?P<prefix>.+)-(?P<run>{_RUN})-(?P<part>\d{{4,}})\.mcap(?P<active>{re.escape(ACTIVE)})?", re.ASCII
)
"""Name of a part, of any prefix."""


class OwnFile(NamedTuple):
    """One of our files; they sort in the order of their writing, as long as no run began before the clock was set back."""

    stamp: str
    again: int
    """Number of the run among those of the same second, 1 for the first."""
    part: int
    active: bool
    path: Path
    run: str


def part_name(prefix: str, run: str, part: int) -> str:
    """Name of a finished part."""
    return f"{prefix}-{run}-{part:04d}.mcap"


def parse(prefix: str, path: Path) -> OwnFile | None:
    """What the name says; None for a file that is not ours."""
    found = PART_PATTERN.fullmatch(path.name)
    if found is None or found["prefix"] != prefix:
        return None
    again = int(found["again"] or 1)
    return OwnFile(found["stamp"], again, int(found["part"]), bool(found["active"]), path, found["run"])


def own_files(directory: Path, prefix: str) -> list[OwnFile]:
    """Our regular files in a directory, oldest first; empty where it cannot be read."""
    try:
        found = [parse(prefix, path) for path in directory.iterdir()]
        return sorted(each for each in found if each and each.path.is_file() and not each.path.is_symlink())
    except OSError:
        return []


def free_run(directory: Path, prefix: str, time_ns: int) -> str:
    """Name for a run that begins at this time: one that no file there has."""
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(time_ns // 1_000_000_000))
    taken = [each.again for each in own_files(directory, prefix) if each.stamp == stamp]
    return f"{stamp}_{max(taken) + 1}" if taken else stamp
