"""Small CANopen nodes for tests: object dictionary, SDO server, NMT and heartbeat on a bus or in a hub."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self

from jtqd.drivers.boot import BootBus, BootReport, BootRequest, boot, parse_request
from jtqd.drivers.bus_socket import CanFilter
from jtqd.drivers.frame import CAN_EFF_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import open_frame_socket
from jtqd.drivers.hub import Hub
from jtqd.drivers.object_dictionary import ObjectStore, SdoServer
from jtqd.drivers.pdo import PdoParameters
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


class _Answering(_Running):
    """Test nodes that answer what arrives; `extra` gives frames of other nodes."""

    def __init__(self, nodes: list[TestNode]) -> None:
        super().__init__()
        self.nodes = nodes
        self.extra: Callable[[], list[tuple[int, bytes]]] = list

    def send(self, frame16: bytes) -> None:
        raise NotImplementedError

    def answer(self, frame16: bytes) -> None:
        can_id, length, data = FRAME.unpack(frame16)
        for node in self.nodes:
            for reply in node.frames(can_id, data[:length]):
                self.send(pack(*reply))

    def beat(self) -> None:
        frames = self.extra()
        for node in self.nodes:
            frames += node.beat(time.monotonic())
        for frame in frames:
            self.send(pack(*frame))


class Responder(_Answering):
    """Test nodes on a bus. Context manager."""

    def __init__(self, bus: str, nodes: list[TestNode]) -> None:
        super().__init__(nodes)
        self._socket = open_frame_socket(bus, [CanFilter(0, CAN_EFF_FLAG)])
        self.close = self._socket.close  # type: ignore[method-assign]

    def send(self, frame16: bytes) -> None:
        self._socket.send(frame16)

    def turn(self) -> None:
        self._socket.wait(0.002)
        for n in range(self._socket.receive()):
            self.answer(bytes(self._socket.frames[16 * n : 16 * n + 16]))
        self.beat()


class HubResponder(_Answering):
    """The same nodes inside a hub on a unix socket. Context manager."""

    def __init__(self, path: str, nodes: list[TestNode]) -> None:
        super().__init__(nodes)
        self.hub = Hub(path)
        self._port = self.hub.attach(lambda frame16, _stamp_ns: self.answer(frame16))
        self.close = self.hub.close  # type: ignore[method-assign]

    def send(self, frame16: bytes) -> None:
        self._port.send(frame16)

    def turn(self) -> None:
        self.hub.run_once(0.002)
        self.beat()


@contextmanager
def booted(request: BootRequest | dict[str, Any]) -> Iterator[BootReport]:
    """Boot, and send jtqd's heartbeat as long as the context lasts. Raises BootError."""
    parsed = request if isinstance(request, BootRequest) else parse_request(request)
    ended = threading.Event()
    with BootBus(parsed) as bus:
        report = boot(parsed, bus)
        thread = threading.Thread(target=bus.run, args=(60.0, ended.is_set))
        thread.start()
        try:
            yield report
        finally:
            ended.set()
            thread.join()


def boot_all(request: BootRequest | dict[str, Any]) -> BootReport:
    """Boot the nodes of a request. Raises BootError."""
    with booted(request) as report:
        return report
