"""The runtime directory of a running jtqd: ring, snapshot and description of one daemon, on a tmpfs.

The directory is open to the daemon's group (0750): its members can read the snapshot, `about.json` and the recorder's
account (`jtq status`); what only the daemon's own processes need (`ring`, `lock`, `control`) stays with its user.

`about.json` is what a running jtqd is: written by the supervisor before the nodes are booted, and again where a drive has
other TPDOs than the configuration. Numbers that change are in the snapshot.
"""

from __future__ import annotations

import fcntl
import json
import mmap
import os
import platform
import re
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jtqd.estimator.files import open_regular, trusted_users
from jtqd.estimator.text import sha256_hex

FILE = "about.json"
SCHEMA = "jtqd.about/1"
_LOCK = "lock"
_ATTEMPTS = 100
_LARGEST_JSON = 1 << 20
"""Bytes; an about.json of four joints has some 5000."""


def write_whole(path: Path, text: str, mode: int = 0o640) -> None:
    """Write a file whole or not at all, by default readable by the daemon's group. Raises OSError."""
    new = path.with_name(path.name + ".new")
    try:
        with open(new, "w", encoding="utf-8") as file:
            os.fchmod(file.fileno(), mode)
            file.write(text)
        os.replace(new, path)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def new_memory(path: Path, size: int, head: bytes, mode: int = 0o640) -> mmap.mmap:
    """Make shared memory that begins with `head`; a reader of an older file at `path` keeps that one. Raises OSError."""
    new = path.with_name(path.name + ".new")
    with open(new, "w+b") as file:
        os.fchmod(file.fileno(), mode)
        os.posix_fallocate(file.fileno(), 0, size)  # a full tmpfs refuses here, not by SIGBUS in a cycle
        memory = mmap.mmap(file.fileno(), 0)
    memory[: len(head)] = head
    os.replace(new, path)
    return memory


def json_of(path: Path) -> Any:
    """Return the value of a JSON file of a running daemon of a trusted user. Raises OSError, ValueError."""
    from jtqd.estimator.decoder import read_json

    return read_json(path, _LARGEST_JSON, owners=trusted_users())


class SharedMemoryError(Exception):
    """No memory of this kind and layout at the path: ring, snapshot or notices."""


def mapped(path: Path, missing: str, *, writable: bool = False) -> mmap.mmap:
    """Map shared memory of a running daemon of a trusted user. Raises SharedMemoryError, with what is `missing`."""
    access = mmap.ACCESS_WRITE if writable else mmap.ACCESS_READ
    try:
        flags = os.O_RDWR if writable else os.O_RDONLY
        with open(open_regular(path, flags, owners=trusted_users()), "r+b" if writable else "rb") as file:
            return mmap.mmap(file.fileno(), 0, access=access)
    except (OSError, ValueError) as error:
        raise SharedMemoryError(f"{path}: {missing}: {error}") from None


def claim(bus: str) -> tuple[Path, int]:
    """Make the directory of the instance on `bus` and claim it until this process ends, however it ends.

    It lies under $RUNTIME_DIRECTORY (systemd), $XDG_RUNTIME_DIR or /dev/shm. Returns it, and the descriptor that holds the
    claim. Raises BlockingIOError where another process holds it, OSError where it cannot be made or is somebody else's.
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
    """Remove a directory that this process has claimed; what cannot be removed stays."""
    with suppress(OSError):
        for entry in directory.iterdir():
            if entry.name != _LOCK:
                entry.unlink(missing_ok=True)
        # Last: from here on the name is free, and another process may make it again.
        (directory / _LOCK).unlink()
        directory.rmdir()


def _sweep(root: Path) -> None:
    """Remove the directories of killed daemons of this user: those whose lock nobody holds."""
    for directory in root.glob(f"jtqd-{os.getuid()}-*"):
        with suppress(OSError):
            if not (directory / _LOCK).is_file():  # not one of ours, or just being made
                continue
            descriptor = _locked(directory)
            remove(directory)
            os.close(descriptor)


def _swept(error: BlockingIOError) -> bool:
    """Return whether no running process holds the lock: another one is removing the directory of a killed daemon."""
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
    return name if name == bus else f"{name}-{sha256_hex(bus.encode())[:4]}"


class AboutError(Exception):
    """No description of a daemon of this version at the path."""


@dataclass(frozen=True)
class AboutJoint:
    """One joint: limits in Nm on the joint side; `inputs` and `sensor` are names of input PDOs."""

    number: int
    name: str
    node: int
    rated_torque_nm: float
    torque_limit_nm: float
    network: str | None
    network_limit_nm: float
    inputs: tuple[str, ...]
    sensor: str | None
    temperature: bool
    contact_threshold_nm: float | None = None
    """None: contacts are not watched."""


@dataclass(frozen=True)
class About:
    """Content of `about.json`; `started` is UTC (ISO 8601), `started_ticks` the process's start time in /proc/PID/stat."""

    bus: str
    instance: str
    pid: int
    started: str
    started_ticks: int
    configuration: str
    configuration_sha256: str
    method: str
    node: int
    bitrate: int
    period_us: int
    deadline_us: float
    heartbeat_ms: int
    joints: tuple[AboutJoint, ...]
    sensor_node: int | None
    inputs: tuple[str, ...]
    """Names of the input PDOs in the order of the snapshot's `inputs`."""
    log_directory: str | None
    log_prefix: str
    versions: dict[str, str]
    tpdos: dict[str, Any] = field(default_factory=dict)
    """TPDOs of the drives as they are in force, by node-ID (`drive.tpdos_as_json`)."""

    @property
    def nodes(self) -> dict[int, str]:
        """Node-ID -> what it is, of every node but the daemon's own."""
        found = {joint.node: f"drive of joint {joint.number}" for joint in self.joints}
        if self.sensor_node is not None:
            found[self.sensor_node] = "torque sensor"
        return found

    def running(self) -> bool:
        """Return True while the very process that wrote this is there; another one with its number does not count."""
        return start_ticks(self.pid) == self.started_ticks


def write_about(directory: Path, content: About) -> None:
    """Write it whole or not at all. Raises OSError."""
    import msgspec  # here and below: readers of the memory alone do without it

    write_whole(directory / FILE, json.dumps({"schema": SCHEMA} | msgspec.to_builtins(content)))


def read_about(path: Path) -> About:
    """Read an `about.json`.

    Raises AboutError where it cannot be read or is of another version, PermissionError for another user's and group's.
    """
    import msgspec

    try:
        content = json_of(path)
        if content["schema"] != SCHEMA:
            raise AboutError(f"{path}: written by another version of jtqd")
        return msgspec.convert(content, About)
    except PermissionError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise AboutError(f"{path}: {error}") from None


def start_ticks(pid: int) -> int | None:
    """Start time of a process in clock ticks since boot (field 22 of /proc/PID/stat); None where there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # the name may hold anything
    return None if fields[0] == "Z" else int(fields[19])


_PACKAGES = ("jtqd", "numpy", "onnxruntime", "python-can", "canopen", "mcap")


def installed(name: str) -> str | None:
    """Version of an installed package."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that an estimate and its log depend on, for `about.json` and the log."""
    found = {name: installed(name) or "not installed" for name in _PACKAGES}
    return found | {"python": platform.python_version()}
