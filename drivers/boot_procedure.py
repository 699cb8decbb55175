"""Boot of one node by SDO, in the order of CiA 302-2: device type, identity, configuration, heartbeat.

Written against `SdoAccess`, so that a node in memory boots as one on a wire does. Every value written is read
back and compared; the values found make the node's configuration hash.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from jtqd.drivers.devices import (
    EVENT_DRIVEN,
    EVENT_MS,
    JTQD_NODE,
    OPERATING_MODE_OBJECT,
    SYNC_COB_ID,
    TEMPERATURE,
    DriveProfile,
    DriveScaling,
    Identity,
    SensorProfile,
    SensorScaling,
    drive_scaling,
    parse_key,
    sensor_scaling,
)
from jtqd.drivers.pdo import CAN_ID, INVALID, NO_RTR, PdoMap
from jtqd.drivers.sdo import BootError, Key, NodeObjects, SdoAccess, mismatch

# A node's configuration as one number: the hash over all that the boot has read back, and what 1020h holds of it. Pure.


def configuration_sha256(found: Mapping[Key, int]) -> str:
    """SHA-256 over every value found, in the order of the objects."""
    lines = [f"{index:04X}h:{subindex}={value}\n" for (index, subindex), value in sorted(found.items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def signature(sha256: str) -> tuple[int, int]:
    """The two words of 1020h for a configuration: the first 64 bits of its hash, never zero (zero: not configured).

    CiA 301 calls them date and time; CiA 302-2 compares them with what the master expects and nothing else.
    """
    words = int(sha256[:8], 16), int(sha256[8:16], 16)
    return words[0] or 1, words[1] or 1


# Which of the objects that a boot has read say what a node's numbers mean: its PDOs and its scaling. Pure.
#
# They are read again in service (`daemon/bus/nodes.py`): where one has changed, the node's numbers mean
# something else than before.


_PDO_PARAMETERS = range(0x1800, 0x1C00)
"""Communication and mapping parameters of TPDOs (CiA 301)."""


def watched_objects(found: Mapping[Key, int], scaling: Collection[Key]) -> tuple[tuple[int, int, int], ...]:
    """(index, sub-index, value) of the objects in `found` that belong to a TPDO, to `scaling` or to a channel's mode."""
    return tuple(
        (*key, value)
        for key, value in sorted(found.items())
        if key[0] in _PDO_PARAMETERS or key[0] == OPERATING_MODE_OBJECT or key in scaling
    )


Profile = DriveProfile | SensorProfile
_IDENTITY = (
    ("vendor", "vendor-ID", "D"),
    ("product", "product code", "M"),
    ("revision", "revision number", "N"),
    ("serial", "serial number", "O"),
)
_TPDO_COUNT = 4  # TPDOs of the predefined connection set: those not used are switched off
_SOFTWARE: Key = (0x100A, 0)
VERIFY_CONFIGURATION = 0x1020
_ERROR_BEHAVIOUR: Key = (0x1029, 1)
_ABORT_OPTION: Key = (0x6007, 0)
_INHIBIT_TIME, _EVENT_TIMER = 3, 5  # sub-indices of a PDO's communication parameter


@dataclass(frozen=True)
class BusSettings:
    """What all nodes are told. None: left alone.

    `counter_overflow` is 1019h (0: SYNC without counter). `error_behaviour` is 1029h:1, what a node does when it misses
    the master's heartbeat: 0 pre-operational, 1 nothing, 2 stopped.
    """

    master_node: int
    master_timeout_ms: int = 500
    heartbeat_ms: int = 100
    sync_cob_id: int = 0x080
    counter_overflow: int | None = None
    error_behaviour: int | None = None


@dataclass(frozen=True)
class BootedNode:
    """What a node said and now holds. `gear_ratio` is None for a sensor."""

    node_id: int
    name: str
    device_type: int
    serial: int
    scaling: DriveScaling | SensorScaling
    gear_ratio: float | None
    tpdos: tuple[PdoMap, ...]
    configuration_sha256: str
    signed: bool = False
    """1020h holds the signature of this configuration."""
    watched: tuple[tuple[int, int, int], ...] = ()
    """Objects that its PDOs and scaling depend on (`drivers/boot_procedure.py`)."""
    notes: tuple[str, ...] = ()
    """What the operator should know although nothing is wrong."""


