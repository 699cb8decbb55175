"""Small CANopen nodes for tests: object dictionary, SDO server, NMT and heartbeat on a bus or in a hub."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Self

import can

from jtqd.drivers.frame import FRAME, pack
from jtqd.drivers.hub import Hub
from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.pdo import PdoParameters
from jtqd.drivers.sdo_server import SdoServer
from tests.paths import EDS


def drive_store(node: int) -> ObjectStore:
    return ObjectStore(EDS / "drive.eds", node)


def sensor_store(node: int) -> ObjectStore:
    return ObjectStore(EDS / "torque_sensor.eds", node)


class TestNode:
    """One node. `answer` filters replies (None: silent); `obeys_start` False ignores NMT start."""

    __test__ = False

    def __init__(self, store: ObjectStore) -> None:
        self.store = store
        self.node = store.node_id
        self.parameters = PdoParameters(store)
        self.server = SdoServer(store)
        self.state = 0x7F
        self.obeys_start = True
        self.beats = True
        self.answer: Callable[[bytes, bytes | None], bytes | None] = lambda _request, reply: reply
        self.next_beat = 0.0
        self.power_up: dict[tuple[int, int], int] = {}
        self.requests: list[bytes] = []

    def frames(self, can_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Frames sent in answer to one received."""
        if can_id == 0 and data[1] in (0, self.node):
            states = {1: 0x05 if self.obeys_start else self.state, 2: 0x04, 0x80: 0x7F}
            self.state = states.get(data[0], self.state)
            if data[0] in (0x81, 0x82):
                return self.restart()
        if can_id == 0x600 + self.node and self.state != 0x04:
            self.requests.append(data)
            key = int.from_bytes(data[1:3], "little"), data[3]
            if data[0] & 0xE0 == 0x20 and key[0] < 0x2000 and self.store.has(*key):
                self.power_up.setdefault(key, self.store.number(*key))
            reply = self.answer(data, self.server.handle(data))
            return [(0x580 + self.node, reply)] if reply is not None else []
        return []

    def restart(self) -> list[tuple[int, bytes]]:
        """As after NMT reset communication, with the boot-up message: what was written by SDO is lost."""
        for key, value in ((key, value) for key, value in self.power_up.items() if self.store.has(*key)):
            self.store.set_number(*key, value)
        self.power_up.clear()
        self.server, self.state, self.next_beat = SdoServer(self.store), 0x7F, 0.0
        return [(0x700 + self.node, b"\0")]

    def beat(self, now: float) -> list[tuple[int, bytes]]:
        """The heartbeat when it is due."""
        period = self.store.number(0x1017) * 1e-3
        if not self.beats or period == 0 or now < self.next_beat:
            return []
        self.next_beat = now + period
        return [(0x700 + self.node, bytes([self.state]))]


class _Running:
    """A thread that calls `turn` until the context ends, then `close`."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            self.turn()

    def turn(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError


class Responder(_Running):
    """Test nodes on a python-can bus. Context manager."""

    def __init__(self, bus: can.BusABC, nodes: list[TestNode]) -> None:
        super().__init__()
        self.bus, self.nodes = bus, nodes
        self.extra: Callable[[], list[tuple[int, bytes]]] = list

    def turn(self) -> None:
        message = self.bus.recv(0.002)
        out = self.extra()
        for node in self.nodes:
            if message is not None and not message.is_extended_id:
                out += node.frames(message.arbitration_id, bytes(message.data))
            out += node.beat(time.monotonic())
        for can_id, data in out:
            self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def close(self) -> None:
        self.bus.shutdown()


class HubResponder(_Running):
    """The same nodes inside a hub on a unix socket. Context manager."""

    def __init__(self, path: str, nodes: list[TestNode]) -> None:
        super().__init__()
        self.hub, self.nodes = Hub(path), nodes
        self._port = self.hub.attach(self._on_frame)

    def _on_frame(self, frame16: bytes, _stamp_ns: int) -> None:
        can_id, length, data = FRAME.unpack(frame16)
        for node in self.nodes:
            for reply_id, reply in node.frames(can_id, data[:length]):
                self._port.send(pack(reply_id, reply))

    def turn(self) -> None:
        self.hub.run_once(0.002)
        for node in self.nodes:
            for can_id, data in node.beat(time.monotonic()):
                self._port.send(pack(can_id, data))

    def close(self) -> None:
        self.hub.close()
