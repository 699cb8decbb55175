"""SDO client of one node over a frame socket: expedited transfers, no thread, no canopen.

For those who already hold a frame socket and must not wait behind other threads. The socket's filters must let
580h+n through; other frames that it receives meanwhile are dropped.
"""

from __future__ import annotations

import struct
import time
from typing import Protocol

from drivers.boot_procedure import SdoSilence
from drivers.frame import FRAME, FRAME_SIZE, pack
from drivers.sdo_abort import LENGTH_TOO_HIGH, SdoAbort

ANSWER_S = 0.1  # a device answers within milliseconds; a longer silence is a lost frame, so ask again
_INITIATE = struct.Struct("<BHBI")
_ABORT = 0x80
_UPLOAD_REQUEST, _UPLOAD_RESPONSE, _DOWNLOAD_RESPONSE = 0x40, 0x40, 0x60
_SPECIFIER = 0xE0


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
        reply = self._exchange(_INITIATE.pack(_UPLOAD_REQUEST, index, subindex, 0), _UPLOAD_RESPONSE)
        if not reply[0] & 2:  # segmented
            self._send(_INITIATE.pack(_ABORT, index, subindex, LENGTH_TOO_HIGH))
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
            again = min(time.monotonic() + ANSWER_S, deadline)
            while (left := again - time.monotonic()) > 0.0:
                self._socket.wait(left)
                for reply in self._replies():
                    if reply[1:4] != request[1:4]:
                        continue  # the late answer to an earlier request, or to somebody else's
                    if reply[0] == _ABORT:
                        raise SdoAbort(int.from_bytes(reply[4:], "little"))
                    if reply[0] & _SPECIFIER == expected:
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
