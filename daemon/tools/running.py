"""Running daemons of this machine, found by their runtime directories. Reads only; holds no lock anybody waits for."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from daemon.shared.about import FILE, About, AboutError, read_about

_SHARED = ("/dev/shm", "/run/jtqd/*", "/run/user/*")


class Daemon(NamedTuple):
    """One daemon that runs."""

    directory: Path
    about: About


class Found(NamedTuple):
    """What a search came upon."""

    daemons: tuple[Daemon, ...]
    closed: tuple[Path, ...]
    """Runtime directories that this user may not look into."""
    left_over: tuple[Path, ...]
    """Runtime directories of daemons that were killed; the next start on the same bus takes them over."""


def places() -> list[Path]:
    """Where runtime directories may lie: this environment's, systemd's, those of the users, and /dev/shm."""
    named = [os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0], os.environ.get("XDG_RUNTIME_DIR", "")]
    found = [Path(each) for each in named if each]
    for pattern in _SHARED:
        found += sorted(Path("/").glob(pattern.lstrip("/")))
    return list(dict.fromkeys(found))


def find_daemons(roots: Iterable[Path] | None = None) -> Found:
    """Every daemon that runs, by the name of its bus; `roots`: where to look instead of `places()`."""
    daemons, closed, left_over = [], [], []
    for root in places() if roots is None else roots:
        for directory in _subdirectories(root):
            try:
                os.scandir(directory).close()
                content = read_about(directory / FILE)
            except PermissionError:
                closed.append(directory)
            except (AboutError, OSError):
                left_over.append(directory)
            else:
                if content.running():
                    daemons.append(Daemon(directory, content))
                else:
                    left_over.append(directory)
    return Found(tuple(sorted(daemons, key=lambda each: each.about.bus)), tuple(closed), tuple(left_over))


def on_bus(found: Found, bus: str) -> Daemon | None:
    """The daemon on `bus`: as its --bus was written, or as the name of its instance; "sim" is one that emulates."""
    for daemon in found.daemons:
        if bus in (daemon.about.bus, daemon.about.instance):
            return daemon
    return None


def _subdirectories(root: Path) -> list[Path]:
    try:
        return sorted(each for each in root.glob("jtqd-*-*") if each.is_dir())
    except OSError:
        return []
