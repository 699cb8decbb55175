"""One emulated CANopen device: NMT, heartbeat, EMCY, SDO, PDOs (CiA 301). Frames and times in, frames out: no socket,
no clock.

`CanopenNode` is the device; `HeartbeatConsumer`, `Emergency` and `transmit.TransmitPdo` are its services. Times are integer
nanoseconds of one steady clock. Every method that may send returns a list of 16-byte frames. Frames of wrong length and
foreign identifiers are ignored or answered as CiA 301 requires; nothing is raised for them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from jtqd.drivers import nmt
from jtqd.drivers.emcy import (
    COMMUNICATION,
    EMCY,
    EMCY_BASE,
    GENERIC,
    HEARTBEAT_LOST,
    NO_ERROR,
    PDO_SHORT,
    SYNC_LENGTH,
    ErrorHistory,
)
from jtqd.drivers.frame import pack
from jtqd.drivers.object_dictionary import ObjectStore, SdoServer
from jtqd.drivers.pdo import LAST_SYNC_TYPE, PdoMap, PdoParameters
from jtqd.drivers.sdo import REQUEST_ID, RESPONSE_ID, SdoAbort, label
from jtqd.sim_can.transmit import NEVER_NS, TransmitPdo

_NS_PER_MS = 1_000_000

Getter = Callable[[], int]


_CONSUMER = 0x1016


class HeartbeatConsumer:
    """Heartbeat consumer, 1016h: one entry per watched node (CiA 301, 7.2.8.3.2.2).

    An entry holds the node in bits 16..22 and the time in ms in bits 0..15; both must be set. Watching starts with the
    node's first heartbeat, and again after the entry was written. `due_ns`: when the next node will be missing.
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._entries = range(1, store.number(_CONSUMER, 0) + 1)
        self._due_ns: dict[int, int] = {}  # by entry, of those that were heard
        self._missing: set[int] = set()
        self._active: set[int] = set()
        self.due_ns = NEVER_NS
        for entry in self._entries:
            store.on_write(_CONSUMER, entry, partial(self._on_write, entry))

    def heard(self, node: int, t_ns: int) -> bool:
        """Take a heartbeat of `node`; return True when it is watched and none of the watched nodes is missing."""
        watched = False
        self._active.add(node)
        for entry in self._entries:
            word = self._store.number(_CONSUMER, entry)
            period_ns = (word & 0xFFFF) * _NS_PER_MS
            if word >> 16 & 0x7F == node and period_ns:
                self._due_ns[entry] = t_ns + period_ns
                self._missing.discard(entry)
                watched = True
        self._plan()
        return watched and not self._missing

    @property
    def missing(self) -> bool:
        """Whether a watched node is missing."""
        return bool(self._missing)

    def restarted(self, node: int) -> bool:
        """Take a boot-up message of `node`; return True when it is watched and was heard before: it has forgotten us."""
        if node not in self._active:
            return False
        self._active.discard(node)
        watched = [
            entry for entry in self._due_ns if self._store.number(_CONSUMER, entry) >> 16 & 0x7F == node
        ]
        return self._miss(watched)

    def lost(self, t_ns: int) -> bool:
        """Return True when a watched node has become missing since the last call."""
        return self._miss([entry for entry, due_ns in self._due_ns.items() if t_ns >= due_ns])

    def _miss(self, entries: list[int]) -> bool:
        for entry in entries:
            del self._due_ns[entry]  # watching starts again with its next heartbeat
        self._missing.update(entries)
        self._plan()
        return bool(entries)

    def forget(self) -> None:
        """Start again after an NMT reset: no node was heard, none is missing."""
        self._due_ns.clear()
        self._missing.clear()
        self._active.clear()
        self._plan()

    def _on_write(self, entry: int, _data: bytes) -> None:
        self._due_ns.pop(entry, None)
        self._missing.discard(entry)
        self._plan()

    def _plan(self) -> None:
        self.due_ns = min(self._due_ns.values(), default=NEVER_NS)


CURRENT = 0x02  # bit of 1001h


