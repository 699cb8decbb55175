"""What the boot hears beside its SDO answers: heartbeats, other masters, errors of the bus. canopen's thread calls them."""

from __future__ import annotations

import threading
import time

import can
import canopen

from drivers.boot_error import BootError
from drivers.boot_request import BootRequest

STATE_BOOT_UP = 0x00
SYNC_LISTEN_S = 0.12  # a little more than the longest period that jtqd itself may have
NOTIFIER_S = 0.01  # canopen's default of 1 s is what closing the network would wait for


class Heartbeats:
    """Newest NMT state of each node, from the notifier's thread."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._state: dict[int, int] = {}
        self._restarted: set[int] = set()

    def on_heartbeat(self, can_id: int, data: bytes, _timestamp: float) -> None:
        """canopen callback; a frame that is not one byte is no heartbeat."""
        if len(data) != 1:
            return
        with self._news:
            self._state[can_id - 0x700] = data[0] & 0x7F
            if data[0] == STATE_BOOT_UP:
                self._restarted.add(can_id - 0x700)
            self._news.notify_all()

    def forget(self, node: int) -> None:
        """What was heard so far does not count."""
        with self._news:
            self._state.pop(node, None)
            self._restarted.discard(node)

    def restarted(self, node: int) -> bool:
        """A boot-up message came since `forget`."""
        with self._news:
            return node in self._restarted

    def wait(self, node: int, wanted: int | None, timeout_s: float) -> int | None:
        """Newest state once it is `wanted` (None: any), or what it is after `timeout_s`."""

        def arrived() -> bool:
            state = self._state.get(node)
            return state is not None and (wanted is None or state == wanted)

        with self._news:
            self._news.wait_for(arrived, timeout_s)
            return self._state.get(node)


class ForeignMaster:
    """Who else sends SYNC, or speaks with jtqd's own node-ID: with such a one on the bus nothing is begun."""

    def __init__(self, network: canopen.Network, request: BootRequest) -> None:
        self._network, self._request = network, request
        self._since = time.monotonic()
        self._syncs = self._namesakes = 0
        if request.check_foreign_sync:
            network.subscribe(request.settings.sync_cob_id, self._on_sync)
            network.subscribe(0x700 + request.settings.master_node, self._on_namesake)

    def _on_sync(self, *_: object) -> None:
        self._syncs += 1

    def _on_namesake(self, *_: object) -> None:
        self._namesakes += 1

    def announce(self) -> None:
        """jtqd's own boot-up message: another one that is booting too hears it, and neither goes on."""
        if self._request.check_foreign_sync:
            self._network.send_message(0x700 + self._request.settings.master_node, [STATE_BOOT_UP])

    def require_none(self) -> None:
        """Raises BootError; waits until it has listened for a while."""
        if not self._request.check_foreign_sync:
            return
        time.sleep(max(0.0, self._since + SYNC_LISTEN_S - time.monotonic()))
        if self._syncs:
            # It would make every input's cycle ambiguous.
            where = f"COB-ID {self._request.settings.sync_cob_id:03X}h"
            detail = f"another SYNC producer is on the bus ({where}, {self._syncs} frames during boot)"
            raise BootError(None, where, expected="no SYNC", found=f"{self._syncs} frames", detail=detail)
        if self._namesakes:
            node = self._request.settings.master_node
            where = f"COB-ID {0x700 + node:03X}h"
            detail = (
                f"another node {node:02X}h, jtqd's own node-ID, is on the bus (heartbeat or boot-up {where})"
            )
            raise BootError(None, where, expected="no such node", found="heartbeat", detail=detail)


class BusErrors(can.Listener):  # type: ignore[misc]
    """Keeps canopen's receiving thread from dying with a traceback, and the reason for the message."""

    def __init__(self) -> None:
        self.last: Exception | None = None

    def on_message_received(self, msg: can.Message) -> None:
        """Nothing: canopen's own listener does it."""

    def on_error(self, exc: Exception) -> None:
        """Keep the reason; a failing recv returns at once, so wait a little."""
        self.last = exc
        time.sleep(NOTIFIER_S)
