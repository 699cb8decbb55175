"""The supervisor's side of the ROS 2 publisher: what its process is told; start and restart: `SideProcess`."""

from __future__ import annotations

import os
from pathlib import Path

from jtqd.daemon.config import LOOPBACK, Config, Ros2Settings
from jtqd.daemon.recording.launch import nodes_of
from jtqd.daemon.ros2.network import domain_id
from jtqd.daemon.shared.side_process import SideProcess, StartChild, say


class Ros2Keeper(SideProcess):
    """ROS 2 publisher of one run of jtqd; its failures do not affect the loop.

    Args:
        start_child: (module, arguments, name) -> child; the supervisor ends what it has started.
        settings: section `ros2` of the configuration.

    Raises:
        ConfigError: ROS_DOMAIN_ID is no domain.
    """

    def __init__(self, start_child: StartChild, settings: Ros2Settings) -> None:
        super().__init__(start_child, "jtqd.daemon.ros2.process", "ROS 2 publisher", "publishing")
        self._settings = settings
        self._domain_id = domain_id(settings.domain_id, os.environ)
        self._directory, self._bus = Path(), ""

    def start(self, config: Config, directory: Path, bus: str) -> None:
        """Start the publisher of the daemon's runtime directory.

        Args:
            config: in force.
            directory: holds `ring` and `snapshot`.
            bus: name of the bus.
        """
        self._directory, self._bus = directory, bus
        self._request = self._request_of(config)
        if self._settings.interface != LOOPBACK:
            say(
                f"ROS 2: torques, positions and diagnostics go to every host that is reached by {self._settings.interface}"
            )
        self._run()

    def _request_of(self, config: Config) -> dict[str, object]:
        settings = self._settings
        return {
            "ring": str(self._directory / "ring"),
            "snapshot": str(self._directory / "snapshot"),
            "domain_id": self._domain_id,
            "interface": settings.interface,
            "rate_hz": settings.rate_hz,
            "names": settings.names_of(len(config.joints)),
            "bus": self._bus,
            "nodes": nodes_of(config),
            "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
        }
