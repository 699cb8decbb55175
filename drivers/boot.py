"""Boot of the bus as a short-lived process: `python -m jtqd.drivers.boot [EDS NODE-ID] < request.json > report.json`.

The request is a `BootRequest`; all keys but "bus", "nodes", "node" and "kind" have defaults:

    {"bus": "can0", "heartbeat_ms": 100, "answer_timeout_s": 0.5, "reset": true, "sync": {"counter_overflow": 0},
     "nodes": [{"node": 1, "kind": "drive", "identity": {"vendor": 1953, "product": 1026}},
               {"node": 2, "kind": "drive", "given": {"6091h:1": 100}, "temperature": {"index": 12289}},
               {"node": 3, "kind": "sensor", "channels": [1], "mandatory": false}]}

The report is
    {"ok": true, "duration_s", "nodes": {"1": {...}}, "absent": {"3": error}}               exit status 0
    {"ok": false, "error": {"node", "object", "expected", "found", "letter", "message"}}    exit status 1
A guest's boot ("guest") asks nothing: it listens, and takes the nodes as files and request have them (`known_nodes`). Its
report also has "identities" (expected 1018h by node) and "unchecked": nodes whose layout is neither checked nor pinned.
With an EDS it also has the entries of that file as "own_entries": the caller needs no parser then, which takes 20 MB.
A node that comes back is booted by the same command with a shorter list of nodes.

jtqd's heartbeat begins with its boot-up message: a drive that watches it (1016h) misses it from its configuration on. At the
first boot this process sends it, after its report too, until its standard input is closed: the loop has taken over.
"""

from __future__ import annotations

import json
import re
import select
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import inf
from statistics import median
from typing import Annotated, Any, Self

import msgspec
from msgspec import Meta, Struct

from jtqd.drivers import nmt
from jtqd.drivers.boot_node import (
    BootedNode,
    BootError,
    BusSettings,
    NodeBoot,
    NodeId,
    Profile,
    reset_during_boot,
)
from jtqd.drivers.bus_socket import CanFilter, exact
from jtqd.drivers.drive import BY_TORQUE, CIA_402, DriveObjects, DriveProfile, Temperature, map_of
from jtqd.drivers.emcy import EMCY_BASE, HISTORY_INDEX, Emergency, name_of, parse, register_text
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_RTR_FLAG, FRAME, FRAME_SIZE
from jtqd.drivers.frame_socket import BusError, open_frame_socket
from jtqd.drivers.object_dictionary import (
    ANY_IDENTITY,
    EdsError,
    Identity,
    ObjectStore,
    entries_to_json,
    read_eds,
)
from jtqd.drivers.pdo import SYNC_COB_ID, SYNC_LISTEN_S, TPDO_BASES, Tpdo
from jtqd.drivers.sdo import (
    ANSWER_S,
    PATIENCE,
    RESPONSE_ID,
    Key,
    SdoAbort,
    SdoClient,
    SdoTimeout,
    parse_key,
)
from jtqd.drivers.sensor import SensorProfile

# The request

_OPTIONAL_TIMEOUT_S = 0.5
"""An optional node is not waited for any longer: it is booted again when it appears."""
_Word = Annotated[int, Meta(ge=0, le=0xFFFF_FFFF)]


class RequestError(ValueError):
    """A request that cannot be carried out; the message has the key, what was found and what is expected."""


