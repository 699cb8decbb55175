"""`about.json` in the runtime directory: what a running jtqd is, for tools that look at it.

Written once by the supervisor at its start, before the nodes are booted; readable by the daemon's group. Numbers that change
are in the snapshot, not here.
"""

from __future__ import annotations

import json
import os
import platform
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from daemon.config import Config, JointConfig
from daemon.loop.input_pdos import input_pdos, sensor_index

FILE = "about.json"
SCHEMA = "jtqd.about/1"
_PACKAGES = ("jtqd", "numpy", "onnxruntime", "python-can", "canopen", "mcap")


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


@dataclass(frozen=True)
class About:
    """What `about.json` says; `started` is UTC (ISO 8601), `started_ticks` the process's start time in /proc/PID/stat."""

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
    joints: tuple[AboutJoint, AboutJoint]
    sensor_node: int | None
    inputs: tuple[str, ...]
    """Names of the input PDOs in the order of the snapshot's `inputs`."""
    log_directory: str | None
    log_prefix: str
    versions: dict[str, str]

    @property
    def nodes(self) -> dict[int, str]:
        """Node-ID -> what it is, of every node but the daemon's own."""
        found = {joint.node: f"drive of joint {joint.number}" for joint in self.joints}
        if self.sensor_node is not None:
            found[self.sensor_node] = "torque sensor"
        return found

    def running(self) -> bool:
        """True while the very process that wrote this is there; another one with its number does not count."""
        return start_ticks(self.pid) == self.started_ticks


def about(config: Config, *, bus: str, instance: str, log_directory: Path | None) -> About:
    """What this process has to say of itself."""
    names = tuple(pdo.name for pdo in input_pdos(config))
    one, two = (_joint(config, number, joint, names) for number, joint in enumerate(config.joints))
    return About(
        bus=bus,
        instance=instance,
        pid=os.getpid(),
        started=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        started_ticks=start_ticks(os.getpid()) or 0,
        configuration=str(config.path.resolve()),
        configuration_sha256=config.sha256,
        method=config.estimator.method,
        node=config.node_id,
        bitrate=config.bitrate,
        period_us=config.period_ns // 1000,
        deadline_us=config.input_deadline_ns / 1000,
        heartbeat_ms=config.heartbeat_ms,
        joints=(one, two),
        sensor_node=config.sensor.node_id if config.sensor else None,
        inputs=names,
        log_directory=str(log_directory.resolve()) if log_directory else None,
        log_prefix=f"jtqd-{instance}-",
        versions={name: installed(name) or "not installed" for name in _PACKAGES}
        | {"python": platform.python_version(), "kernel": platform.release()},
    )


def write_about(directory: Path, content: About) -> None:
    """Write it whole or not at all. Raises OSError."""
    new = directory / (FILE + ".new")
    with open(new, "w", encoding="utf-8") as file:
        os.fchmod(file.fileno(), 0o640)
        json.dump({"schema": SCHEMA} | _plain(content), file)
    os.replace(new, directory / FILE)


def read_about(path: Path) -> About:
    """Read an `about.json`.

    Raises:
        AboutError: it cannot be read, is not JSON, or is of another version.
        PermissionError: it belongs to a daemon of another user and group.
    """
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("schema") != SCHEMA:
            raise AboutError(f"{path}: written by another version of jtqd")
        one, two = (AboutJoint(**each | {"inputs": tuple(each["inputs"])}) for each in content.pop("joints"))
        return About(joints=(one, two), inputs=tuple(content.pop("inputs")), **content)
    except PermissionError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise AboutError(f"{path}: {error}") from None


def start_ticks(pid: int) -> int | None:
    """Start time of a process in clock ticks since boot (field 22 of /proc/PID/stat); None where there is none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # the name may hold anything
    return None if fields[0] == "Z" else int(fields[19])


def installed(name: str) -> str | None:
    """Version of an installed package."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _joint(config: Config, number: int, joint: JointConfig, names: tuple[str, ...]) -> AboutJoint:
    sensor = sensor_index(config, joint.sensor_channel)
    rated = joint.joint.rated_torque_nm
    return AboutJoint(
        number=joint.number,
        name=joint.joint.name,
        node=joint.node_id,
        rated_torque_nm=rated,
        torque_limit_nm=config.estimator.torque_limit * rated,
        network=joint.network.path.name if joint.network else None,
        network_limit_nm=config.estimator.network_limit * rated,
        inputs=names[2 * number : 2 * number + 2],
        sensor=None if sensor is None else names[sensor],
        temperature=joint.temperature,
    )


def _plain(content: About) -> dict[str, Any]:
    return {
        name: [vars(joint) for joint in value] if name == "joints" else value
        for name, value in vars(content).items()
    }
