"""Boot of one node by SDO, in the order of CiA 302-2: device type, identity, configuration, heartbeat.

Written against `SdoAccess`, so that a node in memory boots as one on a wire does. Every value written is read back and
compared; the values read make the node's configuration hash. No bus, no clock.

TPDOs: what is as wanted is read and not written. The first write that the drive refuses (its mapping is fixed, or a part of
it) ends the attempt: what was changed is put back, and all four TPDOs are read. Where they carry every quantity
(`drive.select_tpdos`) they are used as they are; of those jtqd writes COB-ID bit 31 (valid) and the transmission type, where
it must. Order of the writes (CiA 301, 7.5.2.36): COB-ID with bit 31 set, number of entries 0, entries, their number,
transmission type, COB-ID. All of it is read back.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Annotated

from msgspec import Meta, Struct

from jtqd.drivers.drive import (
    EVENT_MS,
    GEAR,
    DriveProfile,
    DriveScaling,
    LayoutError,
    ScalingError,
    drive_scaling,
    map_of,
    select_tpdos,
    tpdos_as_json,
)
from jtqd.drivers.object_dictionary import EdsError
from jtqd.drivers.own_objects import JTQD_NODE
from jtqd.drivers.pdo import (
    ACYCLIC,
    CAN_ID,
    EVENT_DRIVEN,
    EVERY_SYNC,
    INVALID,
    MAX_PDO_BYTES,
    NO_RTR,
    SYNC_COB_ID,
    TPDO_COUNT,
    PdoError,
    PdoMap,
    Tpdo,
    read_tpdos,
    tpdo_parameters,
    whole_entry,
)
from jtqd.drivers.sdo import (
    NO_OBJECT,
    NO_SUBINDEX,
    Key,
    SdoAbort,
    SdoAccess,
    SdoTimeout,
    label,
)
from jtqd.drivers.sensor import OPERATING_MODE_OBJECT, SensorProfile, SensorScaling, sensor_scaling

Profile = DriveProfile | SensorProfile


class BootError(Exception):
    """A node refused at boot or while it is set up; `str()` is one line with everything.

    Attributes:
        node: node number; None: the bus as a whole.
        object: "1018h:2", or what else was looked at; expected, found: as text, "" for none.
        letter: error status of CiA 302-2; "" for none. A not in the configuration, B no answer, C device type, D vendor,
            M product, N revision, O serial number, G no software version, H another one, J configuration refused or not
            taken, K no heartbeat, L was already operational.
    """

    def __init__(
        self,
        node: int | None,
        where: str,
        *,
        expected: str = "",
        found: str = "",
        letter: str = "",
        detail: str = "",
    ) -> None:
        self.node, self.object, self.expected, self.found, self.letter = node, where, expected, found, letter
        self.detail = text = detail or f"{where}: expected {expected}, found {found}"
        who = "" if node is None else f"node {node}: "
        status = f" (status {letter})" if letter else ""
        super().__init__(f"{who}{text}{status}")

    def explained(self, by: str) -> BootError:
        """Return the same error with what the node itself reports about it; "" for nothing."""
        fields = {"expected": self.expected, "found": self.found, "letter": self.letter}
        return BootError(self.node, self.object, **fields, detail=f"{self.detail}; {by}") if by else self

    def report(self) -> dict[str, object]:
        """Return it as a JSON-able mapping: node, object, expected, found, letter, message."""
        fields = {"node": self.node, "object": self.object, "expected": self.expected, "found": self.found}
        return {**fields, "letter": self.letter, "message": str(self)}


def mismatch(node: int, key: Key, name: str, *, expected: str, found: str, letter: str = "") -> BootError:
    """Return the error for an object, `name` in words, that holds another value than it must."""
    where = label(*key)
    detail = f"{where} {name}: expected {expected}, found {found}"
    return BootError(node, where, expected=expected, found=found, letter=letter, detail=detail)


class NodeObjects:
    """Objects of one node, read and written as unsigned numbers of `size` bytes; a failure is a BootError.

    values: newest value of each number that was read; the boot makes the configuration hash of them.
    """

    def __init__(self, access: SdoAccess, node: int) -> None:
        self.node = node
        self.values: dict[Key, int] = {}
        self.access = access

    def read(self, key: Key, letter: str = "") -> bytes | None:
        """Upload an object as bytes, which are not kept in `values`; None when the device does not have it."""
        found = self._upload(key, letter)
        return None if isinstance(found, SdoAbort) else found

    def best_effort(self, key: Key) -> bytes | None:
        """Upload an object that nothing depends on; None where the device gives none, for whatever reason."""
        try:
            return self.access.read(*key)
        except (SdoAbort, SdoTimeout, EdsError):
            return None

    def optional_number(self, key: Key, size: int, letter: str = "") -> int | None:
        """Upload a number; None when the device does not have it."""
        found = self._upload(key, letter)
        return None if isinstance(found, SdoAbort) else self._keep(key, found, size)

    def number(self, key: Key, size: int, letter: str = "") -> int:
        """Upload a number that the device must have."""
        found = self._upload(key, letter)
        if isinstance(found, SdoAbort):
            raise self._refused(key, "read", found, letter)
        return self._keep(key, found, size)

    def _keep(self, key: Key, raw: bytes, size: int) -> int:
        self.values[key] = value = int.from_bytes(raw[:size], "little")
        return value

    def write(self, key: Key, value: int, size: int) -> None:
        """Download a number; a negative one as its two's complement."""
        value &= (1 << 8 * size) - 1
        try:
            self.access.write(*key, value.to_bytes(size, "little"))
        except SdoTimeout as timeout:
            raise self._no_answer(key, timeout, "J") from timeout
        except SdoAbort as abort:
            raise self._refused(key, f"write of 0x{value:0{2 * size}X}", abort, "J") from abort

    def require(self, key: Key, value: int, size: int, name: str) -> None:
        """Read a number back, `name` in words, and compare it with what was written."""
        value &= (1 << 8 * size) - 1
        found = self.number(key, size, letter="J")
        if found != value:
            expected, text = (f"0x{number:0{2 * size}X}" for number in (value, found))
            raise mismatch(self.node, key, f"{name} read back", expected=expected, found=text, letter="J")

    def put(self, key: Key, value: int, size: int, name: str) -> None:
        """Write and read back."""
        self.write(key, value, size)
        self.require(key, value, size, name)

    def _upload(self, key: Key, letter: str) -> bytes | SdoAbort:
        """Return the object's bytes, or the abort of a device that does not have it."""
        try:
            return self.access.read(*key)
        except SdoTimeout as timeout:
            raise self._no_answer(key, timeout, letter) from timeout
        except SdoAbort as abort:
            if abort.code in (NO_OBJECT, NO_SUBINDEX):
                return abort
            raise self._refused(key, "read", abort, letter) from abort

    def _no_answer(self, key: Key, timeout: SdoTimeout, letter: str) -> BootError:
        where = label(*key)
        detail = str(timeout).replace("no answer", f"no answer to SDO {where}", 1)
        found = timeout.refused or "none"
        return BootError(self.node, where, expected="an answer", found=found, letter=letter, detail=detail)

    def _refused(self, key: Key, what: str, abort: SdoAbort, letter: str) -> BootError:
        """`what` is "read" or "write of 0x60640020"."""
        where, found = label(*key), str(abort)
        text = f"{where}: {what} refused: {found}"
        return BootError(
            self.node, where, expected=f"{what} accepted", found=found, letter=letter, detail=text
        )


