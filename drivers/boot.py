"""Boot of the bus as a short-lived process: `python -m jtqd.drivers.boot [EDS NODE-ID] < request.json > report.json`.

The request is checked into frozen profiles:

    {"bus": "can0", "master_node": 32, "heartbeat_ms": 100, "master_timeout_ms": 500, "answer_timeout_s": 0.5,
     "error_behaviour": 0, "reset": true,
     "sync": {"cob_id": 128, "counter_overflow": 0, "check_foreign": true},
     "nodes": [{"node": 1, "kind": "drive", "identity": {"vendor": 1953, "product": 1026}},
               {"node": 2, "kind": "drive", "given": {"6091h:1": 100}, "temperature": true, "sdo_timeout_ms": 1000},
               {"node": 3, "kind": "sensor", "channels": [1], "unit_words": {"0x00560000": 1.0}, "mandatory": false}]}

Only "bus" and "nodes" with "node" and "kind" are needed. `given` replaces objects that are then not read; `temperature` of a
drive (true: 3001h, or fields of `drive.Temperature`) asks for TPDO3; a node that is not `mandatory` may be absent.
"error_behaviour" is 1029h:1; without it the nodes keep theirs. "reset": NMT reset communication comes first.
`sdo_timeout_ms`: silence of the node after which a request is repeated.
`objects` of a drive: fields of `drive.DriveObjects`, each with those of `DriveObject`, or null; `tpdos`: TPDOs that
shall carry them (`drive.tpdos_as_json`), without it TPDO1 and TPDO2 as jtqd maps them. `torque_constant_nm_per_a`: for a
current by its torque (6077h). `acyclic`: TPDOs of transmission types 0, 254 and 255 are accepted.

The report is
    {"ok": true, "duration_s", "nodes": {"1": {...}}, "absent": {"3": error}}               exit status 0
    {"ok": false, "error": {"node", "object", "expected", "found", "letter", "message"}}    exit status 1
With an EDS it also has the entries of that file as "own_entries": the caller needs no parser then, which takes 20 MB.
A node that comes back is booted by the same command with a shorter list of nodes.

jtqd's heartbeat begins with its boot-up message: a drive that watches it (1016h) misses it from its configuration on. At the
first boot this process sends it, also after its report, until its standard input is closed: the loop has
taken over.
"""

from __future__ import annotations

import json
import select
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from math import inf
from typing import Any, Self

from jtqd.drivers import nmt
from jtqd.drivers.boot_node import BootedNode, BootError, BusSettings, NodeBoot, Profile, reset_during_boot
from jtqd.drivers.drive import (
    BY_TORQUE,
    DriveObject,
    DriveObjects,
    DriveProfile,
    Temperature,
    maps_of_json,
    tpdos_as_json,
)
from jtqd.drivers.emcy import EMCY_BASE, HISTORY_INDEX, Emergency, name_of, parse, register_text
from jtqd.drivers.filters import exact
from jtqd.drivers.frame import FRAME, FRAME_SIZE
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.drivers.object_dictionary import Identity, entries_to_json, read_eds
from jtqd.drivers.own_objects import JTQD_NODE
from jtqd.drivers.pdo import SYNC_COB_ID, PdoError, PdoMap
from jtqd.drivers.sdo import ANSWER_S, RESPONSE_ID, Key, SdoAbort, SdoClient, SdoTimeout, parse_key
from jtqd.drivers.sensor import SensorProfile

# The request

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
_NODE |= {"sdo_timeout_ms", "objects", "tpdos", "torque_constant_nm_per_a", "acyclic"}
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
        itself = _boolean(node, "acyclic", default=False, where=where)
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


# The boot

_BOOT_UP_AGAIN_S = 0.05
"""After a reset: some devices send their boot-up message twice."""
_ATTEMPTS = 3
"""At the configuration of a node that sends its boot-up message again meanwhile."""
_REPORT_S = 0.25
"""For each object by which a node that failed explains itself."""
_LONGEST_HOLD_S = 60.0
"""After its report this process sends heartbeats for so long at most."""
_POLL_S = 0.02
"""Between two looks at standard input."""
SYNC_LISTEN_S = 0.12  # a little more than the longest period that jtqd itself may have
_SILENCES = 2.6
"""Of a node's longest silence: two repetitions of a request, and half of it again."""


