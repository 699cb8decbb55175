"""Conditions: what is wrong at present with a joint, a node, a PDO, the bus, the loop, the recorder or the machine.

`CATALOGUE` is the one list of everything that jtqd reports as present for some time. The supervisor's parts observe and
call `Conditions.update`; everybody else sees a view of the same set: lines in journal and /events (`lines`), EMCY, 1001h
and 1003h (`subscribe`), `conditions.json` for `jtq status`, `jtq check` and /diagnostics (`present`), metrics and summary
(`history`). What only happens (a boot-up message, an EMCY of a node, an NMT command of somebody else) is an event
(`events`).

>>> conditions = Conditions()
>>> drive = Subject("node 2", 2, joints=0b10)
>>> conditions.update("node_lost", drive, True, 10.0, "0.3 s")
>>> [(each.name, each.subject, each.text) for each in conditions.present()]
[('node_lost', 'node 2', 'no heartbeat for 0.3 s')]
>>> conditions.update("node_lost", drive, False, 12.5)
>>> [each.text for each in conditions.lines(12.5)]
['node 2: heartbeat is back after 2.5 s (no heartbeat for 0.3 s)']
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from math import inf
from pathlib import Path
from typing import Final, NamedTuple

from jtqd.daemon.shared.events import ERROR, INFO, WARNING
from jtqd.daemon.shared.runtime_dir import json_of, write_whole

FILE = "conditions.json"
"""Name of the file in the runtime directory of a daemon."""
SCHEMA = "jtqd.conditions/1"

SEVERITIES: Final = {INFO: "info", WARNING: "warning", ERROR: "error"}
JOINT, NODE, PDO, BUS, LOOP, RECORDER, MACHINE = "joint", "node", "PDO", "bus", "loop", "recorder", "machine"
"""What a condition can be about."""
QUIET_S: Final = 5.0
"""Between two lines that begin the same condition of the same subject."""
DEVIATION_SIGMAS, DEVIATION_S = 3.0, 1.0
"""`deviation`: so many sigmas between estimate and torque sensor, for so long."""


_COMMUNICATION, _MANUFACTURER = 0x10, 0x80
"""Bits of the error register 1001h (CiA 301)."""


class Emcy(NamedTuple):
    """EMCY messages of a condition: error code, bits of 1001h, and bytes 5 to 7."""

    code: int
    register: int = _COMMUNICATION
    detail: int = 0
    """Added to the subject's number."""
    names_joints: bool = True
    """Byte 7 holds the joints that are concerned."""


@dataclass(frozen=True)
class Definition:
    """One row of the catalogue."""

    name: str
    """As in files, metrics and docs."""
    about: str
    """JOINT .. MACHINE."""
    severity: int
    """INFO, WARNING or ERROR of `events`."""
    text: str
    """One sentence in the present tense; {} takes the details."""
    ended: str = ""
    """Text of the line at its end, before "after 2.3 s"; "" where an event reports it."""
    topic: str = "input"
    """Of the event that a line becomes (`events.Notice`)."""
    emcy: Emcy | None = None
    """Of the EMCY messages of its begin and end; None: none."""
    hold_s: float = 0.0
    """A change that does not last so long is none."""
    logged: bool = True
    """A line when it begins and when it ends; not where another condition or an event has the same line."""
    repeat_s: float = inf
    """While it is present, its line comes again so often; such lines have a rate limit of their own."""


