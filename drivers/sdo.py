"""SDO client of one node over a frame socket: expedited transfers, no thread, no canopen.

For those who already hold a frame socket and must not wait behind other threads. The socket's filters must let
580h+n through; other frames that it receives meanwhile are dropped.
"""

from __future__ import annotations

import queue
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from jtqd.drivers.frame import FRAME, FRAME_SIZE, pack

Key = tuple[int, int]
"""Index and sub-index of an object."""

# SDO abort codes (CiA 301, 7.2.4.3.17, table 22).


TOGGLE_NOT_ALTERNATED = 0x0503_0000
PROTOCOL_TIMED_OUT = 0x0504_0000
UNKNOWN_COMMAND = 0x0504_0001
OUT_OF_MEMORY = 0x0504_0005
UNSUPPORTED_ACCESS = 0x0601_0000
READ_OF_WRITE_ONLY = 0x0601_0001
WRITE_OF_READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
NOT_MAPPABLE = 0x0604_0041
PDO_TOO_LONG = 0x0604_0042
LENGTH_MISMATCH = 0x0607_0010
LENGTH_TOO_HIGH = 0x0607_0012
LENGTH_TOO_LOW = 0x0607_0013
NO_SUBINDEX = 0x0609_0011
VALUE_RANGE = 0x0609_0030
GENERAL_ERROR = 0x0800_0000
DEVICE_STATE = 0x0800_0022
NO_DATA = 0x0800_0024

MEANING = {
    TOGGLE_NOT_ALTERNATED: "toggle bit not alternated",
    PROTOCOL_TIMED_OUT: "SDO protocol timed out",
    UNKNOWN_COMMAND: "unknown SDO command",
    OUT_OF_MEMORY: "out of memory",
    UNSUPPORTED_ACCESS: "unsupported access to an object",
    READ_OF_WRITE_ONLY: "object is write only",
    WRITE_OF_READ_ONLY: "object is read only",
    NO_OBJECT: "object does not exist",
    NOT_MAPPABLE: "object cannot be mapped",
    PDO_TOO_LONG: "mapped objects exceed the PDO",
    LENGTH_MISMATCH: "length does not match the data type",
    LENGTH_TOO_HIGH: "length too high for the data type",
    LENGTH_TOO_LOW: "length too low for the data type",
    NO_SUBINDEX: "sub-index does not exist",
    VALUE_RANGE: "value out of range",
    GENERAL_ERROR: "general error",
    DEVICE_STATE: "not in the present device state",
    NO_DATA: "no data available",
}


def describe_abort(code: int) -> str:
    """The code in words, with its number: "object is read only (06010002h)"."""
    return f"{MEANING.get(code, 'abort')} ({code:08X}h)"


class SdoAbort(Exception):  # noqa: N818  (CiA 301 calls it an abort; it is a reply as much as an error)
    """A transfer refused with an abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(describe_abort(code))
        self.code = code


# What went wrong at boot: node, object, expected, found, with the error status letters of CiA 302-2.


def label(index: int, subindex: int = 0) -> str:
    """An object as people write it: "1018h:2"."""
    return f"{index:04X}h:{subindex}"


class BootError(Exception):
    """Boot refused. `letter` is "" where CiA 302-2 has none; `str()` is one line that says it all.

    A not in the configuration, B no answer, C device type, D vendor, M product, N revision, O serial number, G no software
    version, H another one, J configuration refused or not taken, K no heartbeat, L was already operational.
    """

    def __init__(
        self,
        node: int | None,
        where: str,
        *,
        expected: str = "",
        found: str = "",
        letter: str = "",
        detail: str = "",
    ) -> None:
        self.node, self.object, self.expected, self.found, self.letter = node, where, expected, found, letter
        text = detail or f"{where}: expected {expected}, found {found}"
        who = "" if node is None else f"node {node}: "
        status = f" (status {letter})" if letter else ""
        super().__init__(f"{who}{text}{status}")

    def report(self) -> dict[str, object]:
        """As JSON-able mapping: node, object, expected, found, letter, message."""
        fields = {"node": self.node, "object": self.object, "expected": self.expected, "found": self.found}
        return {**fields, "letter": self.letter, "message": str(self)}


def mismatch(
    node: int, key: tuple[int, int], name: str, *, expected: str, found: str, letter: str = ""
) -> BootError:
    """An object holds another value than it must."""
    where = label(*key)
    detail = f"{where} {name}: expected {expected}, found {found}"
    return BootError(node, where, expected=expected, found=found, letter=letter, detail=detail)


def no_answer(node: int, key: tuple[int, int], waited_s: float, letter: str) -> BootError:
    """The SDO server is silent."""
    where = label(*key)
    detail = f"no answer to SDO {where} within {waited_s:g} s"
    return BootError(node, where, expected="an answer", found="none", letter=letter, detail=detail)


def refused(node: int, key: tuple[int, int], what: str, code: int, letter: str = "") -> BootError:
    """The SDO server aborted; `what` is "read" or "write of 0x60640020"."""
    where = label(*key)
    found = describe_abort(code)
    detail = f"{where}: {what} refused: {found}"
    return BootError(node, where, expected=f"{what} accepted", found=found, letter=letter, detail=detail)


# Objects of one node, read and written by SDO, with the node's name on everything that goes wrong. No bus, no clock.


_ABSENT = (NO_OBJECT, NO_SUBINDEX)


class SdoSilence(Exception):  # noqa: N818  (not an error of this side)
    """No answer within the waiting time."""

    def __init__(self, waited_s: float) -> None:
        super().__init__(f"no answer within {waited_s:g} s")
        self.waited_s = waited_s


class SdoAccess(Protocol):
    """SDO client of one node. Both raise SdoAbort (the node refused) and SdoSilence."""

    def read(self, index: int, subindex: int) -> bytes:
        """Upload."""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Download."""


