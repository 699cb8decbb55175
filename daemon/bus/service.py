"""Bus service beside the loop: jtqd's own node, EMCY, heartbeats, bus state, nodes that return, checks in service.

It runs in the supervisor, on a frame socket of its own: no frame of a cycle passes here, and nothing here can delay one. It
moves frames, times and lines between the other modules of this package.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from jtqd.daemon.bus.boot import ReturningNodes
from jtqd.daemon.bus.nodes import HeardNodes, NodeCare, NodeEvent, NodeWatch
from jtqd.daemon.bus.own_node import OwnErrors, OwnNode
from jtqd.daemon.config import LISTENER, MASTER, Config
from jtqd.daemon.shared.conditions import THE_BUS, Conditions, Subject
from jtqd.daemon.shared.events import RateLimit
from jtqd.daemon.shared.runtime_dir import write_whole
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.drivers import emcy, nmt
from jtqd.drivers.bus_socket import CanFilter, exact
from jtqd.drivers.emcy import NO_ERROR, Emergency, describe, name_of, parse
from jtqd.drivers.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FRAME, pack
from jtqd.drivers.frame_socket import BusDown, FrameSocket
from jtqd.drivers.object_dictionary import ObjectStore
from jtqd.drivers.own_objects import BUS_FIELDS, COMMANDER_NODE
from jtqd.drivers.sdo import REQUEST_ID, RESPONSE_ID

ACTIVE, WARNING, PASSIVE, BUS_OFF, DOWN = 0, 1, 2, 3, 4
STATE_NAMES = ("error active", "error warning", "error passive", "bus-off", "interface down")

# Classes of the error message, in its identifier
_TX_TIMEOUT, _LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _TRANSCEIVER = 0x01, 0x02, 0x04, 0x08, 0x10
_NO_ACK, _BUS_OFF, _BUS_ERROR, _RESTARTED, _COUNTERS = 0x20, 0x40, 0x80, 0x100, 0x200
# data[1] of _CONTROLLER
_OVERFLOW, _WARNING_BITS, _PASSIVE_BITS, _ACTIVE_BIT = 0x03, 0x0C, 0x30, 0x40


class BusChange(NamedTuple):
    """The state has changed."""

    before: int
    after: int


class BusState:
    """State of the CAN controller and `counts` by the names of `BUS_FIELDS`, from error messages of its driver.

    The kernel's driver sends them as frames with CAN_ERR_FLAG to sockets that ask for them (linux/can/error.h). vcan and
    the unix hub make none, but carry those that a node sends.
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

    There is a line at once for the first message of a code; repetitions are counted and mentioned in the next line.
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


FILE = "bus.json"
_HEARTBEATS = ("not watched", "awaited", "heard", "lost")


_BATCHES = 8
"""Calls of `receive` in one turn: a storm of frames waits in the kernel's queue, whose overflow is counted."""
_REPORT_S = 0.5

_BUS_CONDITIONS = {WARNING: "bus_warning", PASSIVE: "bus_passive", BUS_OFF: "bus_off", DOWN: "bus_down"}
_NODE_CONDITIONS = {
    "lost": ("node_lost", True),
    "never": ("node_lost", True),
    "back": ("node_lost", False),
    "restarted": ("node_lost", False),
    "doubled": ("node_doubled", True),
    "single": ("node_doubled", False),
}
"""What an event of `NodeWatch` begins or ends."""
_OWN_BASES, _CONFLICT_S = (emcy.EMCY_BASE, RESPONSE_ID), 1.0
"""Of the COB-IDs that only this service sends with (no own echo is received); silence that ends a conflict of COB-IDs."""
_NODE_LINES = ("restarted", "state", "malformed", "foreign")

LogEvent = Callable[[str, int, str], None]


def service_filters(config: Config) -> list[CanFilter]:
    """Return filters for SDO requests to jtqd, SDO traffic of the nodes, EMCY, heartbeats, NMT commands, own COB-IDs."""
    heartbeats = CanFilter(nmt.HEARTBEAT_BASE, 0x780 | CAN_EFF_FLAG | CAN_RTR_FLAG)
    nodes = [base + node for node in nodes_of(config) for base in (emcy.EMCY_BASE, RESPONSE_ID, REQUEST_ID)]
    return [
        *(exact(base + config.node_id) for base in (REQUEST_ID, *_OWN_BASES)),
        exact(0x000),
        heartbeats,
        *(exact(cob_id) for cob_id in nodes),
    ]


