"""Strict nodes around the library's LocalNode: object dictionary, SDO server, NMT state and EMCY are the library's.

What the library leaves to the device is added here, as strictly as drives have been seen to be:

    mapping      only in pre-operational, only while bit 31 of the COB-ID is set, entries only while their number is 0
    reset        everything written is lost, 1019h too, but for what `keep` has stored
    1016h        counts from the first heartbeat; without it, or at a boot-up message, 8130h, and no start before it is over
    1019h        SYNC of another length than it tells is 8240h until a reset; not to be written while 1006h is set
    SYNC         a TPDO of type 1 is sent at each, with the values of that moment
    events       one of type 254 or 255 when a value has changed, not sooner than its inhibit time (1800h:3, in 100 us) after
                 the last one, and when its event timer (1800h:5, in ms) has run out
"""

from __future__ import annotations

import math
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import can
import canopen
from canopen.objectdictionary import (
    INTEGER16,
    INTEGER32,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    VISIBLE_STRING,
    ObjectDictionary,
    ODArray,
    ODRecord,
    ODVariable,
)

MASTER = 0x20
PRE_OPERATIONAL, OPERATIONAL = 127, 5
MOTOR_COUNTS, LINK_COUNTS, GEAR = 65536, 524288, 100
RATED_MNM, TORQUE_CONSTANT = 100, 0.062
"""Of the drive that tells torque as well as current: 1 A at the top of its swing."""
_WRONG_STATE, _UNSUPPORTED, _NOT_MAPPABLE, _TOO_LONG = 0x08000022, 0x06010000, 0x06040041, 0x06040042
_RANGE = 0x06090030
_SIZES = {UNSIGNED8: "B", UNSIGNED16: "H", UNSIGNED32: "I", INTEGER16: "h", INTEGER32: "i"}


@dataclass(frozen=True)
class Manners:
    """How a node behaves where devices differ.

    Attributes:
        boot_ups: boot-up messages after a reset.
        sdo_s: time for an SDO answer.
        without: objects that it does not have.
        reset_s: from a reset to its boot-up message.
        fixed: its TPDOs have a layout of the maker's (`FIXED`), and what can be written of them is nothing ("mapping";
            "event": of type 255, too) or bit 31 of the COB-ID and the transmission type ("valid"); "": all can be written.
    """

    boot_ups: int = 1
    sdo_s: float = 0.0
    without: tuple[int, ...] = ()
    reset_s: float = 0.03
    fixed: str = ""


