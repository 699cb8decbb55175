"""Where a running jtqd keeps its ring and snapshot: one directory per bus, on a tmpfs.

The directory is open to the daemon's group (0750): the snapshot, `about.json` and the recorder's account can be read by its
members (`jtq status`); what only the daemon's own processes need (`ring`, `lock`, `control`) stays with its user.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import time
from contextlib import suppress
from pathlib import Path

_LOCK = "lock"
_ATTEMPTS = 100


def claim(bus: str) -> tuple[Path, int]:
    """Make the directory of the instance on `bus` and claim it until this process ends, however it ends.

    It lies under $RUNTIME_DIRECTORY (systemd), $XDG_RUNTIME_DIR or /dev/shm.

    Returns:
        The directory, and the descriptor that holds the claim.

    Raises:
        BlockingIOError: another process holds it; the message names it.
        OSError: it cannot be made, or belongs to somebody else.
    """
    base = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0] or os.environ.get("XDG_RUNTIME_DIR", "")
    root = Path(base) if base else Path("/dev/shm")
    _sweep(root)
    directory = root / f"jtqd-{os.getuid()}-{instance_name(bus)}"
    for left in reversed(range(_ATTEMPTS)):
        try:
            descriptor = _locked(directory)
            break
        except FileNotFoundError:  # another process's `remove` came between: once more
            if not left:
                raise
        except BlockingIOError as error:
            if not left or not _swept(error):
                raise
            time.sleep(0.01)
    os.truncate(descriptor, 0)
    os.write(descriptor, f"{os.getpid()}\n".encode())
    return directory, descriptor


def remove(directory: Path) -> None:
    """Take away a directory that this process has claimed; what cannot be removed stays."""
    with suppress(OSError):
        for entry in directory.iterdir():
            if entry.name != _LOCK:
                entry.unlink(missing_ok=True)
        # Last: from here on the name is free, and another process may make it anew.
        (directory / _LOCK).unlink()
        directory.rmdir()


def _sweep(root: Path) -> None:
    """Take away what daemons of this user left that were killed: directories whose claim nobody holds."""
    for directory in root.glob(f"jtqd-{os.getuid()}-*"):
        with suppress(OSError):
            if not (directory / _LOCK).is_file():  # not one of ours, or just being made
                continue
            descriptor = _locked(directory)
            remove(directory)
            os.close(descriptor)


def _swept(error: BlockingIOError) -> bool:
    """The claim is held by none that runs there: somebody is just taking away what a killed daemon left."""
    holder = str(error).split()[1]
    return not (holder.isdigit() and Path("/proc", holder).exists())


def _locked(directory: Path) -> int:
    """Descriptor of the claim. Raises FileNotFoundError where the directory is removed meanwhile."""
    try:
        directory.mkdir(mode=0o750, parents=True, exist_ok=True)
    except FileExistsError:
        if directory.exists() and not directory.is_dir():
            raise
        raise FileNotFoundError(f"{directory} was removed") from None
    if directory.lstat().st_uid != os.getuid():
        raise PermissionError(f"{directory} belongs to another user")
    path = directory / _LOCK
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A file that has lost its name would be locked for nobody but us.
        if not os.path.samestat(os.fstat(descriptor), path.stat()):
            raise FileNotFoundError(f"{path} was removed")
    except BlockingIOError:
        holder = os.read(descriptor, 32).decode(errors="replace").strip()
        os.close(descriptor)
        raise BlockingIOError(f"process {holder} is already running there") from None
    except FileNotFoundError:
        os.close(descriptor)
        raise
    return descriptor


def instance_name(bus: str) -> str:
    """Name of the instance as it can stand in a file name: "vcan0", or "unix-tmp-bench-1f3a" with part of a hash."""
    name = re.sub(r"[^A-Za-z0-9_.]+", "-", bus).strip("-")
    return name if name == bus else f"{name}-{hashlib.sha256(bus.encode()).hexdigest()[:4]}"
