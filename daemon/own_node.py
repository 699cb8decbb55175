"""jtqd as a CANopen node (20h): object dictionary readable by any master, EMCY when an input goes stale.

The loop sends the node's PDO and heartbeat; this part answers SDO requests from the snapshot and sends EMCY.
It runs in the supervisor, so that no SDO client can delay a cycle.
"""

from __future__ import annotations

import struct
import time
from contextlib import suppress
from functools import partial
from math import inf, isfinite, nan

from daemon.config import Config
from daemon.estimate_pdo import field
from daemon.snapshot import SnapshotReader
from drivers.eds.own_objects import COUNTERS, JOINT_PARAMETERS
from drivers.errors import BusDown
from drivers.frame import FRAME, pack
from drivers.frame_socket import FrameSocket
from drivers.object_dictionary import ObjectStore
from drivers.sdo_server import SdoServer
from estimator.status import STALE

EMCY_INPUT_TIMEOUT = 0x8250
EMCY_RESET = 0x0000
_STANDSTILL_S = 0.2
"""A loop whose snapshot has not moved for so long is not running (it moves every 8 cycles)."""
_COMMUNICATION_ERROR = 0x11
"""Error register 1001h: generic and communication bits."""
_EMCY = struct.Struct("<HB5s")


class OwnNode:
    """Answers SDO requests and reports stale inputs.

    Args:
        socket: frame socket that receives SDO requests 600h + node_id.
        store: object dictionary from jtqd.eds.
        config: configuration in force; its joints' parameters are readable in 2202h and 2203h.
        reader: snapshot of the loop.
    """

    def __init__(
        self, socket: FrameSocket, store: ObjectStore, config: Config, reader: SnapshotReader
    ) -> None:
        self.socket = socket
        self._node_id = config.node_id
        self._reader = reader
        self._store = store
        self._server = SdoServer(store)
        self._stale = (False, False)
        self._last_cycle, self._last_change = -1, time.monotonic()
        self.recorder_lost = 0
        self._connect_objects()
        self._set_parameters(config)

    def serve(self) -> None:
        """Answer every request that has arrived; while the interface is down there is none."""
        with suppress(BusDown):
            self._serve()

    def _serve(self) -> None:
        count = self.socket.receive()
        for n in range(count):
            _, length, data = FRAME.unpack_from(self.socket.frames, 16 * n)
            answer = self._server.handle(bytes(data[:length]))
            if answer is not None:
                self.socket.send(pack(0x580 + self._node_id, answer))

    def watch(self) -> None:
        """Send EMCY 8250h when a joint's inputs go stale and 0000h when all are back; call about ten times a second."""
        with suppress(BusDown):
            self._watch()

    def _watch(self) -> None:
        view = self._reader.read()
        if view.cycle != self._last_cycle:
            self._last_cycle, self._last_change = view.cycle, time.monotonic()
        stale = (view.joints[0].status == STALE, view.joints[1].status == STALE)
        if stale != self._stale:
            code = EMCY_INPUT_TIMEOUT if any(stale) else EMCY_RESET
            register = _COMMUNICATION_ERROR if any(stale) else 0
            which = sum(1 << n for n, is_stale in enumerate(stale) if is_stale)
            self._store.set_number(0x1001, 0, register)
            self.socket.send(
                pack(0x080 + self._node_id, _EMCY.pack(code, register, bytes((which,)) + bytes(4)))
            )
            self._stale = stale

    def _connect_objects(self) -> None:
        store = self._store
        for joint in (0, 1):
            store.on_read(0x2100, joint + 1, partial(self._field, joint, 0))
            store.on_read(0x2101, joint + 1, partial(self._field, joint, 1))
        store.on_read(0x2102, 0, lambda: self._field(0, 2) | self._field(1, 2) << 4)
        store.on_read(0x2103, 0, lambda: self._reader.read().sync_counter)
        for sub, name in enumerate(COUNTERS, start=1):
            store.on_read(0x2200, sub, partial(self._counter, name))
        for sub, share in enumerate((0.5, 0.99, 1.0), start=1):
            store.on_read(0x2201, sub, partial(self._work_us, share))

    def _field(self, joint: int, part: int) -> int:
        """Torque (0), sigma (1) or status (2) of a joint as on the bus."""
        view = self._reader.read()
        if view.cycle == self._last_cycle and time.monotonic() - self._last_change > _STANDSTILL_S:
            return field(nan, inf, STALE)[part]  # the loop stands still: what it said last is old
        last = view.joints[joint]
        return field(last.torque_nm, last.sigma_nm, last.status)[part]

    def _counter(self, name: str) -> int:
        value = self.recorder_lost if name == "recorder_lost" else self._reader.read().counters[name]
        return min(value, 0xFFFF_FFFF)

    def _work_us(self, share: float) -> int:
        value = self._reader.work_us(share)[0]
        return round(value) if isfinite(value) else 0

    def _set_parameters(self, config: Config) -> None:
        self._store.set_number(0x1017, 0, config.heartbeat_ms)
        self._store.set_number(0x1019, 0, config.counter_overflow)
        self._store.set_text(0x2204, 0, config.sha256)
        for index, joint in zip((0x2202, 0x2203), config.joints, strict=True):
            for sub, name in enumerate(JOINT_PARAMETERS, start=1):
                self._store.set_number(index, sub, getattr(joint.joint, name))
