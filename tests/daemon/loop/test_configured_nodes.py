"""When a node counts again: with a configuration begun after its last boot-up message, in whatever order things happen."""

from __future__ import annotations

import random
import struct
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jtqd.daemon.bus.boot import ReturningNodes
from jtqd.daemon.config import load_config
from jtqd.daemon.core.cycle import ConfiguredNodes, Cycle, SnapshotWriter
from jtqd.daemon.core.intake import Intake
from jtqd.daemon.loop.process import Duties
from jtqd.daemon.shared.snapshot import Snapshot, SnapshotReader
from jtqd.estimator.status import INVALID
from tests.daemon.loop.cycle_helpers import I32, PDOS, ExactTime, ScriptedSocket, frame, inputs, make, turn

BOOT_UP = frame(0x701, b"\0")


def waits(cycle: Cycle) -> set[int]:
    return set(cycle.intake.unconfigured)


class Loop:
    """A whole cycle on a scripted bus; `extra` are frames that come after the next SYNC."""

    def __init__(self, directory: Path) -> None:
        self.extra: list[bytes] = []
        self.answers = inputs()
        self.cycle, self.socket, _ = make(directory, self._script)
        self.supervisor = SnapshotReader(directory / "snapshot", supervisor=True)
        turn(self.cycle, 30)

    def _script(self, _sync: int) -> list[bytes]:
        extra, self.extra = self.extra, []
        return [*self.answers, *extra]

    def restart(self) -> None:
        self.extra = [BOOT_UP]
        turn(self.cycle)


@pytest.fixture
def loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Loop:
    ExactTime().install(monkeypatch)
    return Loop(tmp_path)


def test_a_node_that_restarted_waits_for_a_configuration_that_was_noted_since(loop: Loop) -> None:
    loop.supervisor.note_configured(1, 0)  # booted before, because it had been stopped
    turn(loop.cycle, 2)
    loop.restart()
    turn(loop.cycle, 20)
    assert waits(loop.cycle) == {1}, "what was noted before it restarted does not answer for it"
    assert loop.supervisor.read().unconfigured == (1,)
    assert loop.supervisor.read().restarts[1] == 1
    loop.supervisor.note_configured(1, 1)
    turn(loop.cycle)
    assert waits(loop.cycle) == set()
    assert loop.supervisor.read().unconfigured == ()


def test_a_boot_that_began_before_the_last_restart_does_not_count(loop: Loop) -> None:
    loop.restart()
    began = loop.cycle.intake.restarts(1)
    loop.restart()
    loop.supervisor.note_configured(1, began)
    turn(loop.cycle, 20)
    assert waits(loop.cycle) == {1}
    loop.supervisor.note_configured(1, began + 1)
    turn(loop.cycle)
    assert waits(loop.cycle) == set()


def test_each_node_by_itself(loop: Loop) -> None:
    loop.extra = [BOOT_UP, frame(0x702, b"\0"), frame(0x703, b"\0")]
    turn(loop.cycle, 2)
    loop.supervisor.note_configured(2, 1)
    turn(loop.cycle)
    assert waits(loop.cycle) == {1, 3}
    loop.supervisor.note_configured(3, 1)
    loop.supervisor.note_configured(1, 1)
    turn(loop.cycle)
    assert waits(loop.cycle) == set()


def test_the_joint_of_a_drive_begins_again_and_no_other_one(loop: Loop) -> None:
    """Its encoders may stand elsewhere: no step is made from where they stood."""
    one, two = loop.cycle.joints
    assert one.sample[11] > 0 < two.sample[11], "time step [s]"
    loop.restart()
    loop.answers[0] = frame(0x181, I32.pack(90_000, 2000))
    loop.supervisor.note_configured(1, 1)
    turn(loop.cycle)
    turn(loop.cycle)
    assert (one.sample[11], two.sample[11] > 0) == (0.0, True)
    assert one.status != INVALID, "no jump"


def test_a_sensor_that_restarts_leaves_the_joints_alone(loop: Loop) -> None:
    loop.extra = [frame(0x703, b"\0")]
    turn(loop.cycle, 2)
    loop.supervisor.note_configured(3, 1)
    turn(loop.cycle, 2)
    assert all(joint.sample[11] > 0 for joint in loop.cycle.joints)
    assert waits(loop.cycle) == set()


