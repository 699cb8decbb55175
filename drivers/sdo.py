"""SDO protocol (CiA 301, 7.2.4.3), client side: abort codes, one transfer, its repetition, a queue, a blocking client.

A client asks on 600h+n, the server of node n answers on 580h+n, both with 8 bytes.

    Transfer    one upload or download, expedited or segmented: the next request, and whether a frame is its answer
    Exchange    a transfer with waiting times: repeated until it is answered, refused, or the time is over
    SdoQueue    uploads from one node, one after the other, without blocking
    SdoClient   uploads and downloads that block until they have ended

Times are arguments of all but SdoClient, in seconds of one monotonic clock. An answer to another request is ignored and
counted: a late one to a request that was given up, one with another index, a flood of them. Block transfer is not used: no
object that is read here is long enough.
"""

from __future__ import annotations

import re
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from jtqd.drivers.frame import FRAME, FRAME_SIZE, pack
from jtqd.estimator.text import counted

Key = tuple[int, int]
"""Index and sub-index of an object."""


def label(index: int, subindex: int = 0) -> str:
    """Return an object in the notation of CiA: "1018h:2"."""
    return f"{index:04X}h:{subindex}"


def parse_key(text: str) -> Key:
    """Return (index, sub-index) of "608Fh:1" or "6075h". Raises ValueError."""
    found = re.fullmatch(r"([0-9A-F]{4})h(?::(0|[1-9][0-9]{0,2}))?", text)
    if found is None:
        raise ValueError(f"{text!r} is not an object like 608Fh:1")
    return int(found[1], 16), int(found[2] or 0)


# Abort codes (CiA 301, 7.2.4.3.17, table 22)

TOGGLE_NOT_ALTERNATED = 0x0503_0000
PROTOCOL_TIMED_OUT = 0x0504_0000
UNKNOWN_COMMAND = 0x0504_0001
OUT_OF_MEMORY = 0x0504_0005
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

_MEANING = {
    TOGGLE_NOT_ALTERNATED: "toggle bit not alternated",
    PROTOCOL_TIMED_OUT: "SDO protocol timed out",
    UNKNOWN_COMMAND: "unknown SDO command",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
    OUT_OF_MEMORY: "out of memory",
    0x0601_0000: "unsupported access to an object",
    READ_OF_WRITE_ONLY: "object is write only",
    WRITE_OF_READ_ONLY: "object is read only",
    NO_OBJECT: "object does not exist",
    NOT_MAPPABLE: "object cannot be mapped",
    PDO_TOO_LONG: "mapped objects exceed the PDO",
    0x0604_0043: "parameters are incompatible with each other",
    0x0604_0047: "incompatible within the device",
    0x0606_0000: "access failed due to a hardware error",
    LENGTH_MISMATCH: "length does not match the data type",
    LENGTH_TOO_HIGH: "length too high for the data type",
    LENGTH_TOO_LOW: "length too low for the data type",
    NO_SUBINDEX: "sub-index does not exist",
    VALUE_RANGE: "value out of range",
    0x0609_0031: "value too high",
    0x0609_0032: "value too low",
    0x0609_0036: "maximum is below the minimum",
    0x060A_0023: "resource not available: SDO connection",
    GENERAL_ERROR: "general error",
    0x0800_0020: "cannot be transferred or stored",
    0x0800_0021: "cannot be transferred or stored: the device is under local control",
    DEVICE_STATE: "not in the present device state",
    0x0800_0023: "no object dictionary: it cannot be made, or is not there",
    0x0800_0024: "no data available",
}


def describe_abort(code: int) -> str:
    """Return the code in words, with its number: "object is read only (06010002h)"."""
    return f"{_MEANING.get(code, 'abort')} ({code:08X}h)"


class SdoAbort(Exception):  # noqa: N818  (CiA 301 calls it an abort; it is a reply as much as an error)
    """A transfer refused with an abort code."""

    def __init__(self, code: int) -> None:
        super().__init__(describe_abort(code))
        self.code = code


# Frames

