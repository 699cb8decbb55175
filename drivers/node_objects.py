"""Objects of one node, read and written by SDO, with the node's name on everything that goes wrong. No bus, no clock."""

from __future__ import annotations

from typing import Protocol

from drivers.boot_error import mismatch, no_answer, refused
from drivers.devices import Key
from drivers.sdo_abort import NO_OBJECT, NO_SUBINDEX, SdoAbort

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