class NodeBoot:
    """The procedure for one node. Each step raises BootError with its own letter."""

    def __init__(self, access: SdoAccess, profile: Profile, settings: BusSettings) -> None:
        self._profile, self._settings = profile, settings
        self._node = profile.node_id
        self._objects = NodeObjects(access, self._node)
        self._notes: list[str] = []

    def run(self, device_type: int) -> BootedNode:
        """All steps between `check_device_type`, whose result it takes, and error control and NMT start."""
        serial = self.check_identity()
        self.check_temperature()
        self.configure_pdos()
        self.configure_sync()
        self.configure_heartbeat()
        self.configure_error_behaviour()
        scaling, gear_ratio = self.read_scaling()
        watched = watched_objects(self._objects.found, self._profile.scaling_objects)
        sha256 = configuration_sha256(self._objects.found)
        signed = self.sign(sha256)
        name = self._objects.optional((0x1008, 0)) or b""
        return BootedNode(
            node_id=self._node,
            name=name.rstrip(b"\0").decode("ascii", "replace"),
            device_type=device_type,
            serial=serial,
            scaling=scaling,
            gear_ratio=gear_ratio,
            tpdos=self._profile.tpdos,
            configuration_sha256=sha256,
            signed=signed,
            watched=watched,
            notes=tuple(self._notes),
        )

    def check_device_type(self) -> int:
        """1000h: the low word is the number of the device profile (402, 404)."""
        found = self._objects.number((0x1000, 0), 4, letter="B")
        number = self._profile.profile_number
        if found & 0xFFFF != number:
            expected = f"profile {number} (0x....{number:04X})"
            raise mismatch(
                self._node, (0x1000, 0), "device type", expected=expected, found=f"0x{found:08X}", letter="C"
            )
        return found

    def check_identity(self) -> int:
        """1018h:1..4 against what is expected; returns the serial number (0: the device has none)."""
        serial = 0
        for subindex, (field, name, letter) in enumerate(_IDENTITY, 1):
            expected = getattr(self._profile.identity, field)
            if expected is None and field != "serial":
                continue
            raw = self._objects.optional((0x1018, subindex))
            if raw is None and expected is None:
                continue
            found = -1 if raw is None else int.from_bytes(raw[:4], "little")
            if expected is not None and found != expected:
                said = "no such object" if raw is None else f"0x{found:08X}"
                key = (0x1018, subindex)
                raise mismatch(self._node, key, name, expected=f"0x{expected:08X}", found=said, letter=letter)
            self._objects.found[0x1018, subindex] = serial = found
        self._check_software()
        return serial

    def _check_software(self) -> None:
        """100Ah; jtqd loads no programs into its nodes, so another version is refused and not replaced."""
        expected = self._profile.identity.software
        if expected is None:
            return
        raw, key, name = self._objects.optional(_SOFTWARE), _SOFTWARE, "software version"
        if raw is None:
            raise mismatch(self._node, key, name, expected=expected, found="no such object", letter="G")
        found = raw.rstrip(b"\0").decode("ascii", "replace")
        if found != expected:
            raise mismatch(self._node, key, name, expected=expected, found=found, letter="H")

    def check_temperature(self) -> None:
        """3001h of a drive that shall tell its joint's temperature; the value does not matter here."""
        profile = self._profile
        if (
            isinstance(profile, DriveProfile)
            and profile.temperature
            and self._objects.optional(TEMPERATURE) is None
        ):
            expected = "a value (the configuration asks for it)"
            what = "joint temperature"
            raise mismatch(
                self._node, TEMPERATURE, what, expected=expected, found="no such object", letter="J"
            )

    def configure_pdos(self) -> None:
        """The profile's TPDOs, each written in the order of CiA 301; other TPDOs of 1..4 are switched off."""
        wanted = {(pdo.cob_id - 0x80) // 0x100: pdo for pdo in self._profile.tpdos}
        for number in range(1, _TPDO_COUNT + 1):
            pdo = wanted.get(number)
            if pdo is None:
                self._switch_off(0x1800 + number - 1)
            else:
                self._configure_pdo(0x1800 + number - 1, pdo)

    def _switch_off(self, communication: int) -> None:
        raw = self._objects.optional((communication, 1))
        if raw is None:
            return
        cob_id = int.from_bytes(raw[:4], "little")
        self._objects.found[communication, 1] = cob_id
        if not cob_id & INVALID:
            self._objects.put((communication, 1), cob_id | INVALID, 4, "COB-ID")

    def _configure_pdo(self, communication: int, pdo: PdoMap) -> None:
        mapping = communication + 0x200
        cob_id = self._objects.number((communication, 1), 4)
        self._objects.write((communication, 1), cob_id | INVALID, 4)
        self._objects.write((mapping, 0), 0, 1)
        for entry, word in enumerate(pdo.words, 1):
            self._objects.write((mapping, entry), word, 4)
        self._objects.write((mapping, 0), len(pdo.words), 1)
        self._objects.write((communication, 2), pdo.transmission_type, 1)
        if pdo.transmission_type in EVENT_DRIVEN:
            self._configure_timer(communication)
        # the device's own RTR bit is kept: some accept one value only
        enabled = cob_id & NO_RTR | pdo.cob_id & CAN_ID
        self._objects.write((communication, 1), enabled, 4)
        # read back at the end and not after each write: a later write may undo an earlier one
        self._objects.compare((mapping, 0), len(pdo.words), 1, "number of mapped objects")
        for entry, word in enumerate(pdo.words, 1):
            self._objects.compare((mapping, entry), word, 4, "mapping entry")
        self._objects.compare((communication, 2), pdo.transmission_type, 1, "transmission type")
        self._objects.compare((communication, 1), enabled, 4, "COB-ID")

    def _configure_timer(self, communication: int) -> None:
        """Event timer, and inhibit time where the node has one: a value that flickers must not fill the bus."""
        if self._objects.optional((communication, _INHIBIT_TIME)) is not None:
            self._objects.put((communication, _INHIBIT_TIME), 10 * EVENT_MS, 2, "inhibit time in 100 us")
        self._objects.put((communication, _EVENT_TIMER), EVENT_MS, 2, "event timer in ms")

    def configure_sync(self) -> None:
        """1005h must be the SYNC that jtqd sends; 1019h tells a node that has it of the counter byte."""
        found = self._objects.number((0x1005, 0), 4)
        wanted = self._settings.sync_cob_id
        if found & CAN_ID != wanted:
            raise mismatch(
                self._node, (0x1005, 0), "COB-ID SYNC", expected=f"{wanted:03X}h", found=f"0x{found:08X}"
            )
        overflow = self._settings.counter_overflow
        if overflow is not None and self._objects.optional((0x1019, 0)) is not None:
            self._objects.put((0x1019, 0), overflow, 1, "SYNC counter overflow")

    def configure_heartbeat(self) -> None:
        """The node's heartbeat, and on drives the supervision of the master's: its loss must stop them."""
        settings = self._settings
        if isinstance(self._profile, DriveProfile):
            consumer = settings.master_node << 16 | settings.master_timeout_ms
            self._objects.put((0x1016, 1), consumer, 4, "consumer heartbeat time")
        self._objects.put((0x1017, 0), settings.heartbeat_ms, 2, "producer heartbeat time")

    def configure_error_behaviour(self) -> None:
        """1029h:1 where the node has it; a drive without, or one told to do nothing about it, is named."""
        behaviour = self._settings.error_behaviour
        if behaviour is None:
            return
        if self._objects.optional(_ERROR_BEHAVIOUR) is not None:
            self._objects.put(_ERROR_BEHAVIOUR, behaviour, 1, "error behaviour")
        if isinstance(self._profile, DriveProfile):
            option = self._objects.optional(_ABORT_OPTION)
            if option is not None and not any(option):
                self._notes.append(
                    "6007h abort connection option is 0: it does not stop when jtqd's heartbeat ends"
                )

    def sign(self, sha256: str) -> bool:
        """1020h, where the node has it: it keeps the signature until anybody changes its configuration (CiA 301)."""
        if self._objects.optional((VERIFY_CONFIGURATION, 1)) is None:
            return False
        for subindex, word in enumerate(signature(sha256), 1):
            self._objects.put((VERIFY_CONFIGURATION, subindex), word, 4, "configuration signature")
        return True

    def read_scaling(self) -> tuple[DriveScaling | SensorScaling, float | None]:
        """Scaling objects, checked for plausibility; (scaling, gear ratio)."""
        profile = self._profile
        values = {key: self._objects.number(key, 4) for key in profile.scaling_objects}
        if isinstance(profile, DriveProfile):
            return drive_scaling(profile, values)
        for channel in profile.channels:
            self._check_channel((OPERATING_MODE_OBJECT, channel))
        return sensor_scaling(profile, values), None

    def _check_channel(self, key: Key) -> None:
        mode = self._objects.optional(key)
        if mode is None:
            return
        self._objects.found[key] = found = int.from_bytes(mode[:1])
        if found != 1:
            expected = "1 (normal operation)"
            raise mismatch(self._node, key, "channel operating mode", expected=expected, found=str(found))


def reset_during_boot(node: int) -> BootError:
    """The node sent a boot-up message after it had been configured: its mapping is the default one again."""
    detail = "it restarted during boot (boot-up message): its configuration is lost"
    return BootError(node, "1000h:0", expected="no restart", found="boot-up message", detail=detail)


# The boot request as JSON, checked into frozen profiles, and the report as JSON.
#
# {"bus": "can0", "master_node": 32, "heartbeat_ms": 100, "master_timeout_ms": 500, "answer_timeout_s": 0.5,
#  "own_eds": "jtqd.eds",
#  "sync": {"cob_id": 128, "counter_overflow": 240, "check_foreign": true},
#  "nodes": [{"node": 1, "kind": "drive", "identity": {"vendor": 1953, "product": 1026}},
#            {"node": 2, "kind": "drive", "given": {"6091h:1": 100}, "temperature": true},
#            {"node": 3, "kind": "sensor", "channels": [1], "unit_words": {"0x00560000": 1.0}}]}
#
# Only "bus" and "nodes" with "node" and "kind" are needed. `given` replaces objects that are then not read;
# `temperature` of a drive asks for TPDO3 with 3001h; a node that is not `mandatory` may be absent. "error_behaviour"
# is 1029h:1; without it the nodes keep theirs.


_TOP = {
    "bus",
    "nodes",
    "master_node",
    "own_eds",
    "sync",
    "heartbeat_ms",
    "master_timeout_ms",
    "answer_timeout_s",
    "error_behaviour",
}
_NODE = {"node", "kind", "identity", "channels", "given", "unit_words", "temperature", "mandatory"}
_OPTIONAL_TIMEOUT_S = 0.5
"""An optional node is not waited for any longer: it is booted again when it appears."""
_SYNC = {"cob_id", "counter_overflow", "check_foreign"}


class RequestError(ValueError):
    """The request itself is wrong."""


@dataclass(frozen=True)
class BootRequest:
    """Which nodes to boot on which bus.

    `check_foreign_sync` is off when jtqd's own SYNC already runs. `own_eds` is a data sheet to be read for the
    caller, who then does without the parser: its entries are in the report as "own_entries".
    """

    bus: str
    profiles: tuple[Profile, ...]
    settings: BusSettings
    check_foreign_sync: bool = True
    answer_timeout_s: float = 0.5
    own_eds: str | None = None
    optional: frozenset[int] = frozenset()

    def timeout_s(self, node: int) -> float:
        """How long a node may take for an answer."""
        return (
            min(self.answer_timeout_s, _OPTIONAL_TIMEOUT_S)
            if node in self.optional
            else self.answer_timeout_s
        )


def parse_request(raw: object) -> BootRequest:
    """Checked request; RequestError names the key, what was found and what is expected."""
    top = _mapping(raw, "request", _TOP)
    bus = top.get("bus")
    if not isinstance(bus, str) or not bus:
        raise RequestError(f"bus: found {bus!r}, expected a name like can0 or unix:PATH")
    nodes = top.get("nodes")
    if not isinstance(nodes, list) or not nodes:
        raise RequestError(f"nodes: found {nodes!r}, expected a list of at least one node")
    profiles = tuple(_profile(node, f"nodes[{position}]") for position, node in enumerate(nodes))
    numbers = [profile.node_id for profile in profiles]
    master = _integer(top, "master_node", 1, 127, JTQD_NODE)
    if len({*numbers, master}) != len(numbers) + 1:
        raise RequestError(f"nodes: {numbers} and master {master}, expected different node numbers")
    sync = _mapping(top.get("sync", {}), "sync", _SYNC)
    overflow = None
    if sync.get("counter_overflow") is not None:
        overflow = _integer(sync, "counter_overflow", 0, 240, 0)
    settings = BusSettings(
        master_node=master,
        master_timeout_ms=_integer(top, "master_timeout_ms", 1, 0xFFFF, 500),
        heartbeat_ms=_integer(top, "heartbeat_ms", 1, 0xFFFF, 100),
        sync_cob_id=_integer(sync, "cob_id", 1, 0x7FF, SYNC_COB_ID),
        counter_overflow=overflow,
        error_behaviour=None
        if top.get("error_behaviour") is None
        else _integer(top, "error_behaviour", 0, 2, 0),
    )
    timeout = top.get("answer_timeout_s", 0.5)
    if isinstance(timeout, bool) or not isinstance(timeout, int | float) or not 0 < timeout <= 60:
        raise RequestError(f"answer_timeout_s: found {timeout!r}, expected seconds above 0 and at most 60")
    own_eds = top.get("own_eds")
    if own_eds is not None and not isinstance(own_eds, str):
        raise RequestError(f"own_eds: found {own_eds!r}, expected a path")
    optional = frozenset(
        profile.node_id
        for profile, node in zip(profiles, nodes, strict=True)
        if not _truth(node, "mandatory", default=True)
    )
    foreign = bool(sync.get("check_foreign", True))
    return BootRequest(bus, profiles, settings, foreign, float(timeout), own_eds, optional)


def _profile(raw: object, where: str) -> Profile:
    node = _mapping(raw, where, _NODE)
    number = _integer(node, "node", 1, 127, None, where=where)
    identity = _identity(node.get("identity"), f"{where}.identity")
    try:
        given = {
            parse_key(key): value for key, value in _integers(node.get("given"), f"{where}.given").items()
        }
    except ValueError as error:
        raise RequestError(f"{where}.given: {error}") from error
    kind = node.get("kind")
    if kind == "drive":
        return DriveProfile(number, identity, given, _truth(node, "temperature", default=False, where=where))
    if kind != "sensor":
        raise RequestError(f"{where}.kind: found {kind!r}, expected 'drive' or 'sensor'")
    channels = node.get("channels", [1])
    if channels not in ([1], [1, 2]):
        raise RequestError(f"{where}.channels: found {channels!r}, expected [1] or [1, 2]")
    return SensorProfile(number, identity, tuple(channels), given, _unit_words(node, where))


def _identity(raw: object, where: str) -> Identity:
    fields = set(asdict(Identity()))
    mapping = dict(_mapping({} if raw is None else raw, where, fields))
    software = mapping.pop("software", None)
    if software is not None and not isinstance(software, str):
        raise RequestError(f"{where}.software: found {software!r}, expected a text")
    return Identity(**_integers(mapping, where, fields), software=software)


def _truth(mapping: Mapping[str, Any], key: str, *, default: bool, where: str = "node") -> bool:
    value = mapping.get(key, default)
    if not isinstance(value, bool):
        raise RequestError(f"{where}.{key}: found {value!r}, expected true or false")
    return value


def _unit_words(node: Mapping[str, Any], where: str) -> dict[int, float]:
    words = _mapping(node.get("unit_words", {}), f"{where}.unit_words", None)
    try:
        return {int(word, 0): float(nm) for word, nm in words.items()}
    except (TypeError, ValueError) as error:
        raise RequestError(f"{where}.unit_words: {error}, expected words and Nm per unit") from error


def _mapping(raw: object, where: str, known: set[str] | None) -> Mapping[str, Any]:
    if not isinstance(raw, dict):
        raise RequestError(f"{where}: found {raw!r}, expected a mapping")
    unknown = sorted(set(raw) - known) if known is not None else []
    if unknown:
        raise RequestError(f"{where}: unknown key {unknown[0]!r}, expected one of {sorted(known or ())}")
    return raw


def _integer(
    mapping: Mapping[str, Any], key: str, low: int, high: int, default: int | None, *, where: str = ""
) -> int:
    value = mapping.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        path = f"{where}.{key}" if where else key
        raise RequestError(f"{path}: found {value!r}, expected a whole number {low}..{high}")
    return value


def _integers(raw: object, where: str, known: set[str] | None = None) -> dict[str, int]:
    """A mapping of 32-bit numbers; null entries are left out."""
    mapping = _mapping({} if raw is None else raw, where, known)
    kept = {key: value for key, value in mapping.items() if value is not None}
    return {key: _integer(kept, key, 0, 0xFFFF_FFFF, None, where=where) for key in kept}


def node_report(node: BootedNode) -> dict[str, object]:
    """One node of the report; `scaling` holds the fields of DriveScaling or SensorScaling."""
    return {
        "name": node.name,
        "device_type": node.device_type,
        "serial": node.serial,
        "scaling": asdict(node.scaling),
        "gear_ratio": node.gear_ratio,
        "tpdos": [
            {
                "cob_id": pdo.cob_id,
                "transmission_type": pdo.transmission_type,
                "words": list(pdo.words),
            }
            for pdo in node.tpdos
        ],
        "configuration_sha256": node.configuration_sha256,
        "signed": node.signed,
        "watched": [list(each) for each in node.watched],
        "notes": list(node.notes),
    }