HEADER = struct.Struct("<BHB")
"""Command, index and sub-index: the first half of most frames."""
INITIATE = struct.Struct("<BHBI")
"""The same with a number of four bytes: a size, or an abort code."""
TOGGLE = 0x10
REQUEST_ID, RESPONSE_ID = 0x600, 0x580
"""COB-IDs of the default SDO, plus the node number."""
_ABORT, _SPECIFIER = 0x80, 0xE0
_UPLOAD, _UPLOAD_SEGMENT, _DOWNLOAD_SEGMENT = 0x40, 0x60, 0x00
_UPLOADED, _SEGMENT_UPLOADED, _DOWNLOADED, _SEGMENT_DOWNLOADED = 0x40, 0x00, 0x60, 0x20


def abort_frame(index: int, subindex: int, code: int) -> bytes:
    """Return the 8 bytes with which either side gives up a transfer."""
    return INITIATE.pack(_ABORT, index, subindex, code)


MAX_BYTES = 65536
"""An upload that announces or sends more is given up: no object that is read here is so long."""


class TransferError(Exception):
    """The transfer cannot go on, but may be repeated; `code` is the abort code for the server."""

    def __init__(self, code: int) -> None:
        super().__init__(describe_abort(code))
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
        self._segmented = False
        self._toggle = 0
        self._size: int | None = None
        self._sent = 0
        self.request = self._first()

    def _first(self) -> bytes:
        data = self._data
        if data is None:
            return INITIATE.pack(_UPLOAD, self.index, self.subindex, 0)
        if 1 <= len(data) <= 4:
            return HEADER.pack(0x23 | (4 - len(data)) << 2, self.index, self.subindex) + data.ljust(4, b"\0")
        return INITIATE.pack(0x21, self.index, self.subindex, len(data))

    def answer(self, reply: bytes) -> bool:
        """Take one frame of the server; return False when it is not the answer to `request`.

        Raises:
            SdoAbort: the server refuses.
            TransferError: toggle or length do not agree.
        """
        if len(reply) != 8:
            return False
        if reply[0] == _ABORT:
            if reply[1:4] != self._object:
                return False
            raise SdoAbort(int.from_bytes(reply[4:], "little"))
        specifier = reply[0] & _SPECIFIER
        if self._data is None:
            take = self._uploaded_segment if self._segmented else self._uploaded
            return take(specifier, reply)
        return self._downloaded(specifier, reply, self._data)

    def abort(self, code: int) -> bytes:
        """Return the frame by which the client gives up."""
        return abort_frame(self.index, self.subindex, code)

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
                raise TransferError(OUT_OF_MEMORY)
        self._segmented = True
        self.request = bytes([_UPLOAD_SEGMENT]) + bytes(7)
        return True

    def _uploaded_segment(self, specifier: int, reply: bytes) -> bool:
        if specifier != _SEGMENT_UPLOADED:
            return False  # the initiate answer once more, or one to another client's download
        if reply[0] & TOGGLE != self._toggle:
            raise TransferError(TOGGLE_NOT_ALTERNATED)
        self.value += reply[1 : 8 - (reply[0] >> 1 & 7)]
        if len(self.value) > MAX_BYTES:
            raise TransferError(OUT_OF_MEMORY)
        if reply[0] & 1:
            if self._size is not None and self._size != len(self.value):
                raise TransferError(LENGTH_MISMATCH)
            self.done = True
            return True
        self._toggle ^= TOGGLE
        self.request = bytes([_UPLOAD_SEGMENT | self._toggle]) + bytes(7)
        return True

    def _downloaded(self, specifier: int, reply: bytes, data: bytes) -> bool:
        if not self._segmented:
            if specifier != _DOWNLOADED or reply[1:4] != self._object:
                return False
            if 1 <= len(data) <= 4:
                self.done = True
                return True
            self._segmented = True
        else:
            if specifier != _SEGMENT_DOWNLOADED:
                return False
            if reply[0] & TOGGLE != self._toggle:
                raise TransferError(TOGGLE_NOT_ALTERNATED)
            self._toggle ^= TOGGLE
            if self._sent >= len(data):
                self.done = True
                return True
        segment = data[self._sent : self._sent + 7]
        self._sent += 7
        last = self._sent >= len(data)
        head = _DOWNLOAD_SEGMENT | self._toggle | (7 - len(segment)) << 1 | last
        self.request = bytes([head]) + segment.ljust(7, b"\0")
        return True


