"""jtqd's own errors: what is present, 1001h, 1003h, and the EMCY messages that tell it, with inhibit time. Pure.

An error is a code with a detail (which PDO, which node); each is told when it comes and when it has gone, and not between.
The end of one is EMCY 0000h with the register of what is left; the manufacturer's field names the code and detail:

    bytes 0..1  error code, 0000h for an end
    byte  2     error register 1001h
    bytes 3..4  the code that ended (0000h only), else 0
    bytes 5..6  detail: COB-ID or node-ID
    byte  7     joints concerned: bit 0 joint 1, bit 1 joint 2

Between two messages passes the inhibit time 1015h. What comes meanwhile waits, in order; an error that has come and gone
before it could be told is not told, but it is in the history.
"""

from __future__ import annotations

import struct
from math import inf

from drivers.emcy import COMMUNICATION, EMCY, GENERIC, NO_ERROR
from drivers.error_history import ErrorHistory
from drivers.object_dictionary import ObjectStore

_FIELD = struct.Struct("<HHB")
_INHIBIT = 0x1015
_INHIBIT_UNIT_S = 1e-4
_WAITING = 64
"""Errors that may wait; there are fewer different ones than that."""

Error = tuple[int, int]
"""(code, detail)"""


class OwnErrors:
    """Errors of jtqd's own node.

    Args:
        store: its object dictionary; 1001h, 1003h and 1015h are kept and read there.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._history = ErrorHistory(store)
        self._present: dict[Error, tuple[int, int]] = {}  # -> register, joints
        self._told: set[Error] = set()
        self._queue: dict[Error, int] = {}  # errors with something to tell -> joints
        self._not_before = -inf

    def present(self, code: int, detail: int = 0) -> bool:
        """It has come and not gone."""
        return (code, detail) in self._present

    def come(self, code: int, detail: int = 0, *, joints: int = 0, register: int = COMMUNICATION) -> bool:
        """An error; False when it is known already."""
        error = code, detail
        if error in self._present:
            return False
        self._present[error] = register | GENERIC, joints
        self._store.set_number(0x1001, 0, self.register)
        self._history.push(code | detail << 16)
        if error in self._told:
            self._queue.pop(
                error, None
            )  # its end had not been told: nothing has changed for those who listen
        elif len(self._queue) < _WAITING:
            self._queue[error] = joints
        return True

    def gone(self, code: int, detail: int = 0) -> bool:
        """It is over; False when it was not present."""
        error = code, detail
        if error not in self._present:
            return False
        _, joints = self._present.pop(error)
        self._store.set_number(0x1001, 0, self.register)
        if error in self._told:
            self._queue[error] = joints
        else:
            self._queue.pop(error, None)
        return True

    def happened(self, code: int, detail: int = 0, *, joints: int = 0, register: int = COMMUNICATION) -> None:
        """Something that does not last, as a recovery from bus-off: told as an error and in the history."""
        if self.come(code, detail, joints=joints, register=register):
            del self._present[code, detail]
            self._store.set_number(0x1001, 0, self.register)

    def tick(self, now_s: float) -> bytes | None:
        """The message that is due: 8 bytes for COB-ID 080h + node-ID. It counts as told."""
        if not self._queue or now_s < self._not_before:
            return None
        error, joints = next(iter(self._queue.items()))
        del self._queue[error]
        self._not_before = now_s + self._store.number(_INHIBIT) * _INHIBIT_UNIT_S
        code, detail = error
        if error in self._told and error not in self._present:
            self._told.discard(error)
            return EMCY.pack(NO_ERROR, self.register, _FIELD.pack(code, detail & 0xFFFF, joints))
        if error in self._present:
            self._told.add(error)
        return EMCY.pack(code, self.register | GENERIC, _FIELD.pack(0, detail & 0xFFFF, joints))

    def all_present(self) -> list[Error]:
        """Every error that has come and not gone, in order."""
        return list(self._present)

    @property
    def register(self) -> int:
        """1001h."""
        register = 0
        for bits, _ in self._present.values():
            register |= bits
        return register
