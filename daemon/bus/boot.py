"""Boot of the nodes: the request, and boots in service of nodes that restart, stop, appear or lose their configuration.

A node is configured before its data is used: one after the other, each by a boot process of its own beside the running loop.
A node that fails is tried again later and keeps no other one waiting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from jtqd.daemon.config import LISTENER, MASTER, Config, as_booted
from jtqd.daemon.shared.events import RateLimit
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.drivers import nmt
from jtqd.drivers.boot import BootRequest, DriveNode, SensorNode
from jtqd.drivers.boot_node import Sync
from jtqd.drivers.bus_load import BusLoad, configured_load
from jtqd.drivers.emcy import COMMUNICATION
from jtqd.drivers.object_dictionary import Identity
from jtqd.drivers.own_objects import own_sheet

_EDS = Path(__file__).resolve().parents[2] / "drivers" / "eds"


def own_eds(config: Config) -> list[str]:
    """Return the arguments by which the boot process reads jtqd's own EDS: its path, and the node-ID."""
    return [str(_EDS / own_sheet(len(config.joints))), str(config.node_id)]


def boot_request(
    config: Config, bus: str, only: int | None = None, *, reset: bool | None = None
) -> BootRequest:
    """Return the request to the boot process for all nodes, or for `only` one.

    reset: begin with NMT reset communication; None: as configured.
    """
    nodes: list[DriveNode | SensorNode] = [
        DriveNode(
            node=joint.node_id,
            identity=Identity(**asdict(joint.identity)),
            given=joint.given,
            eds=str(joint.eds or ""),
            pinned=joint.pinned,
            sdo_timeout_ms=joint.sdo_timeout_ms,
            mandatory=joint.mandatory or only is not None,
            temperature=joint.temperature,
            objects=joint.objects,
            tpdos=tuple(pdo.tpdo for pdo in joint.tpdos),
            torque_constant_nm_per_a=joint.joint.torque_constant_nm_per_a,
            acyclic=joint.max_age_ms > 0.0,
        )
        for joint in config.joints
    ]
    if config.sensor is not None:
        sensor = config.sensor
        nodes.append(
            SensorNode(
                node=sensor.node_id,
                identity=Identity(**asdict(sensor.identity)),
                given=sensor.given,
                sdo_timeout_ms=sensor.sdo_timeout_ms,
                mandatory=sensor.mandatory or only is not None,
                eds=str(sensor.eds or ""),
                pinned=sensor.eds is None,
                channels=sensor.channels,
                unit_words=sensor.unit_words,
            )
        )
    return BootRequest(
        bus=bus,
        nodes=tuple(each for each in nodes if only in (None, each.node)),
        master_node=config.node_id,
        heartbeat_ms=config.heartbeat_ms,
        # Drives that watch our heartbeat allow two to be lost.
        master_timeout_ms=min(max(500, 3 * config.heartbeat_ms), 0xFFFF),
        # In service the node has just been heard.
        answer_timeout_s=config.boot_timeout_s if only is None else min(config.boot_timeout_s, 0.5),
        error_behaviour=config.error_behaviour,
        reset=config.reset_communication if reset is None else reset,
        sync=Sync(counter_overflow=config.counter_overflow, check_foreign=only is None),
        guest=config.role != MASTER,
        listener=config.role == LISTENER,
        period_us=config.period_ns / 1000,
    )


def bus_load_of(config: Config) -> BusLoad:
    """Compute the load of everything that the configuration puts on the bus; nothing is checked here."""
    return configured_load(
        {joint.node_id: joint.tpdos for joint in config.joints},
        {config.sensor.node_id: config.sensor.channels} if config.sensor else {},
        sync_counter=config.counter_overflow > 0,
        temperatures=[joint.node_id for joint in config.joints if joint.temperature],
        contacts=config.contact is not None and config.contact.pdo,
        heartbeat_ms=config.heartbeat_ms,
        master=config.node_id,
        bitrate=config.bitrate,
        period_s=config.period_ns * 1e-9,
    )


_RETRY_S, _LONGEST_RETRY_S = 0.5, 8.0
_REPEAT_LINE_S = 60.0
"""Between two equal lines about a boot that fails."""
_SETTLED_S = 0.3
"""After its boot a node's last heartbeat may still be that of pre-operational."""

