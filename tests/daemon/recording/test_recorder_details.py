"""Corners of recording that a whole run seldom meets: order of time in a chunk, an early end, what is repeated."""

import fcntl
import json
import os

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader

from jtqd.daemon.config import load_config
from jtqd.daemon.logs.recover import recover_unfinished
from jtqd.daemon.recording import messages
from jtqd.daemon.recording.launch import RecorderProcess, recording_request
from jtqd.daemon.recording.mcap_file import ChunkBuilder
from jtqd.daemon.recording.messages import ERROR, WARN, EventLog, definitions
from jtqd.daemon.recording.recorder import RecorderRequest, main
from jtqd.daemon.recording.run_files import parse_part, part_files
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import Snapshot
from jtqd.daemon.supervisor.process import SupervisorError, log_directory
from jtqd.models.files import shipped
from tests.daemon import ring_records as rr
from tests.daemon.recording.recorder_bench import (
    START_NS,
    cycles_of,
    messages_of,
    one_file,
    put,
    record_of,
    session_on,
)

MS = 1_000_000


def in_file_order(path):
    """(topic, log time) of every message as it stands in the file."""
    with open(path, "rb") as file:
        records = list(StreamReader(file).records)
    names = {topic.number: topic.name for topic in messages.TOPICS}
    return [(names[each.channel_id], each.log_time) for each in records if isinstance(each, Message)]


def times_by_topic(path):
    found = {}
    for topic, time in in_file_order(path):
        found.setdefault(topic, []).append(time)
    return found


def test_what_is_heard_of_late_stands_at_its_time(tmp_path):
    """A notice of the supervisor is 30 cycles old when it is read: it goes to its place in the chunk."""
    path = tmp_path / "log.mcap"
    recording, sink = one_file(path, chunk_ns=10**9)
    for n in range(100):
        recording.add(record_of(n))
        if n in (60, 61):
            late_ns = START_NS + (30 - n % 2) * MS + 500
            recording.events.note(messages.NOTICE, f"at {n}", level=WARN, time_ns=late_ns)
    recording.flush()
    sink.end()
    cycles = {topic.name for topic in (*messages.JOINTS, messages.CAN_FRAMES)}
    assert all(times == sorted(times) for times in times_by_topic(path).values())
    others = [(topic, time) for topic, time in in_file_order(path) if topic not in cycles]
    assert [time for _, time in others] == sorted(time for _, time in others)
    with open(path, "rb") as file:
        found = [
            (channel.topic, message.log_time) for _, channel, message in make_reader(file).iter_messages()
        ]
    at = next(n for n, (topic, _) in enumerate(found) if topic == "/events")
    assert found[at - 1][1] == START_NS + 29 * MS
    assert found[at][1] == START_NS + 29 * MS + 500
    texts = [message["text"].rstrip() for _, message in messages_of(path)["/events"]]
    assert texts == ["at 61", "at 60"]
    assert cycles_of(path) == list(range(100))


def test_cycles_keep_their_order_when_the_clock_is_set_back(tmp_path):
    path = tmp_path / "log.mcap"
    recording, sink = one_file(path, chunk_ns=10**9)
    for n in range(50):
        recording.add(record_of(n, start_ns=START_NS - (3600 * 10**9 if n >= 25 else 0)))
        if n == 40:
            recording.events.note(messages.NOTICE, "late", level=WARN, time_ns=START_NS)
    recording.flush()
    sink.end()
    assert cycles_of(path) == list(range(50))


def repeated(builder, spans):
    """Whether each of the next spans repeats the definitions."""
    found = []
    for _ in range(spans):
        builder.add(1, 5, bytes(8))
        (chunk,) = builder.seal().chunks
        found.append(b"jtqd_msgs/msg/JointEstimate" in unpacked(chunk))
    return found


def unpacked(sealed):
    at = 9 + 8 + 8 + 8 + 4 + 4 + 4 + 8
    return zstandard.ZstdDecompressor().decompress(sealed.data[at : at + sealed.packed_size])


def test_each_file_has_the_definitions_in_its_first_span_and_every_so_many():
    builder = ChunkBuilder(*definitions(), [], 3)
    assert repeated(builder, 7) == [True, False, False, True, False, False, True]
    builder.restart()  # nothing collected yet
    assert repeated(builder, 4) == [True, False, False, True]
    builder.add(1, 5, bytes(8))  # a chunk without them has begun: the next one has them
    builder.restart()
    assert repeated(builder, 5) == [False, True, False, False, True]
    builder.seal()
    builder = ChunkBuilder(*definitions(), [], 3)
    builder.add(1, 5, bytes(8))  # a chunk with them has begun: that will do
    builder.restart()
    assert repeated(builder, 4) == [True, False, False, True]


def test_what_tells_of_loss_is_written_however_much_happens(tmp_path):
    """Statuses that flap are bounded in a chunk; a loss after them is not left out."""
    builder = ChunkBuilder(*definitions(), [], 60)
    events = EventLog(builder.add)
    for n in range(80):
        events.note(messages.STATUS_CHANGED, f"{n}", level=WARN)
    events.note(messages.RECORDS_LOST, "lost", level=ERROR)
    assert events.left_out == 30
    assert builder.seal().chunks[0].counts[messages.EVENTS.number] == 51


