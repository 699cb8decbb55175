"""The supervisor's side of the live view: what its process is told; start and restart: `SideProcess`."""

from __future__ import annotations

from pathlib import Path

from jtqd.daemon.config import Config
from jtqd.daemon.live.address import Address
from jtqd.daemon.recording.launch import nodes_of
from jtqd.daemon.shared.notices import FILE as NOTICES
from jtqd.daemon.shared.side_process import SideProcess, StartChild, say


class LiveKeeper(SideProcess):
    """Live view of one run of jtqd; its failures do not affect the loop.

    Args:
        start_child: (module, arguments, name) -> child; the supervisor ends what it has started.
        address: where it listens.
    """

    def __init__(self, start_child: StartChild, address: Address) -> None:
        super().__init__(start_child, "jtqd.daemon.live.process", "live view", "listening")
        self._address = address

    def start(self, config: Config, directory: Path, bus: str) -> None:
        """Start the live view of the daemon's runtime directory.

        Args:
            config: in force.
            directory: holds `ring`, `snapshot` and `notices`.
            bus: name of the bus.
        """
        self._request = {
            "ring": str(directory / "ring"),
            "snapshot": str(directory / "snapshot"),
            "notices": str(directory / NOTICES),
            "host": self._address.host,
            "port": self._address.port,
            "bus": bus,
            "nodes": nodes_of(config),
            "gear_ratios": [joint.joint.gear_ratio for joint in config.joints],
        }
        if not self._address.loopback:
            say(
                f"the live view accepts connections from every host that can reach {self._address.host}; it is read-only"
            )
        self._run()
