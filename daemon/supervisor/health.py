"""What the operator is told while the loop runs: lost inputs, faults of the joints, estimates far from the sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import inf, isfinite

from jtqd.daemon.config import Config
from jtqd.daemon.loop.input_pdos import LIFE_S, input_pdos, joint_temperatures, sensor_index
from jtqd.daemon.loop.joint import FLAG_MOTION, FLAG_POSITION, FLAG_SENSOR, FLAG_TEMPERATURE
from jtqd.daemon.shared.cycle_record import MEANINGS, NAMES
from jtqd.daemon.shared.log_lines import RateLimit, Teller
from jtqd.daemon.shared.snapshot import JointView, View
from jtqd.estimator.status import PUBLISHED, STALE

# Something that comes and goes, told in few lines: neither a flicker nor a flapping contact floods the log.


_HOLD_S = 0.1
"""A change that does not last so long is none; counters and the log's events have it all the same."""
_QUIET_S = 5.0
"""Between two lines that tell a loss. Its end is told at once."""


class Presence:
    """Makes "lost: cause" and "back after 2.3 s" out of readings.

    A loss that comes too soon after the last one is told together with its end, or with those that follow.
    """

    def __init__(self) -> None:
        self.lost = False
        self._reading, self._since = False, -inf
        self._began = 0.0
        self._losses, self._lost_s = 0, 0.0
        self._cause = ""
        self._said = False
        self._not_before = -inf

    def update(self, lost: bool, now_s: float, cause: Callable[[], str]) -> str | None:
        """The line that is due, if any; call it with every reading. `cause` is asked when a loss has lasted."""
        if lost != self._reading:
            self._reading, self._since = lost, now_s
        if lost != self.lost and now_s - self._since >= _HOLD_S:
            self.lost = lost
            if lost:
                self._began, self._losses, self._cause = self._since, self._losses + 1, cause()
            else:
                self._lost_s += self._since - self._began
        may_say = self._said or now_s >= self._not_before
        if self.lost:
            return self._tell_loss(now_s) if may_say and not self._said else None
        return self._tell_return(now_s) if may_say and self._losses else None

    def _tell_loss(self, now_s: float) -> str:
        self._said, self._not_before = True, now_s + _QUIET_S
        return f"lost: {self._cause}"

    def _tell_return(self, now_s: float) -> str:
        text = f"back after {self._lost_s:.1f} s"
        if self._losses > 1:
            text += f", lost {self._losses} times"
        if not self._said:
            text += f": {self._cause}"
            self._not_before = now_s + _QUIET_S
        self._said, self._losses, self._lost_s = False, 0, 0.0
        return text


# A warning when an estimate stays further from the torque sensor than its sigma allows: one of the two is wrong.
#
# Pure: readings of the snapshot and times in, lines out. It runs in the supervisor, beside the loop.


FAR, NEAR = 3.0, 2.0
"""An episode begins beyond FAR times sigma and ends within NEAR: on the edge it does not begin again and again."""
LASTING_S = 1.0
"""Both must last so long: delays and friction at a reversal are over sooner."""
_GAP_S = 0.5
"""Readings further apart say nothing about the time between them."""


class _Joint:
    """One joint's episode, and since when the readings have been asking for a change."""

    def __init__(self) -> None:
        self.far = False
        self.since_s = inf
        self.last_s = -inf


class DeviationWatch:
    """Call `lines` with each reading of the snapshot, some twenty times a second.

    Attributes:
        episodes: how many there were of joint 1 and 2.
    """

    def __init__(self) -> None:
        self.episodes = [0, 0]
        self._joints = (_Joint(), _Joint())
        self._cycle = -1

    def lines(self, view: View, now_s: float) -> list[str]:
        """One line for each episode that begins now (CLOCK_MONOTONIC)."""
        if view.cycle == self._cycle:
            return []
        self._cycle = view.cycle
        said = []
        for n, (joint, seen) in enumerate(zip(self._joints, view.joints, strict=True)):
            if _update(joint, _sigmas(seen), now_s) and joint.far:
                self.episodes[n] += 1
                said.append(
                    f"joint {n + 1}: the estimate has been more than {FAR:g} sigma away from the torque sensor for "
                    f"{LASTING_S:g} s: {seen.torque_nm:.2f} Nm against {seen.sensor_nm:.2f} Nm, "
                    f"sigma {seen.sigma_nm:.2f} Nm"
                )
        return said