_HOLD_S = 0.1
_REPEAT_S = 60.0
# fmt: off
_ROWS = (
    # Joints
    Definition("stale_input", JOINT, WARNING, "inputs lost: {}", "inputs back", hold_s=_HOLD_S),
    Definition("sensor_lost", JOINT, WARNING, "torque sensor lost: {}", "torque sensor back", hold_s=_HOLD_S),
    Definition("temperature_lost", JOINT, WARNING, "temperature lost: {}", "temperature back", hold_s=_HOLD_S),
    Definition("joint_fault", JOINT, ERROR, "no torque: {}", "fault cleared", topic="fault",
               emcy=Emcy(0xFF01, _MANUFACTURER)),
    Definition("fault_latched", JOINT, ERROR, "latched: {}; `jtq control reset` releases it",
               "latched faults released", topic="fault", emcy=Emcy(0xFF02, _MANUFACTURER), repeat_s=_REPEAT_S),
    Definition("drive_fault", JOINT, ERROR, "the drive reports {}", "drive fault cleared", topic="fault",
               hold_s=_HOLD_S),
    Definition("drive_off", JOINT, INFO, "the drive carries no current: {}", hold_s=_HOLD_S, logged=False),
    Definition("degraded", JOINT, INFO, "the estimate is degraded: {}", hold_s=_HOLD_S, logged=False),
    Definition("zero_implausible", JOINT, WARNING, "the link encoder's zero is {}",
               "the link encoder's zero is plausible again"),
    Definition("zero_jumped", JOINT, WARNING, "the link encoder's zero has jumped, {}, and is not known again yet",
               "the link encoder's zero is learned again"),
    Definition("deviation", JOINT, WARNING,
               f"the estimate has been more than {DEVIATION_SIGMAS:g} sigma away from the torque sensor "
               f"for {DEVIATION_S:g} s: {{}}",
               "the estimate agrees with the torque sensor again"),
    # Nodes and their PDOs
    Definition("node_lost", NODE, WARNING, "no heartbeat for {}", "heartbeat is back", topic="heartbeat",
               emcy=Emcy(0x8130)),
    Definition("node_doubled", NODE, WARNING, "{}: possibly two nodes with this node-ID",
               "one heartbeat producer again", topic="heartbeat", emcy=Emcy(0x8150, detail=0x700, names_joints=False)),
    Definition("node_changed", NODE, WARNING, "its configuration was changed {}", topic="boot",
               emcy=Emcy(0xFF03, _MANUFACTURER)),
    Definition("node_unchecked", NODE, WARNING, "its identity (1018h) was checked by nobody: status at most degraded "
               "until its master reads it, or joint_N.tpdos pins the layout", "its identity is checked", topic="boot"),
    Definition("node_absent", NODE, WARNING, "optional node absent", topic="boot", logged=False),
    Definition("node_unconfigured", NODE, WARNING, "not used: {}", topic="boot", logged=False),
    Definition("node_not_operational", NODE, WARNING, "NMT state {}", topic="heartbeat", logged=False),
    Definition("node_error", NODE, WARNING, "reports {}", topic="emcy", logged=False),
    Definition("pdo_timeout", PDO, WARNING, "no valid frame for {} cycles in a row", topic="pdo", emcy=Emcy(0x8250),
               logged=False),
    Definition("pdo_short", PDO, WARNING, "PDO not processed due to length error (8210h): too short",
               "length correct again", topic="pdo", emcy=Emcy(0x8210)),
    Definition("pdo_long", PDO, WARNING, "PDO length exceeded (8220h): not used", "length correct again",
               topic="pdo", emcy=Emcy(0x8220)),
    # Bus
    Definition("bus_warning", BUS, WARNING, "error warning, previously {}", "error active", topic="bus"),
    Definition("bus_passive", BUS, WARNING, "error passive, previously {}", "error active", topic="bus",
               emcy=Emcy(0x8120, names_joints=False)),
    Definition("bus_off", BUS, ERROR, "bus-off, previously {}", "error active", topic="bus"),
    Definition("bus_down", BUS, ERROR, "interface down, previously {}", "error active", topic="bus"),
    Definition("foreign_sync", BUS, ERROR, "another SYNC producer: inputs of these cycles are not used",
               "no other SYNC producer", topic="sync", emcy=Emcy(0x8150, detail=0x080)),
    Definition("sync_lost", BUS, WARNING, "no SYNC of the master {}", "SYNC is back", topic="sync",
               emcy=Emcy(0x8100, detail=0x080)),
    Definition("sync_irregular", BUS, ERROR, "SYNC does not come every {}: inputs of these cycles are not used",
               "SYNC is regular again", topic="sync", emcy=Emcy(0x8150, detail=0x080)),
    Definition("not_operational", BUS, INFO, "jtqd is {}: it sends no estimate until the master starts its node",
               "jtqd is operational", topic="sync"),
    Definition("cob_id_conflict", BUS, ERROR, "another node sends with this COB-ID of jtqd",
               "only jtqd sends with it", topic="bus", emcy=Emcy(0x8150, names_joints=False)),
    Definition("sync_late", BUS, WARNING, "the own SYNC waits in the transmit queue", topic="sync", logged=False),
    Definition("receive_overrun", BUS, WARNING, "received frames were lost: the loop's socket was read too late",
               "no further received frames lost", topic="bus", emcy=Emcy(0x8110, detail=1)),
    Definition("transmit_overrun", BUS, WARNING, "frames could not be sent: the transmit queue is full",
               "frames are sent again", topic="bus", emcy=Emcy(0x8110, detail=2)),
    # Loop, recorder, machine
    Definition("loop_stopped", LOOP, ERROR, "no cycle for {}", "cycles again", topic="loop"),
    Definition("late_loop", LOOP, WARNING, "cycles are missed: the loop is late", topic="loop", logged=False),
    Definition("cycles_lost", RECORDER, ERROR, "cycles are lost: {} are not in the log", "no further cycles lost",
               topic="recorder", repeat_s=_REPEAT_S),
    Definition("stolen_time", MACHINE, INFO, "the hypervisor takes processor time", topic="machine", logged=False),
    Definition("not_granted", MACHINE, WARNING, "not granted: {}", topic="machine", logged=False),
)
# fmt: on
CATALOGUE: Final = {row.name: row for row in _ROWS}