@dataclass(frozen=True)
class BootReport:
    """A boot that went well: `nodes` are operational and configured, `absent` are optional ones and why they are not."""

    nodes: dict[int, BootedNode]
    duration_s: float
    absent: dict[int, BootError]

    def as_json(self) -> dict[str, Any]:
        """Return the report for JSON."""
        nodes = {str(number): node_report(node) for number, node in self.nodes.items()}
        absent = {str(number): error.report() for number, error in self.absent.items()}
        return {"ok": True, "duration_s": round(self.duration_s, 4), "nodes": nodes, "absent": absent}


class BootBus:
    """A frame socket that keeps what the nodes send during the boot, and sends jtqd's heartbeat while it waits.

    It receives the nodes' answers, heartbeats and EMCY; in a first boot also SYNC and frames of jtqd's own node-ID, whose
    other producers make the boot refuse the bus. All methods raise BusError.

    Attributes:
        frames: of the last `receive`, as of a FrameSocket.
        states: newest NMT state of each node since `forget`.
        restarted: nodes with a boot-up message since `forget`.
        boot_ups: boot-up messages of each node.
        emergencies: last EMCY message of each node.
    """

    def __init__(self, request: BootRequest) -> None:
        self._settings, self._first = request.settings, request.check_foreign_sync
        self.states: dict[int, int] = {}
        self.restarted: set[int] = set()
        self.boot_ups: Counter[int] = Counter()
        self.emergencies: dict[int, Emergency] = {}
        self._syncs = self._own_ids = 0
        self._own_id = nmt.HEARTBEAT_BASE + request.settings.master_node
        bases = RESPONSE_ID, nmt.HEARTBEAT_BASE, EMCY_BASE
        identifiers = [base + profile.node_id for profile in request.profiles for base in bases]
        if self._first:
            identifiers += [request.settings.sync_cob_id, self._own_id]
        self._socket = open_frame_socket(request.bus, [exact(each) for each in identifiers])
        self.frames = self._socket.frames
        self._since, self._beat_due = time.monotonic(), inf

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, frame16: bytes) -> bool:
        """Send a frame. Raises BusError also when the transmit queue is full: no other node acknowledges."""
        if not self._socket.send(frame16):
            raise BusError(f"{self._socket.bus}: the transmit queue is full: no node acknowledges")
        return True

    def wait(self, timeout_s: float | None) -> bool:
        """Wait for frames, and send the heartbeats that are due meanwhile."""
        end = inf if timeout_s is None else time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            if now >= self._beat_due:
                self._socket.send(nmt.heartbeat(self._settings.master_node, nmt.PRE_OPERATIONAL))
                self._beat_due = now + self._settings.heartbeat_ms * 1e-3
            if self._socket.wait(max(min(end, self._beat_due) - now, 0.0)):
                return True
            if time.monotonic() >= end:
                return False

    def receive(self) -> int:
        """Take the frames that have arrived; return their number."""
        count = self._socket.receive()
        for position in range(count):
            can_id, length, data = FRAME.unpack_from(self.frames, FRAME_SIZE * position)
            self._observe(can_id, data[:length])
        return count

    def run(self, timeout_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive until `until()`; False: it did not come true within `timeout_s`."""
        end = time.monotonic() + timeout_s
        while not until():
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            if self.wait(left):
                self.receive()
        return True

    def _observe(self, can_id: int, data: bytes) -> None:
        if can_id == self._own_id:
            self._own_ids += 1
        elif can_id >= nmt.HEARTBEAT_BASE:
            if len(data) == 1:
                self._on_heartbeat(can_id - nmt.HEARTBEAT_BASE, data[0])
        elif can_id == self._settings.sync_cob_id:
            self._syncs += 1
        elif can_id < RESPONSE_ID:
            self.emergencies[can_id - EMCY_BASE] = parse(data)

    def _on_heartbeat(self, node: int, state: int) -> None:
        self.states[node] = state & 0x7F
        if state == nmt.BOOT_UP:
            self.restarted.add(node)
            self.boot_ups[node] += 1

    def forget(self, node: int) -> None:
        """Discard the node's state and boot-up messages so far."""
        self.states.pop(node, None)
        self.restarted.discard(node)

    def state(self, node: int, wanted: int | None, timeout_s: float) -> int | None:
        """Return the newest state once it is `wanted` (None: any), or what it is after `timeout_s`."""
        self.run(timeout_s, lambda: node in self.states and wanted in (None, self.states[node]))
        return self.states.get(node)

    def command(self, number: int, node: int) -> None:
        """Send an NMT command."""
        self.send(nmt.command(number, node))

    def begin_heartbeat(self) -> None:
        """Send jtqd's boot-up message and heartbeat from here on; nothing beside a loop that sends it.

        Another jtqd that is booting too hears the boot-up message, and neither goes on.
        """
        if self._first:
            self.send(nmt.heartbeat(self._settings.master_node, nmt.BOOT_UP))
            self._beat_due = time.monotonic()

    def require_one_master(self) -> None:
        """Listen for long enough since the bus was opened. Raises BootError for another SYNC producer or jtqd."""
        if not self._first:
            return
        self.run(self._since + SYNC_LISTEN_S - time.monotonic())
        if self._syncs:
            # it would make every input's cycle ambiguous
            where = f"COB-ID {self._settings.sync_cob_id:03X}h"
            detail = f"another SYNC producer is on the bus ({where}, {self._syncs} frames during boot)"
            raise BootError(None, where, expected="no SYNC", found=f"{self._syncs} frames", detail=detail)
        if self._own_ids:
            node, where = self._settings.master_node, f"COB-ID {self._own_id:03X}h"
            detail = (
                f"another node {node:02X}h, jtqd's own node-ID, is on the bus (heartbeat or boot-up {where})"
            )
            raise BootError(None, where, expected="no such node", found="heartbeat", detail=detail)


def boot(request: BootRequest, bus: BootBus) -> BootReport:
    """Boot all nodes of the request, in its order.

    Raises:
        BootError: a mandatory node cannot be used, or another master is on the bus.
        BusError: the bus is lost.
    """
    started = time.monotonic()
    # Before anything is sent: a second daemon must not disturb the one that runs.
    bus.require_one_master()
    bus.begin_heartbeat()
    wait_s = max(3 * request.settings.heartbeat_ms, 100) * 1e-3
    booted: dict[int, BootedNode] = {}
    absent: dict[int, BootError] = {}

    def attempt(node: int, step: Callable[[], None]) -> None:
        """Do one step; an optional node that fails is absent from then on."""
        try:
            step()
        except BootError as error:
            why = error if error.letter == "B" else error.explained(_own_words(bus, node))
            if node not in request.optional or error.node != node:
                raise why from error
            absent[node] = why
            booted.pop(node, None)

    def configure(profile: Profile) -> None:
        booted[profile.node_id] = _configure(bus, request, profile, ran=running)

    running = {node for node, state in bus.states.items() if state == nmt.OPERATIONAL}
    if request.reset:
        _reset(bus, request)
    for profile in request.profiles:
        attempt(profile.node_id, partial(configure, profile))
    for node in list(booted):
        attempt(node, partial(_require_heartbeat, bus, node, wait_s))
    bus.require_one_master()
    for node in booted:
        bus.command(nmt.START, node)
    for node in list(booted):
        attempt(node, partial(_require_operational, bus, node, wait_s))
    return BootReport(booted, time.monotonic() - started, absent)


def _reset(bus: BootBus, request: BootRequest) -> None:
    """Reset the communication of all nodes: errors of an earlier master's end, and what it had written, are gone.

    A node that sends no boot-up message within the time for its first answer may be absent: its first request shows it.
    """
    nodes = [profile.node_id for profile in request.profiles]
    for node in nodes:
        bus.forget(node)
        bus.command(nmt.RESET_COMMUNICATION, node)
    began = time.monotonic()
    for node in nodes:
        left = began + request.timeout_s(node) - time.monotonic()
        bus.run(left, lambda node=node: node in bus.restarted)  # type: ignore[misc]
    bus.run(_BOOT_UP_AGAIN_S)


def _configure(bus: BootBus, request: BootRequest, profile: Profile, *, ran: Collection[int]) -> BootedNode:
    """Identify and configure one node, which stays pre-operational; `ran`: nodes that were operational before."""
    node = profile.node_id
    notes = []
    if node in ran and request.check_foreign_sync:
        notes.append("it was already operational (status L): stopped and configured again")
    answer_s = request.answer_s(node)
    sdo = SdoClient(bus, node, request.timeout_s(node), answer_s)
    for attempt in range(1, _ATTEMPTS + 1):
        # A running node would refuse to be re-mapped, and a stopped one does not answer SDO.
        bus.command(nmt.ENTER_PRE_OPERATIONAL, node)
        procedure = NodeBoot(sdo, profile, request.settings)
        device_type = procedure.check_device_type()
        sdo.wait_longer(_SILENCES * answer_s)
        bus.forget(node)  # a boot-up message up to its first answer is its own start
        booted = procedure.run(device_type)
        if not (request.reset and node in bus.restarted and attempt < _ATTEMPTS):
            break
        again = "it sent its boot-up message again during its configuration: configured once more"
        notes.append(again)
    return replace(booted, notes=(*notes, *booted.notes), boot_ups=bus.boot_ups[node])


def _own_words(bus: BootBus, node: int) -> str:
    """Return what a node that failed reports about itself: 1001h, 1003h and its last EMCY; "" when it reports no error."""
    last = bus.emergencies.get(node)  # before the questions, which may be refused as well
    sdo = SdoClient(bus, node, _REPORT_S, _REPORT_S)

    def number(key: Key) -> int | None:
        try:
            return int.from_bytes(sdo.read(*key)[:4], "little")
        except (SdoAbort, SdoTimeout):
            return None

    register = number((0x1001, 0))
    history = number((HISTORY_INDEX, 1)) if register is not None and number((HISTORY_INDEX, 0)) else None
    reported = []
    if register:
        reported.append(f"1001h is {register:02X}h ({register_text(register)})")
    if history:
        reported.append(f"1003h:1 is {history & 0xFFFF:04X}h ({name_of(history & 0xFFFF)})")
    if last is not None and last.code:
        reported.append(f"its last EMCY is {last.code:04X}h ({name_of(last.code)})")
    return ", ".join(reported)


def _require_heartbeat(bus: BootBus, node: int, wait_s: float) -> None:
    """Start error control: the node must be heard before it is started."""
    if bus.state(node, None, wait_s) is None:
        detail = f"no heartbeat {nmt.HEARTBEAT_BASE + node:03X}h within {wait_s:g} s"
        raise BootError(node, "1017h:0", expected="heartbeat", found="none", letter="K", detail=detail)
    if node in bus.restarted:
        raise reset_during_boot(node)


def _require_operational(bus: BootBus, node: int, wait_s: float) -> None:
    """Wait until the node is operational, if need be after a second start.

    A drive may still watch the heartbeat of a jtqd that ended a moment ago: not every device restarts its watch when 1016h
    is written. When that runs out it leaves operational (1029h), rightly, as it had no master; but it does so once.
    """
    state = bus.state(node, nmt.OPERATIONAL, wait_s)
    if state == nmt.PRE_OPERATIONAL and node not in bus.restarted:
        bus.command(nmt.START, node)
        state = bus.state(node, nmt.OPERATIONAL, wait_s)
    if node in bus.restarted:
        raise reset_during_boot(node)
    if state != nmt.OPERATIONAL:
        found = nmt.STATES.get(state, f"state {state}") if state is not None else "no heartbeat"
        detail = f"NMT start: expected operational within {wait_s:g} s, found {found}"
        raise BootError(node, "NMT state", expected="operational", found=found, detail=detail)


def main(argv: list[str]) -> int:
    """Read a request from standard input, boot, print the report; return the exit status. Never a traceback."""
    try:
        own = {"own_entries": entries_to_json(read_eds(argv[0], int(argv[1])))} if argv else {}
        request = parse_request(_read_request())
        with _bus(request) as bus:
            report = boot(request, bus)
            print(json.dumps(report.as_json() | own), flush=True)
            _hold(bus)
        return 0
    except BootError as error:
        failure = error
    except (RequestError, json.JSONDecodeError) as error:
        failure = BootError(None, "request", detail=f"boot request: {error}")
    except KeyboardInterrupt:
        failure = BootError(None, "boot", detail="boot interrupted")
    except Exception as error:
        failure = BootError(None, "boot", detail=f"boot failed: {type(error).__name__}: {error}")
    print(json.dumps({"ok": False, "error": failure.report()}))
    return 1


@contextmanager
def _bus(request: BootRequest) -> Iterator[BootBus]:
    """Open the bus; a BusError becomes a BootError of the bus."""
    try:
        with BootBus(request) as bus:
            yield bus
    except BusError as error:
        text = str(error).removeprefix(f"{request.bus}: ")
        detail = f"bus {request.bus}: {text}"
        raise BootError(None, request.bus, expected="a bus", found=text, detail=detail) from error


def _read_request() -> object:
    """Return the JSON value on standard input, which need not end with it. Raises json.JSONDecodeError."""
    text = ""
    for line in sys.stdin:
        text += line
        with suppress(json.JSONDecodeError):
            return json.loads(text)
    return json.loads(text)


def _hold(bus: BootBus) -> None:
    """Send heartbeats until standard input is closed; a bus that is lost is reported by the loop."""
    deadline = time.monotonic() + _LONGEST_HOLD_S
    with suppress(BusError):
        while time.monotonic() < deadline:
            bus.run(_POLL_S)
            if select.select([sys.stdin], [], [], 0.0)[0] and not sys.stdin.readline():
                return


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
