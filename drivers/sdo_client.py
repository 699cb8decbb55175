"""SDO client of one node that blocks until it has its answer: over a frame socket, or over canopen's Network.

    SdoClient      read and write of objects as bytes, over a channel
    NodeObjects    read and write of numbers, every failure a BootError with node and object in its line

The protocol is `jtqd.drivers.sdo.Exchange` in either case. canopen's own client is not used: it repeats nothing
(MAX_RETRIES = 1 means one try), takes frames of any length, and does not compare the answer to a download with its request.
"""

from __future__ import annotations

import queue
import time
from typing import Any, Protocol

from jtqd.drivers.boot_error import BootError, mismatch
from jtqd.drivers.frame import FRAME, FRAME_SIZE, pack
from jtqd.drivers.sdo import (
    ANSWER_S,
    NO_OBJECT,
    NO_SUBINDEX,
    REQUEST_ID,
    RESPONSE_ID,
    Exchange,
    Key,
    SdoAbort,
    describe_abort,
    label,
)

_MAX_QUEUED = 64
"""Answers that wait to be looked at: a flood of them must not fill the memory."""


class Channel(Protocol):
    """Requests to one node, and its answers."""

    def send(self, request: bytes) -> None:
        """Send 8 bytes to 600h+n; one that is lost is repeated by the exchange."""

    def receive(self, timeout_s: float) -> list[bytes]:
        """Return the frames of 580h+n that have come, after `timeout_s` seconds at the latest."""


class Socket(Protocol):
    """What `FrameChannel` needs of `jtqd.drivers.frame_socket.FrameSocket`."""

    frames: bytearray

    def send(self, frame16: bytes) -> bool:
        """Send one frame."""

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for frames."""

    def receive(self) -> int:
        """Take what has arrived."""


class FrameChannel:
    """Channel over a frame socket whose filters let 580h+n through; other frames that come meanwhile are dropped."""

    def __init__(self, socket: Socket, node: int) -> None:
        self._socket = socket
        self._request_id, self._response_id = REQUEST_ID + node, RESPONSE_ID + node

    def send(self, request: bytes) -> None:
        """Send one request. Raises BusError."""
        self._socket.send(pack(self._request_id, request))

    def receive(self, timeout_s: float) -> list[bytes]:
        """Return the node's frames among what has come. Raises BusError."""
        socket = self._socket
        socket.wait(timeout_s)
        replies = []
        for position in range(socket.receive()):
            can_id, length, data = FRAME.unpack_from(socket.frames, FRAME_SIZE * position)
            if can_id == self._response_id:
                replies.append(data[:length])
        return replies


class NetworkChannel:
    """Channel over a `canopen.Network`, whose thread brings the answers; at most 64 of them wait."""

    def __init__(self, network: Any, node: int) -> None:
        self._network, self._node = network, node
        self._replies: queue.Queue[bytes] = queue.Queue(_MAX_QUEUED)
        network.subscribe(RESPONSE_ID + node, self._on_response)

    def _on_response(self, _can_id: int, data: bytes, _timestamp: float) -> None:
        try:
            self._replies.put_nowait(bytes(data))
        except queue.Full:
            return

    def send(self, request: bytes) -> None:
        """Send one request. Raises can.CanError."""
        self._network.send_message(REQUEST_ID + self._node, request)

    def receive(self, timeout_s: float) -> list[bytes]:
        """Return the frames that have come."""
        replies: list[bytes] = []
        try:
            replies.append(self._replies.get(block=timeout_s > 0.0, timeout=timeout_s))
            while len(replies) < _MAX_QUEUED:
                replies.append(self._replies.get_nowait())
        except queue.Empty:
            pass
        return replies


class SdoTimeout(Exception):  # noqa: N818  (the node's fault, not one of this side)
    """No answer within the waiting time."""

    def __init__(self, waited_s: float) -> None:
        super().__init__(f"no answer within {waited_s:g} s")
        self.waited_s = waited_s


