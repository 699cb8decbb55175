"""The live view: the log's topics at 50 Hz to real websocket clients, and nothing the other way."""

import argparse
import json
import socket
import struct
import time

import pytest

from jtqd.daemon.live import Address, address
from jtqd.daemon.live.gateway import OLDER, PROTOCOL
from jtqd.daemon.live.process import LiveStream
from jtqd.daemon.recording import messages
from jtqd.daemon.recording.messages import JOINT_ESTIMATE_SIZE, CycleMessages
from jtqd.daemon.shared import cycle_record
from tests.daemon.live.live_view_helpers import LiveProcess, Memory, Viewer, asked
from tests.daemon.recording.cdr_decoder import Definition
from tests.daemon.recording.recorder_bench import START_NS, joint_values, record_of

pytestmark = pytest.mark.native


@pytest.fixture
def memory(tmp_path):
    return Memory(tmp_path)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """One process for all who leave it as it was: (memory, process)."""
    memory = Memory(tmp_path_factory.mktemp("live"))
    with LiveProcess(memory.directory) as live:
        yield memory, live


# ---- what is made of the cycles: no process ----


def stream():
    return LiveStream(("joint_1", "joint_2"), (100.0, None))


def of(made, topic):
    return [message for message in made if message.topic == topic.number]


def test_one_set_of_messages_in_20_ms_with_the_bytes_of_the_log():
    made = stream().take(record_of(n) for n in range(100, 200))
    for topic, size in (
        (messages.JOINTS[0], JOINT_ESTIMATE_SIZE),
        (messages.JOINTS[1], JOINT_ESTIMATE_SIZE),
        (messages.CAN_FRAMES, CycleMessages(2).frames_size),
    ):
        found = of(made, topic)
        assert [len(message.payload) for message in found] == [size] * 5
        assert [each.time_ns for each in found] == [START_NS + n * 1_000_000 for n in range(100, 200, 20)]
    name = messages.JOINTS[1].schema
    joint = Definition(name, messages.SCHEMAS[name]).decode(of(made, messages.JOINTS[1])[1].payload)
    fields = dict(zip(cycle_record.JointRecord._fields, joint_values(120, 2), strict=True))
    assert {field: joint[field] for field in fields} == fields
    assert len(of(made, messages.JOINT_STATES)) == 5


def test_what_lasts_one_cycle_is_an_event_although_its_cycle_is_left_out():
    records = [
        record_of(n, statuses=(4 if n == 107 else 2, 2), missed=3 if n > 112 else 0) for n in range(100, 119)
    ]
    name = messages.EVENTS.schema
    events = [
        Definition(name, messages.SCHEMAS[name]).decode(message.payload)
        for message in of(stream().take(records), messages.EVENTS)
    ]
    seen = [(each["kind"], each["joint"], each["before"], each["after"], each["count"]) for each in events]
    assert seen == [
        (messages.EventKind.STATUS_CHANGED, 1, 2, 4, 0),
        (messages.EventKind.STATUS_CHANGED, 1, 4, 2, 0),
        (messages.EventKind.SLOTS_MISSED, 0, 0, 0, 3),
    ]
    assert [each["cycle"] for each in events] == [107, 108, 113]
    texts = [message.payload for message in of(stream().take(records), messages.LOG)]
    assert b"joint 1: VALID -> STALE" in texts[0]
    assert texts[0][12] == 30, "a warning"
    assert texts[1][12] == 20, "good news"


def test_changes_while_nobody_looked_are_no_events():
    made = stream()
    made.take([record_of(1, statuses=(2, 2))])
    made.forget()
    assert of(made.take([record_of(500, statuses=(6, 2), missed=9)]), messages.EVENTS) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("8766", ("127.0.0.1", 8766)),
        (":9", ("127.0.0.1", 9)),
        ("0.0.0.0:1", ("0.0.0.0", 1)),
        ("robot-7.local", ("robot-7.local", 8765)),
        ("[::1]:7", ("::1", 7)),
        ("0", ("127.0.0.1", 0)),
    ],
)
def test_addresses(text, expected):
    assert address(text) == Address(*expected)


