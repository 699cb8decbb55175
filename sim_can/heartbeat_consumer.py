"""Heartbeat consumer of an emulated device: 1016h, one entry per watched node (CiA 301, 7.2.8.3.2.2). Pure.

An entry holds the node in bits 16..22 and the time in ms in bits 0..15; both must be set. Watching starts
with the node's first heartbeat, and anew after the entry was written.
"""

from functools import partial

from drivers.object_dictionary import ObjectStore
from sim_can.transmit_pdo import NEVER_NS

_CONSUMER = 0x1016
_MS = 1_000_000


class HeartbeatConsumer:
    """Which of the watched nodes are missing. `due_ns`: when the next one will be."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._entries = range(1, store.number(_CONSUMER, 0) + 1)
        self._due_ns: dict[int, int] = {}  # by entry, of those that were heard
        self._missing: set[int] = set()
        self.due_ns = NEVER_NS
        for entry in self._entries:
            store.on_write(_CONSUMER, entry, partial(self._on_write, entry))

    def heard(self, node: int, t_ns: int) -> bool:
        """A heartbeat of `node`; True when that node is watched and none of the watched ones is missing."""
        watched = False
        for entry in self._entries:
            word = self._store.number(_CONSUMER, entry)
            period_ns = (word & 0xFFFF) * _MS
            if word >> 16 & 0x7F == node and period_ns:
                self._due_ns[entry] = t_ns + period_ns
                self._missing.discard(entry)
                watched = True
        self._plan()
        return watched and not self._missing

    def lost(self, t_ns: int) -> bool:
        """True when a watched node has become missing since the last call."""
        late = {entry for entry, due_ns in self._due_ns.items() if t_ns >= due_ns}
        for entry in late:
            del self._due_ns[entry]  # watching starts again with its next heartbeat
        self._missing |= late
        self._plan()
        return bool(late)

    def forget(self) -> None:
        """NMT reset: nobody was heard, nobody is missing."""
        self._due_ns.clear()
        self._missing.clear()
        self._plan()

    def _on_write(self, entry: int, _data: bytes) -> None:
        self._due_ns.pop(entry, None)
        self._missing.discard(entry)
        self._plan()

    def _plan(self) -> None:
        self.due_ns = min(self._due_ns.values(), default=NEVER_NS)