def test_the_scaling_of_a_node_that_was_absent_comes_with_its_configuration(loop: Loop) -> None:
    loop.cycle.intake.leave_out(3)
    loop.supervisor.note_factors(3, (0.5,))
    turn(loop.cycle, 2)
    (one, _), before = loop.cycle.joints, 0.001
    assert one.inputs.sensor_nm_per_unit == before
    loop.supervisor.note_configured(3, 0)
    turn(loop.cycle)
    assert one.inputs.sensor_nm_per_unit == 0.5
    assert one.inputs.motor_rad_per_count == 1e-4, "the drive's are its own"
    loop.supervisor.note_factors(1, (1.0, 2.0, 3.0, 4.0))
    loop.restart()
    loop.supervisor.note_configured(1, 1)
    turn(loop.cycle)
    assert (one.inputs.motor_rad_per_count, one.inputs.ampere_per_unit) == (1.0, 4.0)
    assert loop.cycle.joints[1].inputs.ampere_per_unit == 0.01


def test_a_node_in_doubt_is_not_used_until_it_is_configured_again(loop: Loop) -> None:
    """Its PDOs come in time and with the right length all the while."""
    duties = Duties(loop.cycle, Fed())  # type: ignore[arg-type]
    loop.supervisor.note_doubt(1)
    for _ in range(16):
        turn(loop.cycle)
        duties()
    assert waits(loop.cycle) == {1}
    turn(loop.cycle, 9)
    assert loop.supervisor.read().unconfigured == (1,)
    assert [joint.status for joint in loop.cycle.joints] == [4, 2]
    assert loop.supervisor.read().counters["boot_ups"] == 0
    for _ in range(32):
        turn(loop.cycle)
        duties()
    loop.supervisor.note_configured(1, 0)
    turn(loop.cycle)
    assert waits(loop.cycle) == set()
    for _ in range(32):
        turn(loop.cycle)
        duties()
    assert waits(loop.cycle) == set(), "once"
    assert [joint.status for joint in loop.cycle.joints] == [2, 2]
    loop.supervisor.note_doubt(3)
    loop.supervisor.note_doubt(2)
    for _ in range(16):
        turn(loop.cycle)
        duties()
    assert waits(loop.cycle) == {2, 3}


def test_the_watchdog_is_fed_only_while_the_supervisor_turns(loop: Loop) -> None:
    fed: list[int] = []

    class Counting:
        def advanced(self, cycles: int) -> None:
            fed.append(cycles)

    intake = SimpleNamespace(claims=False)
    cycle = SimpleNamespace(index=0, grid=loop.cycle.grid, snapshot=loop.cycle.snapshot, intake=intake)
    duties = Duties(cycle, Counting())  # type: ignore[arg-type]
    patience = round(1e9 / cycle.grid.period_ns)
    for _ in range(3):
        loop.supervisor.note_alive()
        for _ in range(patience):
            assert not intake.claims or cycle.index >= patience, "the boot may still send the heartbeat"
            cycle.index += 1
            duties()
    assert sum(fed) == 3 * patience
    assert intake.claims
    for _ in range(3 * patience):  # it is stopped
        cycle.index += 1
        duties()
    assert 3 * patience <= sum(fed) <= 4 * patience + 1
    before = sum(fed)
    loop.supervisor.note_alive()
    cycle.index += 1
    duties()
    assert sum(fed) == before + 1


class Fed:
    """A watchdog that is content."""

    def advanced(self, cycles: int) -> None:
        pass


# Orders of events -------------------------------------------------------------------------------------------

STEPS = {
    "B": "restarts",
    "L": "loop_looks",
    "F": "loop_tells",
    "S": "supervisor_looks",
    "A": "boot_is_answered",
    "E": "boot_ends",
}


class Boot:
    """A boot process: from its first answer on it notices a restart; it reports what it has seen until its end."""

    def __init__(self, events: Events) -> None:
        self.events = events
        self.running, self.heard_restart = True, False
        self.reported: dict[str, Any] | None = None

    def send(self, _request: object) -> None:
        pass

    def end_of_input(self) -> None:
        pass

    def alive(self) -> bool:
        return self.running

    def poll_answer(self) -> dict[str, Any] | None:
        reported, self.reported = self.reported, None
        return reported