ANSWER_S = 0.6
"""Most devices answer within milliseconds, some in 500; a longer silence is a lost frame, so the request is repeated."""
PATIENCE = 2.6
"""Longest wait for an answer, in silences: two repetitions of a request, and half of it again."""
_LONGEST = 10.0
"""A transfer of many segments may take so many times the waiting time of one answer."""


class Exchange:
    """One object read (`data` None) or written, asked for again until it is answered or `timeout_s` is over.

    The methods return the requests to be sent, 8 bytes each. Nothing is repeated inside a segmented transfer, where a late
    answer and a repeated request would be taken for the next segment: each segment may take `timeout_s`.

    Args:
        timeout_s: for an answer, and for all repetitions of the first request together.
        answer_s: silence after which the first request is repeated.

    Attributes:
        value: what was read, or b"" for a write that was accepted; None until then.
        refusal: the server's abort code; None: none.
        timed_out: no answer came in time.
        ignored: answers to other requests that came meanwhile.
        refused: the newest answer that could not be taken, in words; "" for none.
        repeats: of the first request.
    """

    def __init__(
        self,
        index: int,
        subindex: int,
        data: bytes | None,
        *,
        now: float,
        timeout_s: float,
        answer_s: float = ANSWER_S,
    ) -> None:
        self.index, self.subindex, self._data = index, subindex, data
        self.value: bytes | None = None
        self.refusal: int | None = None
        self.timed_out, self.refused = False, ""
        self.ignored = self.repeats = 0
        self._answer_s, self._timeout_s = min(answer_s, timeout_s), timeout_s
        self._deadline = now + timeout_s
        self._longest = now + _LONGEST * timeout_s
        self._repeat_at = now + self._answer_s
        self._transfer = Transfer(index, subindex, data)

    @property
    def ended(self) -> bool:
        """Whether it has ended, well or not."""
        return self.value is not None or self.refusal is not None or self.timed_out

    @property
    def request(self) -> bytes:
        """The request to be sent now; after the constructor the first one."""
        return self._transfer.request

    @property
    def due(self) -> float:
        """When `tick` has something to do."""
        return min(self._repeat_at, self._deadline)

    def on_reply(self, reply: bytes, now: float) -> list[bytes]:
        """Take a frame of the server."""
        if self.ended:
            return []
        try:
            taken = self._transfer.answer(reply)
        except SdoAbort as abort:
            self.refusal = abort.code
            return []
        except TransferError as error:
            self.refused = f"an answer: {error}"
            return [self._transfer.abort(error.code), *self._repeat(now)]
        if not taken:
            self.ignored += 1
            bytes_of = f"of {counted(len(reply), 'byte')}, expected 8"
            self.refused = f"an answer {bytes_of if len(reply) != 8 else reply.hex(' ')}"
            return []
        if self._transfer.done:
            self.value = self._transfer.value
            return []
        self._deadline = self._repeat_at = min(now + self._timeout_s, self._longest)
        return [self._transfer.request]

    def tick(self, now: float) -> list[bytes]:
        """Let time pass: nothing, the request once more, or the end."""
        if self.ended or now < self.due:
            return []
        # too late for one more answer, or between two segments
        if now >= self._deadline - 0.5 * self._answer_s or self._repeat_at >= self._deadline:
            self.timed_out = True
            return [self._transfer.abort(PROTOCOL_TIMED_OUT)]
        return self._repeat(now)

    def _repeat(self, now: float) -> list[bytes]:
        self.repeats += 1
        self._repeat_at = now + self._answer_s
        self._transfer = Transfer(self.index, self.subindex, self._data)
        return [self._transfer.request]


