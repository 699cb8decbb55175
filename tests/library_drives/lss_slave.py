"""An LSS slave (CiA 305), as the library has none: state, identity, pending and stored node-ID and bit rate, fast scan."""

from __future__ import annotations

import struct
import threading
from typing import Self

import can

WAITING, CONFIGURATION = 0, 1
REQUEST, ANSWER = 0x7E5, 0x7E4
NONE = 0xFF


class LssSlave:
    """Answers on a python-can bus in a thread. `node`, `rate` are pending; `stored` is what store has kept."""

    def __init__(self, bus: can.BusABC, identity: tuple[int, int, int, int], node: int = NONE) -> None:
        self._bus, self.identity = bus, identity
        self.node, self.rate, self.state = node, 0, WAITING
        self.stored: tuple[int, int] | None = None
        self.refuses: dict[int, int] = {}
        self.length = 8
        """Of its answers."""
        self._selected = self._position = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._ended.is_set():
            message = self._bus.recv(0.02)
            if message is None or message.arbitration_id != REQUEST or message.dlc != 8:
                continue
            answer = self.answer(bytes(message.data))
            if answer is not None:
                data = answer.ljust(8, b"\0")[: self.length]
                self._bus.send(can.Message(arbitration_id=ANSWER, data=data, is_extended_id=False))

    def answer(self, data: bytes) -> bytes | None:
        service, number = struct.unpack_from("<BI", data)
        if service == 0x04:
            self.state = data[1]
            self._selected = 0
            return None
        if 0x40 <= service <= 0x43:
            fits = self.identity[service - 0x40] == number and (
                service == 0x40 or self._selected == service - 0x40
            )
            self._selected = service - 0x40 + 1 if fits else 0
            if self._selected == 4:
                self.state = CONFIGURATION
                return b"\x44"
            return None
        if service == 0x51:
            return self._fast_scan(number, *data[5:8])
        return self._configure(service, data) if self.state == CONFIGURATION else None

    def _fast_scan(self, number: int, bit: int, part: int, following: int) -> bytes | None:
        if self.node != NONE:
            return None
        if bit == 0x80:
            self._position = 0
            return b"\x4f"
        if part != self._position or (self.identity[part] ^ number) >> bit:
            return None
        if bit == 0:
            self._position = following
            if part == 3 and following == 0:
                self.state = CONFIGURATION
        return b"\x4f"

    def _configure(self, service: int, data: bytes) -> bytes | None:
        if 0x5A <= service <= 0x5D:
            return struct.pack("<BI", service, self.identity[service - 0x5A])
        if service == 0x5E:
            return bytes([service, self.node])
        return bytes([service, self._write(service, data)]) if service in (0x11, 0x13, 0x17) else None

    def _write(self, service: int, data: bytes) -> int:
        """Return the error code."""
        if service in self.refuses:
            return self.refuses[service]
        if service == 0x11 and (1 <= data[1] <= 127 or data[1] == NONE):
            self.node = data[1]
        elif service == 0x13 and not data[1] and data[2] <= 8:
            self.rate = data[2]
        elif service == 0x17:
            self.stored = self.node, self.rate
        else:
            return 1
        return 0