class Events:
    """Loop, supervisor, node 1 and its boots, one step of one of them after the other.

    Attributes:
        written: node 1 holds the configuration that jtqd wants.
    """

    def __init__(self, directory: Path, config: Any) -> None:
        self.snapshot = Snapshot(directory / "snapshot", 1e-3, 0.8)
        self.reader = SnapshotReader(directory / "snapshot", supervisor=True)
        self.intake = Intake(PDOS)
        self.writer = SnapshotWriter(self.snapshot, self.intake, ScriptedSocket(lambda _: []))  # type: ignore[arg-type]
        self.configured = ConfiguredNodes(self.snapshot, self.intake, [])
        scaling = {"scaling": {"k": 1.0}, "gear_ratio": 100.0, "serial": 7, "notes": []}
        self.node = scaling
        report = {"nodes": {"1": scaling}, "absent": {}}
        self.returning = ReturningNodes(config, "bus", report, self._start, lambda *_: None)
        self.boot: Boot | None = None
        self.written = True
        self.now_s = 1000.0

    def _start(self, *_: object) -> Any:
        self.boot = Boot(self)
        return self.boot

    def step(self, what: str) -> None:
        getattr(self, STEPS[what])()
        if 1 not in self.intake.unconfigured and what in "LB":
            assert self.written, "node 1 is believed and has lost its configuration"

    def restarts(self) -> None:
        """Node 1 restarts; its boot-up message reaches everybody."""
        self.written = False
        self.intake.drain(bytearray(struct.pack("<IB3x8s", 0x701, 1, bytes(8))), [1], [False], 1)
        if self.boot is not None:
            self.boot.heard_restart = True

    def loop_looks(self) -> None:
        """The loop looks."""
        self.configured.doubt()
        if self.intake.unconfigured:
            self.configured.look()

    def loop_tells(self) -> None:
        """The loop tells what it knows: every eighth cycle."""
        self.writer.flush(0, 0)

    def supervisor_looks(self) -> None:
        """The supervisor looks."""
        self.now_s += 0.05
        self.returning.watch(self.reader.read(), lambda _: True, self.reader, self.now_s)

    def boot_is_answered(self) -> None:
        """The boot has its first answer: a boot-up message before it was the node's own start."""
        if self.boot is not None and self.boot.running:
            self.boot.heard_restart = False

    def boot_ends(self) -> None:
        """The boot ends."""
        boot = self.boot
        if boot is None or not boot.running:
            return
        boot.running = False
        if boot.heard_restart:
            boot.reported = {"ok": False, "error": {"message": "it restarted during boot"}}
        else:
            self.written = True
            boot.reported = {"ok": True, "nodes": {"1": self.node}}

    def rest(self) -> None:
        """Nothing more happens to the node: all that is left to do is done."""
        for _ in range(3):
            for what in "FSAELFS":
                self.step(what)
            self.now_s += 20.0
        self.step("L")

    def doubted(self) -> None:
        """The supervisor has found another configuration."""
        self.written = False
        self.reader.note_doubt(1)
        self.returning.request(1, "changed")
        self.step("L")

    def stopped(self) -> None:
        """Somebody has stopped it: it is booted and has lost nothing."""
        self.returning.request(1, "stopped")


@pytest.fixture(scope="module")
def config() -> Any:
    return load_config(None)


def tried(directory: Path, config: Any, begin: str, word: str) -> None:
    events = Events(directory, config)
    try:
        if begin == "restarted":
            events.step("B")
        else:
            getattr(events, begin)()
        for what in word:
            events.step(what)
        events.rest()
        assert 1 not in events.intake.unconfigured, "left out for good"
        assert events.written
        assert events.reader.read().unconfigured == ()
    except AssertionError as error:
        raise AssertionError(f"{begin}, then {word}: {error}") from None


@pytest.mark.parametrize("begin", ["restarted", "doubted", "stopped"])
def test_a_node_that_restarted_last_is_never_believed_whatever_the_order(
    tmp_path: Path, config: Any, begin: str
) -> None:
    """Every order of: boot begins (S), first answer (A), boot ends (E), the supervisor takes it in (S), the loop looks (L)
    and tells (F), with a second boot-up message (B) at each place, and a third one at each place.
    """
    course = "LFSAESL"
    words = {course}
    for _ in range(2):
        words |= {word[:at] + "B" + word[at:] for word in words for at in range(len(word) + 1)}
    words |= {word.replace("F", "", 1) for word in words} | {word.replace("A", "", 1) for word in words}
    for word in sorted(words):
        tried(tmp_path, config, begin, word)
    print(f"{len(words)} orders")


def test_short_words_of_everything(tmp_path: Path, config: Any) -> None:
    """All words of four events after a boot has begun, and random long ones; seed 11."""
    count = 0
    for word in product("BLFSAE", repeat=4):
        tried(tmp_path, config, "restarted", "FS" + "".join(word))
        count += 1
    rng = random.Random(11)
    for _ in range(300):
        begin = rng.choice(("restarted", "doubted", "stopped"))
        tried(tmp_path, config, begin, "".join(rng.choices("BLFSAE", (1, 4, 3, 4, 2, 2), k=25)))
    print(f"{count} words")
