"""The whole daemon with the emulated bench on a SocketCAN interface, and the frames of its own node there."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from jtqd.daemon.core.estimate_pdo import decode
from jtqd.daemon.shared.snapshot import SnapshotReader
from jtqd.drivers.bus_socket import exact
from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.frame_socket import BusDown, open_frame_socket
from jtqd.models.files import shipped
from tests.drivers.canopen_nodes import TestNode, sensor_store
from tests.shipped_bench import shipped_bench

INTERFACE = os.environ.get("JTQD_CAN_INTERFACE", "vcan0")
STALE = 4


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


class Daemon:
    """jtqd with a bench; the frames of its own node are collected. Its log goes to DIRECTORY/RECORD, if asked for."""

    def __init__(self, directory: Path, record: str = "", **changes: Any) -> None:
        self.directory, self.bus, self.log = directory, INTERFACE, directory / "stderr"
        (directory / "run").mkdir()
        self.emcys: list[bytes] = []
        self.statuses: list[tuple[int, int]] = []
        self.bench = subprocess.Popen(
            [sys.executable, "-m", "jtqd.sim_can", "--bus", self.bus], stderr=subprocess.PIPE, text=True
        )
        self.socket = open_frame_socket(self.bus, [exact(0x0A0), exact(0x1A0)])
        logs = str(directory / record) if record else "none"
        command = ["--bus", self.bus, "--record", logs, "--config", self._configuration(changes)]
        assert self.bench.stderr is not None
        assert "ready" in self.bench.stderr.readline()
        self.out = directory / "stdout"
        with open(self.log, "w") as log, open(self.out, "w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "jtqd.daemon.jtqd", *command],
                env={**os.environ, "RUNTIME_DIRECTORY": str(directory / "run")},
                stdout=out,
                stderr=log,
            )

    def begun(self) -> None:
        """Wait until it estimates."""
        assert self.until(self.well, 60.0), self.log_text()
        (snapshot,) = (self.directory / "run").glob("*/snapshot")
        self.reader = SnapshotReader(snapshot)

    def _configuration(self, changes: dict[str, Any]) -> str:
        content = shipped_bench()
        content["estimator"] = {"method": "efficiency"}
        for number in (1, 2):
            content[f"joint_{number}"]["file"] = str(shipped(f"joint{number}.yaml"))
        content.update(changes)
        path = self.directory / "c.yaml"
        path.write_text(yaml.safe_dump(content))
        return str(path)

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.socket.send(pack(can_id, data))

    def listen(self) -> None:
        while count := self.socket.receive():
            for n in range(count):
                can_id, length, data = FRAME.unpack_from(self.socket.frames, 16 * n)
                if can_id == 0x0A0:
                    self.emcys.append(bytes(data[:length]))
                elif can_id == 0x1A0:
                    self.statuses.append(decode(bytes(data)).status)

    def until(
        self, condition: Callable[[], bool], longest_s: float = 15.0, do: Callable[[], None] | None = None
    ) -> bool:
        deadline = time.monotonic() + longest_s
        while time.monotonic() < deadline:
            assert self.process.poll() is None, self.log.read_text()
            if do is not None:
                do()
            try:
                self.socket.wait(0.01)
                self.listen()
            except BusDown:
                time.sleep(0.01)
            if condition():
                return True
        return False

    def well(self) -> bool:
        """Both joints have inputs, for a while."""
        recent = self.statuses[-100:]
        return len(recent) == 100 and not any(STALE in each for each in recent)

    def begin(self) -> None:
        """Between two tests all is well and reported."""
        assert self.until(lambda: self.well() and self.reader.read().unconfigured == (), 20.0), (
            self.log_text()
        )
        time.sleep(0.2)
        self.listen()
        self.emcys.clear()
        self.statuses.clear()

    def log_text(self) -> str:
        return self.log.read_text()

    def report(self) -> Any:
        """`bus.json`."""
        return json.loads(next((self.directory / "run").glob("*/bus.json")).read_text())

    def reopen(self) -> None:
        """A new socket of our own: what was queued in the old one is gone."""
        self.socket.close()
        self.socket = open_frame_socket(self.bus, [exact(0x0A0), exact(0x1A0)])
        self.statuses.clear()

    def end(self) -> None:
        for process in (self.process, self.bench):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
                process.wait(20)
        self.socket.close()


@contextmanager
def a_daemon(**changes: Any) -> Iterator[Daemon]:
    with tempfile.TemporaryDirectory(prefix="jtq") as directory:  # short: socket paths have 107 bytes
        daemon = Daemon(Path(directory), **changes)
        try:
            daemon.begun()
            yield daemon
        finally:
            daemon.end()
        assert "Traceback" not in daemon.log_text()


class LateSensor(threading.Thread):
    """A sensor at node 5 that is plugged in while jtqd runs: answers SDO, heartbeats, and each SYNC with its torque."""

    def __init__(self, bus: str) -> None:
        super().__init__(daemon=True)
        self.node = TestNode(sensor_store(5))
        self.socket = open_frame_socket(bus, [exact(0x605), exact(0x000), exact(0x080)])
        self.ended = False

    def run(self) -> None:
        socket, torque = self.socket, pack(0x185, struct.pack("<iB", 4321, 0))
        while not self.ended:
            socket.wait(0.01)
            for n in range(socket.receive()):
                can_id, length, data = FRAME.unpack_from(socket.frames, 16 * n)
                if can_id == 0x080:
                    if self.node.state == 5:
                        socket.send(torque)
                    continue
                for reply_id, reply in self.node.frames(can_id, data[:length]):
                    socket.send(pack(reply_id, reply))
            for reply_id, reply in self.node.beat(time.monotonic()):
                socket.send(pack(reply_id, reply))