class NodeObjects:
    """SDO with names. `found` holds each number that was read, newest value: what the configuration hash is made of."""

    def __init__(self, access: SdoAccess, node: int) -> None:
        self._access, self._node = access, node
        self.found: dict[Key, int] = {}

    def _read(self, key: Key, letter: str) -> bytes:
        try:
            return self._access.read(*key)
        except SdoSilence as silence:
            raise no_answer(self._node, key, silence.waited_s, letter) from silence

    def number(self, key: Key, size: int, letter: str = "") -> int:
        """Unsigned value of an object that must be there. Raises BootError."""
        try:
            raw = self._read(key, letter)
        except SdoAbort as abort:
            raise refused(self._node, key, "read", abort.code, letter) from abort
        self.found[key] = int.from_bytes(raw[:size], "little")
        return self.found[key]

    def optional(self, key: Key) -> bytes | None:
        """None when the device does not have the object."""
        try:
            return self._read(key, "")
        except SdoAbort as abort:
            if abort.code in _ABSENT:
                return None
            raise refused(self._node, key, "read", abort.code) from abort

    def write(self, key: Key, value: int, size: int) -> None:
        """Download. Raises BootError."""
        try:
            self._access.write(*key, value.to_bytes(size, "little"))
        except SdoSilence as silence:
            raise no_answer(self._node, key, silence.waited_s, "J") from silence
        except SdoAbort as abort:
            what = f"write of 0x{value:0{2 * size}X}"
            raise refused(self._node, key, what, abort.code, "J") from abort

    def compare(self, key: Key, wanted: int, size: int, name: str) -> None:
        """Read an object back. Raises BootError when it is not what was written."""
        found = self.number(key, size, letter="J")
        if found != wanted:
            digits = 2 * size
            raise mismatch(
                self._node,
                key,
                f"{name} read back",
                expected=f"0x{wanted:0{digits}X}",
                found=f"0x{found:0{digits}X}",
                letter="J",
            )

    def put(self, key: Key, value: int, size: int, name: str) -> None:
        """Write and read back."""
        self.write(key, value, size)
        self.compare(key, value, size, name)


# One SDO transfer seen from the client, and its repetition: expedited and segmented (CiA 301, 7.2.4.3). Pure.
#
# A `Transfer` says what to send and takes what comes; an `Exchange` adds the waiting times, which are given and not read
# from a clock. What answers another request is passed over and counted, never taken: a late answer to a request given up
# earlier, one with another index, a flood of them. Block transfer is not used: no object of a boot is long enough.


ANSWER_S = 0.1
"""A device answers within milliseconds; a longer silence is a lost frame, so ask again."""
MAX_BYTES = 65536
"""An upload that announces or sends more is given up: nothing that is read here is so long."""
_INITIATE = struct.Struct("<BHBI")
_HEAD = struct.Struct("<BHB")
_ABORT, _SPECIFIER, _TOGGLE = 0x80, 0xE0, 0x10
_UPLOAD, _UPLOAD_SEGMENT, _DOWNLOAD_SEGMENT = 0x40, 0x60, 0x00
_UPLOADED, _SEGMENT_UPLOADED, _DOWNLOADED, _SEGMENT_DOWNLOADED = 0x40, 0x00, 0x60, 0x20