def nodes_of(config: Config) -> list[int]:
    """Return the node-IDs of the configuration: joint 1, joint 2, the sensor."""
    return [
        *(joint.node_id for joint in config.joints),
        *([config.sensor.node_id] if config.sensor is not None else []),
    ]


def node_subjects(config: Config) -> dict[int, Subject]:
    """Return every node of the configuration, by its node-ID."""
    joints = {joint.node_id: 1 << n for n, joint in enumerate(config.joints)}
    return {node: Subject(f"node {node}", node, joints.get(node, 0), node) for node in nodes_of(config)}


def sdo_timeouts_s(config: Config) -> dict[int, float]:
    """Return the silence of each node after which an SDO request is repeated."""
    timeouts_ms = {joint.node_id: joint.sdo_timeout_ms for joint in config.joints}
    if config.sensor is not None:
        timeouts_ms[config.sensor.node_id] = config.sensor.sdo_timeout_ms
    return {node: timeout_ms * 1e-3 for node, timeout_ms in timeouts_ms.items()}


class BusService:
    """Call `turn` about twenty times a second, and whenever the socket has frames.

    Args:
        socket: frame socket with `service_filters` and error messages.
        config, report: in force, and of the first boot.
        reader: snapshot of the loop.
        store: object dictionary of the own node.
        returning: boots nodes in service.
        conditions: updated from here; each change of one that has a code is an EMCY.
        log: takes topic, node and line of an event.
        directory: where `bus.json` is kept up to date, for `jtq status`; None: nowhere.
    """

    def __init__(
        self,
        socket: FrameSocket,
        config: Config,
        report: dict[str, Any],
        *,
        reader: SnapshotReader,
        store: ObjectStore,
        returning: ReturningNodes,
        conditions: Conditions,
        log: LogEvent,
        directory: Path | None = None,
    ) -> None:
        self.socket = socket
        self._config, self._log, self._conditions = config, log, conditions
        nodes = nodes_of(config)
        self._subjects = node_subjects(config)
        self.bus, self.emergencies = BusState(), EmcyLog(nodes)
        self.heartbeats = NodeWatch(
            tuple(nodes),
            (config.node_id, COMMANDER_NODE),
            # the rate that another master has given the nodes is not known
            config.heartbeat_ms * 1e-3 if config.role == MASTER else 0.0,
            config.heartbeat_timeout_ms * 1e-3,
        )
        self.errors = OwnErrors(store)
        conditions.subscribe(self.errors.follow)
        self.own = OwnNode(store, config, reader)
        self.own.bus, self.own.emergencies = self.bus.values, self._emergency
        self.own.nodes = lambda node: self.care.state(node, self._view)
        self.returning = returning
        self.care: NodeCare | HeardNodes = (
            NodeCare(sdo_timeouts_s(config), reader, returning, self.heartbeats, log)
            if config.role == MASTER
            else HeardNodes(report, sdo_timeouts_s(config), reader, returning, self.heartbeats, log)
        )
        self._limit = RateLimit()
        self._report_due = 0.0
        self._view = reader.read()
        bases = () if config.role == LISTENER else _OWN_BASES
        self._own_cob_ids = {base + config.node_id for base in bases}
        self._conflicts = self._view.counters["cob_id_conflicts"]
        self._conflict_until_s: dict[int, float] = {}
        self.foreign_nmt = 0
        self._heard = False
        self._refused_calls = 0
        self._directory, self._written = directory, ""
        self._first = report

    def content(self) -> dict[str, Any]:
        """Return the content of `bus.json`."""
        nodes = {}
        for node, state in self.heartbeats.states().items():
            last = self.emergencies.last(node)
            nodes[str(node)] = {
                "heartbeat": _HEARTBEATS[state],
                "emcy": self.emergencies.count_of(node),
                "last_emcy": None if last is None else describe(last),
                "absent": node in self.returning.absent,
                "sdo": self.care.sdo_counts(node),
            }
        return {
            "state": STATE_NAMES[self.bus.state],
            "counts": {name: value for name, value in self.bus.counts.items() if name != "state"},
            "foreign_nmt": self.foreign_nmt,
            "malformed_heartbeats": self.heartbeats.malformed,
            "nodes": nodes,
            "errors": [
                {"code": f"{code:04X}h", "name": name_of(code), "detail": f"{detail:03X}h"}
                for code, detail in self.errors.present
            ],
            "error_register": self.errors.register,
        }

    def begin(self, now_s: float) -> None:
        """Start the service when the nodes are operational; drop frames of the boot except EMCY and own requests."""
        with suppress(BusDown):
            while count := self.socket.receive():
                for can_id, data in self._frames(count):
                    if self._config.role != MASTER:  # its master may have written to nodes since
                        self._on_frame(can_id, data, now_s)
                    elif can_id in self._own_cob_ids:
                        self._conflict_until_s[can_id] = now_s + _CONFLICT_S
                    elif 0x080 < can_id <= 0x0FF:
                        self._on_emergency(can_id - 0x080, data, now_s)
                    elif can_id == REQUEST_ID + self._config.node_id:
                        self._on_request(data)
        for number, node in self._first["nodes"].items():
            self.care.configured(int(number), node, now_s)
            for note in node.get("notes", ()):
                self._log("boot", int(number), f"node {number}: {note}")
        for number, error in self._first.get("absent", {}).items():
            later = ", and configures it when it appears" if self._config.role == MASTER else " without it"
            self._log("boot", int(number), f"{error['message']}: it is optional; jtqd continues{later}")
        for note in self._first.get("notes", ()):
            self._log("boot", 0, note)

    def turn(self, view: View, now_s: float) -> None:
        """Process received frames and send the due ones. Raises BusGone."""
        self._view = view
        try:
            all_taken = self._receive(now_s)
        except BusDown:
            all_taken = False
            self._bus_change(self.bus.down(), now_s)
        self.own.watch(view.cycle)
        if all_taken:
            self._node_events(self.heartbeats.tick(now_s), now_s)
        refused, self._refused_calls = self._refused_calls, view.counters["bus_errors"]
        if self._refused_calls > refused and not self._heard:
            self._bus_change(self.bus.down(), now_s)
        self._observe_conflicts(view, now_s)
        requests = self.care.turn(view, now_s)
        for node, subject in self._subjects.items():
            text = self.care.changed.get(node)
            self._conditions.update("node_changed", subject, text is not None, now_s, text or "")
            self._conditions.update("node_unchecked", subject, node in self.care.unchecked, now_s)
        with suppress(BusDown):
            for node, request in requests:
                self.socket.send(pack(REQUEST_ID + node, request))
            if self.bus.state not in (BUS_OFF, DOWN) and self._may_send(view):
                message = self.errors.tick(now_s)
                if message is not None:
                    self.socket.send(pack(0x080 + self._config.node_id, message))
        if self._directory is not None and now_s >= self._report_due:
            self._report_due = now_s + _REPORT_S
            text = json.dumps(self.content())
            if text != self._written:
                with suppress(OSError):  # nothing depends on the file
                    write_whole(self._directory / FILE, text)
                    self._written = text

    def _may_send(self, view: View) -> bool:
        """Whether EMCY and SDO answers may be sent: as a guest not after NMT stop, as a listener never."""
        stopped = view.node_states[self._config.node_id] == nmt.STOPPED
        return self._config.role == MASTER or not (self._config.role == LISTENER or stopped)

    def _observe_conflicts(self, view: View, now_s: float) -> None:
        """Report COB-IDs of jtqd that others send with: those of the loop, which counts them, and those of this socket."""
        before, self._conflicts = self._conflicts, view.counters["cob_id_conflicts"]
        if self._conflicts > before:
            self._conflict_until_s[view.conflict_cob_id] = now_s + _CONFLICT_S
        for cob_id, until_s in self._conflict_until_s.items():
            subject = Subject(f"COB-ID {cob_id:03X}h", cob_id)
            self._conditions.update("cob_id_conflict", subject, now_s < until_s, now_s)

    # Frames ---------------------------------------------------------------------------------------------------------------

    def _receive(self, now_s: float) -> bool:
        """Process received frames; return False if more are waiting."""
        self._heard = False
        for _ in range(_BATCHES):
            count = self.socket.receive()
            if not count:
                return True
            for can_id, data in self._frames(count):
                self._on_frame(can_id, data, now_s)
        return False

    def _frames(self, count: int) -> list[tuple[int, bytes]]:
        frames = self.socket.frames
        unpacked = (FRAME.unpack_from(frames, 16 * n) for n in range(count))
        return [(can_id, data[:length]) for can_id, length, data in unpacked]

    def _on_frame(self, can_id: int, data: bytes, now_s: float) -> None:
        if can_id & CAN_ERR_FLAG:
            self._bus_change(self.bus.error_frame(can_id, data), now_s)
            return
        self._heard = True
        self._bus_change(self.bus.alive(), now_s)
        if can_id in self._own_cob_ids:
            self._conflict_until_s[can_id] = now_s + _CONFLICT_S
        elif can_id == REQUEST_ID + self._config.node_id:
            self._on_request(data)
        elif can_id >= nmt.HEARTBEAT_BASE:
            self._node_events(self.heartbeats.receive(can_id - nmt.HEARTBEAT_BASE, data, now_s), now_s)
        elif can_id >= REQUEST_ID:
            self.care.on_foreign_request(can_id - REQUEST_ID, data, now_s)
        elif can_id >= RESPONSE_ID:
            self.care.on_reply(can_id - RESPONSE_ID, data, now_s)
        elif can_id == 0x000:
            self._on_nmt(data, now_s)
        else:
            self._on_emergency(can_id - 0x080, data, now_s)

    def _on_request(self, data: bytes) -> None:
        answer = self.own.answer(data) if self._may_send(self._view) else None
        if answer is not None:
            with suppress(BusDown):
                self.socket.send(pack(RESPONSE_ID + self._config.node_id, answer))

    def _on_emergency(self, node: int, data: bytes, now_s: float) -> None:
        line = self.emergencies.receive(node, data, now_s)
        if line is not None:
            self._log("emcy", node, line)
        last, subject = self.emergencies.last(node), self._subjects.get(node)
        if last is not None:
            self.returning.note_error(node, last.register)
        if last is not None and subject is not None:
            error = last.code != emcy.NO_ERROR or last.register != 0
            self._conditions.update("node_error", subject, error, now_s, describe(last))

    def _on_nmt(self, data: bytes, now_s: float) -> None:
        """Report an NMT command that is not of jtqd's own boots, or the master's."""
        if len(data) == 2:
            self.care.on_command(*data)
        if self.care.is_booting(now_s):
            return
        self.foreign_nmt += 1
        if len(data) == 2 and self._limit.admit(("nmt", data), now_s) is not None:
            command = nmt.COMMANDS.get(data[0], f"{data[0]:02X}h")
            whom = f"node {data[1]}" if data[1] else "all nodes"
            self._log("nmt", data[1] & 0x7F, f"NMT command '{command}' to {whom} from another master")

    def _bus_change(self, change: BusChange | None, now_s: float) -> None:
        if change is None:
            return
        before, after = change
        counts = self.bus.counts
        numbers = f"TEC {counts['tx_errors']}, REC {counts['rx_errors']}"
        detail = f" ({numbers})" if counts["tx_errors"] or counts["rx_errors"] else ""
        for state, name in _BUS_CONDITIONS.items():
            text = f"{STATE_NAMES[before]}{detail}"
            superseded = after != ACTIVE
            self._conditions.update(name, THE_BUS, state == after, now_s, text, superseded=superseded)
        if before == BUS_OFF and after == ACTIVE:
            self.errors.report_once(emcy.BUS_OFF_RECOVERED)

    # Nodes ----------------------------------------------------------------------------------------------------------------

    def _node_events(self, events: list[NodeEvent], now_s: float) -> None:
        for kind, node, text, since_s in events:
            if kind == "restarted":
                self.care.restarted(node)
            if kind in _NODE_CONDITIONS:
                name, present = _NODE_CONDITIONS[kind]
                subject = self._subjects[node]
                self._conditions.update(name, subject, present, now_s, text, since_s=since_s)
            of_boot = kind in ("restarted", "state") and node == self.returning.busy
            if kind in _NODE_LINES and text and not of_boot:
                self._log("heartbeat", node, text)

    # Own node ----------------------------------------------------------------------------------------------

    def _emergency(self, node: int) -> tuple[int, int, int]:
        last = self.emergencies.last(node)
        return (0, 0, 0) if last is None else (last.code, last.register, self.emergencies.count_of(node))
