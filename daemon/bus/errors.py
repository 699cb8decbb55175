"""Errors on the bus: state of the CAN controller, EMCY of the nodes, and jtqd's own EMCY with 1001h and 1003h. Pure.

`BusState` follows the error messages of the controller's driver. `EmcyLog` keeps what the nodes report. `OwnErrors` shows
jtqd's conditions (`jtqd.daemon.shared.conditions`) as those of a CANopen node.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from math import inf
from typing import NamedTuple

from jtqd.daemon.shared.conditions import Change
from jtqd.daemon.shared.events import RateLimit
from jtqd.drivers.emcy import COMMUNICATION, EMCY, GENERIC, NO_ERROR, Emergency, ErrorHistory, describe, parse
from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.own_objects import BUS_FIELDS

ACTIVE, WARNING, PASSIVE, BUS_OFF, DOWN = 0, 1, 2, 3, 4
STATE_NAMES = ("error active", "error warning", "error passive", "bus-off", "interface down")

# Classes of the error message, in its identifier
_TX_TIMEOUT, _LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _TRANSCEIVER = 0x01, 0x02, 0x04, 0x08, 0x10
_NO_ACK, _BUS_OFF, _BUS_ERROR, _RESTARTED, _COUNTERS = 0x20, 0x40, 0x80, 0x100, 0x200
# data[1] of _CONTROLLER
_OVERFLOW, _WARNING_BITS, _PASSIVE_BITS, _ACTIVE_BIT = 0x03, 0x0C, 0x30, 0x40


class BusChange(NamedTuple):
    """The state has changed from `before` to `after`."""

    before: int
    after: int


class BusState:
    """State of the CAN controller and counts of one interface, from the error messages of its driver (linux/can/error.h).

    The kernel's driver sends them as frames with CAN_ERR_FLAG to sockets that ask for them: error warning, error passive,
    bus-off and restart, lost arbitration, missing acknowledge, protocol errors, overruns, and where it can the two error
    counters. vcan and the unix hub make none, but carry those that a node sends.

    Attributes:
        counts: by the names of `BUS_FIELDS`.
    """

    def __init__(self) -> None:
        self.counts = dict.fromkeys(BUS_FIELDS, 0)

    @property
    def state(self) -> int:
        """ACTIVE .. DOWN."""
        return self.counts["state"]

    def values(self) -> tuple[int, ...]:
        """Return the values in the order of `BUS_FIELDS`."""
        return tuple(self.counts.values())

    def error_frame(self, can_id: int, data: bytes) -> BusChange | None:
        """Take one message of the driver and return the change of state, if any; a short one is read as far as possible."""
        counts = self.counts
        data = data.ljust(8, b"\0")
        for bit, name in (
            (_TX_TIMEOUT, "tx_timeouts"),
            (_LOST_ARBITRATION, "arbitration_lost"),
            (_TRANSCEIVER, "transceiver"),
            (_NO_ACK, "no_acknowledge"),
        ):
            counts[name] += bool(can_id & bit)
        counts["protocol_errors"] += bool(can_id & (_PROTOCOL | _BUS_ERROR))
        if can_id & _COUNTERS:
            counts["tx_errors"], counts["rx_errors"] = data[6], data[7]
        if can_id & _CONTROLLER and data[1] & _OVERFLOW:
            counts["overruns"] += 1
        if can_id & _RESTARTED:
            counts["restarts"] += 1
            return self._become(ACTIVE)
        if can_id & _BUS_OFF:
            return self._become(BUS_OFF)
        if can_id & _CONTROLLER:
            return self._controller(data[1])
        return None

    def down(self) -> BusChange | None:
        """Note that the interface is down (ENETDOWN)."""
        return self._become(DOWN)

    def alive(self) -> BusChange | None:
        """Note a received frame: the interface is up, and its controller is not bus-off.

        Some drivers report no restart, and an interface that was set up starts error active without a message.
        """
        return self._become(ACTIVE) if self.state in (BUS_OFF, DOWN) else None

    def _controller(self, bits: int) -> BusChange | None:
        if bits & _PASSIVE_BITS:
            return self._become(PASSIVE)
        if bits & _WARNING_BITS:
            return self._become(WARNING)
        return self._become(ACTIVE) if bits & _ACTIVE_BIT else None

    def _become(self, state: int) -> BusChange | None:
        before = self.state
        if state == before:
            return None
        self.counts["state"] = state
        name = {WARNING: "warnings", PASSIVE: "passives", BUS_OFF: "bus_offs", DOWN: "downs"}.get(state)
        if name is not None:
            self.counts[name] += 1
        return BusChange(before, state)


class _Node:
    def __init__(self) -> None:
        self.last: Emergency | None = None
        self.count = 0
        self.limit = RateLimit()


class EmcyLog:
    """EMCY messages of these nodes: the last one of each, how many, and few lines. Those of other nodes are ignored.

    There is a line at once for the first message of a code; repetitions are counted and mentioned in the next line, so that
    a storm is a few lines in five seconds.
    """

    def __init__(self, nodes: Iterable[int]) -> None:
        self._nodes = {node: _Node() for node in nodes}

    def receive(self, node: int, data: bytes, now_s: float) -> str | None:
        """Take a message and return the line to be logged, if any."""
        seen = self._nodes.get(node)
        if seen is None:
            return None
        seen.last = emergency = parse(data)
        seen.count += 1
        refused = seen.limit.admit((emergency.code, emergency.register), now_s)
        if refused is None:
            return None
        over = emergency.code == NO_ERROR and not emergency.register
        what = "EMCY 0000h: error reset" if over else describe(emergency)
        return f"node {node}: {what}" + (f" ({refused} more before)" if refused else "")

    def count_of(self, node: int) -> int:
        """Return the number of messages of a node."""
        return self._nodes[node].count

    def last(self, node: int) -> Emergency | None:
        """Return the last message of a node, or None."""
        return self._nodes[node].last


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
    its message could be sent has none, but it is in the history.

    Args:
        store: its object dictionary; 1001h, 1003h and 1015h are kept and read there.
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

    def report_once(
        self, code: int, detail: int = 0, *, joints: int = 0, register: int = COMMUNICATION
    ) -> None:
        """Report a single occurrence, such as a recovery from bus-off: an EMCY message and a history entry."""
        if self.report(code, detail, joints=joints, register=register):
            del self._present[code, detail]
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
        register = 0
        for bits, _ in self._present.values():
            register |= bits
        return register
