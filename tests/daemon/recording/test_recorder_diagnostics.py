"""/diagnostics: one status each for loop, bus, joints, nodes, recorder and disk; of one size; levels that follow events."""

import math
from types import SimpleNamespace

import pytest

from jtqd.daemon.recording import diagnostics, messages
from jtqd.daemon.recording.diagnostics import Diagnostics, Node
from jtqd.daemon.recording.run_files import Account
from jtqd.daemon.shared.conditions import Condition
from jtqd.daemon.shared.counters import COUNTERS
from jtqd.daemon.shared.events import ERROR, INFO, WARNING, Notices
from jtqd.daemon.shared.snapshot import JointView, Snapshot
from tests.daemon.recording.recorder_bench import DEFINITIONS, messages_of, session_on, statuses_of
from tests.daemon.snapshots import EstimateWriter

NAMES = ["loop", "bus", "joint 1", "joint 2", "node 1", "node 3", "recorder", "disk"]
NOW = 1_700_000_000_000_000_000
OK, WARN, FAULT, STALE = range(4)


class Bench:
    """A snapshot to be written, and what /diagnostics makes of it."""

    def __init__(self, directory, monkeypatch):
        self.snapshot = Snapshot(directory / "snapshot", 1e-3, 0.85)
        self.estimate = EstimateWriter(self.snapshot)
        nodes = [Node(1, "drive 1"), Node(3, "torque sensor")]
        self.diagnostics = Diagnostics(directory / "snapshot", "can0", ("a", "b"), nodes)
        self.conditions = []
        monkeypatch.setattr(diagnostics, "read_conditions", lambda _: self.conditions)
        self.account = Account()
        self.cycle = 0
        self.sizes = set()

    def heartbeat(self, node, state, at_ns=NOW):
        self.snapshot.node_states[node] = state
        self.snapshot.node_heard[node] = at_ns

    def count(self, name, number):
        self.snapshot.counters[COUNTERS.index(name)] += number

    def look(self, statuses=(2, 6), conditions=(), **recorder):
        """One message, a second after the last; {name: (level, text, values)}."""
        self.cycle += 1000
        joint = JointView(*[0] * len(JointView._fields))._replace(torque_nm=1.0, sensor_nm=1.1)
        joints = [joint._replace(network_nm=math.nan, status=status) for status in statuses]
        self.estimate.write(self.cycle, 1, NOW, tuple(joints))
        rules = SimpleNamespace(reserve=10**8, budget=recorder.get("budget"))
        parts = SimpleNamespace(
            part=1, size=10**6, total_size=10**7, free_bytes=10**9, obstacle="", rules=rules
        )
        vars(parts).update({key: value for key, value in recorder.items() if key in vars(parts)})
        figures = {"backlog": 50, "cpu_percent": recorder.get("cpu_percent", 1.5), "events_left_out": 0}
        self.conditions = conditions
        _, found = self.diagnostics.of_loop(NOW)
        found += self.diagnostics.of_recorder(self.account, parts, recorder.get("flight"), **figures)
        payload = messages.diagnostics(NOW, found)
        self.sizes.add(len(payload))
        message = DEFINITIONS["diagnostic_msgs/msg/DiagnosticArray"].decode(payload)
        return {name.removeprefix("jtqd: "): found for name, found in statuses_of(message).items()}


@pytest.fixture
def bench(tmp_path, monkeypatch):
    result = Bench(tmp_path, monkeypatch)
    result.heartbeat(1, 5)
    result.heartbeat(3, 5)
    return result


def levels(found):
    return {name: level for name, (level, _, _) in found.items() if level}


def test_all_is_well(bench):
    found = bench.look()
    assert list(found) == NAMES
    assert levels(found) == {}
    assert found["joint 2"][1:] == (
        "STANDSTILL",
        found["joint 2"][2] | {"status": "STANDSTILL", "sensor_nm": "1.1"},
    )
    # Every counter of the loop is somewhere.
    assert set(COUNTERS) <= {*found["loop"][2], *found["bus"][2]}
    assert found["disk"][2] == {
        "part_mb": "1", "logs_mb": "10", "budget_mb": "none", "free_mb": "1000", "reserve_mb": "100",
    }  # fmt: skip


def test_levels_follow_what_happened_since_the_last_message(bench):
    bench.look()
    bench.count("missed", 3)
    bench.count("tx_dropped", 1)
    found = bench.look()
    assert levels(found) == {"loop": WARN, "bus": WARN}
    assert found["loop"][1] == "3 slots missed since the last message"
    assert found["bus"][1] == "frames could not be sent: the transmit queue is full"
    found = bench.look()
    assert levels(found) == {}
    assert found["loop"][2]["missed"] == "3"