def test_a_recorder_that_is_told_to_end_before_it_has_begun_records_what_there_is(tmp_path):
    ring = Ring(tmp_path / "ring", 1024, rr.RECORD_SIZE)
    for n in range(500):
        put(ring, record_of(n))
    Snapshot(tmp_path / "snapshot", 1e-3, 0.5)
    keeper = RecorderProcess(lambda module, arguments, name: Child(module, arguments, name=name), tmp_path)
    request = {"ring": str(tmp_path / "ring"), "directory": str(tmp_path / "logs"), "prefix": "test"}
    keeper.start(request | {"progress": str(keeper.progress)})
    result = keeper.end()  # its imports take half a second: this comes before them
    assert (result["written"], result["lost"], result["left"]) == (500, 0, [])
    assert cycles_of(result["path"]) == list(range(500))


def test_other_files_in_force_are_attached_from_the_next_part_on(tmp_path):
    session = session_on(tmp_path, attachments=[{"name": "joint.yaml", "text": "old"}])
    session.recording.add(record_of(0))
    again = RecorderRequest(
        ring=tmp_path / "ring",
        directory=tmp_path / "logs",
        attachments=({"name": "joint.yaml", "text": "new"}, {"name": "broken", "base64": "?"}),
    )
    said = []
    session._warn = said.append
    session.renew(again)
    session.recording.add(record_of(1))
    summary = session.finish()
    contents = []
    for path in summary["paths"]:
        with open(path, "rb") as file:
            contents.append(
                {r.name: r.data for r in StreamReader(file).records if type(r).__name__ == "Attachment"}
            )
    assert contents == [{"joint.yaml": b"old"}, {"joint.yaml": b"new"}]
    assert len(said) == 1
    assert said[0].startswith("attachment broken: its base64: ")


def test_leftovers_that_are_being_written_or_empty(tmp_path):
    names = [f"test-20260101T000000Z-{n:04d}.mcap.active" for n in (1, 2)]
    for name in names:
        (tmp_path / name).touch()
    held, empty = part_files(tmp_path, "test")
    with open(held.path, "rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert recover_unfinished(held) is None
    assert held.path.exists()
    assert recover_unfinished(empty) == (f"{names[1]} was empty: removed", False)
    assert not empty.path.exists()


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("a-20260101T000000Z-0001.mcap", ("20260101T000000Z", 1, 1, False)),
        ("a-20260101T000000Z_12-12345.mcap.active", ("20260101T000000Z_12", 12, 12345, True)),
        ("a-20260101T000000Z_0-0001.mcap", None),
        ("a-20260101T000000Z-001.mcap", None),
        ("a-20260101T000000Z-0001.mcap.bak", None),
        ("b-20260101T000000Z-0001.mcap", None),
        ("a-b-20260101T000000Z-0001.mcap", None),
        ("a-20260101T000000Z-0001-20260101T000000Z-0001.mcap", None),
        ("a-２0260101T000000Z-0001.mcap", None),
    ],
)
def test_only_names_of_exactly_our_form_are_ours(tmp_path, name, found):
    each = parse_part("a", tmp_path / name)
    assert (each and (each.run, each.again, each.part, each.active)) == found


def test_two_joints_with_files_of_one_name_have_two_attachments(tmp_path):
    for number in (1, 2):
        (tmp_path / f"arm{number}").mkdir()
        (tmp_path / f"arm{number}" / "joint.yaml").write_bytes(shipped(f"joint{number}.yaml").read_bytes())
    import yaml

    content = yaml.safe_load(shipped("bench.yaml").read_text())
    content["estimator"] = {"method": "efficiency"}
    for number in (1, 2):
        content[f"joint_{number}"]["file"] = f"arm{number}/joint.yaml"
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(content))
    where = {"runtime": tmp_path, "directory": tmp_path / "logs", "bus": "can0"}
    scaling = dict.fromkeys(
        ("motor_rad_per_count", "link_rad_per_count", "motor_rad_s_per_unit", "ampere_per_unit"), 1.0
    )
    nodes = {str(n): {"scaling": scaling} for n in (1, 2)}
    request = recording_request(load_config(tmp_path / "c.yaml"), {"nodes": nodes}, **where)
    (tmp_path / "request.json").write_text(json.dumps(request))
    loaded = RecorderRequest.from_file(tmp_path / "request.json").load_attachments(pytest.fail)
    files = {item.name: item.data for item in loaded}
    assert len(files) == len(loaded)
    provenance = json.loads(files["provenance.json"])["joints"]
    for number in (1, 2):
        assert files[provenance[str(number)]["file"]] == shipped(f"joint{number}.yaml").read_bytes()


@pytest.mark.parametrize("record", ["file", "file/below", "/proc/nothing", ""])
def test_a_path_that_can_be_no_directory_is_refused(tmp_path, monkeypatch, record):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SupervisorError, match=r"^--record "):
        log_directory(record)


def test_log_directory_is_made(tmp_path):
    assert log_directory(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert (tmp_path / "a" / "b").is_dir()
    assert log_directory("none") is None


def test_progress_that_cannot_be_kept_is_one_line(tmp_path, capfd):
    Ring(tmp_path / "ring", 256, rr.RECORD_SIZE)
    (tmp_path / "recorded").mkdir()
    request = {
        "ring": str(tmp_path / "ring"),
        "directory": str(tmp_path / "logs"),
        "progress": str(tmp_path / "recorded"),
    }
    (tmp_path / "request.json").write_text(json.dumps(request))
    pid = os.fork()
    if pid == 0:
        os._exit(main([str(tmp_path / "request.json")]))
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 1
    assert capfd.readouterr().err == f"recorder: {tmp_path}/recorded: Is a directory\n"
