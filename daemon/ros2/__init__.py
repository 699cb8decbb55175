"""ROS 2 publisher: joint states, diagnostics and torque states as DDS topics that ROS 2 nodes subscribe to, without ROS.

In comes the loop's shared memory, read-only; out go DDS messages with the types and names of ROS 2 (extra `ros2`).
Here: domain and network interface, and how the supervisor starts `process`.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path

from jtqd.daemon.config import HIGHEST_DOMAIN, LOOPBACK, Config, Ros2Settings
from jtqd.daemon.recording.launch import loop_request
from jtqd.daemon.shared.processes import SideProcess, StartChild
from jtqd.estimator.errors import ConfigError

_WHEELS_FOR = "x86_64"
_VARIABLE = "ROS_DOMAIN_ID"


def installed() -> bool:
    """Return whether the package that the publisher needs is installed."""
    return importlib.util.find_spec("cyclonedds") is not None


def needed(machine: str) -> str:
    """Return what is missing and how it is installed, for a machine as `platform.machine` names it."""
    if machine == _WHEELS_FOR:
        return "the package cyclonedds: pip install 'jtqd[ros2]'"
    return f"the package cyclonedds, of which there is no wheel for {machine}: docs/ros2.md states how it is built"


def domain_id(configured: int | None, environment: Mapping[str, str]) -> int:
    """Return the DDS domain: as configured, else by the environment (ROS_DOMAIN_ID), else 0. Raises ConfigError."""
    text = environment.get(_VARIABLE, "")
    if configured is not None or not text:
        return configured or 0
    if not (text.isascii() and text.isdecimal()) or int(text) > HIGHEST_DOMAIN:
        raise ConfigError(f"{_VARIABLE}: found {text!r}, expected a whole number from 0 to {HIGHEST_DOMAIN}")
    return int(text)


class Ros2Publisher(SideProcess):
    """ROS 2 publisher of one run of jtqd; its failures do not affect the loop. Raises ConfigError (ROS_DOMAIN_ID)."""

    def __init__(self, start_child: StartChild, settings: Ros2Settings) -> None:
        super().__init__(start_child, "jtqd.daemon.ros2.process", "ROS 2 publisher", "publishing")
        self._settings = settings
        self._domain_id = domain_id(settings.domain_id, os.environ)

    def start(self, config: Config, runtime: Path, bus: str) -> None:
        """Start the publisher of the daemon with this runtime directory; `bus`: its name."""
        settings = self._settings
        request = loop_request(config, runtime, bus) | {
            "domain_id": self._domain_id,
            "interface": settings.interface,
            "rate_hz": settings.rate_hz,
            "joint_names": settings.names_of(len(config.joints)),
        }
        reach = f"ROS 2: torques, positions and diagnostics go to every host that is reached by {settings.interface}"
        self.begin(request, "" if settings.interface == LOOPBACK else reach)
