"""Where a running jtqd keeps its ring and snapshot: one directory per bus, on a tmpfs, readable by its own user only."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from pathlib import Path


def runtime_dir(bus: str) -> Path:
    """Directory of the instance on `bus`, made if needed: under $RUNTIME_DIRECTORY (systemd), $XDG_RUNTIME_DIR or /dev/shm.

    Raises:
        OSError: it cannot be made, or belongs to somebody else.
    """
    base = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0] or os.environ.get("XDG_RUNTIME_DIR", "")
    root = Path(base) if base else Path("/dev/shm")
    path = root / f"jtqd-{os.getuid()}-{instance_name(bus)}"
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if path.lstat().st_uid != os.getuid():
        raise PermissionError(f"{path} belongs to another user")
    return path


def lock(directory: Path) -> int:
    """Claim the directory until this process ends, however it ends; returns the descriptor that holds the claim.

    Raises:
        BlockingIOError: another process holds it; the message names it.
    """
    descriptor = os.open(directory / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(descriptor, 32).decode(errors="replace").strip()
        os.close(descriptor)
        raise BlockingIOError(f"process {holder} is already running there") from None
    os.truncate(descriptor, 0)
    os.write(descriptor, f"{os.getpid()}\n".encode())
    return descriptor


def instance_name(bus: str) -> str:
    """Name of the instance as it can stand in a file name: "vcan0", or "unix-tmp-bench-1f3a" with part of a hash."""
    name = re.sub(r"[^A-Za-z0-9_.]+", "-", bus).strip("-")
    return name if name == bus else f"{name}-{hashlib.sha256(bus.encode()).hexdigest()[:4]}"