LogEvent = Callable[[str, int, str], None]
"""Takes topic, node and a line of an event."""


class ReturningNodes:
    """Boots nodes that restarted, are not operational, were absent at the start, or for which `request` asks.

    A node that comes back with another scaling than at the start stays out: the loop's factors are those of the start. The
    report of the first boot gets the nodes that are booted later. `busy`: node that is being booted, 0 for none; `absent`:
    optional nodes that have not been booted yet.
    """

    def __init__(
        self,
        config: Config,
        bus: str,
        report: dict[str, Any],
        start_child: Callable[[str, list[str], str], Child],
        log: LogEvent,
    ) -> None:
        self._config, self._bus, self._report = config, bus, report
        self._start_child, self._log = start_child, log
        self._child: Child | None = None
        self._restarts = 0
        """`View.restarts` of the node that is being booted, before that began."""
        self.busy = 0
        self.absent = {int(node) for node in report.get("absent", {})}
        self._requested: dict[int, str] = {}
        self._not_before: dict[int, float] = {}
        self._retry_s: dict[int, float] = {}
        self._limit = RateLimit(_REPEAT_LINE_S)
        self._in_error: set[int] = set()

    def note_error(self, node: int, register: int) -> None:
        """Take the error register (1001h) of an EMCY: a drive with an error of communication may have to be reset."""
        if register & COMMUNICATION:
            self._in_error.add(node)
        else:
            self._in_error.discard(node)

    def request(self, node: int, why: str) -> None:
        """Request a boot of this node; `why` goes into the line about it."""
        self._requested[node] = why

    def waiting(self, view: View, now_s: float) -> list[int]:
        """Return the nodes that need a boot and may be tried now, the longest waiting first."""
        idle = [
            int(node) for node in self._report["nodes"] if view.node_states[int(node)] in nmt.NOT_OPERATIONAL
        ]
        wanted = dict.fromkeys((*view.unconfigured, *idle, *self._requested, *self.absent))
        due = [node for node in wanted if now_s >= self._not_before.get(node, 0.0)]
        return sorted(due, key=lambda node: self._not_before.get(node, 0.0))

    def watch(
        self, view: View, present: Callable[[int], bool], reader: SnapshotReader, now_s: float
    ) -> dict[str, Any] | None:
        """Return the report of a node that has just been configured: {"node": number, ...}. Call often.

        present: whether a node was heard recently; reader: reports to the loop that a node is configured.
        """
        if self._child is not None:
            running = self._child.alive()  # before its answer is read: the last one is then complete
            answer = self._child.poll_answer()
            if answer is None and running:
                return None
            node, self._child, self.busy = self.busy, None, 0
            # A node that has restarted meanwhile, but for the boot's own reset, may have lost its configuration.
            # Where the loop has counted fewer restarts (it missed a boot-up message), it compares with its own count.
            most, self._restarts = self._restarts + _boot_ups(answer, node), view.restarts[node]
            if view.restarts[node] > most:
                text = f"node {node} restarted during its configuration: configuring again"
                booted = self._refuse(node, text, now_s)
            else:
                booted = self._accepted(node, answer, now_s)
            if booted is None:
                self._put_off(node, now_s)
                return None
            self._adopt(node, booted, reader, now_s)
            return {"node": node, **booted}
        for node in self.waiting(view, now_s):
            if present(node):
                self._start(node, view.restarts[node])
                break
        return None

    def _start(self, node: int, restarts: int) -> None:
        self.busy, self._restarts = node, restarts
        self._child = self._start_child("jtqd.drivers.boot", [], f"the boot of node {node}")
        # A node that has just restarted needs no reset; one that could not be booted, or reports an error, may.
        reset = self._config.reset_communication and (node in self._retry_s or node in self._in_error)
        self._in_error.discard(node)
        self._child.send(boot_request(self._config, self._bus, only=node, reset=reset).as_json())
        self._child.end_of_input()

    def _put_off(self, node: int, now_s: float) -> None:
        retry_s = self._retry_s.get(node, _RETRY_S)
        self._retry_s[node] = min(2.0 * retry_s, _LONGEST_RETRY_S)
        self._not_before[node] = now_s + retry_s

    def _adopt(self, node: int, booted: dict[str, Any], reader: SnapshotReader, now_s: float) -> None:
        key = str(node)
        if key not in self._report["nodes"]:
            reader.note_factors(node, _factors(booted["scaling"]))
        self._report["nodes"][key] = booted
        reader.note_configured(node, self._restarts)
        self._retry_s.pop(node, None)
        self._not_before[node] = now_s + _SETTLED_S
        why = self._requested.pop(node, None)
        if node in self.absent:
            self.absent.discard(node)
            self._log("boot", node, f"node {node} appeared and is configured")
        else:
            text = f"node {node} returned and is configured again"
            self._log("boot", node, text if why is None else f"node {node} is configured again: {why}")
        for note in booted.get("notes", ()):
            self._log("boot", node, f"node {node}: {note}")

    def _accepted(self, node: int, answer: dict[str, Any] | None, now_s: float) -> dict[str, Any] | None:
        """Return the node's part of the report, if it may be used."""
        if answer is None:
            return self._refuse(node, "boot in service: the boot process ended without a report", now_s)
        if not answer["ok"]:
            return self._refuse(node, f"boot in service: {answer['error']['message']}", now_s)
        now: dict[str, Any] = answer["nodes"][str(node)]
        then = self._report["nodes"].get(str(node))
        if then is None:
            return self._accepted_first(node, now, now_s)
        for key in ("scaling", "gear_ratio"):
            if now[key] != then[key]:
                text = f"node {node} has another {key} than at the start: expected {then[key]}, found {now[key]}: not used"
                return self._refuse(node, text, now_s)
        if now.get("tpdos") != then.get("tpdos"):
            text = f"node {node} has other TPDOs than at the start: not used; restart jtqd"
            return self._refuse(node, text, now_s)
        if now["serial"] != then["serial"]:
            text = f"another device: serial number {now['serial']:08X}h, before {then['serial']:08X}h"
            self._log("boot", node, f"node {node}: {text}")
        return now

    def _accepted_first(self, node: int, now: dict[str, Any], now_s: float) -> dict[str, Any] | None:
        """Check a node that was absent at the start as the first boot would have done."""
        wrong = gear_ratio_error(self._config, node, now.get("gear_ratio"))
        if wrong is None and as_booted(self._config, {str(node): now}) != self._config:
            wrong = f"node {node} has other TPDOs than expected at the start, when it was absent: not used; restart jtqd"
        return now if wrong is None else self._refuse(node, wrong, now_s)

    def _refuse(self, node: int, text: str, now_s: float) -> dict[str, Any] | None:
        """Report why the node is not used; return nothing that may be used."""
        if self._limit.admit(text, now_s) is not None:
            self._log("boot", node, text)
        return None


def _boot_ups(answer: dict[str, Any] | None, node: int) -> int:
    """Return the boot-up messages that the boot heard before it configured the node."""
    if answer is None or not answer["ok"]:
        return 0
    count: int = answer["nodes"].get(str(node), {}).get("boot_ups", 0)
    return count


def gear_ratio_error(config: Config, node: int, found: float | None) -> str | None:
    """Compare the drive's gear ratio (6091h) with the joint file; return the difference as text, or None."""
    for joint in config.joints:
        expected = joint.joint.gear_ratio
        if joint.node_id == node and found and abs(found - expected) > 0.005 * expected:
            where = f"{joint.joint_path}, joint {joint.number}"
            return f"node {node}: 6091h gear ratio: expected {expected:g} ({where}), found {found:g}"
    return None


def _factors(scaling: dict[str, Any]) -> tuple[float, ...]:
    """In the order of `SnapshotReader.note_factors`."""
    if "nm_per_unit" in scaling:
        return tuple(scaling["nm_per_unit"][channel] for channel in sorted(scaling["nm_per_unit"]))
    names = ("motor_rad_per_count", "motor_rad_s_per_unit", "link_rad_per_count", "ampere_per_unit")
    return tuple(scaling[name] for name in names)