@pytest.mark.parametrize("text", ["", ":", "a:b", "h:70000", "1:2:3", "::1", "[x]:1", "a b", "66000"])
def test_addresses_that_are_none(text):
    with pytest.raises(argparse.ArgumentTypeError, match="expected HOST:PORT"):
        print(address(text))


def test_who_can_reach_an_address():
    assert [Address(host).loopback for host in ("127.0.0.1", "127.3.2.1", "localhost", "::1")] == [True] * 4
    assert [Address(host).loopback for host in ("0.0.0.0", "::", "10.0.0.1", "robot")] == [False] * 4


# ---- the process ----


def test_a_viewer_gets_the_topics_and_schemas_of_the_log_at_50_hz(memory):
    memory.notices.add(20, "boot", 1, "before anybody looked")
    with LiveProcess(memory.directory) as live:
        viewer = Viewer(live.url)
        info = viewer.texts[0]
        assert (info["op"], info["name"], info["capabilities"]) == ("serverInfo", "jtqd on vcan7", [])
        assert "services" not in {text["op"] for text in viewer.texts}
        found = {
            channel["topic"]: (
                channel["encoding"],
                channel["schemaName"],
                channel["schemaEncoding"],
                channel["schema"],
            )
            for channel in viewer.channels.values()
        }
        assert found == {
            topic.name: ("cdr", topic.schema, "ros2msg", messages.SCHEMAS[topic.schema])
            for topic in messages.TOPICS
        }
        feeding = memory.feeding(3000, statuses=lambda n: (4 if n % 500 == 33 else 2, 2))
        viewer.wait_for("/joint/1/state")
        memory.notices.add(30, "heartbeat", 3, "node 3: no heartbeat for 0.3 s")
        viewer.watch(2.0)
        feeding.join()
        joints = viewer.messages["/joint/1/state"]
        cycles = [message["cycle"] for _, message in joints]
        first, last = cycles[0], cycles[-1]
        assert 0.9 * (last - first) / 20 <= len(cycles) - 1 <= (last - first) / 20 + 1, cycles
        for stamp, message in joints:
            index = message["cycle"]
            assert stamp == START_NS + index * 1_000_000
            assert (
                message["torque_nm"]
                == joint_values(index, 1)[cycle_record.JointRecord._fields.index("torque_nm")]
            )
        assert {"/joint/2/state", "/can/frames", "/joint_states", "/events", "/log", "/diagnostics"} < {
            *viewer.messages
        }
        kinds = [message["kind"] for _, message in viewer.messages["/events"]]
        assert kinds.count(messages.EventKind.STATUS_CHANGED) >= 4, "each lasted one cycle"
        notices = [
            m["text"].strip() for _, m in viewer.messages["/events"] if m["kind"] == messages.EventKind.NOTICE
        ]
        assert notices == ["node 3: no heartbeat for 0.3 s"]
        names = [status["name"] for status in viewer.messages["/diagnostics"][0][1]["status"]]
        assert names[0] == "jtqd: loop"
        viewer.leave()


@pytest.mark.parametrize(
    ("offered", "chosen"),
    [([OLDER], OLDER), ([PROTOCOL], PROTOCOL), ([OLDER, PROTOCOL], PROTOCOL), (["other.v1", OLDER], OLDER)],
)
def test_viewers_of_both_protocols_are_served(shared, offered, chosen):
    memory, live = shared
    viewer = Viewer(live.url, ["/joint/1/state"], subprotocols=offered)
    assert viewer.socket.subprotocol == chosen
    feeding = memory.feeding(500)
    viewer.wait_for("/joint/1/state")
    feeding.join()
    stamp, message = viewer.messages["/joint/1/state"][0]
    assert stamp == START_NS + message["cycle"] * 1_000_000
    viewer.leave()


def test_a_client_of_another_protocol_is_answered_what_to_use(shared):
    answer = asked(shared[1].port, "/", "Upgrade: websocket", "Sec-WebSocket-Protocol: chat")
    assert answer.startswith(b"HTTP/1.1 400 ")
    for word in (PROTOCOL, OLDER):
        assert word.encode() in answer


