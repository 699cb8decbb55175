"""SDO client of one node over canopen's Network, for the boot: waits, asks again, takes no answer to another request.

canopen's own client retries nothing (MAX_RETRIES = 1 means one try), takes any frame length, and does not compare the answer
to a download with its request; so only its Network is used, and `drivers.sdo_transfer` does the talking.
"""

from __future__ import annotations

import queue
import time
from typing import Any

from drivers.boot_procedure import SdoSilence
from drivers.sdo_abort import SdoAbort
from drivers.sdo_transfer import Exchange

_KEPT = 64
"""Answers that wait to be looked at: a flood of them must not fill the memory."""


class NodeSdo:
    """Implements `boot_procedure.SdoAccess`. Asks again until `timeout_s` is over, then raises SdoSilence."""

    def __init__(self, network: Any, node: int, timeout_s: float) -> None:
        self._network, self._node = network, node
        self._timeout_s = timeout_s
        self._replies: queue.Queue[bytes] = queue.Queue(_KEPT)
        network.subscribe(0x580 + node, self._on_response)

    def _on_response(self, _can_id: int, data: bytes, _timestamp: float) -> None:
        """From the network's thread."""
        try:
            self._replies.put_nowait(bytes(data))
        except queue.Full:
            return

    def read(self, index: int, subindex: int) -> bytes:
        """Upload, expedited or segmented."""
        return self._exchange(index, subindex, None)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Download, expedited up to 4 bytes."""
        self._exchange(index, subindex, data)

    def _exchange(self, index: int, subindex: int, data: bytes | None) -> bytes:
        while not self._replies.empty():
            self._replies.get_nowait()  # answers to what was given up: not ours
        exchange = Exchange(index, subindex, data, now=time.monotonic(), timeout_s=self._timeout_s)
        self._send(exchange.begin())
        while not exchange.over:
            try:
                reply = self._replies.get(timeout=max(exchange.due - time.monotonic(), 1e-4))
            except queue.Empty:
                self._send(exchange.tick(time.monotonic()))
            else:
                self._send(exchange.on_reply(reply, time.monotonic()))
                self._send(
                    exchange.tick(time.monotonic())
                )  # a flood must not keep the clock from being looked at
        if exchange.refusal is not None:
            raise SdoAbort(exchange.refusal)
        if exchange.value is None:
            raise SdoSilence(self._timeout_s)
        return exchange.value

    def _send(self, requests: list[bytes]) -> None:
        for request in requests:
            self._network.send_message(0x600 + self._node, request)
