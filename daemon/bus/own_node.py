"""jtqd as a CANopen node (20h): its object dictionary, readable by any master.

The loop sends the node's PDO and heartbeat. This module answers SDO requests from the snapshot, the state of the bus and the
configuration. It runs in the supervisor, so that no SDO client can delay a cycle.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from functools import partial, reduce
from math import inf, isfinite, nan
from operator import or_

from jtqd.daemon.config import Config
from jtqd.daemon.core.estimate_pdo import contact_field, field
from jtqd.daemon.shared.conditions import Change
from jtqd.daemon.shared.counters import OBJECT_2200, RECORDER_LOST
from jtqd.daemon.shared.cycle_record import FLAG_CONTACT, FLAG_CONTACT_KNOWN
from jtqd.daemon.shared.snapshot import NO_ZEROS, SnapshotReader, View
from jtqd.drivers.boot_node import signature
from jtqd.drivers.emcy import COMMUNICATION, EMCY, GENERIC, NO_ERROR, ErrorHistory
from jtqd.drivers.object_dictionary import ObjectStore, SdoServer
from jtqd.drivers.own_objects import (
    BUS_FIELDS,
    JOINT_PARAMETERS,
    PARAMETERS,
    VERSION,
    ZERO_FIELDS,
    ZEROS,
    contact_tpdos,
    room_for,
)
from jtqd.drivers.pdo import INVALID as PDO_INVALID
from jtqd.drivers.pdo import NO_RTR
from jtqd.estimator.settings import age_ms
from jtqd.estimator.status import CONTACT_NONE, CONTACT_OFF, CONTACT_PRESENT, CONTACT_UNKNOWN, OFF, STALE

_STANDSTILL_S = 0.2
"""A loop whose snapshot has not moved for so long is not running (it moves every 8 cycles)."""
_MS_TO_INHIBIT = 10
"""1015h is in 100 us."""


class OwnNode:
    """Object dictionary (`store`, from the EDS of `own_sheet`) and SDO server.

    Attributes:
        recorder_lost: cycles that are in no log.
        bus: values of 2205h, in the order of `own_objects.BUS_FIELDS`.
        nodes: value of 2206h by node-ID: NMT state, heartbeat (`jtqd.daemon.bus.nodes`), configured.
        emergencies: value of 2207h by node-ID: code, register, number of messages.
    """

    def __init__(self, store: ObjectStore, config: Config, reader: SnapshotReader) -> None:
        self._reader, self._store, self._server = reader, store, SdoServer(store)
        self._last_cycle, self._last_change = -1, time.monotonic()
        self.recorder_lost = self._asked = 0
        self.bus: Callable[[], tuple[int, ...]] = lambda: (0,) * len(BUS_FIELDS)
        self.nodes: Callable[[int], tuple[int, int, int]] = lambda _node: (0, 0, 0)
        self.emergencies: Callable[[int], tuple[int, int, int]] = lambda _node: (0, 0, 0)
        self._joints = len(config.joints)
        self._room = room_for(self._joints)
        self._watched = {sub: joint.node_id for sub, joint in enumerate(config.joints, start=1)}
        if config.sensor is not None:
            self._watched[self._room + 1] = config.sensor.node_id
        self._connect_objects()
        self._set_parameters(config)

    def answer(self, request: bytes) -> bytes | None:
        """Return the SDO answer to a frame 600h + node-ID, or None."""
        return self._server.handle(request)

    def watch(self, cycle: int) -> None:
        """Take the cycle number of each reading of the snapshot, so that values of a stalled loop do not look new."""
        if cycle != self._last_cycle:
            self._last_cycle, self._last_change = cycle, time.monotonic()

    def _connect_objects(self) -> None:
        store = self._store
        for joint in range(self._room):
            store.on_read(0x2100, joint + 1, partial(self._field, joint, 0))
            store.on_read(0x2101, joint + 1, partial(self._field, joint, 1))
            store.on_read(0x2104, joint + 1, partial(self._latched, joint))
            store.on_read(0x2106, joint + 1, partial(self._contact, joint, 0))
        pairs = zip(range(0, self._room, 2), (0x2102, 0x2105), (0x2107, 0x2108), strict=False)
        for pair, statuses, contacts in pairs:
            store.on_read(statuses, 0, partial(self._nibbles, self._field, pair, 2))
            store.on_read(contacts, 0, partial(self._nibbles, self._contact, pair, 1))
        store.on_read(0x2103, 0, lambda: self._reader.read().sync_counter)
        store.on_read(0x2110, 0, lambda: int(self._asked > self._reader.resets_done))
        store.on_write(0x2110, 0, self._reset)
        for sub, name in enumerate(OBJECT_2200, start=1):
            store.on_read(0x2200, sub, partial(self._counter, name))
        for sub, share in enumerate((0.5, 0.99, 1.0), start=1):
            store.on_read(0x2201, sub, partial(self._work_us, share))
        for sub in range(len(BUS_FIELDS)):
            store.on_read(0x2205, sub + 1, partial(self._bus, sub))
        for number, index in enumerate(ZEROS[: self._room]):
            for sub, name in enumerate(ZERO_FIELDS, start=1):
                store.on_read(index, sub, partial(self._zero, number, name))
            store.on_read(0x220E, number + 1, partial(self._zero, number, "flags"))
            store.on_read(0x220F, number + 1, partial(self._zero, number, "jumps"))
        for sub, node in self._watched.items():
            store.on_read(0x2206, sub, partial(self._node, node))
            store.on_read(0x2207, sub, partial(self._emergency, node))

    def _zero(self, joint: int, name: str) -> float:
        """Return a value of `jtqd.estimator.status.Zeros`."""
        zeros = self._reader.read().zeros
        value: float = getattr(zeros[joint] if joint < len(zeros) else NO_ZEROS, name)
        return value

    def _field(self, joint: int, part: int) -> int:
        """Return torque (0), sigma (1) or status (2) of a joint as on the bus."""
        if joint >= self._joints:
            return field(nan, inf, OFF)[part]
        view = self._reader.read()
        if self._stands_still(view):
            return field(nan, inf, STALE)[part]
        last = view.joints[joint]
        return field(last.torque_nm, last.sigma_nm, last.status)[part]

    def _stands_still(self, view: View) -> bool:
        """Return whether the loop's last estimate is old."""
        return view.cycle == self._last_cycle and time.monotonic() - self._last_change > _STANDSTILL_S

    @staticmethod
    def _nibbles(part_of: Callable[[int, int], int], pair: int, part: int) -> int:
        """Return the byte of status or contact of the PDO that begins with joint `pair`."""
        return part_of(pair, part) | part_of(pair + 1, part) << 4

    def _contact(self, joint: int, part: int) -> int:
        """Return torque rate (0) or code (1) of a joint as in the contact PDO."""
        if joint >= self._joints or not self._watches:
            return contact_field(nan, nan, CONTACT_OFF)[part]
        view = self._reader.read()
        if self._stands_still(view):
            return contact_field(nan, nan, CONTACT_UNKNOWN)[part]
        last = view.joints[joint]
        code = CONTACT_NONE if last.input_flags & FLAG_CONTACT_KNOWN else CONTACT_UNKNOWN
        if last.input_flags & FLAG_CONTACT:
            code = CONTACT_PRESENT
        return contact_field(last.torque_rate_nm_s, last.contact_nm, code)[part]

    def _latched(self, joint: int) -> int:
        """Return the latched bits of `daemon/shared/cycle_record.py`."""
        return self._reader.read().joints[joint].latched if joint < self._joints else 0

    def _reset(self, data: bytes) -> None:
        """Release latched faults by 2110h = 1, as `jtq control reset` does."""
        if data == b"\x01":
            self._asked = self._reader.ask_reset()

    def _counter(self, name: str) -> int:
        value = self.recorder_lost if name == RECORDER_LOST.name else self._reader.count(name)
        return value & 0xFFFF_FFFF if name == "bits_worst_case" else min(value, 0xFFFF_FFFF)

    def _work_us(self, share: float) -> int:
        value = self._reader.work_us(share)[0]
        return round(value) if isfinite(value) else 0

    def _bus(self, position: int) -> int:
        return min(self.bus()[position], 0xFFFF_FFFF)

    def _node(self, node: int) -> int:
        state, heartbeat, configured = self.nodes(node)
        return node << 24 | configured << 16 | heartbeat << 8 | state

    def _emergency(self, node: int) -> int:
        code, register, count = self.emergencies(node)
        return min(count, 0xFF) << 24 | register << 16 | code

    def _set_parameters(self, config: Config) -> None:
        """Write the configuration to the objects that show it."""
        store = self._store
        store.set_text(0x100A, 0, VERSION)
        store.set_number(0x1006, 0, config.period_ns // 1000)
        store.set_number(0x1015, 0, config.emcy_inhibit_ms * _MS_TO_INHIBIT)
        for sub, node in self._watched.items():
            store.set_number(0x1016, sub, node << 16 | config.heartbeat_timeout_ms)
        store.set_number(0x1017, 0, config.heartbeat_ms)
        store.set_number(0x1019, 0, config.counter_overflow)
        self._watches = config.contact is not None
        sends = config.contact is not None and config.contact.pdo
        for number, pdo in enumerate(contact_tpdos(self._joints, config.node_id), start=2):
            store.set_number(0x1800 + number, 1, pdo.cob_id | NO_RTR | (0 if sends else PDO_INVALID))
        for sub, word in enumerate(signature(config.sha256), start=1):
            store.set_number(0x1020, sub, word)
        store.set_text(0x2204, 0, config.sha256)
        for index, joint in zip(PARAMETERS, config.joints, strict=False):
            for sub, name in enumerate(JOINT_PARAMETERS, start=1):
                of_estimate = name == "age_ms"
                network = joint.network is not None
                value = (
                    age_ms(joint.joint, config.estimator, network=network)
                    if of_estimate
                    else getattr(joint.joint, name)
                )
                store.set_number(index, sub, value)


# Its errors ------------------------------------------------------------------------------------------------------------

_FIELD = struct.Struct("<HHB")
_INHIBIT = 0x1015
_INHIBIT_UNIT_S = 1e-4
_WAITING = 64
"""Errors that may wait; there are fewer different ones than that."""

Error = tuple[int, int]
"""(code, detail)"""


class OwnErrors:
    """Errors of jtqd's own node: those present, 1001h, 1003h, and the EMCY messages, with inhibit time.

    An error is a code with a detail (which PDO, which node). There is one message when it occurs and one when it ends:
    EMCY 0000h with the register of the errors that are still present. The manufacturer's field holds code and detail:

        bytes 0..1  error code, 0000h for an end
        byte  2     error register 1001h
        bytes 3..4  the code that ended (0000h only), else 0
        bytes 5..6  detail: COB-ID or node-ID
        byte  7     joints concerned: bit 0 joint 1, bit 1 joint 2

    Between two messages passes the inhibit time 1015h. Errors that occur meanwhile wait, in order; one that has ended before
    its message could be sent has none, but it is in the history (1003h of `store`).
    """

    def __init__(self, store: ObjectStore) -> None:
        self._store = store
        self._history = ErrorHistory(store)
        self._present: dict[Error, tuple[int, int]] = {}  # -> register, joints
        self._sent: set[Error] = set()
        self._queue: dict[Error, int] = {}  # errors with a message to be sent -> joints
        self._not_before = -inf

    def follow(self, change: Change) -> None:
        """Raise or clear the error of a condition; conditions without an EMCY code are ignored."""
        emcy, subject = change.definition.emcy, change.subject
        if emcy is None:
            return
        detail = emcy.detail + subject.number
        if change.present:
            joints = subject.joints if emcy.names_joints else 0
            self.report(emcy.code, detail, joints=joints, register=emcy.register)
        else:
            self.reset(emcy.code, detail)

    @property
    def present(self) -> list[Error]:
        """The errors that are present, in order."""
        return list(self._present)

    def report(self, code: int, detail: int = 0, *, joints: int = 0, register: int = COMMUNICATION) -> bool:
        """Report an error as present; return False if it is already."""
        error = code, detail
        if error in self._present:
            return False
        self._present[error] = register | GENERIC, joints
        self._store.set_number(0x1001, 0, self.register)
        self._history.push(code | detail << 16)
        if error in self._sent:
            self._queue.pop(error, None)  # its end had not been sent: nothing has changed for a receiver
        elif len(self._queue) < _WAITING:
            self._queue[error] = joints
        return True

    def reset(self, code: int, detail: int = 0) -> bool:
        """Report the end of an error; return False if it was not present."""
        error = code, detail
        if error not in self._present:
            return False
        _, joints = self._present.pop(error)
        self._store.set_number(0x1001, 0, self.register)
        if error in self._sent:
            self._queue[error] = joints
        else:
            self._queue.pop(error, None)
        return True

    def report_once(self, code: int) -> None:
        """Report a single occurrence, such as a recovery from bus-off: an EMCY message and a history entry."""
        if self.report(code):
            del self._present[code, 0]
            self._store.set_number(0x1001, 0, self.register)

    def tick(self, now_s: float) -> bytes | None:
        """Return the EMCY message that is due (8 bytes for COB-ID 080h + node-ID) and count it as sent."""
        if not self._queue or now_s < self._not_before:
            return None
        error, joints = next(iter(self._queue.items()))
        del self._queue[error]
        self._not_before = now_s + self._store.number(_INHIBIT) * _INHIBIT_UNIT_S
        code, detail = error
        if error in self._sent and error not in self._present:
            self._sent.discard(error)
            return EMCY.pack(NO_ERROR, self.register, _FIELD.pack(code, detail & 0xFFFF, joints))
        if error in self._present:
            self._sent.add(error)
        return EMCY.pack(code, self.register | GENERIC, _FIELD.pack(0, detail & 0xFFFF, joints))

    @property
    def register(self) -> int:
        """Return the error register 1001h."""
        return reduce(or_, (bits for bits, _ in self._present.values()), 0)
