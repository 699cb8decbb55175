"""The bus service on a real hub with small nodes, without a loop: its snapshot is written by the test."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from jtqd.daemon.bus.boot import ReturningNodes, boot_request
from jtqd.daemon.bus.service import BusService, service_filters
from jtqd.daemon.config import load_config
from jtqd.daemon.shared.conditions import Conditions
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.frame import CAN_RTR_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.models.files import shipped
from tests.drivers.canopen_nodes import EDS, HubResponder, TestNode, boot_all, drive_store, sensor_store

OWN = 0x20


class MasterBench:
    """jtqd's bus service and three nodes on a hub. Context manager.

    Attributes:
        lines: of the log.
        heard: frames of jtqd's own node: (identifier, data).
        drives, sensor: the nodes; the sensor is on the bus only after `appear()` where `with_sensor` is False.
    """

    def __init__(self, directory: Path, *, with_sensor: bool = True, heartbeat_ms: int = 30) -> None:
        text = shipped("bench.yaml").read_text().replace("heartbeat_ms: 100", f"heartbeat_ms: {heartbeat_ms}")
        text = text.replace("temperature: true", "temperature: false").replace(
            "boot_timeout_s: 2.0", "boot_timeout_s: 0.4"
        )
        text = text.replace("file: trained", f"file: {shipped('bench.yaml').parent}/trained")
        (directory / "c.yaml").write_text(text)
        self.config = load_config(directory / "c.yaml")
        self.drives = [TestNode(drive_store(1)), TestNode(drive_store(2))]
        for drive in self.drives:
            drive.store.set_number(0x608F, 1, 65536)
        self.sensor = TestNode(sensor_store(3))
        self.path = str(directory / "hub")
        self.bus = f"unix:{self.path}"
        self.responder = HubResponder(self.path, [*self.drives, *([self.sensor] if with_sensor else [])])
        self.snapshot = Snapshot(directory / "snapshot", 1e-3, 0.8)
        self.reader = SnapshotReader(directory / "snapshot", supervisor=True)
        self.conditions = Conditions()
        self.lines: list[str] = []
        self.heard: list[tuple[int, bytes]] = []
        self.children: list[Child] = []
        self._directory = directory

    def __enter__(self) -> Self:
        self.responder.__enter__()
        socket = open_frame_socket(self.bus, service_filters(self.config), error_frames=True)
        booted = boot_all(boot_request(self.config, self.bus))
        self.report = json.loads(json.dumps(booted.as_json()))  # as the supervisor gets it
        for node in (1, 2, 3):
            self.snapshot.node_states[node] = 5
        self.returning = ReturningNodes(self.config, self.bus, self.report, self._child, self._log)
        self.tester = open_frame_socket(self.bus, [CanFilter(0, CAN_RTR_FLAG)])
        self.service = BusService(
            socket,
            self.config,
            self.report,
            reader=self.reader,
            store=ObjectStore(EDS / "jtqd.eds", OWN),
            returning=self.returning,
            conditions=self.conditions,
            log=self._log,
            directory=self._directory,
        )
        self.service.begin(time.monotonic())
        return self

    def __exit__(self, *_: object) -> None:
        for child in self.children:
            child.end()
        self.responder.__exit__()

    def _child(self, module: str, arguments: list[str], name: str) -> Child:
        self.children.append(Child(module, arguments, name=name))
        return self.children[-1]

    def _log(self, topic: str, node: int, line: str) -> None:
        self.lines.append(line)

    def appear(self) -> None:
        """The sensor is plugged in."""
        self.responder.nodes.append(self.sensor)

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.tester.send(pack(can_id, data))

    def run(self, until: Callable[[], bool], longest_s: float = 10.0) -> bool:
        """Turn until `until()`; False: not within the time."""
        deadline = time.monotonic() + longest_s
        while time.monotonic() < deadline:
            now_s = time.monotonic()
            self.service.turn(self.reader.read(), now_s)
            self.lines += [line.text for line in self.conditions.lines(now_s)]
            self._listen()
            if until():
                return True
            time.sleep(0.004)
        return False

    def pause(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.run(lambda: time.monotonic() >= end, seconds + 1.0)

    def own(self, base: int) -> list[bytes]:
        """Data of the frames that jtqd has sent as base + 20h."""
        return [data for can_id, data in self.heard if can_id == base + OWN]

    def logged(self, words: str) -> bool:
        return any(words in line for line in self.lines)

    def sdo(self, index: int, subindex: int) -> int:
        """Value of an object of jtqd, asked for by a frame."""
        key = index.to_bytes(2, "little") + bytes([subindex])
        self.heard.clear()
        self.send(0x600 + OWN, b"\x40" + key + bytes(4))
        assert self.run(lambda: any(data[1:4] == key for data in self.own(0x580)), 2.0)
        (reply,) = (data for data in self.own(0x580) if data[1:4] == key)
        assert reply[0] & 0xE3 == 0x43, reply.hex(" ")
        return int.from_bytes(reply[4 : 8 - (reply[0] >> 2 & 3)], "little")

    def _listen(self) -> None:
        while count := self.tester.receive():
            for n in range(count):
                can_id, length, data = FRAME.unpack_from(self.tester.frames, 16 * n)
                self.heard.append((can_id, bytes(data[:length])))
        del self.heard[:-5000]
