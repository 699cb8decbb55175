"""The nodes in service: their heartbeats, their configuration, and boots of those that need one.

`NodeWatch` follows the heartbeats, `ConfigurationWatch` the objects of one node, and `NodeCare` joins them with the boots in
service; it owns the SDO queues of the nodes. Pure but for the boot processes: replies and times in, requests out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Any, NamedTuple

from jtqd.daemon.bus.boot import ReturningNodes
from jtqd.daemon.shared.events import RateLimit
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.drivers.boot_node import VERIFY_CONFIGURATION, signature
from jtqd.drivers.nmt import COMMANDS, OPERATIONAL, START, STATES
from jtqd.drivers.sdo import NO_OBJECT, NO_SUBINDEX, SdoQueue

NOT_WATCHED, WAITING, ACTIVE, LOST = 0, 1, 2, 3
"""States of a watch, as in CANopenNode: unconfigured, unknown, active, timeout."""
_WINDOW = 20
"""Heartbeats over which the rate is taken."""
_TWICE = 0.65
"""Share of the regular time in which a window may pass before there are two producers: with two it is a half."""
_LATE = 5.0
"""Heartbeats after which a reader was away for too long: those that have queued up do not show the rate."""
_OTHERS = 16
"""Foreign nodes that are logged."""


class NodeEvent(NamedTuple):
    """One event of a node: lost, never, back, doubled and single begin and end conditions, with details in `text`;
    restarted, state, malformed and foreign have a whole line, or "" where there were too many."""

    kind: str
    node: int
    text: str
    since_s: float


class _Watch:
    def __init__(self, limit: RateLimit) -> None:
        self.state = NOT_WATCHED
        self.heard_s = -inf
        self.since_s = 0.0
        self.last_state: int | None = None
        self.window: list[float] = []
        self.doubled = False
        self.limit = limit


class NodeWatch:
    """Heartbeat consumers of all nodes (CiA 301, 7.2.8.3.2.2), with the boot timeout that the standard lacks.

    A node is watched from the moment it is configured. One without a first heartbeat within the timeout is reported as one
    that stops sending it. Two producers with one node-ID show by nearly twice the configured rate.

    Args:
        nodes: their node-IDs.
        known: other node-IDs that are not reported as foreign (jtqd's own, the commander's).
        heartbeat_s: what was written to 1017h.
        timeout_s: silence after which a node is lost; also how long it may take for its first heartbeat.

    Attributes:
        malformed: heartbeats with a wrong length or an impossible state.
    """

    def __init__(
        self, nodes: tuple[int, ...], known: tuple[int, ...], heartbeat_s: float, timeout_s: float
    ) -> None:
        self._watches = {node: _Watch(RateLimit()) for node in nodes}
        self._known = set(known)
        self._heartbeat_s, self._timeout_s = heartbeat_s, timeout_s
        self._ticked_s = inf
        self.malformed = 0

    def watch(self, node: int, now_s: float) -> None:
        """Start monitoring a node that has been configured and started."""
        watch = self._watches[node]
        if watch.state == NOT_WATCHED:
            watch.state = WAITING
        watch.since_s = now_s
        watch.window.clear()

    def state(self, node: int) -> int:
        """Return NOT_WATCHED, WAITING, ACTIVE or LOST."""
        return self._watches[node].state

    def states(self) -> dict[int, int]:
        """Return the state of all nodes."""
        return {node: watch.state for node, watch in self._watches.items()}

    def heard_within(self, node: int, span_s: float, now_s: float) -> bool:
        """Return whether a heartbeat or boot-up message was received in the last `span_s` seconds."""
        return now_s - self._watches[node].heard_s <= span_s

    def receive(self, node: int, data: bytes, now_s: float) -> list[NodeEvent]:
        """Take a frame 700h + node and return its events."""
        watch = self._watches.get(node)
        if watch is None:
            return self._foreign(node, data)
        if len(data) != 1 or data[0] not in STATES:
            self.malformed += 1
            found = f"{len(data)} bytes" if len(data) != 1 else f"state {data[0]:02X}h"
            return [self._event("malformed", node, watch, now_s, f"invalid heartbeat ({found})")]
        events = []
        watch.heard_s = now_s
        if data[0] == 0:
            watch.window.clear()
            events.append(self._event("restarted", node, watch, now_s, "it has restarted (boot-up message)"))
        elif watch.state == LOST:
            events.append(NodeEvent("back", node, "", now_s))
        if watch.state in (WAITING, LOST):
            watch.state = ACTIVE
        if data[0] and watch.last_state is not None and data[0] != watch.last_state:
            name = STATES[data[0]]
            events.append(self._event("state", node, watch, now_s, f"it is {name} now"))
        watch.last_state = data[0] or None
        if data[0]:
            events += self._rate(node, watch, now_s)
        return events

    def tick(self, now_s: float) -> list[NodeEvent]:
        """Return the timeouts. Call it after all received frames were taken, so that a late reader misses none."""
        self._ticked_s = now_s
        events = []
        for node, watch in self._watches.items():
            last_s = max(watch.heard_s, watch.since_s)
            if watch.state not in (WAITING, ACTIVE) or now_s - last_s <= self._timeout_s:
                continue
            kind, text = ("never", " since its boot") if watch.state == WAITING else ("lost", "")
            watch.state = LOST
            watch.window.clear()
            events.append(NodeEvent(kind, node, f"{self._timeout_s:g} s{text}", last_s))
        return events

    def _rate(self, node: int, watch: _Watch, now_s: float) -> list[NodeEvent]:
        if now_s - self._ticked_s > _LATE * self._heartbeat_s:
            watch.window.clear()
            return []
        watch.window.append(now_s)
        if len(watch.window) <= _WINDOW:
            return []
        passed = watch.window[-1] - watch.window[0]
        watch.window = [now_s]
        doubled = passed < _TWICE * _WINDOW * self._heartbeat_s
        if doubled == watch.doubled:
            return []
        watch.doubled = doubled
        text = f"{_WINDOW} heartbeats in {passed:.1f} s" if doubled else ""
        return [NodeEvent("doubled" if doubled else "single", node, text, now_s)]

    def _foreign(self, node: int, data: bytes) -> list[NodeEvent]:
        """Report a node that is not in the network list (CiA 302-2, status A), once."""
        if node in self._known or len(self._known) > _OTHERS or len(data) != 1:
            return []
        self._known.add(node)
        line = f"node {node}: on the bus but not in the configuration (status A)"
        return [NodeEvent("foreign", node, line, 0.0)]

    @staticmethod
    def _event(kind: str, node: int, watch: _Watch, now_s: float, text: str) -> NodeEvent:
        refused = watch.limit.admit(kind, now_s)
        if refused is None:
            return NodeEvent(kind, node, "", now_s)
        line = f"node {node}: {text}" + (f" ({refused} more before)" if refused else "")
        return NodeEvent(kind, node, line, now_s)


SIGNATURE_EVERY = 4
_CAN_ID, _INVALID, _ALL = 0x7FF, 0x8000_0000, 0xFFFF_FFFF
_COB_IDS, _MAPPINGS = range(0x1800, 0x1A00), range(0x1A00, 0x1C00)
_PROFILE, _UNIT = 0x6000, 0x6131
_MODE_DISPLAY = 0x6061


@dataclass(frozen=True)
class Check:
    """One object, the bits of it that count, and their expected value (None: the first one that is read)."""

    index: int
    subindex: int
    mask: int
    expected: int | None

    def text(self, value: int) -> str:
        """Format a value: bit fields as hexadecimal digits, numbers of the profile as decimal digits."""
        return str(value) if self.index >= _PROFILE and self.index != _UNIT else f"0x{value:X}"


CHANGED = "its configuration was changed "


class ConfigurationMismatch(NamedTuple):
    """Result of a reading: with `changed`, the node is not used until its next boot; else it is only logged."""

    changed: bool
    text: str


def checks_of(node: Mapping[str, Any]) -> list[Check]:
    """Return the objects of a boot report that define the meaning of a node's PDOs, and a drive's mode."""
    checks = []
    for index, subindex, value in node["watched"]:
        mask = _ALL
        if index in _COB_IDS and subindex == 1:
            # bit 30 is the device's own; of a PDO that is off nothing else matters
            mask = _INVALID if value & _INVALID else _CAN_ID | _INVALID
        elif index in _MAPPINGS and subindex:
            mask = _ALL & ~0x80  # bit 7 of a length is none: `pdo.whole_entry`
        checks.append(Check(index, subindex, mask, value & mask))
    if node["gear_ratio"] is not None:
        checks.append(Check(_MODE_DISPLAY, 0, 0xFF, None))
    return checks


class ConfigurationWatch:
    """Whether one node is still configured as at its boot: `next` is the object to be read, `result` takes its value.

    1020h, where a node has it, shows a write to its configuration: it holds the signature of the boot until then (CiA 301).
    It need not cover the scaling, and a value may change by other ways than an SDO. So all objects on which the meaning of
    its PDOs depends are read cyclically (`jtqd.drivers.boot_node`); every `SIGNATURE_EVERY`th reading is the signature's.

    A signature that is gone while these are unchanged (the commander maps RPDOs) is logged once, and so is a change of the
    displayed mode of operation (6061h), which does not affect the estimate.
    """

    def __init__(self, report: Mapping[str, Any]) -> None:
        self._objects = checks_of(report)
        first, _ = signature(report["configuration_sha256"])
        self._signature = Check(VERIFY_CONFIGURATION, 1, _ALL, first) if report["signed"] else None
        self._position = self._turn = 0
        self._mode: int | None = None

    def next(self) -> Check:
        """Return the object to be read now; it is the same until `result` is called."""
        if self._signature is not None and self._turn % SIGNATURE_EVERY == 0:
            return self._signature
        return self._objects[self._position]

    def result(self, value: bytes | None, refusal: int | None = None) -> ConfigurationMismatch | None:
        """Take the value of the object named by `next`, or the abort code of the refusal; return the mismatch, or None."""
        check = self.next()
        self._turn += 1
        if check is not self._signature:
            self._position = (self._position + 1) % len(self._objects)
        if value is None:
            return self._missing(check) if refusal in (NO_OBJECT, NO_SUBINDEX) else None
        found = int.from_bytes(value[:4], "little")
        if check.expected is None:
            return self._mode_now(found)
        if found & check.mask == check.expected:
            return None
        return self._finding(check, check.text(found))

    def _finding(self, check: Check, found: str) -> ConfigurationMismatch:
        assert check.expected is not None
        text = f"{check.index:04X}h:{check.subindex}: expected {check.text(check.expected)}, found {found}"
        if check is not self._signature:
            return ConfigurationMismatch(True, f"{CHANGED}({text})")
        self._signature, self._position = None, 0
        return ConfigurationMismatch(False, f"its configuration was written by another master ({text})")

    def _missing(self, check: Check) -> ConfigurationMismatch | None:
        if check.expected is not None:
            return self._finding(check, "no such object")
        self._objects.remove(check)
        self._position = 0
        return None

    def _mode_now(self, found: int) -> ConfigurationMismatch | None:
        before, self._mode = self._mode, found
        if before is None or found == before:
            return None
        now, then = (int.from_bytes(bytes([mode & 0xFF]), signed=True) for mode in (found, before))
        return ConfigurationMismatch(False, f"its mode of operation (6061h) is {now} now, {then} before")


_CHECK_S = 0.1
"""Between two objects read to check a node's configuration: two frames, 0.27 % of 1 Mbit/s at most."""
_PROBE_S = 0.25
"""Between two requests to a node that needs a boot, whether it answers."""
_PRESENT_S = 1.0
_OTHERS_S = 1.0
"""A node whose SDO server another client uses (it serves one) is not read for so long."""
_SDO_TIMEOUT_S = 0.3