class _Node(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """A node of a request.

    Attributes:
        given: values of scaling objects that are then not read, by object: {"6091h:1": 100}.
        sdo_timeout_ms: silence of the node after which a request is repeated.
        mandatory: the boot fails without it.
        eds: its EDS or DCF, for a guest.
        pinned: its layout is that of the request, whatever the EDS has.
    """

    node: NodeId
    identity: Identity = ANY_IDENTITY
    given: dict[str, _Word] = {}
    sdo_timeout_ms: Annotated[int, Meta(ge=10, le=10_000)] | None = None
    mandatory: bool = True
    eds: str = ""
    pinned: bool = False

    @property
    def given_values(self) -> dict[Key, int]:
        """The values of `given` by index and sub-index. Raises ValueError."""
        return {parse_key(key): value for key, value in self.given.items()}


class DriveNode(_Node, frozen=True, kw_only=True, tag="drive"):
    """A drive of a request, with the fields of a `DriveProfile`. `tpdos`: those that carry its quantities; none: jtqd's."""

    temperature: Temperature | None = None
    objects: DriveObjects = CIA_402
    tpdos: tuple[Tpdo, ...] = ()
    torque_constant_nm_per_a: float = 0.0
    acyclic: bool = False

    @property
    def profile(self) -> DriveProfile:
        """The drive as the boot configures it. Raises PdoError, ValueError."""
        current = self.objects.current
        if current.by == BY_TORQUE and not current.factor and self.torque_constant_nm_per_a <= 0.0:
            found = self.torque_constant_nm_per_a
            raise ValueError(f"torque_constant_nm_per_a: found {found}, expected a number above 0")
        maps = tuple(map_of(self.node, each, self.objects) for each in self.tpdos)
        return DriveProfile(
            self.node,
            self.identity,
            self.given_values,
            self.temperature,
            self.objects,
            maps,
            self.torque_constant_nm_per_a,
            self.acyclic,
        )


class SensorNode(_Node, frozen=True, kw_only=True, tag="sensor"):
    """A torque sensor of a request, with the fields of a `SensorProfile`; `unit_words`: keys such as "0x00560000"."""

    channels: tuple[int, ...] = (1,)
    unit_words: dict[str, float] = {}

    @property
    def profile(self) -> SensorProfile:
        """The sensor as the boot configures it. Raises ValueError."""
        words = {int(word, 0): nm for word, nm in self.unit_words.items()}
        return SensorProfile(self.node, self.identity, self.channels, self.given_values, words)


class BootRequest(BusSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which nodes to boot on which bus.

    Attributes:
        bus: CAN interface or unix:PATH.
        answer_timeout_s: longest wait for the answer of a mandatory node.
        reset: begin with NMT reset communication.
        guest: another node is the master. listener: nobody but it sends with jtqd's node-ID. period_us: of its SYNC.
    """

    bus: Annotated[str, Meta(min_length=1)]
    nodes: Annotated[tuple[DriveNode | SensorNode, ...], Meta(min_length=1)]
    answer_timeout_s: Annotated[float, Meta(gt=0.0, le=60.0)] = 0.5
    reset: bool = True
    guest: bool = False
    listener: bool = False
    period_us: float = 1000.0

    def __post_init__(self) -> None:
        numbers = [each.node for each in self.nodes]
        if len({*numbers, self.master_node}) != len(numbers) + 1:
            found = f"found {numbers} and master {self.master_node}"
            raise ValueError(f"nodes: {found}, expected different node numbers")
        for at, each in enumerate(self.nodes):
            try:
                _ = each.profile
            except ValueError as error:
                raise ValueError(f"nodes[{at}]: {error}") from None

    def as_json(self) -> Any:
        """Return it as plain data, of which `parse_request` makes it again."""
        return msgspec.to_builtins(self, str_keys=True)

    @property
    def profiles(self) -> tuple[Profile, ...]:
        """The nodes as the boot configures them, in its order."""
        return tuple(each.profile for each in self.nodes)

    def _node(self, node: int) -> DriveNode | SensorNode:
        (found,) = (each for each in self.nodes if each.node == node)
        return found

    def timeout_s(self, node: int) -> float:
        """Return how long a node may take for its first answer."""
        found, longest = self._node(node), self.answer_timeout_s
        longest = longest if found.mandatory else min(_OPTIONAL_TIMEOUT_S, longest)
        return max(longest, (found.sdo_timeout_ms or 0) * 1e-3)

    def answer_s(self, node: int) -> float:
        """Return the silence of a node after which a request is repeated."""
        timeout_ms = self._node(node).sdo_timeout_ms
        return ANSWER_S if timeout_ms is None else timeout_ms * 1e-3


def parse_request(raw: object) -> BootRequest:
    """Check a request as it comes from JSON. Raises RequestError."""
    try:
        return msgspec.convert(raw, BootRequest, str_keys=True)
    except msgspec.ValidationError as error:
        text, _, path = str(error).partition(" - at `$")
        key = path.strip(".`") or "request"
        raise RequestError(f"{key}: {_found(raw, path)}{text[0].lower()}{text[1:]}") from None


def _found(raw: Any, path: str) -> str:
    """Return "found VALUE, " of the place `.nodes[0].node` in a request; "" for an object or a place that is not there."""
    try:
        for part in re.findall(r"[^.`\[\]]+", path):
            raw = raw[int(part)] if isinstance(raw, list) else raw[part]
    except (KeyError, IndexError, TypeError, ValueError):
        return ""
    return "" if isinstance(raw, dict) else f"found {raw!r}, "


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


@dataclass(frozen=True)
class BootReport:
    """A boot that went well: `nodes` are operational and configured, `absent` are optional ones and why they are not."""

    nodes: dict[int, BootedNode]
    duration_s: float
    absent: dict[int, BootError]

    def as_json(self) -> dict[str, Any]:
        """Return the report for JSON."""
        nodes = {str(number): node.as_json() for number, node in self.nodes.items()}
        absent = {str(number): error.report() for number, error in self.absent.items()}
        return {"ok": True, "duration_s": round(self.duration_s, 4), "nodes": nodes, "absent": absent}


class BootBus:
    """A frame socket that keeps what the nodes send during the boot, and sends jtqd's heartbeat while it waits.

    In a first boot it also receives SYNC and frames of jtqd's own node-ID: another producer of them makes the boot refuse
    the bus. All methods raise BusError.

    Attributes:
        frames: of the last `receive`, as of a FrameSocket.
        states: newest NMT state of each node since `forget`.
        restarted: nodes with a boot-up message since `forget`.
        boot_ups: boot-up messages of each node.
        emergencies: last EMCY message of each node.
    """

    def __init__(self, request: BootRequest) -> None:
        self._settings, self._first = request, request.sync.check_foreign
        self.states: dict[int, int] = {}
        self.restarted: set[int] = set()
        self.boot_ups: Counter[int] = Counter()
        self.emergencies: dict[int, Emergency] = {}
        self._syncs = self._own_ids = 0
        self._own_id = nmt.HEARTBEAT_BASE + request.master_node
        bases = RESPONSE_ID, nmt.HEARTBEAT_BASE, EMCY_BASE
        identifiers = [base + profile.node_id for profile in request.profiles for base in bases]
        if self._first:
            identifiers += [request.sync.cob_id, self._own_id]
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
        node = can_id & 0x7F
        if can_id == self._own_id:
            self._own_ids += 1
        elif can_id >= nmt.HEARTBEAT_BASE:
            if len(data) == 1:
                self.states[node] = data[0] & 0x7F
                if data[0] == nmt.BOOT_UP:
                    self.restarted.add(node)
                    self.boot_ups[node] += 1
        elif can_id == self._settings.sync.cob_id:
            self._syncs += 1
        elif can_id < RESPONSE_ID:
            self.emergencies[node] = parse(data)

    def forget(self, node: int) -> None:
        """Discard the node's state and boot-up messages so far."""
        self.states.pop(node, None)
        self.restarted.discard(node)

    def state(self, node: int, wanted: int | None, timeout_s: float) -> int | None:
        """Return the newest state once it is `wanted` (None: any), or what it is after `timeout_s`."""
        self.run(timeout_s, lambda: node in self.states and wanted in (None, self.states[node]))
        return self.states.get(node)

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
            where = f"COB-ID {self._settings.sync.cob_id:03X}h"
            detail = f"another SYNC producer is on the bus ({where}, {self._syncs} frames): jtqd --guest runs beside it"
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
    wait_s = max(3 * request.heartbeat_ms, 100) * 1e-3
    booted: dict[int, BootedNode] = {}
    absent: dict[int, BootError] = {}
    mandatory = {each.node for each in request.nodes if each.mandatory}

    def attempt(node: int, step: Callable[[], None]) -> None:
        """Do one step; an optional node that fails is absent from then on."""
        try:
            step()
        except BootError as error:
            why = error if error.letter == "B" else error.explained(_own_words(bus, node))
            if node in mandatory or error.node != node:
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
        bus.send(nmt.command(nmt.START, node))
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
        bus.send(nmt.command(nmt.RESET_COMMUNICATION, node))
    began = time.monotonic()
    for node in nodes:
        left = began + request.timeout_s(node) - time.monotonic()
        bus.run(left, lambda node=node: node in bus.restarted)  # type: ignore[misc]
    bus.run(_BOOT_UP_AGAIN_S)


def _configure(bus: BootBus, request: BootRequest, profile: Profile, *, ran: Collection[int]) -> BootedNode:
    """Identify and configure one node, which stays pre-operational; `ran`: nodes that were operational before."""
    node = profile.node_id
    notes = []
    if node in ran and request.sync.check_foreign:
        notes.append("it was already operational (status L): stopped and configured again")
    answer_s = request.answer_s(node)
    sdo = SdoClient(bus, node, request.timeout_s(node), answer_s)
    for attempt in range(1, _ATTEMPTS + 1):
        # A running node would refuse to be re-mapped, and a stopped one does not answer SDO.
        bus.send(nmt.command(nmt.ENTER_PRE_OPERATIONAL, node))
        procedure = NodeBoot(sdo, profile, request)
        device_type = procedure.check_device_type()
        sdo.wait_longer(PATIENCE * answer_s)
        bus.forget(node)  # a boot-up message up to its first answer is its own start
        booted = procedure.run(device_type)
        if not (request.reset and node in bus.restarted and attempt < _ATTEMPTS):
            break
        notes.append("it sent its boot-up message again during its configuration: configured once more")
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
        bus.send(nmt.command(nmt.START, node))
        state = bus.state(node, nmt.OPERATIONAL, wait_s)
    if node in bus.restarted:
        raise reset_during_boot(node)
    if state != nmt.OPERATIONAL:
        found = nmt.STATES.get(state, f"state {state}") if state is not None else "no heartbeat"
        detail = f"NMT start: expected operational within {wait_s:g} s, found {found}"
        raise BootError(node, "NMT state", expected="operational", found=found, detail=detail)


# As a guest: a bus that another master has booted, or will

Heard = dict[int, list[tuple[int, int]]]
"""Stamp [ns] and length of the frames of each COB-ID."""
_LISTEN_S, _FEW, _PERIOD_OFF = 1.2, 5, 0.1
"""A heartbeat of once a second is heard; SYNCs that make a period; its largest difference, as a share."""


def known_nodes(request: BootRequest, heard: Heard) -> dict[str, Any]:
    """Return the report of a bus that was listened to. Raises BootError, EdsError."""
    notes = _check_sync(request, heard.get(SYNC_COB_ID, []))
    bases = [] if request.listener else [*TPDO_BASES, EMCY_BASE, RESPONSE_ID, nmt.HEARTBEAT_BASE]
    for cob_id in (base + request.master_node for base in bases):
        if cob_id in heard:
            where, detail = (
                f"COB-ID {cob_id:03X}h",
                f"node {request.master_node:02X}h, jtqd's own node-ID, is on the bus",
            )
            raise BootError(
                None, where, expected="no such node", found="frames", detail=f"{detail} ({where})"
            )
    booted: dict[int, BootedNode] = {}
    absent: dict[int, BootError] = {}
    identities = {}
    for each in request.nodes:
        node, eds = each.node, read_eds(each.eds, each.node) if each.eds else None
        store = ObjectStore(eds.entries if eds else [], node)
        notes += eds.notes if eds else ()
        try:
            booted[node] = NodeBoot(store, each.profile, request).describe(pinned=each.pinned, eds=each.eds)
        except BootError as error:
            if each.mandatory:
                raise
            absent[node] = error
        given, of_eds = (
            each.identity,
            [store.number(0x1018, sub) if store.has(0x1018, sub) else 0 for sub in (1, 2)],
        )
        numbers = (given.vendor or of_eds[0], given.product or of_eds[1], given.revision, given.serial)
        identities[str(node)] = {str(sub): number for sub, number in enumerate(numbers, 1) if number}
    report = BootReport(booted, _LISTEN_S, absent).as_json()
    unchecked = [each.node for each in request.nodes if each.node in booted and not each.pinned]
    return {**report, "identities": identities, "unchecked": unchecked, "notes": notes}


def _check_sync(request: BootRequest, syncs: Sequence[tuple[int, int]]) -> list[str]:
    """Check the SYNC of the master; return what the operator should know. Raises BootError."""
    period_us = interval_us(syncs)
    if period_us is None:
        return [f"no SYNC within {_LISTEN_S:g} s: jtqd waits for that of the master"]
    wanted_us, counts, expects = request.period_us, syncs[-1][1] > 0, bool(request.sync.counter_overflow)
    if abs(period_us - wanted_us) > _PERIOD_OFF * wanted_us:
        expected = f"one every {wanted_us:g} us (sync.period_us)"
        raise BootError(None, "SYNC", expected=expected, found=f"one every {period_us:.0f} us")
    if expects and not counts:
        raise BootError(None, "SYNC", expected="a counter byte (sync.counter_overflow)", found="none")
    text = "SYNC has a counter byte: with sync.counter_overflow (1019h of the master) the sequence follows it"
    return [text] if counts and not expects else []


def listen(bus: str, seconds: float) -> Heard:
    """Return what is heard on a bus: stamp [ns] and length of the frames of each COB-ID. Raises BusError."""
    heard: Heard = {}
    end = time.monotonic() + seconds
    with closing(open_frame_socket(bus, [CanFilter(0, CAN_EFF_FLAG | CAN_RTR_FLAG)])) as socket:
        while (left := end - time.monotonic()) > 0.0:
            socket.wait(left)
            for at in range(socket.receive()):
                can_id, length, _ = FRAME.unpack_from(socket.frames, FRAME_SIZE * at)
                heard.setdefault(can_id, []).append((socket.stamps_ns[at], length))
    return heard


def interval_us(frames: Sequence[tuple[int, int]]) -> float | None:
    """Return the median interval of frames; None for too few of them."""
    if len(frames) < _FEW:
        return None
    return median(after - before for (before, _), (after, _) in pairwise(frames)) / 1e3


def main(argv: list[str]) -> int:
    """Read a request from standard input, boot, print the report; return the exit status. Never a traceback."""
    try:
        own = {"own_entries": entries_to_json(read_eds(argv[0], int(argv[1])).entries)} if argv else {}
        request = parse_request(_read_request())
        if request.guest:
            with _errors_of_bus(request.bus):
                heard = listen(request.bus, _LISTEN_S)
            print(json.dumps(known_nodes(request, heard) | own), flush=True)
            return 0
        with _bus(request) as bus:
            report = boot(request, bus)
            print(json.dumps(report.as_json() | own), flush=True)
            _hold(bus)
        return 0
    except BootError as error:
        failure = error
    except EdsError as error:
        failure = BootError(None, "EDS", detail=str(error))
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
    """Open the bus."""
    with _errors_of_bus(request.bus), BootBus(request) as bus:
        yield bus


@contextmanager
def _errors_of_bus(bus: str) -> Iterator[None]:
    """Make a BusError a BootError of the bus."""
    try:
        yield
    except BusError as error:
        text = str(error).removeprefix(f"{bus}: ")
        detail = f"bus {bus}: {text}"
        raise BootError(None, bus, expected="a bus", found=text, detail=detail) from error


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