def test_nothing_that_a_viewer_sends_changes_anything(memory):
    memory.feed(50)
    before = [path.read_bytes() for path in memory.files()]
    with LiveProcess(memory.directory) as live:
        shared = live.shared()
        assert {path.name: shared[path.name] for path in memory.files()} == {
            path.name: "r--s" for path in memory.files()
        }
        viewer = Viewer(live.url)
        viewer.send(
            op="advertise", channels=[{"id": 1, "topic": "/cmd", "encoding": "json", "schemaName": ""}]
        )
        viewer.socket.send(struct.pack("<BI", 1, 1) + b'{"torque": 5}')
        viewer.send(op="setParameters", parameters=[{"name": "x", "value": 1}], id="1")
        viewer.socket.send(struct.pack("<BIII", 2, 1, 1, 4) + b"json{}")
        viewer.watch(0.5)
        refused = [text for text in viewer.texts if text["op"] == "status"]
        assert refused, viewer.texts
        assert live.process.poll() is None
        other = Viewer(live.url, ["/joint/1/state"])
        memory_unchanged = [path.read_bytes() for path in memory.files()] == before
        feeding = memory.feeding(500)
        other.wait_for("/joint/1/state")
        feeding.join()
    assert memory_unchanged


def test_a_viewer_that_does_not_read_costs_others_nothing(memory):
    """8000 cycles a second give 2.5 MB in 5 s: more than all buffers on the way to the one that is stuck."""
    with LiveProcess(memory.directory) as live, socket.socket() as narrow:
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        narrow.connect(("127.0.0.1", live.port))
        stuck = Viewer(live.url, sock=narrow, max_queue=1)  # reads nothing from now on
        good = Viewer(live.url, ["/joint/1/state"])
        start_mb = live.resident_mb()
        feeding = memory.feeding(40_000, rate_hz=8_000)
        while feeding.is_alive():
            good.watch(0.2)
        good.watch(0.5)
        assert live.process.poll() is None
        cycles = [message["cycle"] for _, message in good.messages["/joint/1/state"]]
        assert len(cycles) >= 0.5 * 40_000 / 20, "a busy machine may overrun the ring"
        assert cycles[-1] > 39_000, "up to the newest"
        assert live.resident_mb() - start_mb < 10.0
        unread = len(stuck.messages)
        stuck.leave()
    assert unread == 0


def test_a_viewer_that_goes_without_a_word_and_garbage_are_no_trouble(shared):
    memory, live = shared
    Viewer(live.url).leave()
    for data in (b"\0" * 5000, b"GET / HTTP/1.1\r\n\r\n", b""):
        with socket.create_connection(("127.0.0.1", live.port), timeout=5) as raw:
            raw.sendall(data)
    feeding = memory.feeding(500)
    viewer = Viewer(live.url, ["/joint/1/state"])
    assert viewer.wait_for("/joint/1/state")
    feeding.join()
    viewer.leave()


@pytest.mark.measures
def test_without_a_viewer_it_reads_no_cycle(memory):
    with LiveProcess(memory.directory) as live:
        memory.feed(500)
        before = live.cpu_s()
        memory.feed(1000)
        assert live.cpu_s() - before <= 0.05


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"ring": "/nowhere/ring"}, "/nowhere/ring: cannot be read as a ring"),
        ({"host": "192.0.2.7", "port": 9}, "192.0.2.7:9: Cannot assign requested address"),
        ({"port": None}, ": Address already in use"),
    ],
)
def test_a_process_that_cannot_begin_answers_why(memory, changes, part):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        if changes.get("port", 0) is None:
            changes = {"port": taken.getsockname()[1]}
        with LiveProcess(memory.directory, **changes) as live:
            assert live.process.wait(10) == 1
            assert part in live.answer["failed"]


@pytest.mark.measures
def test_it_ends_on_sigterm(memory):
    with LiveProcess(memory.directory) as live:
        Viewer(live.url)
        live.process.terminate()
        began = time.monotonic()
        assert live.process.wait(5) == 0
        assert time.monotonic() - began < 2.0
    assert json.dumps(live.answer)
