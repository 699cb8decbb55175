"""Running daemons of this machine, found by their runtime directories."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from jtqd.daemon.live.reading import Daemon
from jtqd.daemon.shared.runtime_dir import FILE, AboutError, read_about
from jtqd.estimator.files import trusted_users
from jtqd.estimator.text import counted

_SHARED = ("/dev/shm", "/run/jtqd/*", "/run/user/*")


class DaemonSearch(NamedTuple):
    """Runtime directories of jtqd on this machine."""

    daemons: tuple[Daemon, ...]
    closed: tuple[Path, ...]
    """Runtime directories that this user may not read."""
    abandoned: tuple[Path, ...]
    """Runtime directories of killed daemons; the next start on the same bus reuses them."""
    foreign: tuple[Path, ...] = ()
    """What users made who are neither root nor this user nor a service's: not read."""


def places() -> list[Path]:
    """Return the possible runtime directories: this environment's, systemd's, those of the users, and /dev/shm."""
    named = [os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0], os.environ.get("XDG_RUNTIME_DIR", "")]
    found = [Path(each) for each in named if each]
    for pattern in _SHARED:
        found += sorted(Path("/").glob(pattern.lstrip("/")))
    return list(dict.fromkeys(found))


def find_daemons(roots: Iterable[Path] | None = None) -> DaemonSearch:
    """Return every running daemon, by the name of its bus; `roots`: directories instead of `places()`."""
    daemons, closed, abandoned, foreign, users = [], [], [], [], trusted_users()
    for root in places() if roots is None else roots:
        for directory in _subdirectories(root):
            try:
                if directory.lstat().st_uid not in users:
                    foreign.append(directory)
                    continue
                os.scandir(directory).close()
                content = read_about(directory / FILE)
            except PermissionError:
                closed.append(directory)
            except (AboutError, OSError):
                abandoned.append(directory)
            else:
                if content.running():
                    daemons.append(Daemon(directory, content))
                else:
                    abandoned.append(directory)
    return DaemonSearch(
        tuple(sorted(daemons, key=lambda each: each.about.bus)),
        tuple(closed),
        tuple(abandoned),
        tuple(foreign),
    )


def on_bus(search: DaemonSearch, bus: str) -> Daemon | None:
    """Return the daemon on `bus` (its --bus or the name of its instance); "sim" is one that emulates."""
    for daemon in search.daemons:
        if bus in (daemon.about.bus, daemon.about.instance):
            return daemon
    return None


class NoDaemonError(Exception):
    """No daemon to talk to, or more than one; the message is for the operator."""

    def __init__(self, message: str, exit_status: int) -> None:
        super().__init__(message)
        self.exit_status = exit_status


def choose_daemon(bus: str | None) -> Daemon:
    """Return the daemon on `bus`, or the only running one.

    Raises:
        NoDaemonError: none runs there (exit status 1), or several run and no bus is named (2).
    """
    search = find_daemons()
    others = "".join(f"\n  --bus {each.about.instance:<24} pid {each.about.pid}" for each in search.daemons)
    closed = "".join(
        f"\n  {path} belongs to another user: join its group to read it" for path in search.closed
    )
    if search.foreign:
        what = counted(len(search.foreign), "directory", "directories")
        closed = f" ({what} of other users not read){closed}"
    if bus is not None:
        daemon = on_bus(search, bus)
        if daemon is None:
            raise NoDaemonError(f"no jtqd runs on {bus}{closed}{others}", 1)
        return daemon
    if not search.daemons:
        raise NoDaemonError(f"no jtqd runs on this machine{closed}", 1)
    if len(search.daemons) > 1:
        raise NoDaemonError(f"several daemons run; select one with --bus:{others}", 2)
    return search.daemons[0]


def _subdirectories(root: Path) -> list[Path]:
    try:
        return sorted(each for each in root.glob("jtqd-*-*") if each.is_dir() and not each.is_symlink())
    except OSError:
        return []