Done = Callable[[bytes | None, int | None], None]
"""Takes the value of an upload, or the abort code of a refusal; both None: no answer."""


class SdoQueue:
    """Uploads from one node, one after the other, for a master in service that must not wait.

    A node has one default SDO server, which holds one transfer: requests to it queue, those to different nodes need not.

    `limit` requests may wait; each is repeated after `answer_s` of silence. Attributes: `ignored`, answers that belonged to
    no request of ours; `repeats`, `timeouts`, `refusals`, requests repeated, never answered, refused.
    """

    def __init__(self, limit: int = 32, answer_s: float = ANSWER_S) -> None:
        self._waiting: deque[tuple[Key, float, Done]] = deque()
        self._answer_s, self._limit = answer_s, limit
        self._running: tuple[Exchange, Done] | None = None
        self.ignored = self.repeats = self.timeouts = self.refusals = 0

    @property
    def busy(self) -> bool:
        """Whether a request is under way or waits."""
        return self._running is not None or bool(self._waiting)

    def read(self, key: Key, done: Done, timeout_s: float = 0.5) -> bool:
        """Queue an upload; return False when the queue is full."""
        if len(self._waiting) >= self._limit:
            return False
        self._waiting.append((key, timeout_s, done))
        return True

    def clear(self) -> None:
        """Discard every request, without a result: another client (the boot) uses the node's server."""
        self._waiting.clear()
        self._running = None

    def on_reply(self, reply: bytes, now: float) -> list[bytes]:
        """Take a frame of the node; return what to send."""
        if self._running is None:
            self.ignored += 1
            return []
        return self._finish(self._running[0].on_reply(reply, now), now)

    def tick(self, now: float) -> list[bytes]:
        """Let time pass; return what to send. Call it often."""
        if self._running is None:
            return self._begin_next(now)
        return self._finish(self._running[0].tick(now), now)

    def _finish(self, frames: list[bytes], now: float) -> list[bytes]:
        """Hand out the result of an exchange that has ended, and begin the next one."""
        if self._running is None or not self._running[0].ended:
            return frames
        (exchange, done), self._running = self._running, None
        self.ignored += exchange.ignored
        self.repeats += exchange.repeats
        self.timeouts += exchange.timed_out
        self.refusals += exchange.refusal is not None
        done(exchange.value, exchange.refusal)
        return frames + self._begin_next(now)

    def _begin_next(self, now: float) -> list[bytes]:
        if not self._waiting or self._running is not None:
            return []
        key, timeout_s, done = self._waiting.popleft()
        exchange = Exchange(*key, None, now=now, timeout_s=timeout_s, answer_s=self._answer_s)
        self._running = exchange, done
        return [exchange.request]


# Blocking client


class Socket(Protocol):
    """What `SdoClient` needs of `jtqd.drivers.frame_socket.FrameSocket`."""

    frames: bytearray

    def send(self, frame16: bytes, /) -> bool: ...  # noqa: D102
    def wait(self, timeout_s: float | None, /) -> bool: ...  # noqa: D102
    def receive(self) -> int: ...  # noqa: D102


class SdoTimeout(Exception):  # noqa: N818  (a state of the node)
    """No answer within the waiting time; `refused`: the newest one that could not be taken, in words."""

    def __init__(self, waited_s: float, refused: str = "") -> None:
        super().__init__(f"no answer within {waited_s:g} s{f'; refused {refused}' if refused else ''}")
        self.waited_s, self.refused = waited_s, refused


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
        self._send([exchange.request])
        while not exchange.ended:
            for reply in self._replies(max(exchange.due - time.monotonic(), 1e-4)):
                self._send(exchange.on_reply(reply, time.monotonic()))
            self._send(exchange.tick(time.monotonic()))  # also in a flood of foreign answers
        if exchange.refusal is not None:
            raise SdoAbort(exchange.refusal)
        if exchange.value is None:
            raise SdoTimeout(self._timeout_s, exchange.refused)
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