class Broken(Exception):  # noqa: N818  (a state of the transfer)
    """The transfer cannot go on and may be begun again; `code` is the abort that the server is told."""

    def __init__(self, code: int) -> None:
        super().__init__(f"transfer broken ({code:08X}h)")
        self.code = code


class Transfer:
    """Upload of an object (`data` None) or download of `data`.

    Attributes:
        request: the 8 bytes to be sent now.
        done: it has ended well; `value` is then what was uploaded.
    """

    def __init__(self, index: int, subindex: int, data: bytes | None = None) -> None:
        self.index, self.subindex = index, subindex
        self.done = False
        self.value = b""
        self._data = data
        self._object = struct.pack("<HB", index, subindex)
        self._segments = False
        self._toggle = 0
        self._size: int | None = None
        self._sent = 0
        self.request = self._first()

    def _first(self) -> bytes:
        data = self._data
        if data is None:
            return _INITIATE.pack(_UPLOAD, self.index, self.subindex, 0)
        if 1 <= len(data) <= 4:
            return _HEAD.pack(0x23 | (4 - len(data)) << 2, self.index, self.subindex) + data.ljust(4, b"\0")
        return _INITIATE.pack(0x21, self.index, self.subindex, len(data))

    def answer(self, reply: bytes) -> bool:
        """Take one frame of the server; False when it is not the answer to `request`.

        Raises:
            SdoAbort: the server refuses. Broken: toggle or length do not agree.
        """
        if len(reply) != 8:
            return False
        if reply[0] == _ABORT:
            if reply[1:4] != self._object:
                return False
            raise SdoAbort(int.from_bytes(reply[4:], "little"))
        specifier = reply[0] & _SPECIFIER
        if self._data is None:
            return self._uploaded(specifier, reply) if not self._segments else self._segment(specifier, reply)
        return self._downloaded(specifier, reply)

    def abort(self, code: int) -> bytes:
        """The frame that tells the server that its client gives up."""
        return _INITIATE.pack(_ABORT, self.index, self.subindex, code)

    def _uploaded(self, specifier: int, reply: bytes) -> bool:
        if specifier != _UPLOADED or reply[1:4] != self._object:
            return False
        if reply[0] & 2:  # expedited
            self.value = reply[4 : 8 - (reply[0] >> 2 & 3 if reply[0] & 1 else 0)]
            self.done = True
            return True
        if reply[0] & 1:
            self._size = int.from_bytes(reply[4:], "little")
            if self._size > MAX_BYTES:
                raise Broken(OUT_OF_MEMORY)
        self._segments = True
        self.request = bytes([_UPLOAD_SEGMENT]) + bytes(7)
        return True

    def _segment(self, specifier: int, reply: bytes) -> bool:
        if specifier != _SEGMENT_UPLOADED:
            return False  # the initiate answer once more, or one to somebody else's download
        if reply[0] & _TOGGLE != self._toggle:
            raise Broken(TOGGLE_NOT_ALTERNATED)
        self.value += reply[1 : 8 - (reply[0] >> 1 & 7)]
        if len(self.value) > MAX_BYTES:
            raise Broken(OUT_OF_MEMORY)
        if reply[0] & 1:
            if self._size is not None and self._size != len(self.value):
                raise Broken(LENGTH_MISMATCH)
            self.done = True
            return True
        self._toggle ^= _TOGGLE
        self.request = bytes([_UPLOAD_SEGMENT | self._toggle]) + bytes(7)
        return True

    def _downloaded(self, specifier: int, reply: bytes) -> bool:
        assert self._data is not None
        if not self._segments:
            if specifier != _DOWNLOADED or reply[1:4] != self._object:
                return False
            if 1 <= len(self._data) <= 4:
                self.done = True
                return True
            self._segments = True
        else:
            if specifier != _SEGMENT_DOWNLOADED:
                return False
            if reply[0] & _TOGGLE != self._toggle:
                raise Broken(TOGGLE_NOT_ALTERNATED)
            self._toggle ^= _TOGGLE
            if self._sent >= len(self._data):
                self.done = True
                return True
        part = self._data[self._sent : self._sent + 7]
        self._sent += 7
        last = self._sent >= len(self._data)
        head = _DOWNLOAD_SEGMENT | self._toggle | (7 - len(part)) << 1 | last
        self.request = bytes([head]) + part.ljust(7, b"\0")
        return True