def test_what_happened_before_the_first_message_is_no_warning(bench):
    """A recorder that is started again: the counts are from the start of the loop."""
    bench.count("missed", 3)
    bench.count("tx_dropped", 1)
    assert levels(bench.look()) == {}


def test_loop_that_stands_still(bench):
    bench.look()
    bench.cycle -= 1000
    assert levels(bench.look()) == {"loop": STALE}


@pytest.mark.parametrize(
    ("status", "level"),
    [(0, WARN), (1, WARN), (2, OK), (3, WARN), (4, STALE), (5, FAULT), (6, OK), (15, FAULT)],
)
def test_joint(bench, status, level):
    found = bench.look(statuses=(status, 2))
    assert found["joint 1"][:2] == (level, messages.STATUS_NAMES[status])
    assert found["joint 2"][0] == OK


def test_nodes(bench):
    bench.heartbeat(1, 127)
    bench.heartbeat(3, 5, NOW - 1_500_000_000)
    found = bench.look()
    assert found["node 1"][:2] == (WARN, "pre-operational")
    assert found["node 3"][:2] == (STALE, "no heartbeat")
    assert found["node 3"][2]["heartbeat_age_s"] == "1.5"
    bench.heartbeat(3, 5)
    text = "has restarted and is not configured yet"
    unready = Condition("node_unconfigured", "node 3", WARNING, text, 0)
    assert bench.look(conditions=[unready])["node 3"][:2] == (WARN, text)


def test_the_worst_condition_of_a_subject_is_its_level_and_text(bench):
    conditions = [
        Condition("sensor_lost", "joint 1", WARNING, "torque sensor lost: node 3 is absent", 1),
        Condition("temperature_lost", "joint 1", WARNING, "temperature lost", 2),
        Condition("joint_fault", "joint 2", ERROR, "no torque: x", 3),
        Condition("bus_off", "bus", ERROR, "bus-off, previously error passive", 4),
    ]
    found = bench.look(statuses=(2, 15), conditions=conditions)
    assert found["joint 1"][:2] == (WARN, "VALID: torque sensor lost: node 3 is absent")
    assert found["joint 2"][:2] == (FAULT, "INVALID: no torque: x")
    assert found["bus"][:2] == (FAULT, "bus-off, previously error passive")


def test_node_that_was_never_heard(bench):
    bench.heartbeat(3, 0, 0)
    assert bench.look()["node 3"][:2] == (STALE, "no heartbeat")


def test_recorder_and_disk(bench):
    bench.look()
    bench.account.overwritten = 7
    found = bench.look(free_bytes=150_000_000, obstacle="recording pauses: no room")
    assert found["recorder"][2]["mode"] == "waiting"
    assert found["recorder"][:2] == (FAULT, "7 cycles lost since the last message")
    assert found["disk"][:2] == (FAULT, "recording pauses: no room")
    found = bench.look(free_bytes=150_000_000, budget=5 * 10**9)
    assert found["recorder"][:2] == (WARN, "7 cycles lost so far")
    assert found["disk"][:2] == (WARN, "little room")
    assert found["disk"][2]["budget_mb"] == "5000"


def test_one_size_for_every_content(bench):
    bench.look()
    for name in COUNTERS:
        bench.count(name, 2**50)
    bench.account.written = 2**60
    bench.heartbeat(1, 77)
    flight = SimpleNamespace(saving=False, memory_bytes=10**12, memory_s=1e9)
    bench.look((15, 9), flight=flight, obstacle="x" * 300, free_bytes=-1, budget=0, cpu_percent=1e-9)
    assert len(bench.sizes) == 1


def test_notices_of_the_supervisor_become_events_and_log_lines(tmp_path):
    notices = Notices(tmp_path / "notices")
    notices.add(INFO, "boot", 2, "node 2: boot-up")
    session = session_on(tmp_path, notices=tmp_path / "notices")
    session.poll()
    notices.add(ERROR, "emcy", 1, "node 1: EMCY 8611h following error")
    session.poll()
    path = session.finish()["path"]
    found = messages_of(path)
    texts = [
        (event["count"], event["text"].rstrip())
        for _, event in found["/events"]
        if event["kind"] == messages.EventKind.NOTICE
    ]
    assert texts == [(2, "node 2: boot-up"), (1, "node 1: EMCY 8611h following error")]
    lines = [(line["level"], line["msg"].rstrip()) for _, line in found["/log"]]
    assert (40, "node 1: EMCY 8611h following error") in lines