class Subject(NamedTuple):
    """Subject of a condition: "joint 1", "node 3", "281h drive 1 TPDO2", "bus".

    `number` is the drive's node-ID, the node-ID, the COB-ID or 0: the detail of EMCY messages. `joints`: bit 0 joint 1,
    bit 1 joint 2. `node`: node-ID of its events; 0 for none.
    """

    name: str
    number: int = 0
    joints: int = 0
    node: int = 0


THE_BUS: Final = Subject("bus", joints=3)
THE_LOOP, THE_RECORDER, THE_MACHINE = Subject("loop"), Subject("recorder"), Subject("machine")


SHOWN_BY_COUNTERS: Final = {
    "bus_errors": ("bus_down", THE_BUS),
    "foreign_sync": ("foreign_sync", THE_BUS),
    "rx_dropped": ("receive_overrun", THE_BUS),
    "tx_dropped": ("transmit_overrun", THE_BUS),
    "sync_errors": ("sync_late", THE_BUS),
    "missed": ("late_loop", THE_LOOP),
}
"""Counter of the loop -> condition that its rise shows, subject."""


@dataclass(frozen=True)
class Condition:
    """One present condition; `since_ns` is CLOCK_MONOTONIC."""

    name: str
    subject: str
    severity: int
    text: str
    since_ns: int

    @property
    def line(self) -> str:
        """Return subject and text."""
        return f"{self.subject}: {self.text}"


class Change(NamedTuple):
    """A condition has begun (`present`) or ended."""

    definition: Definition
    subject: Subject
    present: bool


class Line(NamedTuple):
    """One line for the operator; `severity` INFO at the end of a condition."""

    definition: Definition
    subject: Subject
    severity: int
    text: str

    @property
    def rate_class(self) -> str:
        """Lines of one class share a rate limit; "": none.

        A fault may come and go with its cable: few lines of each joint. What waits for the operator is not limited with
        them.
        """
        if self.definition.about not in (JOINT, PDO):
            return ""
        waits = self.definition.repeat_s < inf
        return f"{self.subject.name} {self.definition.name}" if waits else self.subject.name


class Occurrences(NamedTuple):
    """Count, total duration and first occurrence (CLOCK_MONOTONIC) of a condition."""

    name: str
    subject: str
    times: int
    total_s: float
    first_s: float


class _State:
    """State of one condition of one subject, and the lines that are due.

    A begin sooner than QUIET_S after the last line about one is reported together with its end, or with those that follow.
    """

    def __init__(self, definition: Definition, subject: Subject) -> None:
        self.definition, self.subject = definition, subject
        self.present = False
        self.text = ""
        self.since_s = self.first_s = 0.0
        self.count, self.total_s = 0, 0.0
        self._reading, self._reading_since_s = False, -inf
        self._unlogged, self._unlogged_s = 0, 0.0
        self._logged, self._not_before_s = False, -inf
        self._repeat_s = inf
        self.again = False
        self._texts: dict[str, float] = {}

    def update(self, reading: bool, now_s: float, since_s: float) -> bool:
        """Take a reading; True when the condition begins or ends with it."""
        if reading != self._reading:
            self._reading, self._reading_since_s = reading, since_s
        if reading == self.present or now_s - self._reading_since_s < self.definition.hold_s:
            return False
        self.present = reading
        if reading:
            self.since_s, self.count = self._reading_since_s, self.count + 1
            self._unlogged += 1
            self.first_s = self.first_s if self.count > 1 else self.since_s
        else:
            lasted_s = self._reading_since_s - self.since_s
            self.total_s, self._unlogged_s = self.total_s + lasted_s, self._unlogged_s + lasted_s
        return True

    def no_end_line(self) -> None:
        """Suppress the line at its end, because another line reports it."""
        self._logged = self.again = False
        self._unlogged, self._unlogged_s = 0, 0.0

    def line(self, now_s: float) -> Line | None:
        """Return the line that is due, if any."""
        definition = self.definition
        if not definition.logged:
            return None
        may = now_s >= self._not_before_s
        if self.present:
            if self._logged:  # another line only with details that no recent line had
                self._texts = {text: at_s for text, at_s in self._texts.items() if now_s - at_s < QUIET_S}
                may = (self.again and self.text not in self._texts) or now_s >= self._repeat_s
            if not may:
                return None
            self._logged, self.again, self._not_before_s = True, False, now_s + QUIET_S
            self._repeat_s = now_s + definition.repeat_s
            self._texts[self.text] = now_s
            return Line(definition, self.subject, definition.severity, f"{self.subject.name}: {self.text}")
        if not self._unlogged or not (self._logged or may):
            return None
        if not definition.ended:
            self.no_end_line()
            return None
        text = f"{self.subject.name}: {definition.ended} after {self._unlogged_s:.1f} s"
        if self._unlogged > 1:
            text += f", {self._unlogged} times"
        if not self._logged:
            text += f" ({self.text})"
            self._not_before_s = now_s + QUIET_S
        self.no_end_line()
        return Line(definition, self.subject, INFO, text)