class NodeCare:
    """Boots, presence and configuration of the nodes: call `turn` often, and the other methods for what arrives.

    nodes: silence of each node-ID after which an SDO request is repeated [s]. `changed`: nodes that are configured otherwise
    than at their boot, and how that shows.
    """

    def __init__(
        self,
        nodes: Mapping[int, float],
        reader: SnapshotReader,
        returning: ReturningNodes,
        heartbeats: NodeWatch,
        log: Callable[[str, int, str], None],
    ) -> None:
        self._reader, self._returning, self._heartbeats, self._log = reader, returning, heartbeats, log
        self._queues = {node: SdoQueue(answer_s=answer_s) for node, answer_s in nodes.items()}
        self._timeouts_s = {node: max(_SDO_TIMEOUT_S, answer_s) for node, answer_s in nodes.items()}
        self._out: list[tuple[int, bytes]] = []
        self._checks: dict[int, ConfigurationWatch] = {}
        self._present_until: dict[int, float] = {}
        self._others_until: dict[int, float] = {}
        self._check_due = self._probe_due = self._boot_ended = 0.0
        self._check_turn = 0
        self.changed: dict[int, str] = {}

    unchecked: frozenset[int] = frozenset()
    """Nodes with an identity that nobody has checked: none, after a boot."""

    def is_booting(self, now_s: float) -> bool:
        """Return whether a boot is running or has just ended, so that NMT commands may belong to it."""
        return bool(self._returning.busy) or now_s < self._boot_ended

    def on_reply(self, node: int, data: bytes, now_s: float) -> None:
        """Take a frame 580h + node, which proves that the node is present."""
        self._present_until[node] = now_s + _PRESENT_S
        if node != self._returning.busy:
            self._out += [(node, request) for request in self._queues[node].on_reply(data, now_s)]

    def on_command(self, number: int, node: int) -> None:
        """Take an NMT command of another node: its effect shows in the heartbeats."""

    def on_foreign_request(self, node: int, data: bytes, now_s: float) -> None:
        """Take a frame 600h + node that jtqd did not send."""
        self._others_until[node] = now_s + _OTHERS_S

    def configured(self, node: int, report: dict[str, Any], now_s: float) -> None:
        """Take a node that was booted, with its part of the boot report."""
        self.changed.pop(node, None)
        self._heartbeats.watch(node, now_s)
        self._checks[node] = ConfigurationWatch(report)

    def restarted(self, node: int) -> None:
        """Take a boot-up message: the node has neither a configuration to be checked nor an error."""
        self._checks.pop(node, None)
        self._returning.note_error(node, 0)

    def turn(self, view: View, now_s: float) -> list[tuple[int, bytes]]:
        """Return the SDO request that is due, as (node, request)."""
        self._watch_nodes(view, now_s)
        for node, queue in self._queues.items():
            if node != self._returning.busy:
                self._out += [(node, request) for request in queue.tick(now_s)]
        out, self._out = self._out, []
        return out

    def state(self, node: int, view: View) -> tuple[int, int, int]:
        """Return NMT state, heartbeat state (`jtqd.daemon.bus.nodes`) and whether the node is configured."""
        configured = node not in view.unconfigured and node not in self._returning.absent
        return view.node_states[node], self._heartbeats.state(node), int(configured)

    def sdo_counts(self, node: int) -> dict[str, int]:
        """Return the counts of SDO requests repeated, unanswered and refused, and of unrelated answers."""
        queue = self._queues[node]
        return {
            "repeats": queue.repeats,
            "silences": queue.timeouts,
            "refusals": queue.refusals,
            "ignored": queue.ignored,
        }

    def _watch_nodes(self, view: View, now_s: float) -> None:
        """Boot nodes that need it, poll their presence, and check the configuration of the others."""
        returning = self._returning
        was_busy = returning.busy
        booted = returning.watch(view, lambda node: self._present(node, now_s), self._reader, now_s)
        if was_busy and not returning.busy:
            self._boot_ended = now_s + _PROBE_S
        if returning.busy and returning.busy != was_busy:
            self._queues[returning.busy].clear()
        if booted is not None:
            self.configured(booted["node"], booted, now_s)
        if now_s >= self._probe_due and not returning.busy:
            self._probe_due = now_s + _PROBE_S
            for node in returning.waiting(view, now_s):
                queue = self._queues.get(node)
                if queue is not None and not queue.busy and not self._others_talk_to(node, now_s):
                    queue.read((0x1000, 0), _ignore, _SDO_TIMEOUT_S)  # a later answer shows it, too
        if now_s >= self._check_due:
            self._check_due = now_s + _CHECK_S
            self._check_one(view, now_s)

    def _present(self, node: int, now_s: float) -> bool:
        answered = self._present_until.get(node, 0.0) > now_s
        return answered or self._heartbeats.heard_within(node, _PRESENT_S, now_s)

    def _others_talk_to(self, node: int, now_s: float) -> bool:
        return now_s < self._others_until.get(node, 0.0)

    def _check_one(self, view: View, now_s: float) -> None:
        """Read one object of one operational, idle node."""
        waiting = {*self._returning.waiting(view, now_s), self._returning.busy, *view.unconfigured}
        nodes = [
            node
            for node in self._checks
            if node not in waiting
            and not self._queues[node].busy
            and not self._others_talk_to(node, now_s)
            and self._heartbeats.state(node) != LOST
        ]
        if not nodes:
            return
        self._check_turn += 1
        node = nodes[self._check_turn % len(nodes)]
        check, watch = self._checks[node].next(), self._checks[node]
        done = partial(self._on_check, node, watch)
        self._queues[node].read((check.index, check.subindex), done, self._timeouts_s[node])

    def _on_check(
        self, node: int, watch: ConfigurationWatch, value: bytes | None, refusal: int | None
    ) -> None:
        if self._checks.get(node) is not watch:
            return
        finding = watch.result(value, refusal)
        if finding is None:
            return
        if not finding.changed:
            self._log("boot", node, f"node {node}: {finding.text}")
            return
        del self._checks[node]
        self.changed[node] = finding.text.removeprefix(CHANGED)
        self._reader.note_doubt(node)
        self._returning.request(node, finding.text)


