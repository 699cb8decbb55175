"""The library's nodes in the thread of a rig: frames go in by a call and come out of it, so that a fault can stand between.

`LibraryNodes` has of `jtqd.sim_can.bench.Bench` what the fault cases use (tests/slow/faults): `on_frame`, `tick`, `due_ns`,
and, by node, the few things that a fault does to a device.
"""

from __future__ import annotations

import math
import time
from collections import deque
from types import SimpleNamespace
from typing import Any, ClassVar

import can

from jtqd.drivers.frame import pack
from tests.library_drives.nodes import MOTOR_COUNTS, Cable, Manners, StrictDrive, StrictNode, StrictSensor

_POLL_NS = 2_000_000
_FAULT, _ENABLED = 0x1218, 0x1237
"""6041h."""


class _Wire(Cable):
    """What a node sends, heartbeats by their own threads too, waits in a queue; what it hears is handed over by a call."""

    sent: deque[bytes]

    def connect(self, *_: Any, **__: Any) -> _Wire:
        return self

    def disconnect(self) -> None:
        self.bus = None

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        if not self.cut:
            self.sent.append(pack(can_id, bytes(data)))


class _Drive(StrictDrive):
    """Ten turns to and fro, so that there is a velocity that a fault can turn round."""

    swing_turns: ClassVar[float] = 10.0


class Store:
    """Objects of one node, as `ObjectStore` names them."""

    def __init__(self, device: StrictNode) -> None:
        self._device = device

    def number(self, index: int, subindex: int = 0) -> int:
        return self._device.number_of(index, subindex)

    def set_number(self, index: int, subindex: int, value: int) -> None:
        size = len(self._device.node.get_data(index, subindex))
        self._device.node.set_data(index, subindex, value.to_bytes(size, "little"))

    def keep_as_default(self, index: int, subindex: int) -> None:
        self._device.keep(index, subindex)


class Node:
    """One device, as `CanopenNode` is used."""

    def __init__(self, device: StrictNode) -> None:
        self.device, self.store = device, Store(device)
        self.due_ns = 0

    @property
    def state(self) -> int:
        return self.device.state

    @state.setter
    def state(self, value: int) -> None:
        self.device.set_state(value)

    def on_frame(self, can_id: int, data: bytes, now_ns: int) -> None:
        """NMT reset (129) alone: it restarts by itself."""
        assert (can_id, data[0]) == (0x000, 129)
        self.device.restart()

    @property
    def machine(self) -> Any:
        """Its power stage as statusword 6041h tells it."""

        def report(word: int) -> None:
            self.device.statusword = word  # type: ignore[attr-defined]

        return SimpleNamespace(
            fault=lambda: report(_FAULT), stopped=lambda: None, release=lambda: report(_ENABLED)
        )

    def raise_error(self, code: int, register: int) -> list[bytes]:
        self.device.raise_error(code, register)
        return []

    def clear_error(self, code: int) -> list[bytes]:
        self.device.clear_error(code)
        return []

    def event(self) -> list[bytes]:
        return []


class LibraryNodes:
    """Drives 1 and 2 and sensor 3. `close` ends their threads."""

    library = True

    def __init__(self) -> None:
        self._sent: deque[bytes] = deque()
        manners = Manners()

        def no_bus() -> can.BusABC:
            return SimpleNamespace(channel_info="a rig")  # type: ignore[return-value]

        devices: list[StrictNode] = [
            _Drive(1, no_bus, manners),
            _Drive(2, no_bus, manners),
            StrictSensor(3, no_bus, manners),
        ]
        for device in devices:
            device.cable_class = type("Wire", (_Wire,), {"sent": self._sent})
            device.power_on()
        self.nodes = [Node(device) for device in devices]
        self.drives = self.nodes[:2]

    @property
    def source(self) -> Any:
        """How the motor of drive 1 turns."""
        counts = self.drives[0].device.value(0x606C, 0, time.monotonic())
        return SimpleNamespace(
            drives=[SimpleNamespace(motor_velocity_rad_s=counts * 2.0 * math.pi / MOTOR_COUNTS)]
        )

    @property
    def due_ns(self) -> int:
        """When `tick` has something to say: at once where a thread has sent."""
        return 0 if self._sent else time.monotonic_ns() + _POLL_NS

    def tick(self, now_ns: int) -> list[bytes]:
        """Return what the nodes have sent by themselves."""
        return self._taken()

    def on_frame(self, can_id: int, data: bytes, stamp_ns: int, now_ns: int) -> list[bytes]:
        """Hand a frame to all nodes; return what they have sent."""
        for each in self.nodes:
            each.device.cable.notify(can_id, bytearray(data), now_ns * 1e-9)
        return self._taken()

    def _taken(self) -> list[bytes]:
        return [self._sent.popleft() for _ in range(len(self._sent))]

    def close(self) -> None:
        for each in self.nodes:
            each.device.power_off()
