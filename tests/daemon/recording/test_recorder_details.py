"""Corners of recording that a whole run seldom meets: order of time in a chunk, an early end, what is repeated."""

import fcntl
import json
import os

import zstandard
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from jtqd.daemon.logs.recover import recover_unfinished
from jtqd.daemon.recording import messages
from jtqd.daemon.recording.launch import RecorderProcess
from jtqd.daemon.recording.mcap_file import ChunkBuilder
from jtqd.daemon.recording.messages import ERROR, WARN, EventKind, EventLog, definitions
from jtqd.daemon.recording.recorder import RecorderRequest, main
from jtqd.daemon.recording.run_files import part_files
from jtqd.daemon.shared.cycle_record import Ring
from jtqd.daemon.shared.processes import Child
from jtqd.daemon.shared.snapshot import Snapshot
from tests.daemon import ring_records as rr
from tests.daemon.recording.recorder_bench import (
    START_NS,
    cycles_of,
    messages_of,
    one_file,
    put,
    record_of,
    session_on,
    statuses_of,
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
    recording, file = one_file(path, chunk_ns=10**9)
    for n in range(100):
        recording.add(record_of(n))
        if n in (60, 61):
            late_ns = START_NS + (30 - n % 2) * MS + 500
            recording.events.note(EventKind.NOTICE, f"at {n}", level=WARN, time_ns=late_ns)
    recording.flush()
    file.finish("log.mcap")
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
    recording, file = one_file(path, chunk_ns=10**9)
    for n in range(50):
        recording.add(record_of(n, start_ns=START_NS - (3600 * 10**9 if n >= 25 else 0)))
        if n == 40:
            recording.events.note(EventKind.NOTICE, "late", level=WARN, time_ns=START_NS)
    recording.flush()
    file.finish("log.mcap")
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
        events.note(EventKind.STATUS_CHANGED, f"{n}", level=WARN)
    events.note(EventKind.RECORDS_LOST, "lost", level=ERROR)
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


# ---- events, definitions ----


def events(path, kind):
    return [event for _, event in messages_of(path)["/events"] if event["kind"] == kind]


def test_status_changes_and_missed_slots_are_events(tmp_path):
    session = session_on(tmp_path)
    for n, pair in enumerate([(2, 2)] * 5 + [(2, 4)] * 3 + [(6, 2)] * 4):
        session.recording.add(record_of(n, statuses=pair, missed=7 if n < 10 else 10))
    path = session.finish()["path"]
    changes = events(path, EventKind.STATUS_CHANGED)
    assert [(e["cycle"], e["joint"], e["before"], e["after"]) for e in changes] == [
        (5, 2, 2, 4),
        (8, 1, 2, 6),
        (8, 2, 4, 2),
    ]
    assert [(e["cycle"], e["count"]) for e in events(path, EventKind.SLOTS_MISSED)] == [(10, 3)]
    assert "joint 2: VALID -> STALE" in [line["msg"].rstrip() for _, line in messages_of(path)["/log"]]


def test_flapping_status_is_bounded_and_counted(tmp_path):
    session = session_on(tmp_path)
    for n in range(1000):
        session.recording.add(record_of(n, statuses=(2 + n % 2, 2)))
    session.diagnose(0, 0.0)
    path = session.finish()["path"]
    written = len(events(path, EventKind.STATUS_CHANGED))
    values = statuses_of(messages_of(path)["/diagnostics"][-1][1])["jtqd: recorder"][2]
    assert 50 <= written <= 150
    assert written + int(values["events_left_out"]) == 999


def test_schemas_are_repeated_for_a_file_that_lost_its_head(tmp_path):
    session = session_on(tmp_path, chunk_s=0.01)
    for n in range(1500):
        session.recording.add(record_of(n))
    with open(session.finish()["path"], "rb") as file:
        chunks = [r for r in StreamReader(file, emit_chunks=True).records if isinstance(r, Chunk)]
    repeated, spans = [], 0
    for chunk in chunks:
        records = breakup_chunk(chunk)
        kinds = [type(record) for record in records]
        if Schema in kinds:
            repeated.append(spans)
            assert (kinds.count(Schema), kinds.count(Channel)) == (7, 9)
        spans += any(isinstance(record, Message) and record.channel_id == 1 for record in records)
    assert spans > 120
    assert repeated == [0, 60, 120]
