"""SDO of one node with the node's name on everything that goes wrong. No bus, no clock."""

from __future__ import annotations

from drivers.boot_error import BootError, label, mismatch, no_answer, refused
from drivers.boot_procedure import SdoAccess, SdoSilence
from drivers.sdo_abort import NO_OBJECT, NO_SUBINDEX, SdoAbort

Key = tuple[int, int]


class NodeSdo:
    """SDO with the node's name on what goes wrong."""

    def __init__(self, access: SdoAccess, node: int) -> None:
        self._access, self.node = access, node

    def number(self, key: Key, signed: bool = False) -> int:
        """Upload. Raises BootError."""
        found = self.optional(key, signed)
        if found is None:
            raise BootError(self.node, label(*key), detail=f"{label(*key)}: no such object in this device")
        return found

    def optional(self, key: Key, signed: bool = False) -> int | None:
        """None when the device does not have the object."""
        try:
            return int.from_bytes(self._access.read(*key), "little", signed=signed)
        except SdoSilence as silence:
            raise no_answer(self.node, key, silence.waited_s, "") from silence
        except SdoAbort as abort:
            if abort.code in (NO_OBJECT, NO_SUBINDEX):
                return None
            raise refused(self.node, key, "read", abort.code) from abort

    def write(self, key: Key, value: int, size: int) -> None:
        """Download. Raises BootError."""
        value &= (1 << 8 * size) - 1
        try:
            self._access.write(*key, value.to_bytes(size, "little"))
        except SdoSilence as silence:
            raise no_answer(self.node, key, silence.waited_s, "") from silence
        except SdoAbort as abort:
            raise refused(self.node, key, f"write of 0x{value:0{2 * size}X}", abort.code) from abort

    def put(self, key: Key, value: int, size: int, signed: bool = False) -> None:
        """Download and compare."""
        self.write(key, value, size)
        self.require(key, value, signed)

    def require(self, key: Key, value: int, signed: bool = False) -> None:
        """BootError unless the object holds `value`."""
        found = self.number(key, signed)
        if found != value:
            raise mismatch(self.node, key, "read back", expected=f"0x{value:X}", found=f"0x{found:X}")
