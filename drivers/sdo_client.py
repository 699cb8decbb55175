"""SDO client of one node that blocks until it has its answer.

    SdoClient      read and write of objects as bytes, over a frame socket
    NodeObjects    read and write of numbers, every failure a BootError with node and object in its line

The protocol is `jtqd.drivers.sdo.Exchange`. canopen's own client is not used: it repeats nothing
(MAX_RETRIES = 1 means one try), takes frames of any length, and does not compare the answer to a download with its request.
"""

from __future__ import annotations

import time
from typing import Protocol

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


class Socket(Protocol):
    """What `SdoClient` needs of `jtqd.drivers.frame_socket.FrameSocket`."""

    frames: bytearray

    def send(self, frame16: bytes) -> bool:
        """Send one frame."""

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for frames."""

    def receive(self) -> int:
        """Take what has arrived."""


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

    The filters of the socket let 580h+n through; other frames that come meanwhile are dropped. `read` and `write` raise
    SdoAbort (the node refuses), SdoTimeout, and BusError.
    """

    def __init__(self, socket: Socket, node: int, timeout_s: float = 0.5, answer_s: float = ANSWER_S) -> None:
        self._socket, self._timeout_s, self._answer_s = socket, timeout_s, answer_s
        self._request_id, self._response_id = REQUEST_ID + node, RESPONSE_ID + node

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
        self._replies(0.0)  # to a request that was given up
        now, timeout_s = time.monotonic(), self._timeout_s
        exchange = Exchange(index, subindex, data, now=now, timeout_s=timeout_s, answer_s=self._answer_s)
        self._send(exchange.begin())
        while not exchange.ended:
            for reply in self._replies(max(exchange.due - time.monotonic(), 1e-4)):
                self._send(exchange.on_reply(reply, time.monotonic()))
            self._send(exchange.tick(time.monotonic()))  # also in a flood of foreign answers
        if exchange.refusal is not None:
            raise SdoAbort(exchange.refusal)
        if exchange.value is None:
            raise SdoTimeout(self._timeout_s)
        return exchange.value

    def _send(self, requests: list[bytes]) -> None:
        """Send requests; one that is lost is repeated by the exchange."""
        for request in requests:
            self._socket.send(pack(self._request_id, request))

    def _replies(self, timeout_s: float) -> list[bytes]:
        """Return the node's frames that have come, after `timeout_s` at the latest."""
        socket = self._socket
        socket.wait(timeout_s)
        frames = [FRAME.unpack_from(socket.frames, FRAME_SIZE * n) for n in range(socket.receive())]
        return [data[:length] for can_id, length, data in frames if can_id == self._response_id]


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