class Emergency:
    """EMCY producer: present errors, error register 1001h, error history 1003h.

    An error is reported when it comes and not again while it lasts (CiA 301, 7.2.7).
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._history = ErrorHistory(store)
        self._present: dict[int, int] = {}  # EMCY code -> bits of the error register

    def present(self, code: int) -> bool:
        """Return whether the error is present."""
        return code in self._present

    def come(self, code: int, register: int) -> list[bytes]:
        """Add an error to 1001h and 1003h; return its EMCY, nothing when it is present already."""
        if code in self._present:
            return []
        self._present[code] = register | GENERIC
        self._history.push(code)
        return [self._message(code)]

    def gone(self, *codes: int) -> list[bytes]:
        """Remove errors; return EMCY 0000h with what is left in the register, if one of them was present."""
        over = [code for code in codes if self._present.pop(code, None) is not None]
        return [self._message(NO_ERROR)] if over else []

    def forget(self) -> None:
        """Remove all errors after an NMT reset, without an EMCY."""
        self._present.clear()
        self._store.set_number(0x1001, 0, 0)

    def _message(self, code: int) -> bytes:
        register = 0
        for bits in self._present.values():
            register |= bits
        self._store.set_number(0x1001, 0, register)
        return pack(EMCY_BASE + self._store.node_id, EMCY.pack(code, register, b""))


_VERIFY, _DOWNLOADED = 0x1020, 0x60

Handler = Callable[[int], None]


class CanopenNode:
    """Base of the bench's devices, which add getters of their process objects and handlers of their commands.

    `getters[(index, subindex)]` returns the present value of an object; SDO and TPDO read it. `handlers[(index,
    subindex)]` is called with each value that an SDO or an RPDO writes; it may refuse an SDO by raising SdoAbort.
    A change of a `quiet` object is no event for a TPDO. `due_ns`: when `tick` has something to do.
    """

    def __init__(self, store: ObjectStore) -> None:
        self.store = store
        self.node_id = store.node_id
        self.state = nmt.PRE_OPERATIONAL
        self.due_ns = 0
        self.getters: dict[tuple[int, int], Getter] = {}
        self.handlers: dict[tuple[int, int], Handler] = {}
        self.quiet: frozenset[tuple[int, int]] = frozenset()
        self._pdos = PdoParameters(store)
        self._emergency = Emergency(store)
        self._sdo = SdoServer(store)
        self._generation = -1
        self._transmit: list[TransmitPdo] = []
        self._receive: dict[int, PdoMap] = {}
        self._waiting: dict[int, bytes] = {}  # synchronous RPDOs received since the last SYNC
        self._bootup_pending = True
        self._heartbeat_due_ns = NEVER_NS
        self._heartbeat_ns = 0
        self._consumer = HeartbeatConsumer(store)
        self._sync_error_reported = False

    # For the devices ----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Tie getters and handlers to the object dictionary; called once by the device when all are there."""
        for key, getter in self.getters.items():
            self.store.on_read(*key, getter)
        for key, handler in self.handlers.items():
            layout = self.store.entry(*key).layout
            if layout is None:
                raise ValueError(f"{label(*key)} is not a number")

            def on_write(
                data: bytes, unpack: Callable[[bytes], tuple[int]] = layout.unpack, handle: Handler = handler
            ) -> None:
                handle(unpack(data)[0])

            self.store.on_write(*key, on_write)

    def on_reset(self) -> None:
        """NMT reset node: the device goes to its power-on state."""

    def on_heartbeat_lost(self) -> list[bytes]:
        """React to the loss of a watched heartbeat; EMCY and 1029h are the base's."""
        return []

    def raise_error(self, code: int, register: int) -> list[bytes]:
        """Add an error with its bits of 1001h; return the EMCY, unless the node is stopped."""
        frames = self._emergency.come(code, register)
        return [] if self.state == nmt.STOPPED else frames

    def clear_error(self, *codes: int) -> list[bytes]:
        """Remove errors; return EMCY 0000h if one of them was present and the node is not stopped."""
        frames = self._emergency.gone(*codes)
        return [] if self.state == nmt.STOPPED else frames

    def event(self) -> list[bytes]:
        """Send the event-driven TPDOs (types 254, 255) whose values have changed, and those never sent."""
        frames: list[bytes] = []
        if self.state == nmt.OPERATIONAL:
            for transmit in self._pdo_maps():
                if transmit.type > LAST_SYNC_TYPE and not (transmit.timed_only and transmit.last):
                    frame = transmit.frame()
                    if frame != transmit.last:
                        transmit.last = frame
                        frames.append(frame)
        return frames

    # From the bus -------------------------------------------------------------------------------------------

    def on_frame(self, can_id: int, data: bytes, t_ns: int) -> list[bytes]:
        """Handle any frame but SYNC: NMT, SDO request, RPDO, a watched heartbeat; others are ignored."""
        if can_id == REQUEST_ID + self.node_id:
            if self.state == nmt.STOPPED:
                return []
            return self._on_sdo(data, t_ns)
        if can_id == 0:
            return self._on_nmt(data, t_ns)
        if nmt.HEARTBEAT_BASE < can_id <= nmt.HEARTBEAT_BASE + 127:
            return self._on_heartbeat(can_id - nmt.HEARTBEAT_BASE, data, t_ns)
        if self.state == nmt.OPERATIONAL:
            self._pdo_maps()
            pdo = self._receive.get(can_id)
            if pdo is not None:
                return self._on_rpdo(pdo, data)
        return []

    def on_sync(self, data: bytes) -> list[bytes]:
        """Handle a SYNC: apply the synchronous RPDOs received before it, then send the TPDOs that are due."""
        if self.state != nmt.OPERATIONAL:
            return []
        frames: list[bytes] = []
        counter = data[0] if len(data) == 1 else 0
        if len(data) > 1 and not self._sync_error_reported:
            self._sync_error_reported = True
            frames += self.raise_error(SYNC_LENGTH, COMMUNICATION)
        transmits = self._pdo_maps()
        if self._waiting:
            self._apply_waiting()
            frames += self.after_command()
        for transmit in transmits:
            frame = transmit.on_sync(counter)
            if frame is not None:
                frames.append(frame)
        return frames

    def tick(self, t_ns: int) -> list[bytes]:
        """Serve boot-up message, heartbeat, event timers and watched heartbeats; set `due_ns` to the next of them."""
        frames: list[bytes] = []
        if self._bootup_pending:
            self._bootup_pending = False
            frames.append(nmt.heartbeat(self.node_id, nmt.BOOT_UP))
            self._plan_heartbeat(t_ns)
        if t_ns >= self._heartbeat_due_ns:
            frames.append(nmt.heartbeat(self.node_id, self.state))
            missed = (t_ns - self._heartbeat_due_ns) // self._heartbeat_ns
            self._heartbeat_due_ns += (missed + 1) * self._heartbeat_ns
        if t_ns >= self._consumer.due_ns and self._consumer.lost(t_ns):
            frames += self._on_master_lost()
        due = min(self._heartbeat_due_ns, self._consumer.due_ns)
        if self.state == nmt.OPERATIONAL:
            for transmit in self._pdo_maps():
                if transmit.type > LAST_SYNC_TYPE and transmit.period_ns:
                    if t_ns >= transmit.due_ns:
                        frames.append(transmit.frame())
                        transmit.due_ns = NEVER_NS
                    if transmit.due_ns == NEVER_NS:
                        transmit.due_ns = t_ns + transmit.period_ns
                    due = min(due, transmit.due_ns)
        self.due_ns = due
        return frames

    # Services -----------------------------------------------------------------------------------------------

    def _on_sdo(self, data: bytes, t_ns: int) -> list[bytes]:
        before = self.store.number(0x1017)
        reply = self._sdo.handle(data)
        self._forget_signature(data, reply)
        if self.store.number(0x1017) != before:
            self._plan_heartbeat(t_ns)
        self.due_ns = 0  # whatever was written, the next tick plans again
        frames = [] if reply is None else [pack(RESPONSE_ID + self.node_id, reply)]
        return frames + self.after_command()

    def _forget_signature(self, request: bytes, reply: bytes | None) -> None:
        """1020h is 0 once a communication parameter has been written after it (CiA 301, 7.5.2.22)."""
        if reply is None or reply[0] != _DOWNLOADED or len(request) != 8 or not self.store.has(_VERIFY, 1):
            return
        index = int.from_bytes(request[1:3], "little")
        if 0x1005 <= index < 0x2000 and index != _VERIFY:
            self.store.set_number(_VERIFY, 1, 0)
            self.store.set_number(_VERIFY, 2, 0)

    def after_command(self) -> list[bytes]:
        """Return a device's frames after an SDO or RPDO wrote to it (EMCY, event-driven TPDOs)."""
        return []

    def _on_nmt(self, data: bytes, t_ns: int) -> list[bytes]:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return []
        command = data[0]
        self.due_ns = 0
        if command == nmt.START:
            if self._consumer.missing:
                return []  # no start before every watched node is heard again
            if self.state != nmt.OPERATIONAL:
                self.state = nmt.OPERATIONAL
                self._generation = -1
                return self.event()  # event-driven TPDOs are sent once on entering
        elif command == nmt.STOP:
            self.state = nmt.STOPPED
        elif command == nmt.ENTER_PRE_OPERATIONAL:
            self.state = nmt.PRE_OPERATIONAL
        elif command in (nmt.RESET_NODE, nmt.RESET_COMMUNICATION):
            self._reset(command == nmt.RESET_NODE)
            return self.tick(t_ns)
        return []

    def _reset(self, whole: bool) -> None:
        """Restore power-on values of the communication parameters (mapping too), or of everything; plan the boot-up."""
        self.store.restore(0x1000, 0xFFFF if whole else 0x1FFF)
        if whole:
            self.on_reset()
        self.state = nmt.PRE_OPERATIONAL
        self._sdo = SdoServer(self.store)
        self._emergency.forget()
        self._generation = -1
        self._waiting.clear()
        self._sync_error_reported = False
        self._bootup_pending = True
        self._heartbeat_due_ns = NEVER_NS
        self._consumer.forget()

    def _plan_heartbeat(self, t_ns: int) -> None:
        self._heartbeat_ns = self.store.number(0x1017) * _NS_PER_MS
        self._heartbeat_due_ns = t_ns + self._heartbeat_ns if self._heartbeat_ns else NEVER_NS

    def _on_heartbeat(self, node: int, data: bytes, t_ns: int) -> list[bytes]:
        """Return whether the error is over: when every watched node is heard again."""
        if len(data) == 1 and data[0] == nmt.BOOT_UP:
            return self._on_master_lost() if self._consumer.restarted(node) else []
        if len(data) != 1 or not self._consumer.heard(node, t_ns):
            return []
        self.due_ns = min(self.due_ns, self._consumer.due_ns)
        return self.clear_error(HEARTBEAT_LOST) if self._emergency.present(HEARTBEAT_LOST) else []

    def _on_master_lost(self) -> list[bytes]:
        frames = self.raise_error(HEARTBEAT_LOST, COMMUNICATION)
        frames += self.on_heartbeat_lost()
        behaviour = self.store.number(0x1029, 1)
        if behaviour == 0 and self.state == nmt.OPERATIONAL:
            self.state = nmt.PRE_OPERATIONAL
        elif behaviour == 2:
            self.state = nmt.STOPPED
        return frames

    def _on_rpdo(self, pdo: PdoMap, data: bytes) -> list[bytes]:
        if len(data) < pdo.length:
            return self.raise_error(PDO_SHORT, COMMUNICATION)
        if pdo.transmission_type <= LAST_SYNC_TYPE:
            self._waiting[pdo.cob_id] = data
            return []
        self._apply(pdo, data)
        return self.clear_error(PDO_SHORT) + self.after_command()

    def _apply_waiting(self) -> None:
        for cob_id, data in self._waiting.items():
            pdo = self._receive.get(cob_id)
            if pdo is not None:
                self._apply(pdo, data)
        self._waiting.clear()

    def _apply(self, pdo: PdoMap, data: bytes) -> None:
        for mapped, value in zip(pdo.objects, pdo.layout.unpack_from(data), strict=True):
            try:
                self.store.write(
                    mapped.index,
                    mapped.subindex,
                    value.to_bytes(mapped.bits // 8, "little", signed=mapped.signed),
                )
            except SdoAbort:
                continue  # a value out of range is not applied; an RPDO has no reply

    def _pdo_maps(self) -> list[TransmitPdo]:
        """Return the active TPDOs; after a change of the PDO parameters TPDOs and RPDOs are compiled again."""
        if self._generation != self._pdos.generation:
            self._generation = self._pdos.generation
            self._receive = {pdo.cob_id: pdo for pdo in self._pdos.rpdos()}
            self._transmit = [
                self._compiled(index, pdo)
                for index in self._pdos.tpdo_indices
                if (pdo := self._pdos.active_map(index)) is not None
            ]
        return self._transmit

    def _compiled(self, index: int, pdo: PdoMap) -> TransmitPdo:
        """Return a TPDO; objects without a getter are read from the store; of quiet ones alone: by its event timer alone."""
        store, keys = self.store, [(mapped.index, mapped.subindex) for mapped in pdo.objects]
        sources = tuple(self.getters.get(key) or partial(store.number, *key) for key in keys)
        start, period_ms = store.number(index, 6), store.number(index, 5)
        return TransmitPdo(pdo, sources, start, period_ms, all(key in self.quiet for key in keys))
