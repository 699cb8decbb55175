"""Pre-defined error field 1003h: the newest error first, bounded, cleared by writing 0 (CiA 301, 7.5.2.4)."""

from __future__ import annotations

from drivers.object_dictionary import ObjectStore
from drivers.sdo_abort import VALUE_RANGE, SdoAbort

INDEX = 0x1003


class ErrorHistory:
    """Keeps 1003h of a store; its depth is the number of sub-indices the EDS gives it."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._depth = max(subindex for index, subindex in store.entries if index == INDEX)
        store.on_write(INDEX, 0, self._clear)

    def push(self, error: int) -> None:
        """Put an error first (EMCY code in the low word); the oldest falls out when the field is full."""
        count = self._store.number(INDEX, 0)
        kept = [self._store.number(INDEX, subindex) for subindex in range(1, count + 1)]
        recent = [error, *kept][: self._depth]
        for subindex, value in enumerate(recent, 1):
            self._store.set_number(INDEX, subindex, value)
        self._store.set_number(INDEX, 0, len(recent))

    def _clear(self, data: bytes) -> None:
        if data != b"\0":
            raise SdoAbort(VALUE_RANGE)
        for subindex in range(1, self._depth + 1):
            self._store.set_number(INDEX, subindex, 0)