class Cable(canopen.Network):  # type: ignore[misc]
    """The library's network, with a cable that can be cut; what it sends periodically is sent by a thread."""

    cut = False

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        if not self.cut and self.bus is not None:
            try:
                super().send_message(can_id, data, remote)
            except can.CanError:
                self.cut = True

    def notify(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if not self.cut:
            super().notify(can_id, data, timestamp)

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        return Periodic(self, can_id, data, period)


class Periodic:
    """What the library's heartbeat expects of a periodic message."""

    def __init__(self, cable: Cable, can_id: int, data: Any, period_s: float) -> None:
        self._cable, self._can_id, self._data, self._period_s = cable, can_id, data, period_s
        self._ended = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while not self._ended.wait(self._period_s):
            self._cable.send_message(self._can_id, self._data)

    def update(self, data: Any) -> None:
        self._data = data

    def stop(self) -> None:
        self._ended.set()


def variable(index: int, subindex: int, kind: int, value: Any, access: str = "rw") -> ODVariable:
    result = ODVariable(f"{index:04X}h:{subindex}", index, subindex)
    result.data_type, result.access_type, result.default = kind, access, value
    return result


def dictionary(
    numbers: dict[tuple[int, int], tuple[int, Any, str]], without: tuple[int, ...]
) -> ObjectDictionary:
    """Object dictionary of numbers (and one text) by object; records get their sub-index 0 from the caller."""
    result = ObjectDictionary()
    for index in sorted({index for index, _ in numbers} - set(without)):
        members = {sub: value for (at, sub), value in numbers.items() if at == index}
        if list(members) == [0]:
            result.add_object(variable(index, 0, *members[0]))
            continue
        group = ODArray if index in (0x1003, 0x1016) else ODRecord
        record = group(f"{index:04X}h", index)
        for sub, value in sorted(members.items()):
            record.add_member(variable(index, sub, *value))
        result.add_object(record)
    return result


def _common(device_type: int, serial: int) -> dict[tuple[int, int], tuple[int, Any, str]]:
    u8, u16, u32 = UNSIGNED8, UNSIGNED16, UNSIGNED32
    numbers: dict[tuple[int, int], tuple[int, Any, str]] = {
        (0x1000, 0): (u32, device_type, "ro"),
        (0x1001, 0): (u8, 0, "ro"),
        (0x1003, 0): (u8, 0, "rw"),
        (0x1003, 1): (u32, 0, "ro"),
        (0x1005, 0): (u32, 0x80, "rw"),
        (0x1006, 0): (u32, 0, "rw"),
        (0x1008, 0): (VISIBLE_STRING, "library drive of another make", "const"),
        (0x1014, 0): (u32, 0x80 + serial, "rw"),
        (0x1016, 0): (u8, 2, "const"),
        (0x1016, 1): (u32, 0, "rw"),
        (0x1016, 2): (u32, 0, "rw"),
        (0x1017, 0): (u16, 0, "rw"),
        (0x1018, 0): (u8, 4, "const"),
        (0x1019, 0): (u8, 0, "rw"),
        (0x1029, 0): (u8, 1, "const"),
        (0x1029, 1): (u8, 0, "rw"),
    }
    for sub, value in enumerate((0x2B5, 0x11, 0x10002, 0x7000 + serial), 1):
        numbers[0x1018, sub] = (u32, value, "ro")
    for number in range(4):
        numbers[0x1800 + number, 0] = (u8, 5, "const")
        numbers[0x1800 + number, 1] = (u32, 0xC0000180 + 0x100 * number + serial, "rw")
        numbers[0x1800 + number, 2] = (u8, 255, "rw")
        numbers[0x1800 + number, 3] = (u16, 0, "rw")
        numbers[0x1800 + number, 5] = (u16, 0, "rw")
        numbers[0x1A00 + number, 0] = (u8, 1, "rw")
        for entry in range(1, 5):
            numbers[0x1A00 + number, entry] = (u32, 0x10010008 if entry == 1 else 0, "rw")
    return numbers


FIXED = (
    (0x180, (0x60410010, 0x60640020)),
    (0x380, (0x60610008, 0x606C0020, 0x60780010)),
    (0x280, (0x10010008,)),
    (0x480, (0x60E40120,)),
)
"""TPDOs of a drive whose maker has thought of other readers: COB-IDs without the node-ID, and mapping."""
INHIBIT_MS, EVENT_TIMER_MS = 10, 30
"""Of a drive that sends by itself ("event")."""


class Tpdo(NamedTuple):
    """One that is valid, as it was when the node was started."""

    cob_id: int
    objects: list[tuple[int, int]]
    layout: str
    kind: int
    inhibit_s: float
    timer_s: float


class StrictNode:
    """One device on a bus of its own: `power_on`, `power_off`, `cable.cut`."""

    device_type = 0
    process: ClassVar[dict[tuple[int, int], tuple[int, Any, str]]] = {}
    unmappable: ClassVar[frozenset[tuple[int, int]]] = frozenset()
    cable_class: type[Cable] = Cable

    def __init__(self, number: int, open_bus: Callable[[], can.BusABC], manners: Manners) -> None:
        self.number, self.manners = number, manners
        self._open_bus = open_bus
        self._stored: dict[int, dict[int, bytes]] = {}
        self._lock = threading.RLock()
        self.errors: dict[int, int] = {}
        self.emergencies: list[int] = []
        self.silent_heartbeat = False
        self.on = False

    # Power --------------------------------------------------------------------------------------------------

    def power_on(self) -> None:
        self.cable = self.cable_class()
        self.cable.bus = self._open_bus()
        self.cable.NOTIFIER_CYCLE = 0.01
        numbers = {**_common(self.device_type, self.number), **self.process}
        if self.fixed:
            for number, (base, words) in enumerate(FIXED):
                cob_id = 0x40000000 + base + self.number
                valid = self.manners.fixed in ("mapping", "event")
                event = self.manners.fixed == "event"
                numbers[0x1800 + number, 1] = (
                    UNSIGNED32,
                    cob_id if valid else cob_id | 0x80000000,
                    "ro" if valid else "rw",
                )
                kind = 1 if valid and not event else 255
                numbers[0x1800 + number, 2] = (UNSIGNED8, kind, "ro" if valid else "rw")
                if event:
                    numbers[0x1800 + number, 3] = (UNSIGNED16, 10 * INHIBIT_MS, "ro")
                    numbers[0x1800 + number, 5] = (UNSIGNED16, EVENT_TIMER_MS, "ro")
                numbers[0x1A00 + number, 0] = (UNSIGNED8, len(words), "ro")
                for entry in range(1, 5):
                    word = words[entry - 1] if entry <= len(words) else 0
                    numbers[0x1A00 + number, entry] = (UNSIGNED32, word, "ro")
        self.node = _Local(self, dictionary(numbers, self.manners.without))
        self.cable.add_node(self.node)
        for cob_id, callback in (
            (0x000, self._on_nmt),
            (0x080, self._on_sync),
            (0x700 + MASTER, self._on_master),
        ):
            self.cable.subscribe(cob_id, callback)
        self.on = True
        self._start()
        self.cable.connect()
        threading.Thread(target=self._watch, args=(self.cable,), daemon=True).start()
        if self.manners.fixed == "event":
            threading.Thread(target=self._send_events, args=(self.cable,), daemon=True).start()

    @property
    def fixed(self) -> bool:
        """Its mapping is fixed: of drives alone."""
        return bool(self.manners.fixed) and self.device_type & 0xFFFF == 402

    def power_off(self) -> None:
        self.on = False
        self.cable.cut = True
        self.node.nmt.stop_heartbeat()
        self.cable.disconnect()

    def _start(self) -> None:
        """After power-up and after a reset: what was stored, an NMT state, boot-up messages."""
        with self._lock:
            node = self.node
            node.data_store.clear()
            for index, members in self._stored.items():
                node.data_store[index] = dict(members)
            self.errors.clear()
            self._tpdos: list[Tpdo] = []
            self._master_due = math.inf
            node.nmt.stop_heartbeat()
            node.nmt._state = 0
        for _ in range(self.manners.boot_ups):
            time.sleep(self.manners.reset_s)
            self.cable.send_message(0x700 + self.number, [0])
        node.nmt._state = PRE_OPERATIONAL
        node.nmt.start_heartbeat(self.number_of(0x1017))

    def restart(self) -> None:
        """Restart, as after a dip of the supply; returns before it has."""
        threading.Thread(target=self._start, daemon=True).start()

    def keep(self, index: int, subindex: int) -> None:
        """Store one object: it is there after a reset."""
        self._stored.setdefault(index, {})[subindex] = self.node.get_data(index, subindex)

    def number_of(self, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self.node.get_data(index, subindex), "little")

    # NMT, heartbeat, SYNC -----------------------------------------------------------------------------------

    @property
    def state(self) -> int:
        return int(self.node.nmt._state)

    def set_state(self, state: int) -> None:
        self.node.nmt._state = state
        self.node.nmt.update_heartbeat()

    def _on_nmt(self, _can_id: int, data: bytes, _timestamp: float) -> None:
        """After the library has taken the command: it knows no reset, and no error that forbids the start."""
        if len(data) != 2 or data[1] not in (0, self.number):
            return
        if data[0] in (0x81, 0x82):
            self.restart()
        elif self.state == OPERATIONAL:
            if self.errors:
                self.set_state(PRE_OPERATIONAL)
            else:
                self._tpdos = list(self._compiled())

    def _on_master(self, _can_id: int, data: bytes, timestamp: float) -> None:
        period_ms = next(
            (
                word & 0xFFFF
                for word in (self._consumer(1), self._consumer(2))
                if word >> 16 & 0x7F == MASTER and word & 0xFFFF
            ),
            0,
        )
        if not period_ms or len(data) != 1:
            return
        if data[0] == 0:  # it has restarted
            if self._master_due < math.inf:
                self.raise_error(0x8130, 0x10)
            self._master_due = math.inf
            return
        self._master_due = time.monotonic() + period_ms * 1e-3
        self.clear_error(0x8130)

    def _consumer(self, entry: int) -> int:
        return 0 if 0x1016 in self.manners.without else self.number_of(0x1016, entry)

    def _watch(self, cable: Cable) -> None:
        while self.on and self.cable is cable:
            time.sleep(0.01)
            if time.monotonic() > self._master_due:
                self._master_due = math.inf
                self.raise_error(0x8130, 0x10)

    def _on_sync(self, _can_id: int, data: bytes, timestamp: float) -> None:
        if self.state not in (PRE_OPERATIONAL, OPERATIONAL):
            return
        counts = 0x1019 not in self.manners.without and self.number_of(0x1019)
        if len(data) != (1 if counts else 0):
            self.raise_error(0x8240, 0x10)
        if self.state != OPERATIONAL:
            return
        now = time.monotonic()
        for pdo in self._tpdos:
            if pdo.kind == 1:
                self.cable.send_message(pdo.cob_id, self._data(pdo, now))

    def _data(self, pdo: Tpdo, now: float) -> bytes:
        return struct.pack(pdo.layout, *(self.value(index, subindex, now) for index, subindex in pdo.objects))

    def _send_events(self, cable: Cable) -> None:
        last: dict[int, tuple[float, bytes]] = {}
        while self.on and self.cable is cable:
            time.sleep(0.001)
            now = time.monotonic()
            for pdo in self._tpdos if self.state == OPERATIONAL else ():
                at, before = last.get(pdo.cob_id, (-math.inf, b""))
                if pdo.kind not in (254, 255) or now - at < pdo.inhibit_s:
                    continue
                data = self._data(pdo, now)
                if data != before or (pdo.timer_s and now - at >= pdo.timer_s):
                    last[pdo.cob_id] = now, data
                    cable.send_message(pdo.cob_id, data)

    # Errors -------------------------------------------------------------------------------------------------

    def raise_error(self, code: int, register: int) -> None:
        if code in self.errors:
            return
        self.errors[code] = register | 1
        self.emergencies.append(code)
        self._show()
        self.node.emcy.send(code, self._register())
        if register & 0x10 and self.state == OPERATIONAL:
            self.set_state(PRE_OPERATIONAL)

    def clear_error(self, code: int) -> None:
        if self.errors.pop(code, None) is None:
            return
        self._show()
        self.node.emcy.reset(self._register())

    def _register(self) -> int:
        register = 0
        for bits in self.errors.values():
            register |= bits
        return register

    def _show(self) -> None:
        store = self.node.data_store
        store[0x1001] = {0: bytes([self._register()])}
        last = next(reversed(self.errors), 0)
        store[0x1003] = {0: bytes([bool(last)]), 1: last.to_bytes(4, "little")}

    # Objects ------------------------------------------------------------------------------------------------

    def check_write(self, index: int, subindex: int, data: bytes) -> None:
        """Refuse what a strict device refuses, before it is stored."""
        value = int.from_bytes(data[:4], "little")
        if 0x1800 <= index < 0x1C00 and self.state != PRE_OPERATIONAL:
            raise canopen.SdoAbortedError(_WRONG_STATE)
        if 0x1800 <= index < 0x1A00:
            before = self.number_of(index, 1)
            if not before >> 31 and (subindex != 1 or (value ^ before) & 0x7FFFFFFF):
                raise canopen.SdoAbortedError(_RANGE if subindex == 1 else _UNSUPPORTED)
        elif 0x1A00 <= index < 0x1C00:
            if not self.number_of(index - 0x200, 1) >> 31:
                raise canopen.SdoAbortedError(_UNSUPPORTED)
            if subindex and self.number_of(index, 0):
                raise canopen.SdoAbortedError(_UNSUPPORTED)
            if not subindex:
                self._check_mapping(index, value)
        elif index == 0x1019 and 0x1006 not in self.manners.without and self.number_of(0x1006):
            raise canopen.SdoAbortedError(_WRONG_STATE)
        elif index == 0x1016:
            self._master_due = math.inf

    def _check_mapping(self, index: int, count: int) -> None:
        bits = 0
        for entry in range(1, count + 1):
            word = self.number_of(index, entry)
            key = word >> 16, word >> 8 & 0xFF
            kind = None if key in self.unmappable else self.process.get(key, (None,))[0]
            if kind is None or 8 * struct.calcsize(_SIZES[kind]) != word & 0xFF:
                raise canopen.SdoAbortedError(_NOT_MAPPABLE)
            bits += word & 0xFF
        if bits > 64:
            raise canopen.SdoAbortedError(_TOO_LONG)

    def _compiled(self) -> Any:
        for number in range(4):
            cob_id = self.number_of(0x1800 + number, 1)
            kind = self.number_of(0x1800 + number, 2)
            if cob_id >> 31 or kind not in (1, 254, 255):
                continue
            words = [
                self.number_of(0x1A00 + number, entry + 1)
                for entry in range(self.number_of(0x1A00 + number, 0))
            ]
            objects = [(word >> 16, word >> 8 & 0xFF) for word in words]
            layout = "<" + "".join(_SIZES[self.process[key][0]] for key in objects)
            inhibit_s = self.number_of(0x1800 + number, 3) * 1e-4
            timer_s = self.number_of(0x1800 + number, 5) * 1e-3
            yield Tpdo(cob_id & 0x7FF, objects, layout, kind, inhibit_s, timer_s)

    def value(self, index: int, subindex: int, now: float) -> int:
        raise NotImplementedError


class _Local(canopen.LocalNode):  # type: ignore[misc]
    """The library's node; its device may refuse a write, and takes its time for each SDO answer."""

    def __init__(self, device: StrictNode, objects: ObjectDictionary) -> None:
        super().__init__(device.number, objects)
        self._device = device
        self._respond = self.sdo.send_response
        self.sdo.send_response = self._later
        self._answer = self.sdo.on_request
        self.sdo.on_request = self._asked

    def _asked(self, can_id: int, data: bytes, timestamp: float) -> None:
        """A stopped or starting device does not answer."""
        if self._device.state in (PRE_OPERATIONAL, OPERATIONAL):
            self._answer(can_id, data, timestamp)

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        if check_writable:
            self._find_object(index, subindex)
            self._device.check_write(index, subindex, data)
        super().set_data(index, subindex, data, check_writable)

    def _later(self, response: bytes) -> None:
        if self._device.manners.sdo_s:
            threading.Timer(self._device.manners.sdo_s, self._respond, (bytes(response),)).start()
        else:
            self._respond(response)


class StrictDrive(StrictNode):
    """A CiA 402 drive whose motor swings to and fro; it counts its torque backwards, mA and rpm, too."""

    device_type = 0x00020192
    swing_turns: ClassVar[float] = 1.0
    statusword = 0x1237
    process: ClassVar = {
        (0x1001, 0): (UNSIGNED8, 0, "ro"),
        (0x2030, 0): (INTEGER16, 0, "ro"),
        (0x2031, 0): (INTEGER16, 0, "ro"),
        (0x6041, 0): (UNSIGNED16, 0x1237, "ro"),
        (0x6061, 0): (UNSIGNED8, 9, "ro"),
        (0x6064, 0): (INTEGER32, 0, "ro"),
        (0x606C, 0): (INTEGER32, 0, "ro"),
        (0x6075, 0): (UNSIGNED32, 5000, "rw"),
        (0x6076, 0): (UNSIGNED32, RATED_MNM, "rw"),
        (0x6077, 0): (INTEGER16, 0, "ro"),
        (0x6078, 0): (INTEGER16, 0, "ro"),
        (0x608F, 0): (UNSIGNED8, 2, "const"),
        (0x608F, 1): (UNSIGNED32, MOTOR_COUNTS, "ro"),
        (0x608F, 2): (UNSIGNED32, 1, "ro"),
        (0x6090, 0): (UNSIGNED8, 2, "const"),
        (0x6090, 1): (UNSIGNED32, MOTOR_COUNTS, "ro"),
        (0x6090, 2): (UNSIGNED32, 1, "ro"),
        (0x6091, 0): (UNSIGNED8, 2, "const"),
        (0x6091, 1): (UNSIGNED32, GEAR, "ro"),
        (0x6091, 2): (UNSIGNED32, 1, "ro"),
        (0x60E4, 0): (UNSIGNED8, 1, "const"),
        (0x60E4, 1): (INTEGER32, 0, "ro"),
        (0x60E6, 0): (UNSIGNED8, 1, "const"),
        (0x60E6, 1): (UNSIGNED32, LINK_COUNTS, "ro"),
        (0x60EB, 0): (UNSIGNED8, 1, "const"),
        (0x60EB, 1): (UNSIGNED32, 1, "ro"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        phase = 2.0 * math.pi * 0.2 * now
        turns = self.swing_turns * math.sin(phase)
        per_s = self.swing_turns * 2.0 * math.pi * 0.2 * math.cos(phase)
        return {
            0x1001: 0,
            0x2030: round(-1000 * math.sin(phase)),
            0x2031: round(60 * per_s),
            0x6041: self.statusword,
            0x6061: 9,
            0x6064: round(MOTOR_COUNTS * turns),
            0x606C: round(MOTOR_COUNTS * per_s),
            0x6077: round(-TORQUE_CONSTANT * math.sin(phase) * 1e6 / RATED_MNM),
            0x6078: round(200 * math.sin(phase)),
            0x60E4: round(LINK_COUNTS * turns / GEAR),
        }[index]


class StrictSensor(StrictNode):
    """A CiA 404 torque sensor with one channel in mNm."""

    device_type = 0x00020194
    process: ClassVar = {
        (0x6112, 0): (UNSIGNED8, 1, "const"),
        (0x6112, 1): (UNSIGNED8, 1, "rw"),
        (0x6131, 0): (UNSIGNED8, 1, "const"),
        (0x6131, 1): (UNSIGNED32, 0x00230000, "rw"),
        (0x6132, 0): (UNSIGNED8, 1, "const"),
        (0x6132, 1): (UNSIGNED8, 3, "rw"),
        (0x6150, 0): (UNSIGNED8, 1, "const"),
        (0x6150, 1): (UNSIGNED8, 0, "ro"),
        (0x9130, 0): (UNSIGNED8, 1, "const"),
        (0x9130, 1): (INTEGER32, 0, "ro"),
    }

    def value(self, index: int, subindex: int, now: float) -> int:
        return round(2000 * math.sin(2.0 * math.pi * 0.2 * now)) if index == 0x9130 else 0