class Exchange:
    """One object read or written, asked for again until it is answered or the time is over.

    Each method returns the requests to be sent, as 8 bytes. Times are seconds of one steady clock.

    Attributes:
        value: what was read, or b"" for a write that was accepted; None until then.
        refusal: the server's abort code; None: none.
        silent: nothing came within the time.
        ignored: answers to other requests that came meanwhile.
        repeats: how often it was begun again.
    """

    def __init__(
        self, index: int, subindex: int, data: bytes | None, *, now: float, timeout_s: float
    ) -> None:
        self.index, self.subindex, self._data = index, subindex, data
        self.value: bytes | None = None
        self.refusal: int | None = None
        self.silent = False
        self.ignored = self.repeats = 0
        self._answer_s = min(ANSWER_S, timeout_s)
        self._deadline = now + timeout_s
        self._again = now + self._answer_s
        self._transfer = Transfer(index, subindex, data)

    @property
    def over(self) -> bool:
        """It has ended, well or not."""
        return self.value is not None or self.refusal is not None or self.silent

    @property
    def due(self) -> float:
        """When `tick` has something to do."""
        return min(self._again, self._deadline)

    def begin(self) -> list[bytes]:
        """The first request."""
        return [self._transfer.request]

    def on_reply(self, reply: bytes, now: float) -> list[bytes]:
        """A frame of the server."""
        if self.over:
            return []
        try:
            if not self._transfer.answer(reply):
                self.ignored += 1
                return []
        except SdoAbort as abort:
            self.refusal = abort.code
            return []
        except Broken as broken:
            return [self._transfer.abort(broken.code), *self._begin_again(now)]
        if self._transfer.done:
            self.value = self._transfer.value
            return []
        self._again = now + self._answer_s
        return [self._transfer.request]

    def tick(self, now: float) -> list[bytes]:
        """Time has passed: nothing, the request once more, or the end."""
        if self.over or now < self.due:
            return []
        if now >= self._deadline - 0.5 * self._answer_s:
            self.silent = True
            return [self._transfer.abort(PROTOCOL_TIMED_OUT)]
        return self._begin_again(now)

    def _begin_again(self, now: float) -> list[bytes]:
        self.repeats += 1
        self._again = now + self._answer_s
        self._transfer = Transfer(self.index, self.subindex, self._data)
        return [self._transfer.request]


# SDO requests to one node, one after the other: for a master that is in service and must not wait. Pure.
#
# A node has one default SDO server, which holds one transfer: requests to it must queue, those to different nodes need not.
# The queue is bounded, each request has its own waiting time, and its result is given to the function it was submitted with.


@dataclass(frozen=True)
class SdoResult:
    """How a request ended: one of `value` (b"" for a write), `refusal` (abort code), or neither: silence."""

    index: int
    subindex: int
    value: bytes | None
    refusal: int | None


@dataclass(frozen=True)
class _Request:
    index: int
    subindex: int
    data: bytes | None
    timeout_s: float
    done: Callable[[SdoResult], None]


class SdoQueue:
    """The queue of one node. Times are seconds of one steady clock; frames are the 8 bytes of 600h+n and 580h+n.

    Attributes:
        ignored: answers that belonged to no request of ours.
        repeats, silences, refusals: requests asked again, never answered, refused.
    """

    def __init__(self, limit: int = 32) -> None:
        self._waiting: deque[_Request] = deque()
        self._limit = limit
        self._exchange: Exchange | None = None
        self._done: Callable[[SdoResult], None] = lambda _result: None
        self.ignored = self.repeats = self.silences = self.refusals = 0

    @property
    def busy(self) -> bool:
        """Something is under way or waits."""
        return self._exchange is not None or bool(self._waiting)

    def read(
        self, index: int, subindex: int, done: Callable[[SdoResult], None], timeout_s: float = 0.5
    ) -> bool:
        """Queue an upload; False when the queue is full."""
        return self._submit(_Request(index, subindex, None, timeout_s, done))

    def write(
        self,
        index: int,
        subindex: int,
        data: bytes,
        done: Callable[[SdoResult], None],
        timeout_s: float = 0.5,
    ) -> bool:
        """Queue a download; False when the queue is full."""
        return self._submit(_Request(index, subindex, data, timeout_s, done))

    def clear(self) -> None:
        """Forget everything: somebody else (the boot) talks to the node now. Nobody is told."""
        self._waiting.clear()
        self._exchange = None

    def on_reply(self, reply: bytes, now: float) -> list[bytes]:
        """A frame of the node; returns what to send."""
        if self._exchange is None:
            self.ignored += 1
            return []
        return self._then(self._exchange.on_reply(reply, now), now)

    def tick(self, now: float) -> list[bytes]:
        """Call often; returns what to send."""
        if self._exchange is None:
            return self._next(now)
        return self._then(self._exchange.tick(now), now)

    def _submit(self, request: _Request) -> bool:
        if len(self._waiting) >= self._limit:
            return False
        self._waiting.append(request)
        return True

    def _then(self, frames: list[bytes], now: float) -> list[bytes]:
        exchange = self._exchange
        if exchange is None or not exchange.over:
            return frames
        self._exchange = None
        self.ignored += exchange.ignored
        self.repeats += exchange.repeats
        self.silences += exchange.silent
        self.refusals += exchange.refusal is not None
        self._done(SdoResult(exchange.index, exchange.subindex, exchange.value, exchange.refusal))
        return frames + self._next(now)

    def _next(self, now: float) -> list[bytes]:
        if not self._waiting or self._exchange is not None:
            return []
        request = self._waiting.popleft()
        self._done = request.done
        self._exchange = Exchange(
            request.index, request.subindex, request.data, now=now, timeout_s=request.timeout_s
        )
        return self._exchange.begin()


