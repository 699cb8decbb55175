"""Request and report of the boot process as JSON; the request is checked into frozen profiles.

    {"bus": "can0", "master_node": 32, "heartbeat_ms": 100, "master_timeout_ms": 500, "answer_timeout_s": 0.5,
     "error_behaviour": 0, "reset": true,
     "sync": {"cob_id": 128, "counter_overflow": 0, "check_foreign": true},
     "nodes": [{"node": 1, "kind": "drive", "identity": {"vendor": 1953, "product": 1026}},
               {"node": 2, "kind": "drive", "given": {"6091h:1": 100}, "temperature": true, "sdo_timeout_ms": 1000},
               {"node": 3, "kind": "sensor", "channels": [1], "unit_words": {"0x00560000": 1.0}, "mandatory": false}]}

Only "bus" and "nodes" with "node" and "kind" are needed. `given` replaces objects that are then not read; `temperature` of a
drive (true: 3001h, or fields of `devices.Temperature`) asks for TPDO3; a node that is not `mandatory` may be absent.
"error_behaviour" is 1029h:1; without it the nodes keep theirs. "reset": NMT reset communication comes first.
`sdo_timeout_ms`: silence of the node after which a request is repeated.
`objects` of a drive: fields of `devices.DriveObjects`, each with those of `DriveObject`, or null; `tpdos`: TPDOs that
shall carry them (`layout.tpdos_as_json`), without it TPDO1 and TPDO2 as jtqd maps them. `torque_constant_nm_per_a`: for a
current by its torque (6077h). `by_itself`: TPDOs of transmission types 0, 254 and 255 are accepted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from jtqd.drivers.boot_procedure import BootedNode, BusSettings
from jtqd.drivers.devices import (
    JTQD_NODE,
    SYNC_COB_ID,
    DriveObject,
    DriveObjects,
    DriveProfile,
    Identity,
    Profile,
    SensorProfile,
    Temperature,
    parse_key,
)
from jtqd.drivers.layout import maps_of_json, tpdos_as_json
from jtqd.drivers.pdo import PdoError, PdoMap
from jtqd.drivers.sdo import ANSWER_S, Key
from jtqd.drivers.units import BY_TORQUE

_TOP = {
    "bus",
    "nodes",
    "master_node",
    "sync",
    "heartbeat_ms",
    "master_timeout_ms",
    "answer_timeout_s",
    "error_behaviour",
    "reset",
}
_SYNC = {"cob_id", "counter_overflow", "check_foreign"}
_NODE = {"node", "kind", "identity", "channels", "given", "unit_words", "temperature", "mandatory"}
_NODE |= {"sdo_timeout_ms", "objects", "tpdos", "torque_constant_nm_per_a", "by_itself"}
_OPTIONAL_TIMEOUT_S = 0.5
"""An optional node is not waited for any longer: it is booted again when it appears."""


class RequestError(ValueError):
    """The request itself is wrong; the message names the key, what was found and what is expected."""


@dataclass(frozen=True)
class BootRequest:
    """Which nodes to boot on which bus.

    Attributes:
        bus: CAN interface or unix:PATH.
        check_foreign_sync: refuse a bus with another SYNC producer; off when jtqd's own SYNC already runs.
        answer_timeout_s: longest wait for the answer of a mandatory node.
        optional: nodes that may be absent.
        reset: begin with NMT reset communication.
        sdo_answer_s: silence of a node after which a request is repeated, by node; ANSWER_S for the others.
    """

    bus: str
    profiles: tuple[Profile, ...]
    settings: BusSettings
    check_foreign_sync: bool = True
    answer_timeout_s: float = 0.5
    optional: frozenset[int] = frozenset()
    reset: bool = True
    sdo_answer_s: Mapping[int, float] = field(default_factory=dict)

    def timeout_s(self, node: int) -> float:
        """Return how long a node may take for its first answer."""
        longest = _OPTIONAL_TIMEOUT_S if node in self.optional else self.answer_timeout_s
        return max(min(self.answer_timeout_s, longest), self.sdo_answer_s.get(node, 0.0))

    def answer_s(self, node: int) -> float:
        """Return the silence of a node after which a request is repeated."""
        return self.sdo_answer_s.get(node, ANSWER_S)


def parse_request(raw: object) -> BootRequest:
    """Check a request as it comes from JSON. Raises RequestError."""
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
    settings = BusSettings(
        master_node=master,
        master_timeout_ms=_integer(top, "master_timeout_ms", 1, 0xFFFF, 500),
        heartbeat_ms=_integer(top, "heartbeat_ms", 1, 0xFFFF, 100),
        sync_cob_id=_integer(sync, "cob_id", 1, 0x7FF, SYNC_COB_ID),
        counter_overflow=_optional_integer(sync, "counter_overflow", 0, 240),
        error_behaviour=_optional_integer(top, "error_behaviour", 0, 2),
    )
    timeout = top.get("answer_timeout_s", 0.5)
    if isinstance(timeout, bool) or not isinstance(timeout, int | float) or not 0 < timeout <= 60:
        raise RequestError(f"answer_timeout_s: found {timeout!r}, expected seconds above 0 and at most 60")
    optional = frozenset(
        profile.node_id
        for profile, node in zip(profiles, nodes, strict=True)
        if not _boolean(node, "mandatory", default=True)
    )
    foreign = bool(sync.get("check_foreign", True))
    answers = {
        profile.node_id: _integer(node, "sdo_timeout_ms", 10, 10_000, None) * 1e-3
        for profile, node in zip(profiles, nodes, strict=True)
        if "sdo_timeout_ms" in node
    }
    reset = _boolean(top, "reset", default=True, where="request")
    return BootRequest(
        bus, profiles, settings, foreign, float(timeout), optional, reset=reset, sdo_answer_s=answers
    )


def _profile(raw: object, where: str) -> Profile:
    node = _mapping(raw, where, _NODE)
    number = _integer(node, "node", 1, 127, None, where=where)
    identity = _identity(node.get("identity"), f"{where}.identity")
    given = _given(node.get("given"), f"{where}.given")
    kind = node.get("kind")
    if kind == "drive":
        temperature = _temperature(node, where)
        objects = _objects(node.get("objects"), f"{where}.objects")
        layout = _layout(node.get("tpdos", []), number, objects, f"{where}.tpdos")
        constant = node.get("torque_constant_nm_per_a", 0.0)
        itself = _boolean(node, "by_itself", default=False, where=where)
        by_torque = objects.current.by == BY_TORQUE and not objects.current.factor
        if isinstance(constant, bool) or not isinstance(constant, int | float) or constant <= 0.0 < by_torque:
            raise RequestError(
                f"{where}.torque_constant_nm_per_a: found {constant!r}, expected a number above 0"
            )
        return DriveProfile(number, identity, given, temperature, objects, layout, float(constant), itself)
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


def _objects(raw: object, where: str) -> DriveObjects:
    """Return the objects of a drive from what `asdict` made of them; None: those of CiA 402."""
    if raw is None:
        return DriveObjects()
    names = {each.name for each in fields(DriveObjects)}
    known = {each.name for each in fields(DriveObject)}
    found = _mapping(raw, where, names)
    try:
        chosen: dict[str, Any] = {
            name: None if each is None else DriveObject(**_mapping(each, f"{where}.{name}", known))
            for name, each in found.items()
        }
        return DriveObjects(**chosen)
    except TypeError as error:
        raise RequestError(f"{where}: {error}") from error


def _layout(raw: object, node: int, objects: DriveObjects, where: str) -> tuple[PdoMap, ...]:
    """Return the TPDOs of a request. Raises RequestError."""
    if not isinstance(raw, list):
        raise RequestError(f"{where}: found {raw!r}, expected a list")
    try:
        return maps_of_json(node, raw, objects)
    except (PdoError, KeyError, TypeError, AttributeError) as error:
        raise RequestError(f"{where}: {error}") from error


def _given(raw: object, where: str) -> dict[Key, int]:
    """Return values by object: {"6091h:1": 100}."""
    try:
        return {parse_key(key): value for key, value in _integers(raw, where).items()}
    except RequestError:
        raise
    except ValueError as error:
        raise RequestError(f"{where}: {error}") from error


def _unit_words(node: Mapping[str, Any], where: str) -> dict[int, float]:
    words = _mapping(node.get("unit_words", {}), f"{where}.unit_words", None)
    try:
        return {int(word, 0): float(nm) for word, nm in words.items()}
    except (TypeError, ValueError) as error:
        raise RequestError(f"{where}.unit_words: {error}, expected words and Nm per unit") from error


def _mapping(raw: object, where: str, known: set[str] | None) -> Mapping[str, Any]:
    """Return a mapping with keys of `known` only; None: any."""
    if not isinstance(raw, dict):
        raise RequestError(f"{where}: found {raw!r}, expected a mapping")
    unknown = sorted(set(raw) - known) if known is not None else []
    if unknown:
        raise RequestError(f"{where}: unknown key {unknown[0]!r}, expected one of {sorted(known or ())}")
    return raw


def _temperature(node: Mapping[str, Any], where: str) -> Temperature | None:
    """Return the object of the joint's temperature: true for 3001h, false for none, or a mapping."""
    value = node.get("temperature", False)
    if not isinstance(value, dict):
        return Temperature() if _boolean(node, "temperature", default=False, where=where) else None
    where = f"{where}.temperature"
    known = _mapping(value, where, {"index", "subindex", "c_per_unit"})
    factor = known.get("c_per_unit")
    if isinstance(factor, bool) or not isinstance(factor, int | float) or not factor > 0.0:
        raise RequestError(f"{where}.c_per_unit: found {factor!r}, expected a number above 0")
    index = _integer(known, "index", 0x1000, 0xFFFF, None, where=where)
    return Temperature(index, _integer(known, "subindex", 0, 254, 0, where=where), float(factor))