class SdoAccess(Protocol):
    """Objects of one node as bytes: an `SdoClient`, or a node in memory. Both raise SdoAbort and SdoTimeout."""

    def read(self, index: int, subindex: int) -> bytes:
        """Upload an object."""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Download an object."""


class SdoClient:
    """One exchange at a time with one node; each may take `timeout_s` seconds, and is repeated after `answer_s` of silence.

    Both methods raise SdoAbort (the node refuses), SdoTimeout, and what the channel raises.
    """

    def __init__(self, channel: Channel, timeout_s: float = 0.5, answer_s: float = ANSWER_S) -> None:
        self._channel, self._timeout_s, self._answer_s = channel, timeout_s, answer_s

    def wait_longer(self, timeout_s: float) -> None:
        """Wait at least so long for an answer from here on: the node has given its first one."""
        self._timeout_s = max(self._timeout_s, timeout_s)

    def read(self, index: int, subindex: int) -> bytes:
        """Upload an object, expedited or segmented."""
        return self._exchange(index, subindex, None)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Download an object, expedited up to 4 bytes."""
        self._exchange(index, subindex, data)

    def _exchange(self, index: int, subindex: int, data: bytes | None) -> bytes:
        self._channel.receive(0.0)  # answers to a request that was given up
        now, timeout_s = time.monotonic(), self._timeout_s
        exchange = Exchange(index, subindex, data, now=now, timeout_s=timeout_s, answer_s=self._answer_s)
        self._send(exchange.begin())
        while not exchange.ended:
            for reply in self._channel.receive(max(exchange.due - time.monotonic(), 1e-4)):
                self._send(exchange.on_reply(reply, time.monotonic()))
            self._send(exchange.tick(time.monotonic()))  # also in a flood of foreign answers
        if exchange.refusal is not None:
            raise SdoAbort(exchange.refusal)
        if exchange.value is None:
            raise SdoTimeout(self._timeout_s)
        return exchange.value

    def _send(self, requests: list[bytes]) -> None:
        for request in requests:
            self._channel.send(request)


class NodeObjects:
    """Objects of one node, read and written as numbers; every failure is a BootError that names node and object.

    Numbers are unsigned, little endian, `size` bytes.

    Attributes:
        node: node number.
        access: to its SDO server.
        values: newest value of each number that was read; the boot makes the configuration hash of them.
    """

    def __init__(self, access: SdoAccess, node: int) -> None:
        self.node = node
        self.values: dict[Key, int] = {}
        self.access = access

    def read(self, key: Key, letter: str = "") -> bytes | None:
        """Upload an object as bytes, which are not kept in `values`; None when the device does not have it."""
        try:
            return self._read(key, letter)
        except SdoAbort as abort:
            if abort.code in (NO_OBJECT, NO_SUBINDEX):
                return None
            raise self._refused(key, "read", abort, letter) from abort

    def best_effort(self, key: Key) -> bytes | None:
        """Upload an object that nothing depends on; None where the device gives none, for whatever reason."""
        try:
            return self.access.read(*key)
        except (SdoAbort, SdoTimeout):
            return None

    def number(self, key: Key, size: int, letter: str = "") -> int:
        """Upload a number that the device must have."""
        try:
            raw = self._read(key, letter)
        except SdoAbort as abort:
            raise self._refused(key, "read", abort, letter) from abort
        return self._keep(key, raw, size)

    def optional_number(self, key: Key, size: int) -> int | None:
        """Upload a number; None when the device does not have it."""
        raw = self.read(key)
        return None if raw is None else self._keep(key, raw, size)

    def write(self, key: Key, value: int, size: int) -> None:
        """Download a number; a negative one as its two's complement."""
        value &= (1 << 8 * size) - 1
        try:
            self.access.write(*key, value.to_bytes(size, "little"))
        except SdoTimeout as timeout:
            raise self._no_answer(key, timeout, "J") from timeout
        except SdoAbort as abort:
            raise self._refused(key, f"write of 0x{value:0{2 * size}X}", abort, "J") from abort

    def require(self, key: Key, value: int, size: int, name: str) -> None:
        """Read a number back, `name` in words, and compare it with what was written."""
        value &= (1 << 8 * size) - 1
        found = self.number(key, size, letter="J")
        if found != value:
            expected, text = (f"0x{number:0{2 * size}X}" for number in (value, found))
            raise mismatch(self.node, key, f"{name} read back", expected=expected, found=text, letter="J")

    def put(self, key: Key, value: int, size: int, name: str) -> None:
        """Write and read back."""
        self.write(key, value, size)
        self.require(key, value, size, name)

    def _read(self, key: Key, letter: str) -> bytes:
        try:
            return self.access.read(*key)
        except SdoTimeout as timeout:
            raise self._no_answer(key, timeout, letter) from timeout

    def _keep(self, key: Key, raw: bytes, size: int) -> int:
        self.values[key] = value = int.from_bytes(raw[:size], "little")
        return value

    def _no_answer(self, key: Key, timeout: SdoTimeout, letter: str) -> BootError:
        where = label(*key)
        detail = f"no answer to SDO {where} within {timeout.waited_s:g} s"
        return BootError(self.node, where, expected="an answer", found="none", letter=letter, detail=detail)

    def _refused(self, key: Key, what: str, abort: SdoAbort, letter: str) -> BootError:
        """`what` is "read" or "write of 0x60640020"."""
        where, found = label(*key), describe_abort(abort.code)
        detail = f"{where}: {what} refused: {found}"
        return BootError(
            self.node, where, expected=f"{what} accepted", found=found, letter=letter, detail=detail
        )