def _sigmas(seen: JointView) -> float | None:
    """Distance between estimate and sensor in sigmas; None where one of them is missing."""
    difference = abs(seen.torque_nm - seen.sensor_nm)
    if seen.status not in PUBLISHED or not isfinite(difference) or not seen.sigma_nm > 0.0:
        return None
    return difference / seen.sigma_nm


def _update(joint: _Joint, sigmas: float | None, now_s: float) -> bool:
    """Take in a reading; True when an episode begins or ends. One without a number is passed over."""
    if sigmas is None:
        return False
    asks = sigmas < NEAR if joint.far else sigmas > FAR
    if not asks:
        joint.since_s = inf
    elif joint.since_s == inf or now_s - joint.last_s > _GAP_S:
        joint.since_s = now_s
    joint.last_s = now_s
    if not asks or now_s - joint.since_s < LASTING_S:
        return False
    joint.far, joint.since_s = not joint.far, inf
    return True


# Lines for the operator when a joint has no torque because of a fault, when a fault is latched, and when all is well again.
#
# Pure: readings of the snapshot and times in, lines out. It runs in the supervisor, so that no line costs the loop anything.


class FaultWatch:
    """Call `lines` with each reading of the snapshot, some twenty times a second.

    Attributes:
        present: faults of joint 1 and 2 as of the last reading, bits of `daemon/shared/cycle_record.py`.
        latched: those that are latched.
    """

    def __init__(self) -> None:
        self.present, self.latched = [0, 0], [0, 0]
        self._since_s = [0.0, 0.0]
        self._limits = (RateLimit(), RateLimit())

    def lines(self, view: View, now_s: float) -> list[str]:
        """What has to be told now (CLOCK_MONOTONIC)."""
        said = []
        for n, seen in enumerate(view.joints):
            line = self._line(n, seen, now_s)
            if line is not None:
                said.append(f"joint {n + 1}: {line}")
        return said

    def _line(self, n: int, seen: JointView, now_s: float) -> str | None:
        present = seen.input_flags >> 8 | seen.latched
        before, self.present[n] = self.present[n], present
        held, self.latched[n] = self.latched[n], seen.latched
        new = present & ~before | seen.latched & ~held
        if new:
            if not before:
                self._since_s[n] = now_s
            if self._limits[n].may_say(new, now_s) is None:
                return None
            end = "; latched: `jtq control reset` releases it" if seen.latched & new else ""
            return f"no torque: {_meanings(new)}{end}"
        if before and not present and self._limits[n].may_say(0, now_s) is not None:
            return f"no fault any more after {now_s - self._since_s[n]:.1f} s"
        return None


def _meanings(bits: int) -> str:
    return ", ".join(f"{MEANINGS[bit]} ({name})" for bit, name in NAMES.items() if bits & bit)


# Lines for the operator when a joint's inputs, torque sensor or temperature are lost and come back, with the cause.
#
# Pure: readings of the snapshot and times in, lines out. It runs in the supervisor, so that no line costs the loop anything.


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
class _InputWatchJoint:
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
                _InputWatchJoint(
                    joint.number, joint.node_id, own, reference, source, temperatures.get(joint.node_id)
                )
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


def _cause(joint: _InputWatchJoint, seen: JointView, view: View) -> str:
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


def _sensor_cause(joint: _InputWatchJoint, seen: JointView, view: View) -> str:
    if not seen.input_flags & FLAG_SENSOR:
        if joint.sensor_node is not None and (unready := _unready(joint.sensor_node, view)):
            return unready
        return f"{joint.sensor} not received in time"
    reasons = [text for bit, text in _SENSOR_STATUS.items() if seen.sensor_status & bit]
    return f"{joint.sensor} says {', '.join(reasons) or 'no number'}"


class Watches:
    """Call `turn` with each reading of the snapshot; lines go to `tell`."""

    def __init__(self, config: Config, tell: Teller) -> None:
        self._tell = tell
        self._inputs, self._faults, self._deviation = InputWatch(config), FaultWatch(), DeviationWatch()

    @property
    def deviations(self) -> tuple[int, int]:
        """How often the estimate of joint 1 and 2 stayed far from the sensor."""
        one, two = self._deviation.episodes
        return one, two

    def turn(self, view: View, now_s: float) -> None:
        """Say what has changed; `now_s` is CLOCK_MONOTONIC."""
        for line in self._inputs.lines(view, now_s):
            self._tell("input", 0, line, line.split(":")[0])
        for line in self._faults.lines(view, now_s):
            self._tell("fault", 0, line, line.split(":")[0])
        for line in self._deviation.lines(view, now_s):
            self._tell("input", 0, line, "deviation")
