"""Statuses of /diagnostics, once a second: loop, bus, every joint, every node, recorder and disk.

A view of the conditions (`jtqd.daemon.shared.conditions`): the worst one of a subject is its level and its text. A condition
that shows by a counter counts when the counter has risen since the last message: a slot that was missed an hour ago is in
the count, not in the level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jtqd.daemon.recording import messages
from jtqd.daemon.recording.messages import Status
from jtqd.daemon.recording.run_files import MEGABYTE, Account
from jtqd.daemon.shared import events
from jtqd.daemon.shared.conditions import CATALOGUE, SHOWN_BY_COUNTERS, Condition, read_conditions, worst
from jtqd.daemon.shared.counters import Shown, shown_in
from jtqd.daemon.shared.cycle_record import RingReader, layout_of
from jtqd.daemon.shared.snapshot import SnapshotReader, View
from jtqd.drivers import nmt
from jtqd.estimator.text import counted

if TYPE_CHECKING:
    from jtqd.daemon.recording.parts import FlightRecorder, Parts

OK, WARN, ERROR, STALE = range(4)
_OF_THE_BUS = shown_in(Shown.BUS)
_JOINT_LEVELS = {"VALID": OK, "STANDSTILL": OK, "STALE": STALE, "DRIVE_FAULT": ERROR, "INVALID": ERROR}
_LEVELS = {events.INFO: OK, events.WARNING: WARN, events.ERROR: ERROR}
"""Of severities."""
_QUANTILES = (0.5, 0.99, 1.0)
_PERIOD_NS = 1_000_000_000
_SILENT_S = 1.0
_NEAR = 2.0
"""Times the reserve: less free space than this is a warning."""


class Node(NamedTuple):
    """A node of the bus."""

    node_id: int
    name: str


class Diagnostics:
    """Statuses of loop, bus, joints and nodes by the loop's snapshot, and of the recorder; remembers the previous counts.

    Args:
        snapshot: of the loop; the supervisor's conditions lie in the same directory. None: there is none.
        bus: name of the bus.
        joints: names of the joints.
        nodes: whose heartbeats are watched.

    Raises:
        SharedMemoryError: the snapshot is none.
    """

    def __init__(self, snapshot: Path | None, bus: str, joints: Sequence[str], nodes: Sequence[Node]) -> None:
        self._directory = Path() if snapshot is None else snapshot.parent
        self._snapshot = None if snapshot is None else SnapshotReader(snapshot)
        self._bus = bus
        self._joints = joints
        self._nodes = nodes
        self._before: dict[str, int] = {}
        self._lost = 0
        self._cycle: int | None = None

    def of_loop(self, now_ns: int) -> tuple[View | None, list[Status]]:
        """Read the snapshot: its view and the statuses of loop, bus, joints and nodes; nothing without a snapshot.

        now_ns: CLOCK_REALTIME.
        """
        snapshot = self._snapshot
        if snapshot is None:
            return None, []
        work_us, late_us = snapshot.work_us(*_QUANTILES), snapshot.late_us(*_QUANTILES)
        view = snapshot.read()
        found = [*read_conditions(self._directory), *self._risen(view)]
        result = [self._loop(view, work_us, late_us, found), self._bus_status(view, found)]
        result += [self._joint(view, number, found) for number in range(1, len(view.joints) + 1)]
        result += [self._node(view, node, now_ns, found) for node in self._nodes]
        self._before, self._cycle = dict(view.counters), view.cycle
        return view, result

    def of_recorder(
        self,
        account: Account,
        parts: Parts,
        flight: FlightRecorder | None,
        *,
        backlog: int,
        cpu_percent: float,
        events_left_out: int,
    ) -> list[Status]:
        """Return the statuses of recorder and disk."""
        mode = "recording" if flight is None else "saving" if flight.saving else "in memory"
        mode = "waiting" if parts.obstacle else mode
        level, text = OK, mode
        if account.lost:
            level, text = WARN, f"{counted(account.lost, 'cycle')} lost so far"
        if account.lost > self._lost:
            lost = account.lost - self._lost
            level, text = ERROR, f"{counted(lost, 'cycle')} lost since the last message"
        self._lost = account.lost
        values: dict[str, float | str] = {
            "mode": mode,
            "backlog": backlog,
            "cycles": account.cycles,
            "written": account.written,
            "lost_overwritten": account.overwritten,
            "lost_unwritten": account.unwritten,
            "let_go": account.let_go,
            "events_left_out": events_left_out,
            "cpu_percent": cpu_percent,
            "part": parts.part,
            "memory_mb": (0 if flight is None else flight.memory_bytes) / MEGABYTE,
            "memory_s": 0.0 if flight is None else flight.memory_s,
        }
        return [Status("jtqd: recorder", self._bus, level, text, values), self._disk(parts)]

    def _disk(self, parts: Parts) -> Status:
        free, reserve, budget = parts.free_bytes, parts.rules.reserve, parts.rules.budget
        level, text = OK, "room"
        if 0 <= free < _NEAR * reserve:
            level, text = WARN, "little room"
        if parts.obstacle:
            level, text = ERROR, parts.obstacle
        values: dict[str, float | str] = {
            "part_mb": parts.size / MEGABYTE,
            "logs_mb": parts.total_size / MEGABYTE,
            "budget_mb": "none" if budget is None else budget / MEGABYTE,
            "free_mb": free / MEGABYTE if free >= 0 else "unknown",
            "reserve_mb": reserve / MEGABYTE,
        }
        return Status("jtqd: disk", self._bus, level, text, values)

    def _risen(self, view: View) -> list[Condition]:
        """Return conditions whose counter has risen since the last message."""
        if not self._before:
            return []
        return [
            Condition(name, subject.name, CATALOGUE[name].severity, CATALOGUE[name].text.format(counter), 0)
            for counter, (name, subject) in SHOWN_BY_COUNTERS.items()
            if view.counters.get(counter, 0) > self._before.get(counter, 0)
        ]

    def _loop(
        self, view: View, work_us: Sequence[float], late_us: Sequence[float], found: Sequence[Condition]
    ) -> Status:
        level, text = _level(found, "loop", "running")
        missed = view.counters["missed"] - self._before.get("missed", 0)
        if self._before and missed:
            text = f"{counted(missed, 'slot')} missed since the last message"
        if view.cycle == self._cycle:
            level, text = STALE, "the loop is stalled"
        values: dict[str, float | str] = {"cycle": view.cycle}
        values |= {name: count for name, count in view.counters.items() if name not in _OF_THE_BUS}
        for name, figures in (("work", work_us), ("late", late_us)):
            values |= dict(zip((f"{name}_p50_us", f"{name}_p99_us", f"{name}_max_us"), figures, strict=True))
        return Status("jtqd: loop", self._bus, level, text, values)

    def _bus_status(self, view: View, found: Sequence[Condition]) -> Status:
        level, text = _level(found, "bus", "running")
        values: dict[str, float | str] = {
            name: view.counters[name] for name in _OF_THE_BUS if name in view.counters
        }
        return Status("jtqd: bus", self._bus, level, text, values | {"worst_case_load": view.worst_load})

    def _joint(self, view: View, number: int, found: Sequence[Condition]) -> Status:
        joint = view.joints[number - 1]
        name = messages.STATUS_NAMES.get(joint.status, str(joint.status))
        values: dict[str, float | str] = {
            "status": name,
            "torque_nm": joint.torque_nm,
            "sigma_nm": joint.sigma_nm,
            "sensor_nm": joint.sensor_nm,
            "reference_nm": joint.reference_nm,
            "age_ms": joint.age_ms,
            "rmse_nm": view.rmse_nm[number - 1],
            "statusword": f"{joint.statusword:04X}h",
            "sensor_status": joint.sensor_status,
            "input_flags": joint.input_flags,
        }
        zeros = view.zeros[number - 1]
        if zeros.tracked:
            values |= {
                "link_zero_rad": zeros.link_rad,
                "link_zero_sigma_rad": zeros.link_sigma_rad,
                "link_zero_used_rad": zeros.link_used_rad,
                "current_zero_a": zeros.current_a,
                "zero_learned": "yes" if zeros.learned else "no",
                "zero_jumps": zeros.jumps,
            }
        level, text = _level(found, f"joint {number}", "")
        title, hardware = f"jtqd: joint {number}", self._joints[number - 1]
        by_status = _JOINT_LEVELS.get(name, WARN)
        shown = f"{name}: {text}" if text else name
        return Status(title, hardware, by_status or level, shown, values)

    def _node(self, view: View, node: Node, now_ns: int, found: Sequence[Condition]) -> Status:
        state = view.node_states[node.node_id]
        name = nmt.STATES.get(state, f"state {state}")
        heard = view.node_heard_ns[node.node_id]
        age_s = (now_ns - heard) * 1e-9 if heard else float("nan")
        level, text = _level(found, f"node {node.node_id}", name)
        level = max(level, OK if state == nmt.OPERATIONAL else WARN)
        if not age_s <= _SILENT_S:
            level, text = STALE, "no heartbeat"
        values: dict[str, float | str] = {"nmt_state": name, "heartbeat_age_s": age_s}
        return Status(f"jtqd: node {node.node_id}", node.name, level, text, values)


def _level(found: Sequence[Condition], subject: str, otherwise: str) -> tuple[int, str]:
    """Return level and text of the worst condition of a subject; OK and `otherwise` without one."""
    condition = worst(found, subject)
    return (OK, otherwise) if condition is None else (_LEVELS[condition.severity], condition.text)


class LoopReader:
    """The loop's memory for a process beside it: cycle records, and /diagnostics once a second.

    Args:
        request: made by `launch.loop_request`.

    Attributes:
        ring: cycle records; reading begins behind those that are there.

    Raises:
        SharedMemoryError: the memory is not there.
    """

    def __init__(self, request: Mapping[str, Any]) -> None:
        self.joints: tuple[str, ...] = tuple(request["joint_names"])
        self.ring = RingReader(Path(request["ring"]), layout_of(len(self.joints), request["shadow"]).size)
        nodes = [Node(int(number), str(name)) for number, name in request["nodes"]]
        self._diagnostics = Diagnostics(Path(request["snapshot"]), request["bus"], self.joints, nodes)
        self._diagnosed_ns = 0
        self.skip()

    def skip(self) -> None:
        """Skip to the newest record."""
        self.ring.position += self.ring.backlog

    def diagnosis(self, now_ns: int, realtime_ns: int) -> tuple[View, list[Status]] | None:
        """Return view and statuses of the loop, once a second.

        Args:
            now_ns: CLOCK_MONOTONIC.
            realtime_ns: CLOCK_REALTIME.
        """
        if now_ns - self._diagnosed_ns < _PERIOD_NS:
            return None
        self._diagnosed_ns = now_ns
        view, statuses = self._diagnostics.of_loop(realtime_ns)
        assert view is not None, "the snapshot is open"
        return view, statuses