def _boolean(mapping: Mapping[str, Any], key: str, *, default: bool, where: str = "node") -> bool:
    value = mapping.get(key, default)
    if not isinstance(value, bool):
        raise RequestError(f"{where}.{key}: found {value!r}, expected true or false")
    return value


def _integer(
    mapping: Mapping[str, Any], key: str, low: int, high: int, default: int | None, *, where: str = ""
) -> int:
    value = mapping.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        path = f"{where}.{key}" if where else key
        raise RequestError(f"{path}: found {value!r}, expected a whole number {low}..{high}")
    return value


def _optional_integer(mapping: Mapping[str, Any], key: str, low: int, high: int) -> int | None:
    return None if mapping.get(key) is None else _integer(mapping, key, low, high, None)


def _integers(raw: object, where: str, known: set[str] | None = None) -> dict[str, int]:
    """Return a mapping of 32-bit numbers; null entries are left out."""
    mapping = _mapping({} if raw is None else raw, where, known)
    kept = {key: value for key, value in mapping.items() if value is not None}
    return {key: _integer(kept, key, 0, 0xFFFF_FFFF, None, where=where) for key in kept}


def node_report(node: BootedNode) -> dict[str, object]:
    """Return one node of the report; `scaling` holds the fields of DriveScaling or SensorScaling."""
    return {
        "name": node.name,
        "device_type": node.device_type,
        "serial": node.serial,
        "scaling": asdict(node.scaling),
        "gear_ratio": node.gear_ratio,
        "tpdos": tpdos_as_json(node.tpdos),
        "configuration_sha256": node.configuration_sha256,
        "signed": node.signed,
        "watched": [list(each) for each in node.watched],
        "notes": list(node.notes),
        "boot_ups": node.boot_ups,
    }