def _ignore(_value: bytes | None, _refusal: int | None) -> None:
    """Take the result of a request of which only the answer as such matters."""


# As a guest -----------------------------------------------------------------------------------------------------------

_IDENTITY = 0x1018


class HeardNodes(NodeCare):
    """The nodes of another master: what is heard of them, and no request.

    A node that left operational, or sent its boot-up message, is used again once it is operational. One of which a master
    writes or reads another value than its PDOs are decoded with is not used until that value is back. `unchecked`: nodes
    whose identity (1018h) no master has read yet.

    report: of `jtqd.drivers.boot.known_nodes`; the other arguments are those of `NodeCare`.
    """

    def __init__(self, report: Mapping[str, Any], *arguments: Any) -> None:
        super().__init__(*arguments)
        self._expected: dict[int, dict[tuple[int, int], Check]] = {}
        self._unread: dict[int, set[tuple[int, int]]] = {node: set() for node in report.get("unchecked", ())}
        for number, each in report["nodes"].items():
            identity = report["identities"].get(number, {})
            checks = [Check(_IDENTITY, int(sub), _ALL, value) for sub, value in identity.items()]
            checks += [check for check in checks_of(each) if check.expected is not None]
            self._expected[int(number)] = {(check.index, check.subindex): check for check in checks}
        self._asked: dict[int, tuple[tuple[int, int], int | None]] = {}
        self._differs: dict[int, dict[tuple[int, int], str]] = {node: {} for node in self._expected}
        self._runs: dict[int, bool] = {}
        """By the last NMT command; a node without one may be operational."""
        self._waiting: set[int] = set()
        for node in self._unread:
            self._uncheck(node)

    def _uncheck(self, node: int) -> None:
        """It may be another device than before."""
        self._unread[node] = {key for key in self._expected[node] if key[0] == _IDENTITY} or {(_IDENTITY, 0)}
        self._note_identity(node)

    def _note_identity(self, node: int) -> None:
        self.unchecked = frozenset(each for each, unread in self._unread.items() if unread)
        self._reader.note_checked(node, node not in self.unchecked)

    def is_booting(self, now_s: float) -> bool:
        """Return True: NMT commands are those of the master."""
        return True

    def on_command(self, number: int, node: int) -> None:
        """Take an NMT command."""
        if number in COMMANDS:
            self._runs |= dict.fromkeys([node] if node else self._expected, number == START)

    def on_foreign_request(self, node: int, data: bytes, now_s: float) -> None:
        """Take a frame 600h + node of its master: an upload, or a download with its value."""
        if len(data) == 8 and data[0] >> 5 in (1, 2):
            # what comes in segments is not followed: it counts as another value
            value = int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little") if data[0] & 2 else _ALL
            self._asked[node] = (data[1] | data[2] << 8, data[3]), value if data[0] >> 5 == 1 else None

    def on_reply(self, node: int, data: bytes, now_s: float) -> None:
        """Take a frame 580h + node: the value of the object that its master has read, or written."""
        key, value = self._asked.pop(node, ((0, 0), None))
        check = self._expected.get(node, {}).get(key)
        if check is None or len(data) != 8 or (data[1] | data[2] << 8, data[3]) != key:
            return
        if data[0] >> 5 == 2 and data[0] & 2:
            value = int.from_bytes(data[4 : 8 - (data[0] >> 2 & 3)], "little")
        elif data[0] >> 5 != 3:
            return
        if value is not None and value & check.mask != check.expected:
            found = f"expected {check.text(check.expected or 0)}, found {check.text(value)}"
            self._differs[node][key] = f"({key[0]:04X}h:{key[1]}: {found})"
            return
        self._differs[node].pop(key, None)
        if node in self.unchecked and key in self._unread[node]:
            self._unread[node].discard(key)
            self._note_identity(node)

    def configured(self, node: int, report: dict[str, Any], now_s: float) -> None:
        """Take a node of the start: its heartbeat is watched from the first one on."""

    def restarted(self, node: int) -> None:
        """Take a boot-up message: what was written before is gone."""
        if node not in self._differs:
            return  # of a sensor that nobody has described
        self._differs[node].clear()
        self._runs.pop(node, None)
        self._waiting.add(node)
        if node in self._unread:
            self._uncheck(node)

    def turn(self, view: View, now_s: float) -> list[tuple[int, bytes]]:
        """Doubt the nodes that were changed, use again those that are as expected; return no request."""
        for node, differs in self._differs.items():
            state = view.node_states[node]
            if state and self._heartbeats.state(node) == NOT_WATCHED:
                self._heartbeats.watch(node, now_s)
            if differs:
                if node not in self.changed:
                    self._reader.note_doubt(node)
                    self._waiting.add(node)
                self.changed[node] = next(iter(differs.values()))
                continue
            self.changed.pop(node, None)
            if node in view.unconfigured and self._runs.get(node, state == OPERATIONAL):
                self._reader.note_configured(node, view.restarts[node])
                if node in self._waiting:
                    self._waiting.discard(node)
                    self._log("boot", node, f"node {node} is operational and used again")
        return []
