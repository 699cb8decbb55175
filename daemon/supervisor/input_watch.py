"""Lines for the operator when a joint's inputs, torque sensor or temperature are lost and come back, with the cause.

Pure: readings of the snapshot and times in, lines out. It runs in the supervisor, so that no line costs the loop anything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isfinite

from daemon.config import Config
from daemon.loop.input_pdos import input_pdos, joint_temperatures, sensor_index
from daemon.loop.joint_cycle import FLAG_MOTION, FLAG_POSITION, FLAG_SENSOR, FLAG_TEMPERATURE
from daemon.loop.temperature import LIFE_S
from daemon.shared.snapshot import JointView, View
from daemon.supervisor.presence import Presence
from estimator.status import STALE

_OPERATIONAL = 5
_STATES = {4: "stopped", 127: "pre-operational"}
"""Heartbeat states in which a node sends no PDO (CiA 301)."""
_ON_THE_BUS = (
    ("bus_errors", "the bus is down"),
    ("foreign_sync", "another SYNC is on the bus"),
    ("sync_errors", "the own SYNC waits in the transmit queue"),
)
"""Counters whose rise makes every input of the bus doubtful, and what that means."""
_ON_THE_PDO = (
    ("late_frames", "late frames on the bus"),
    ("rejected_frames", "frames of a wrong format on the bus"),
)
_SENSOR_STATUS = {1: "not valid", 2: "positive overload", 4: "negative overload"}
"""6150h of CiA 404."""


@dataclass
class _Joint:
    """One joint's PDOs by name, and the counters when it was last well."""

    number: int
    node: int
    names: tuple[str, str]
    sensor: str | None
    sensor_node: int | None
    temperature: str | None
    well: dict[str, int] = field(default_factory=dict)
    inputs: Presence = field(default_factory=Presence)
    reference: Presence = field(default_factory=Presence)
    warmth: Presence = field(default_factory=Presence)


class InputWatch:
    """Call `lines` with each reading of the snapshot, some twenty times a second."""

    def __init__(self, config: Config) -> None:
        names = [pdo.name for pdo in input_pdos(config)]
        temperatures = {each.node_id: each.name for each in joint_temperatures(config)}
        self._joints = []
        for n, joint in enumerate(config.joints):
            sensor = sensor_index(config, joint.sensor_channel)
            own = (names[2 * n], names[2 * n + 1])
            reference = None if sensor is None else names[sensor]
            source = None if sensor is None or config.sensor is None else config.sensor.node_id
            self._joints.append(
                _Joint(joint.number, joint.node_id, own, reference, source, temperatures.get(joint.node_id))
            )

    def lines(self, view: View, now_s: float) -> list[str]:
        """What has to be told now (CLOCK_MONOTONIC)."""
        said = []
        for joint, seen in zip(self._joints, view.joints, strict=True):
            stale = seen.status == STALE
            if not stale or not joint.well:
                joint.well = view.counters
            line = joint.inputs.update(stale, now_s, partial(_cause, joint, seen, view))
            if line:
                said.append(f"joint {joint.number}: inputs {line}")
            if joint.sensor is not None:
                gone = not isfinite(seen.sensor_nm)
                line = joint.reference.update(gone, now_s, partial(_sensor_cause, joint, seen, view))
                if line:
                    said.append(f"joint {joint.number}: torque sensor {line}")
            if joint.temperature is not None:
                # It comes twice a second: at the start nobody can have it yet.
                gone = not seen.input_flags & FLAG_TEMPERATURE and view.cycle * view.period_s > LIFE_S
                cause = f"{joint.temperature} not received for {LIFE_S:g} s, or it says not measured"
                line = joint.warmth.update(gone, now_s, partial(str, cause))
                if line:
                    said.append(f"joint {joint.number}: temperature {line}")
        return said


def _cause(joint: _Joint, seen: JointView, view: View) -> str:
    return stale_cause(joint.node, joint.names, seen, view, joint.well)


def stale_cause(node: int, names: Sequence[str], seen: JointView, view: View, well: Mapping[str, int]) -> str:
    """Why a joint's inputs are not used. The likeliest cause first: what explains more comes before what explains less.

    Args:
        node: its drive.
        names: of its TPDO1 and TPDO2.
        seen: the joint's estimate.
        view: the reading it is from.
        well: the counters of an earlier reading; what has risen since then may be the cause.
    """

    def rose(name: str) -> bool:
        return view.counters[name] > well[name]

    unready = _unready(node, view)
    if unready:
        return unready
    state = _STATES.get(view.node_states[node])
    if state:
        return f"node {node} is {state}"
    for counter, meaning in _ON_THE_BUS:
        if rose(counter):
            return meaning
    missing = [
        name
        for name, flag in zip(names, (FLAG_POSITION, FLAG_MOTION), strict=True)
        if not seen.input_flags & flag
    ]
    if not missing:
        return "the estimate is not ready before the next SYNC"
    what = f"{' and '.join(missing)} not received in time"
    hints = [meaning for counter, meaning in _ON_THE_PDO if rose(counter)]
    return f"{what} ({', '.join(hints)})" if hints else what


def _unready(node: int, view: View) -> str:
    """Of a node that nobody believes: it restarted, is configured otherwise, or was never there. Empty for the others."""
    if node not in view.unconfigured:
        return ""
    if not view.node_heard_ns[node] and not view.node_states[node]:
        return f"node {node} is not there"
    if view.node_states[node] == _OPERATIONAL:
        return f"node {node} is not configured as it was"
    return f"node {node} has restarted and is not configured yet"


def _sensor_cause(joint: _Joint, seen: JointView, view: View) -> str:
    if not seen.input_flags & FLAG_SENSOR:
        if joint.sensor_node is not None and (unready := _unready(joint.sensor_node, view)):
            return unready
        return f"{joint.sensor} not received in time"
    reasons = [text for bit, text in _SENSOR_STATUS.items() if seen.sensor_status & bit]
    return f"{joint.sensor} says {', '.join(reasons) or 'no number'}"