# SDO client of one node over canopen's Network, for the boot: waits, asks again, takes no answer to another request.
#
# canopen's own client retries nothing (MAX_RETRIES = 1 means one try), takes any frame length, and does not compare the
# answer to a download with its request; so only its Network is used, and `jtqd.drivers.sdo` does the talking.


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


FRAME_SDO_ANSWER_S = (
    0.1  # a device answers within milliseconds; a longer silence is a lost frame, so ask again
)
_FRAME_SDO_INITIATE = struct.Struct("<BHBI")
_FRAME_SDO_ABORT = 0x80
_UPLOAD_REQUEST, _UPLOAD_RESPONSE, _DOWNLOAD_RESPONSE = 0x40, 0x40, 0x60
_FRAME_SDO_SPECIFIER = 0xE0


class Socket(Protocol):
    """What is needed of `frame_socket.FrameSocket`."""

    frames: bytearray

    def send(self, frame16: bytes) -> bool:
        """Send one frame."""

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for frames."""

    def receive(self) -> int:
        """Take what has arrived."""


class FrameSdo:
    """Implements `boot_procedure.SdoAccess`. Asks again until `timeout_s` is over, then raises SdoSilence.

    Both methods also raise SdoAbort (the node refused) and BusError.
    """

    def __init__(self, socket: Socket, node: int, timeout_s: float = 0.5) -> None:
        self._socket = socket
        self._request_id, self._response_id = 0x600 + node, 0x580 + node
        self._timeout_s = timeout_s

    def read(self, index: int, subindex: int) -> bytes:
        """Upload of an object of 1..4 bytes; a longer one is refused with 06070012h."""
        reply = self._exchange(
            _FRAME_SDO_INITIATE.pack(_UPLOAD_REQUEST, index, subindex, 0), _UPLOAD_RESPONSE
        )
        if not reply[0] & 2:  # segmented
            self._send(_FRAME_SDO_INITIATE.pack(_FRAME_SDO_ABORT, index, subindex, LENGTH_TOO_HIGH))
            raise SdoAbort(LENGTH_TOO_HIGH)
        unused = reply[0] >> 2 & 3 if reply[0] & 1 else 0
        return reply[4 : 8 - unused]

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Expedited download of 1..4 bytes; ValueError for other lengths."""
        if not 1 <= len(data) <= 4:
            raise ValueError(f"an expedited download has 1..4 bytes, not {len(data)}")
        command = 0x23 | (4 - len(data)) << 2
        self._exchange(
            struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0"), _DOWNLOAD_RESPONSE
        )

    def _exchange(self, request: bytes, expected: int) -> bytes:
        """The reply to `request` with the command specifier `expected` and the same object."""
        deadline = time.monotonic() + self._timeout_s
        while True:
            self._send(request)
            again = min(time.monotonic() + FRAME_SDO_ANSWER_S, deadline)
            while (left := again - time.monotonic()) > 0.0:
                self._socket.wait(left)
                for reply in self._replies():
                    if reply[1:4] != request[1:4]:
                        continue  # the late answer to an earlier request, or to somebody else's
                    if reply[0] == _FRAME_SDO_ABORT:
                        raise SdoAbort(int.from_bytes(reply[4:], "little"))
                    if reply[0] & _FRAME_SDO_SPECIFIER == expected:
                        return reply
            if time.monotonic() >= deadline:
                raise SdoSilence(self._timeout_s)

    def _send(self, data: bytes) -> None:
        self._socket.send(pack(self._request_id, data))

    def _replies(self) -> list[bytes]:
        socket = self._socket
        found = []
        for position in range(socket.receive()):
            can_id, length, data = FRAME.unpack_from(socket.frames, FRAME_SIZE * position)
            if can_id == self._response_id and length == 8:
                found.append(bytes(data))
        return found
