"""EMCY producer of an emulated device: present errors, error register 1001h, error history 1003h, the
messages. Pure.
"""

import struct

from drivers.error_history import ErrorHistory
from drivers.frame import pack
from drivers.object_dictionary import ObjectStore

_EMCY = struct.Struct("<HB5x")  # error code, error register, manufacturer's field
ERROR_RESET = 0x0000
GENERIC = 0x01  # bit 0 of 1001h is set with every error
CURRENT, COMMUNICATION = 0x02, 0x10


class Emergency:
    """Errors of one device. An error is told when it comes and not again while it lasts (CiA 301, 7.2.7)."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._history = ErrorHistory(store)
        self._present: dict[int, int] = {}  # EMCY code -> bits of the error register

    def present(self, code: int) -> bool:
        """The error has come and has not gone."""
        return code in self._present

    def come(self, code: int, register: int) -> list[bytes]:
        """A new error: into 1001h and 1003h, and the frame that tells it; nothing when it is known."""
        if code in self._present:
            return []
        self._present[code] = register | GENERIC
        self._history.push(code)
        return [self._message(code)]

    def gone(self, *codes: int) -> list[bytes]:
        """These errors are over: EMCY 0000h with what is left in the register, if one of them was present."""
        over = [code for code in codes if self._present.pop(code, None) is not None]
        return [self._message(ERROR_RESET)] if over else []

    def forget(self) -> None:
        """NMT reset: no error is present; nothing is told."""
        self._present.clear()
        self._store.set_number(0x1001, 0, 0)

    def _message(self, code: int) -> bytes:
        register = 0
        for bits in self._present.values():
            register |= bits
        self._store.set_number(0x1001, 0, register)
        return pack(0x080 + self._store.node_id, _EMCY.pack(code, register))
