"""One SDO transfer seen from the client, and its repetition: expedited and segmented (CiA 301, 7.2.4.3). Pure.

A `Transfer` says what to send and takes what comes; an `Exchange` adds the waiting times, which are given and not read from
a clock. What answers another request is passed over and counted, never taken: a late answer to a request given up earlier,
one with another index, a flood of them. Block transfer is not used: no object of a boot is long enough.
"""

from __future__ import annotations

import struct

from drivers.sdo_abort import (
    LENGTH_MISMATCH,
    OUT_OF_MEMORY,
    PROTOCOL_TIMED_OUT,
    TOGGLE_NOT_ALTERNATED,
    SdoAbort,
)

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