class Conditions:
    """The set of conditions of one daemon. Times are CLOCK_MONOTONIC [s], arguments of every call."""

    def __init__(self) -> None:
        self._states: dict[tuple[str, str], _State] = {}
        self._listeners: list[Callable[[Change], None]] = []

    def subscribe(self, listener: Callable[[Change], None]) -> None:
        """Call `listener` with each change, at once and in order."""
        self._listeners.append(listener)

    def update(
        self,
        name: str,
        subject: Subject,
        present: bool,
        now_s: float,
        details: str | Callable[[], str] = "",
        *,
        since_s: float | None = None,
        log_again: bool = False,
        superseded: bool = False,
    ) -> None:
        """Take what a part has observed; call it with every reading or with every change.

        Args:
            name, subject, present, now_s: condition of the catalogue as observed at this time.
            details: for the text's {}; a function is asked only where the text is needed.
            since_s: when it began or ended, where that is known better than by `now_s`.
            log_again: although it is present already, these details are worth another line.
            superseded: it ended because another condition has taken its place: no line.
        """
        key = name, subject.name
        state = self._states.get(key)
        if state is None:
            if not present:
                return
            state = self._states[key] = _State(CATALOGUE[name], subject)
        changed = state.update(present, now_s, now_s if since_s is None else since_s)
        if state.present and present:
            text = details() if callable(details) else details
            state.text = state.definition.text.format(text)
            state.again |= log_again and not changed
        if not changed:
            return
        if superseded and not state.present:
            state.no_end_line()
        for listener in self._listeners:
            listener(Change(state.definition, subject, state.present))

    def lines(self, now_s: float) -> list[Line]:
        """Return the lines for the operator that are due; each is returned once."""
        return [line for state in self._states.values() if (line := state.line(now_s)) is not None]

    def present(self) -> list[Condition]:
        """Return every present condition, the worst first, then the oldest."""
        found = [
            Condition(
                state.definition.name,
                state.subject.name,
                state.definition.severity,
                state.text,
                round(state.since_s * 1e9),
            )
            for state in self._states.values()
            if state.present
        ]
        return sorted(found, key=lambda each: (-each.severity, each.since_ns))

    def is_present(self, name: str, subject: str) -> bool:
        """Return whether this condition of this subject is present."""
        state = self._states.get((name, subject))
        return state is not None and state.present

    def history(self, now_s: float) -> list[Occurrences]:
        """Return every condition that was present at any time, in the order of the first time."""
        found = [
            Occurrences(
                name,
                subject,
                state.count,
                state.total_s + (now_s - state.since_s if state.present else 0.0),
                state.first_s,
            )
            for (name, subject), state in self._states.items()
            if state.count
        ]
        return sorted(found, key=lambda each: each.first_s)


class ConditionsFile:
    """Keeps `conditions.json` in `directory` up to date; write errors are ignored, as nothing depends on the file."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / FILE
        self._last: Sequence[Condition] | None = None

    def write(self, present: Sequence[Condition]) -> None:
        """Replace the file as a whole when something has changed."""
        if present == self._last:
            return
        with suppress(OSError):
            rows = [asdict(each) for each in present]
            write_whole(self._path, json.dumps({"schema": SCHEMA, "conditions": rows}))
            self._last = present


def read_conditions(directory: Path) -> list[Condition]:
    """Read the conditions of the daemon with this runtime directory, the worst first; none without a valid file.

    They are as of the supervisor's last look: `jtqd.daemon.shared.runtime_dir.About.running` is whether that runs.
    """
    try:
        content = json_of(directory / FILE)
        if content["schema"] != SCHEMA:
            return []
        return [Condition(**each) for each in content["conditions"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def worst(conditions: Iterable[Condition], subject: str) -> Condition | None:
    """Return the worst condition of this subject, the oldest of them, or None."""
    own = [each for each in conditions if each.subject == subject]
    return max(own, key=lambda each: (each.severity, -each.since_ns), default=None)