_IDENTITY = (
    ("vendor", "vendor-ID", "D"),
    ("product", "product code", "M"),
    ("revision", "revision number", "N"),
    ("serial", "serial number", "O"),
)
_PDO_PARAMETERS = range(0x1800, 0x1C00)  # communication and mapping parameters of TPDOs
_SOFTWARE: Key = (0x100A, 0)
VERIFY_CONFIGURATION = 0x1020
_ERROR_BEHAVIOUR: Key = (0x1029, 1)
_ABORT_OPTION: Key = (0x6007, 0)
_SYNC_PRODUCER = 1 << 30  # of 1005h


NodeId = Annotated[int, Meta(ge=1, le=127)]
_Ms = Annotated[int, Meta(ge=1, le=0xFFFF)]


class Sync(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SYNC of the bus.

    Attributes:
        cob_id: 1005h must hold it.
        counter_overflow: 1019h (0: SYNC without counter); None: left alone.
        check_foreign: refuse a bus with another SYNC producer; off beside jtqd's own SYNC.
    """

    cob_id: Annotated[int, Meta(ge=1, le=0x7FF)] = SYNC_COB_ID
    counter_overflow: Annotated[int, Meta(ge=0, le=240)] | None = None
    check_foreign: bool = True


class BusSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that are the same for all nodes.

    Attributes:
        master_node: node number of jtqd, whose heartbeat the drives watch for `master_timeout_ms` (1016h:1).
        heartbeat_ms: 1017h of all nodes, and period of jtqd's own heartbeat.
        error_behaviour: 1029h:1, what a node does when it misses the master's heartbeat: 0 pre-operational, 1 nothing,
            2 stopped; None: left alone.
    """

    master_node: NodeId = JTQD_NODE
    master_timeout_ms: _Ms = 500
    heartbeat_ms: _Ms = 100
    sync: Sync = Sync()
    error_behaviour: Annotated[int, Meta(ge=0, le=2)] | None = None


@dataclass(frozen=True)
class BootedNode:
    """A node as it was identified and configured.

    Attributes:
        serial: 1018h:4; 0: the device has none.
        gear_ratio: 6091h; None for a sensor.
        configuration_sha256: of all that the boot has read (`configuration_sha256`).
        signed: 1020h holds the signature of this configuration.
        watched: objects that its PDOs and scaling depend on (`watched_objects`).
        notes: what the operator should know although nothing is wrong.
        boot_ups: its boot-up messages before it was configured: the reset of the boot is one.
    """

    node_id: int
    name: str
    device_type: int
    serial: int
    scaling: DriveScaling | SensorScaling
    gear_ratio: float | None
    tpdos: tuple[PdoMap, ...]
    configuration_sha256: str
    signed: bool = False
    watched: tuple[tuple[int, int, int], ...] = ()
    notes: tuple[str, ...] = ()
    boot_ups: int = 0

    def as_json(self) -> dict[str, object]:
        """Return it for a report; `scaling` holds the fields of DriveScaling or SensorScaling."""
        own = {name: value for name, value in vars(self).items() if name != "node_id"}
        return {**own, "scaling": asdict(self.scaling), "tpdos": tpdos_as_json(self.tpdos)}


# TPDOs

_INHIBIT_TIME, _EVENT_TIMER = 3, 5
"""Subindices of the communication parameter."""

_Row = tuple[Key, int, int, str]
"""An object of a TPDO: key, wanted value, size, name in words."""


def _mapping_rows(pdo: PdoMap, transmission_type: int) -> list[_Row]:
    """Return number of entries, entries and transmission type of a TPDO."""
    communication, mapping = tpdo_parameters(pdo.number)
    return [
        ((mapping, 0), len(pdo.words), 1, "number of mapped objects"),
        *(((mapping, entry), word, 4, "mapping entry") for entry, word in enumerate(pdo.words, 1)),
        ((communication, 2), transmission_type, 1, "transmission type"),
    ]


class TpdoSetup:
    """TPDOs of one node. `run` raises BootError for what the node lacks, refuses or does not keep.

    The values in force are in `values` of `objects` afterwards; `notes` takes what the operator should know.
    """

    def __init__(self, objects: NodeObjects, profile: Profile, notes: list[str]) -> None:
        self._objects, self._profile, self._notes = objects, profile, notes
        self._changes: list[tuple[Key, int, int]] = []  # writes: key, value before, size
        self._written: dict[Key, int] = {}

    def run(self) -> tuple[PdoMap, ...]:
        """Set up the TPDOs and return those that are used."""
        wanted = {pdo.number: pdo for pdo in self._profile.tpdos}
        try:
            for number in range(1, TPDO_COUNT + 1):
                pdo = wanted.get(number)
                if pdo is None:
                    self._switch_off(number)
                elif not self._as_wanted(pdo):
                    self._write(pdo)
        except BootError as refused:
            if not _is_refused_write(refused):
                raise
            return self._use_as_found(refused)
        return self._profile.tpdos

    def described(self) -> tuple[PdoMap, ...]:
        """Return the TPDOs with every quantity that an EDS or DCF has. Raises BootError."""
        node, profile = self._profile.node_id, self._profile
        found, unusable = self._found(only_valid=True)
        try:
            used = self._select(found)
        except LayoutError as error:
            detail = "; ".join((str(error), *unusable))
            raise BootError(node, "1A00h", expected="its mapping", found="another", detail=detail) from None
        allowed = (EVERY_SYNC, *(ACYCLIC if isinstance(profile, DriveProfile) and profile.acyclic else ()))
        for pdo in used:
            if pdo.transmission_type not in allowed and not _is_temperature(pdo):
                key, expected = (tpdo_parameters(pdo.number)[0], 2), "1, or 0, 254, 255 with max_age_ms"
                raise mismatch(node, key, "type", expected=expected, found=str(pdo.transmission_type))
        return used

    def _as_wanted(self, pdo: PdoMap) -> bool:
        """Return whether a TPDO is valid and as wanted."""
        cob_id = self._objects.number((tpdo_parameters(pdo.number)[0], 1), 4)
        count, *mapping = _mapping_rows(pdo, pdo.transmission_type)
        return (
            self._holds(count)
            and cob_id & ~NO_RTR == pdo.cob_id
            and all(self._holds(row) for row in mapping)
            and self._timers_as_wanted(pdo)
        )

    def _holds(self, row: _Row) -> bool:
        key, value, size, _ = row
        found = self._objects.number(key, size)
        return value in (found, whole_entry(found) if size == 4 else found)  # 4: a mapping entry

    def _timers_as_wanted(self, pdo: PdoMap) -> bool:
        if not _is_temperature(pdo):
            return True
        communication = tpdo_parameters(pdo.number)[0]
        inhibit = self._objects.optional_number((communication, _INHIBIT_TIME), 2)
        timer = self._objects.optional_number((communication, _EVENT_TIMER), 2)
        return inhibit in (None, 10 * EVENT_MS) and timer == EVENT_MS

    def _write(self, pdo: PdoMap) -> None:
        """Map a TPDO; `_as_wanted` has read its COB-ID."""
        objects, (communication, mapping) = self._objects, tpdo_parameters(pdo.number)
        cob_id = objects.values[communication, 1]
        self._change((communication, 1), cob_id | INVALID, 4)
        self._change((mapping, 0), 0, 1)
        for entry, word in enumerate(pdo.words, 1):
            self._change((mapping, entry), word, 4)
        self._change((mapping, 0), len(pdo.words), 1)
        self._change((communication, 2), pdo.transmission_type, 1)
        if _is_temperature(pdo):
            self._set_timers(communication)
        # the device's own RTR bit is kept: some accept one value only
        valid = cob_id & NO_RTR | pdo.cob_id
        self._change((communication, 1), valid, 4)
        # read back at the end and not after each write: a later write may undo an earlier one
        for entry in range(len(pdo.words) + 1, MAX_PDO_BYTES + 1):
            objects.values.pop((mapping, entry), None)  # not part of this mapping
        self._require_mapping(pdo, pdo.transmission_type)
        objects.require((communication, 1), valid, 4, "COB-ID")

    def _set_timers(self, communication: int) -> None:
        """Set the event timer, and the inhibit time where the node has one: a value that flickers does not fill the bus."""
        inhibit, timer = (communication, _INHIBIT_TIME), (communication, _EVENT_TIMER)
        if self._objects.read(inhibit) is not None:
            self._change(inhibit, 10 * EVENT_MS, 2)
            self._objects.require(inhibit, 10 * EVENT_MS, 2, "inhibit time in 100 us")
        self._change(timer, EVENT_MS, 2)
        self._objects.require(timer, EVENT_MS, 2, "event timer in ms")

    def _require_mapping(self, pdo: PdoMap, transmission_type: int) -> None:
        """Read mapping and transmission type back."""
        for row in _mapping_rows(pdo, transmission_type):
            if not self._holds(row):
                self._objects.require(*row)

    def _change(self, key: Key, value: int, size: int) -> None:
        """Write a number, and remember the one that it replaces."""
        before = self._written.get(key, self._objects.values.get(key))
        if before is None:
            raw = self._objects.read(key)
            before = None if raw is None else int.from_bytes(raw[:size], "little")
        self._objects.write(key, value, size)
        self._written[key] = value
        if before is not None:
            self._changes.append((key, before, size))

    def _switch_off(self, number: int) -> None:
        key = (tpdo_parameters(number)[0], 1)
        cob_id = self._objects.optional_number(key, 4)
        if cob_id is not None and not cob_id & INVALID:
            self._change(key, cob_id | INVALID, 4)
            self._objects.require(key, cob_id | INVALID, 4, "COB-ID")

    def _use_as_found(self, refused: BootError) -> tuple[PdoMap, ...]:
        """Put back what was changed and use the TPDOs as they are; raises `refused`, and why they are not enough."""
        self._put_back()
        values = self._objects.values
        for key in [key for key in values if key[0] in _PDO_PARAMETERS]:
            del values[key]  # of the attempt
        found, unusable = self._found()
        try:
            used = self._select(found)
        except LayoutError as error:
            raise refused.explained("; ".join((str(error), *unusable))) from refused
        for number in range(1, TPDO_COUNT + 1):
            if number not in {pdo.number for pdo in used}:
                try:
                    self._switch_off(number)
                except BootError as error:  # it costs bus load and no more
                    self._notes.append(f"TPDO{number} is not needed and stays on ({error.detail})")
        used = tuple(self._make_valid(pdo) for pdo in used)
        names = ", ".join(f"TPDO{pdo.number} ({pdo.cob_id:03X}h)" for pdo in used)
        self._notes.append(f"its mapping is used as it is: {names} ({refused.detail})")
        return used

    def _put_back(self) -> None:
        """Undo what the attempt has written, the last first: that is the order of CiA 301 again.

        What the drive does not take back shows when its TPDOs are read.
        """
        for change in reversed(self._changes):
            with suppress(BootError):
                self._objects.write(*change)
        self._changes.clear()
        self._written.clear()

    def _found(self, *, only_valid: bool = False) -> tuple[list[PdoMap], list[str]]:
        """Read all TPDOs that there are; return those that can be used, and why others cannot."""
        maps, unusable = [], []
        objects = NodeObjects(self._objects.access, self._profile.node_id)  # values that are not in force
        for tpdo in read_tpdos(lambda key: objects.optional_number(key, 4)):
            try:
                if tpdo.fault:
                    raise PdoError(tpdo.fault)
                if only_valid and not tpdo.on:
                    raise PdoError("it is switched off (bit 31 of its COB-ID)")
                if tpdo.extended:
                    raise PdoError(f"TPDO{tpdo.number} has a 29-bit COB-ID")
                maps.append(self._map_of(tpdo))
                self._notes += [tpdo.note] if tpdo.note else []
            except PdoError as error:
                if tpdo.words or tpdo.fault:
                    unusable.append(f"TPDO{tpdo.number}: {error}")
        return maps, unusable

    def _map_of(self, tpdo: Tpdo) -> PdoMap:
        """Return the map of a TPDO that was found; of a sensor by the objects of its own profile."""
        profile = self._profile
        if isinstance(profile, DriveProfile):
            return map_of(profile.node_id, tpdo, profile.objects)
        for pdo in profile.tpdos:
            if (pdo.number, pdo.cob_id, pdo.words) == (tpdo.number, tpdo.cob_id, tpdo.words):
                return PdoMap(pdo.cob_id, pdo.objects, tpdo.transmission_type, pdo.number)
        raise PdoError(f"it maps {', '.join(f'0x{word:08X}' for word in tpdo.words)}")

    def _select(self, found: list[PdoMap]) -> tuple[PdoMap, ...]:
        """Return the TPDOs that carry all that the profile wants. Raises LayoutError."""
        profile = self._profile
        if not isinstance(profile, DriveProfile):
            carried = {pdo.cob_id for pdo in found}
            if missing := [f"{pdo.cob_id:03X}h" for pdo in profile.tpdos if pdo.cob_id not in carried]:
                raise LayoutError(f"no TPDO is that of {', '.join(missing)}")
            return tuple(found)
        used = select_tpdos(profile.objects, found)
        if profile.temperature is None:
            return used
        (wanted,) = filter(_is_temperature, profile.tpdos)
        same = [pdo for pdo in found if (pdo.cob_id, pdo.words) == (wanted.cob_id, wanted.words)]
        if not same:
            key = label(*profile.temperature.key)
            raise LayoutError(f"no TPDO with COB-ID {wanted.cob_id:03X}h carries {key} alone (temperature)")
        return (*used, PdoMap(wanted.cob_id, wanted.objects, same[0].transmission_type, same[0].number))

    def _accept_acyclic(self, pdo: PdoMap, refused: BootError) -> bool:
        """Accept a TPDO that is not bound to SYNC, where the profile allows it; raises `refused`."""
        profile, kind = self._profile, f"transmission type {pdo.transmission_type}"
        if pdo.transmission_type not in ACYCLIC:
            raise refused.explained(f"TPDO{pdo.number} has {kind}") from refused
        if not (isinstance(profile, DriveProfile) and profile.acyclic):
            text = f"TPDO{pdo.number} has {kind}: joint_N.max_age_ms allows it"
            raise refused.explained(text) from refused
        self._notes.append(f"TPDO{pdo.number} keeps {kind}")
        return True

    def _make_valid(self, pdo: PdoMap) -> PdoMap:
        """Make a TPDO valid, and sent at each SYNC, where it is not; return it as it is in force, read once more."""
        objects, communication = self._objects, tpdo_parameters(pdo.number)[0]
        cob_id = objects.number((communication, 1), 4)
        configured = {
            each.transmission_type for each in self._profile.tpdos if each.number == pdo.number
        }.intersection(ACYCLIC)
        keeps_type = _is_temperature(pdo) or pdo.transmission_type in configured
        if pdo.transmission_type != EVERY_SYNC and not keeps_type:
            with suppress(BootError):
                if not cob_id & INVALID:
                    objects.write((communication, 1), cob_id | INVALID, 4)
            try:
                objects.write((communication, 2), EVERY_SYNC, 1)
            except BootError as refused:
                keeps_type = self._accept_acyclic(pdo, refused)
        if objects.number((communication, 1), 4) & INVALID:
            objects.put((communication, 1), cob_id & NO_RTR | pdo.cob_id, 4, "COB-ID")
        kind = pdo.transmission_type if keeps_type else EVERY_SYNC
        self._require_mapping(pdo, kind)
        return PdoMap(pdo.cob_id, pdo.objects, kind, pdo.number)


def _is_temperature(pdo: PdoMap) -> bool:
    """Return whether this is the event-driven TPDO with the temperature, whose timers jtqd sets."""
    return pdo.transmission_type in EVENT_DRIVEN and pdo.names[0] == "temperature"


def _is_refused_write(error: BootError) -> bool:
    """Return whether the node has refused a write of its TPDOs' parameters."""
    written = error.letter == "J" and error.expected.endswith(" accepted")
    return written and error.object.startswith(("18", "19", "1A", "1B"))


# The procedure


class NodeBoot:
    """The procedure for one node. Each step raises BootError with its own letter."""

    def __init__(self, access: SdoAccess, profile: Profile, settings: BusSettings) -> None:
        self._profile, self._settings = profile, settings
        self._node = profile.node_id
        self._objects = NodeObjects(access, self._node)
        self._notes: list[str] = []

    def run(self, device_type: int) -> BootedNode:
        """Do all steps between `check_device_type`, whose result it takes, and error control and NMT start."""
        objects, profile = self._objects, self._profile
        serial = self.check_identity()
        self._check_temperature()
        tpdos = self.configure_pdos()
        self.configure_sync()
        self.configure_heartbeat()
        self.configure_error_behaviour()
        scaling, gear_ratio = self.read_scaling()
        watched = watched_objects(objects.values, profile.scaling_objects)
        sha256 = configuration_sha256(objects.values)
        signed = self.sign(sha256)
        name = printable(objects.best_effort((0x1008, 0)) or b"")
        return BootedNode(
            node_id=self._node,
            name=name,
            device_type=device_type,
            serial=serial,
            scaling=scaling,
            gear_ratio=gear_ratio,
            tpdos=tpdos,
            configuration_sha256=sha256,
            signed=signed,
            watched=watched,
            notes=tuple(self._notes),
        )

    def describe(self, *, pinned: bool, eds: str) -> BootedNode:
        """Return the node as its EDS or DCF (`access`) and the configuration have it: nothing is asked, nothing is written.

        pinned: its TPDOs are those of the configuration; eds: its file, "" for none. Raises BootError for what neither has.
        """
        objects, profile = self._objects, self._profile
        missing = [label(*key) for key in profile.scaling_objects if not objects.optional_number(key, 4)]
        missing += [] if pinned or eds else ["1A00h (mapping: 'tpdos')"]
        if missing:
            detail = f"not known: {', '.join(missing)}: a guest asks no node, expected in 'given' or in a DCF ('eds')"
            raise BootError(self._node, missing[0], expected="a value", found="none", detail=detail)
        tpdos = profile.tpdos if pinned else TpdoSetup(objects, profile, self._notes).described()
        scaling, gear_ratio = self.read_scaling()
        values = {**{key: objects.values[key] for key in profile.scaling_objects}, **profile.given}
        watched = values.keys() - (
            set() if isinstance(profile, DriveProfile) and profile.counts_at_shaft else {*GEAR}
        )
        for pdo in tpdos:
            values |= {key: value for key, value, _, _ in _mapping_rows(pdo, pdo.transmission_type)}
            values[tpdo_parameters(pdo.number)[0], 1] = pdo.cob_id
        return BootedNode(
            node_id=self._node,
            name=printable(objects.best_effort((0x1008, 0)) or b""),
            device_type=profile.profile_number,
            serial=0,
            scaling=scaling,
            gear_ratio=gear_ratio,
            tpdos=tpdos,
            configuration_sha256=configuration_sha256(values),
            watched=watched_objects(values, watched),
        )

    def check_device_type(self) -> int:
        """Check 1000h, whose low word is the number of the device profile (402, 404), and return it."""
        found = self._objects.number((0x1000, 0), 4, letter="B")
        number = self._profile.profile_number
        if found & 0xFFFF != number:
            expected, text = f"profile {number} (0x....{number:04X})", f"0x{found:08X}"
            raise mismatch(self._node, (0x1000, 0), "device type", expected=expected, found=text, letter="C")
        return found

    def check_identity(self) -> int:
        """Check 1018h:1..4 and 100Ah against the profile; return the serial number (0: the device has none)."""
        serial = 0
        for subindex, (field, name, letter) in enumerate(_IDENTITY, 1):
            expected = getattr(self._profile.identity, field)
            if expected is None and field != "serial":
                continue
            key = (0x1018, subindex)
            found = self._objects.optional_number(key, 4)
            if expected is not None and found != expected:
                text = "no such object" if found is None else f"0x{found:08X}"
                raise mismatch(self._node, key, name, expected=f"0x{expected:08X}", found=text, letter=letter)
            serial = found or 0
        self._check_software()
        return serial

    def _check_software(self) -> None:
        """Check 100Ah; jtqd loads no programs into its nodes, so another version is refused and not replaced."""
        expected = self._profile.identity.software
        if expected is None:
            return
        raw, key, name = self._objects.read(_SOFTWARE), _SOFTWARE, "software version"
        if raw is None:
            raise mismatch(self._node, key, name, expected=expected, found="no such object", letter="G")
        found = printable(raw)
        if found != expected:
            raise mismatch(self._node, key, name, expected=expected, found=found, letter="H")

    def _check_temperature(self) -> None:
        """Require the object of a drive whose temperature is asked for; its value does not matter here."""
        profile = self._profile
        wanted = profile.temperature if isinstance(profile, DriveProfile) else None
        if wanted is not None and self._objects.read(wanted.key) is None:
            expected, found = "a value (required by the configuration)", "no such object"
            what = "joint temperature"
            raise mismatch(self._node, wanted.key, what, expected=expected, found=found, letter="J")

    def configure_pdos(self) -> tuple[PdoMap, ...]:
        """Set up the TPDOs and return those that are used (`TpdoSetup`)."""
        return TpdoSetup(self._objects, self._profile, self._notes).run()

    def configure_sync(self) -> None:
        """Check that 1005h is jtqd's SYNC; make 1019h tell whether it has a counter byte."""
        wanted = self._settings.sync.cob_id
        found = self._objects.optional_number((0x1005, 0), 4)
        if found is None:  # as some have it that list no 1005h
            self._notes.append(f"no 1005h: its SYNC is taken to be the default {wanted:03X}h")
            found = wanted
        if found & CAN_ID != wanted:
            expected, text = f"{wanted:03X}h", f"0x{found:08X}"
            raise mismatch(self._node, (0x1005, 0), "COB-ID SYNC", expected=expected, found=text)
        if found & _SYNC_PRODUCER:
            self._objects.put((0x1005, 0), found & ~_SYNC_PRODUCER, 4, "COB-ID SYNC")
            self._notes.append("1005h: it was a SYNC producer, which jtqd is")
        overflow, key = self._settings.sync.counter_overflow, (0x1019, 0)
        if overflow is None:
            return
        counts = self._objects.optional_number(key, 1)
        if counts is None and overflow:
            expected = f"{overflow} (sync.counter_overflow; 0 for SYNC without a counter)"
            name = "SYNC counter overflow"
            raise mismatch(self._node, key, name, expected=expected, found="no such object", letter="J")
        if counts not in (None, overflow):  # some refuse any write while 1006h is set
            self._objects.put(key, overflow, 1, "SYNC counter overflow")

    def configure_heartbeat(self) -> None:
        """Set the node's heartbeat, and on drives the supervision of the master's, whose loss must stop them."""
        settings = self._settings
        if isinstance(self._profile, DriveProfile):
            consumer = settings.master_node << 16 | settings.master_timeout_ms
            why = self._try((0x1016, 1), consumer, 4, "consumer heartbeat time")
            if why:
                self._notes.append(f"{why}: the drive does not notice when jtqd's heartbeat ends")
        self._objects.put((0x1017, 0), settings.heartbeat_ms, 2, "producer heartbeat time")
        emcy = self._objects.best_effort((0x1014, 0))
        if emcy is not None:
            cob_id, expected = int.from_bytes(emcy[:4], "little"), 0x080 + self._node
            if cob_id & (INVALID | CAN_ID) != expected:
                text = f"1014h COB-ID EMCY: expected {expected:03X}h, found 0x{cob_id:08X}"
                self._notes.append(f"{text}: its EMCY messages are not read")

    def _try(self, key: Key, value: int, size: int, name: str) -> str:
        """Write and read back what a node can do without; return why it does, "" where it has it."""
        if self._objects.best_effort(key) is None:
            return f"{label(*key)} {name}: no such object"
        try:
            self._objects.put(key, value, size, name)
        except BootError as error:
            if not error.letter:
                raise
            return error.detail
        return ""

    def configure_error_behaviour(self) -> None:
        """Set 1029h:1 where the node has it; note a drive whose 6007h lets it run on without its master."""
        behaviour = self._settings.error_behaviour
        if behaviour is None:
            return
        if self._objects.best_effort(_ERROR_BEHAVIOUR) is not None:
            why = self._try(_ERROR_BEHAVIOUR, behaviour, 1, "error behaviour")
            if why:
                self._notes.append(why)
        if isinstance(self._profile, DriveProfile):
            option = self._objects.best_effort(_ABORT_OPTION)
            if option is not None and not any(option):
                text = "6007h abort connection option is 0"
                self._notes.append(f"{text}: the drive does not stop when jtqd's heartbeat ends")

    def sign(self, sha256: str) -> bool:
        """Write the signature to 1020h where the node has it; it holds until the configuration is changed (CiA 301)."""
        if self._objects.read((VERIFY_CONFIGURATION, 1)) is None:
            return False
        for subindex, word in enumerate(signature(sha256), 1):
            self._objects.put((VERIFY_CONFIGURATION, subindex), word, 4, "configuration signature")
        return True

    def read_scaling(self) -> tuple[DriveScaling | SensorScaling, float | None]:
        """Read the scaling objects and check them for plausibility; return (scaling, gear ratio)."""
        profile = self._profile
        values = {key: self._objects.number(key, 4) for key in profile.scaling_objects}
        try:
            if isinstance(profile, DriveProfile):
                return drive_scaling(profile, values)
            for channel in profile.channels:
                self._check_channel((OPERATING_MODE_OBJECT, channel))
            return sensor_scaling(profile, values), None
        except ScalingError as error:
            found = error.found
            raise mismatch(self._node, error.key, error.name, expected=error.expected, found=found) from None

    def _check_channel(self, key: Key) -> None:
        found = self._objects.optional_number(key, 1)
        if found not in (None, 1):
            expected = "1 (normal operation)"
            raise mismatch(self._node, key, "channel operating mode", expected=expected, found=str(found))


def printable(raw: bytes) -> str:
    """Return a text of a device as lines can show it: what is no printable ASCII character is replaced."""
    text = raw.rstrip(b"\0").decode("ascii", "replace")
    return "".join(each if " " <= each <= "~" else "?" for each in text)


def reset_during_boot(node: int) -> BootError:
    """Return the error for a boot-up message after the configuration: the mapping is the default one again."""
    detail = "the node restarted during boot (boot-up message): its configuration is lost"
    return BootError(node, "1000h:0", expected="no restart", found="boot-up message", detail=detail)


def configuration_sha256(values: Mapping[Key, int]) -> str:
    """Return the SHA-256 over every value, in the order of the objects."""
    lines = [f"{index:04X}h:{subindex}={value}\n" for (index, subindex), value in sorted(values.items())]
    import hashlib  # in the boot process alone: it loads OpenSSL, 3.4 MB

    return hashlib.sha256("".join(lines).encode()).hexdigest()


def signature(sha256: str) -> tuple[int, int]:
    """Return the two words of 1020h for a configuration: the first 64 bits of its hash, never zero (not configured).

    CiA 301 calls them date and time; CiA 302-2 compares them with what the master expects and nothing else.
    """
    words = int(sha256[:8], 16), int(sha256[8:16], 16)
    return words[0] or 1, words[1] or 1


def watched_objects(values: Mapping[Key, int], scaling: Collection[Key]) -> tuple[tuple[int, int, int], ...]:
    """Return (index, sub-index, value) of all that the meaning of a node's numbers depends on.

    These are the parameters of its TPDOs, its `scaling` objects, and the operating mode of a channel. They are read again in
    service (`daemon/bus/nodes.py`): where one has changed, the node's numbers mean something else than before.
    """
    return tuple(
        (*key, value)
        for key, value in sorted(values.items())
        if key[0] in _PDO_PARAMETERS or key[0] == OPERATING_MODE_OBJECT or key in scaling
    )
