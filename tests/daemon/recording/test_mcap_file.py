"""One file of whole spans, on a disk that fails for a while, against the library's reader."""

import errno
import fcntl
import os
import struct

import pytest
import zstandard
from mcap.reader import NonSeekingReader, SeekingReader, make_reader
from mcap.records import Channel, Chunk, ChunkIndex, MessageIndex, Schema
from mcap.stream_reader import StreamReader

from jtqd.daemon.recording import mcap_file as appender
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, NamedData
from jtqd.daemon.recording.messages import definitions
from tests.daemon.recording.recorder_bench import START_NS, cycles_of, metadata_of, one_file, record_of


def written(path, record=record_of):
    """A file of 250 cycles."""
    recording, file = one_file(path)
    for n in range(250):
        recording.add(record(n))
    recording.flush()
    file.finish("log.mcap")


@pytest.fixture
def failing_disk(monkeypatch):
    """A knob: while it is set, a write takes half of what it gets and the next one fails."""
    knob = {"full": False, "half": False}
    real = os.pwrite

    def pwrite(file, data, offset):
        if not knob["full"]:
            return real(file, data, offset)
        knob["half"] = not knob["half"]
        if knob["half"]:
            return real(file, data[: len(data) // 2], offset)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", pwrite)
    return knob


def test_span_that_did_not_fit_is_taken_back(tmp_path, failing_disk):
    """The third of five spans is written by half and refused: the file is whole without it."""
    path = tmp_path / "log.mcap"
    recording, file = one_file(path, chunk_ns=10**9)
    for n in range(500):
        recording.add(record_of(n))
        if n % 100 == 99:
            failing_disk["full"] = n == 299
            if n == 299:
                length = path.stat().st_size
                with pytest.raises(OSError, match="No space"):
                    recording.flush()
                assert path.stat().st_size == length
                failing_disk["full"] = False
            else:
                recording.flush()
    file.finish("log.mcap")
    assert cycles_of(path) == [*range(200), *range(300, 500)]
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count == 4 * 4


def test_disk_that_stays_full_leaves_whole_chunks(tmp_path, failing_disk):
    path = tmp_path / "log.mcap"
    recording, file = one_file(path)
    for n in range(200):
        recording.add(record_of(n))
    recording.flush()
    length = path.stat().st_size
    failing_disk["full"] = True
    with pytest.raises(OSError, match="No space"):
        file.finish("log.mcap")
    assert path.stat().st_size == length
    with open(path, "rb") as file:
        assert any(isinstance(record, Chunk) for record in StreamReader(file, emit_chunks=True).records)


def test_room_for_the_summary_is_taken_before_it_is_needed(tmp_path, monkeypatch):
    """Every write lies within blocks that were taken before; the summary needs no more than what is there."""
    taken, written = [0], []
    real_write, real_take = os.pwrite, appender._fallocate

    def take(file, start, length):
        real_take(file, start, length)
        taken[0] = start + length

    def write(file, data, offset):
        written.append((offset + len(data), taken[0]))
        return real_write(file, data, offset)

    monkeypatch.setattr(os, "fdatasync", lambda _: None)
    monkeypatch.setattr(appender, "_STEP", 1)  # nothing is there by luck
    monkeypatch.setattr(appender, "_fallocate", take)
    monkeypatch.setattr(os, "pwrite", write)
    path = tmp_path / "log.mcap"
    recording, file = one_file(path, chunk_ns=1_000_000)  # many small chunks: the summary grows fastest
    for n in range(3000):
        recording.add(record_of(n))
    recording.flush()
    monkeypatch.setattr(appender, "_fallocate", lambda *_: pytest.fail("the summary asked for more"))
    file.finish("log.mcap")
    assert len(written) > 1000
    assert all(end <= room for end, room in written)
    # What was not used is given back.
    assert path.stat().st_blocks * 512 <= path.stat().st_size + 8192


def test_file_system_without_reservation(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EOPNOTSUPP, "not supported")

    monkeypatch.setattr(appender, "_fallocate", refuse)
    written(tmp_path / "log.mcap")
    assert cycles_of(tmp_path / "log.mcap") == list(range(250))


def test_head_that_cannot_be_written_leaves_no_file(tmp_path, failing_disk):
    failing_disk["full"] = True
    with pytest.raises(OSError, match="No space"):
        one_file(tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_not_touched(tmp_path):
    path = tmp_path / "log.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        one_file(path)
    assert path.read_bytes() == b"precious"


def test_file_is_locked_while_it_is_written(tmp_path):
    path = tmp_path / "log.mcap"
    recording, file = one_file(path)
    recording.add(record_of(0))
    recording.flush()
    with open(path, "rb") as other:
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_SH | fcntl.LOCK_NB)
        file.finish("log.mcap")
        fcntl.flock(other, fcntl.LOCK_SH | fcntl.LOCK_NB)


def test_directory_that_is_moved_meanwhile(tmp_path):
    """The file goes with its directory and gets its name there."""
    (tmp_path / "a").mkdir()
    recording, file = one_file(tmp_path / "a" / "log.mcap.active")
    recording.add(record_of(0))
    recording.flush()
    (tmp_path / "a").rename(tmp_path / "b")
    file.finish("log.mcap")
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["log.mcap"]
    assert cycles_of(tmp_path / "b" / "log.mcap") == [0]


def test_metadata_and_attachments_come_before_the_messages(tmp_path):
    schema_records, channels = definitions()
    head = Head(schema_records, channels, [NamedData("a.yaml", "application/yaml", b"a: 1\n")])
    file = McapFile(tmp_path / "log.mcap", head, {"run": "r", "part": "7"}, 5)
    builder = ChunkBuilder(schema_records, channels, [], 60)
    builder.add(1, 5, bytes(8))
    file.append(builder.seal())
    file.finish("log.mcap")
    assert metadata_of(tmp_path / "log.mcap") == {"run": "r", "part": "7"}
    with open(tmp_path / "log.mcap", "rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
        found = list(make_reader(stream).iter_attachments())
    assert [(item.name, item.data) for item in found] == [("a.yaml", b"a: 1\n")]
    at = summary.metadata_indexes[0].offset, summary.attachment_indexes[0].offset
    assert 0 < at[0] < at[1] < summary.chunk_indexes[0].chunk_start_offset
    assert (summary.statistics.metadata_count, summary.statistics.attachment_count) == (1, 1)


def test_messages_of_several_channels_are_found_by_their_index(tmp_path):
    """Two channels, times out of order: the reader's index finds each message, and sorts them."""
    path = tmp_path / "log.mcap"
    schemas = [Schema(id=1, name="x", encoding="ros2msg", data=b"uint8 a\n")]
    channels = [
        Channel(id=n, topic=f"/{n}", message_encoding="cdr", metadata={}, schema_id=1) for n in (1, 2)
    ]
    builder = ChunkBuilder(schemas, channels, [], 60)
    file = McapFile(path, Head(schemas, channels, []), {}, 0)
    for time_ns, channel in ((30, 1), (10, 2), (20, 1)):
        builder.add(channel, time_ns, b"\x00\x01\x00\x00" + bytes([time_ns]), sequence=time_ns)
    file.append(builder.seal())
    assert builder.seal() is None
    builder.add(2, 5, b"\x00\x01\x00\x00\x05", sequence=5)
    file.append(builder.seal())
    file.finish(path.name)
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        found = [(c.topic, m.log_time, m.sequence, m.data[4]) for _, c, m in reader.iter_messages()]
    assert found == [("/2", 5, 5, 5), ("/2", 10, 10, 10), ("/1", 20, 20, 20), ("/1", 30, 30, 30)]
    statistics = summary.statistics
    assert (statistics.message_start_time, statistics.message_end_time, statistics.chunk_count) == (5, 30, 2)


@pytest.mark.parametrize("stream", [False, True], ids=["by the index", "from a pipe"])
def test_readers_get_the_messages_of_a_span_in_the_order_of_time(tmp_path, stream):
    """Its chunks lie behind one another and are of the same time; what is of one time comes in the order of the topics."""
    path = tmp_path / "log.mcap"
    written(path)
    with open(path, "rb") as file:
        make = NonSeekingReader if stream else SeekingReader
        messages = make(file, validate_crcs=True).iter_messages()
        found = [(message.log_time, channel.topic) for _, channel, message in messages]
    topics = ["/joint/1/state", "/joint/2/state", "/can/frames", "/joint_states"]
    assert found == [
        (START_NS + n * 1_000_000, topic) for n in range(250) for topic in topics[: 4 if n % 20 == 0 else 3]
    ]


def test_a_joint_is_read_without_the_chunks_of_the_others(tmp_path):
    path = tmp_path / "log.mcap"
    written(path)
    with open(path, "rb") as file:
        index = make_reader(file).get_summary().chunk_indexes
    topics = [{*each.message_index_offsets} for each in index]
    assert topics == 3 * [{1}, {2}, {3}, {4}]


def test_every_index_entry_points_at_its_message(tmp_path):
    """Readers that go by offset (numpy views of a chunk, seeking) rely on it; the library's reader does not."""
    path = tmp_path / "log.mcap"
    written(path, lambda n: record_of(n, statuses=(2 + n // 100, 2)))
    with open(path, "rb") as file:
        records = list(StreamReader(file, emit_chunks=True).records)
    entries, chunk = 0, None
    for record in records:
        if isinstance(record, Chunk):
            chunk = zstandard.ZstdDecompressor().decompress(record.data, record.uncompressed_size)
        elif isinstance(record, MessageIndex):
            for time_ns, offset in record.records:
                opcode, _, channel, _, log_time = struct.unpack_from("<BQHIQ", chunk, offset)
                assert (opcode, channel, log_time) == (0x05, record.channel_id, time_ns)
                entries += 1
    index = [record for record in records if isinstance(record, ChunkIndex)]
    chunks = [record for record in records if isinstance(record, Chunk)]
    data = path.read_bytes()
    for record, chunk in zip(index, chunks, strict=True):
        assert (record.message_start_time, record.message_end_time, record.uncompressed_size) == (
            chunk.message_start_time,
            chunk.message_end_time,
            chunk.uncompressed_size,
        )
        behind = record.chunk_start_offset + record.chunk_length + record.message_index_length
        assert behind in {each.chunk_start_offset for each in index} or data[behind] == 0x0F
    for record in index:
        assert data[record.chunk_start_offset] == 0x06
        for channel, offset in record.message_index_offsets.items():
            assert struct.unpack_from("<BQH", data, offset)[::2] == (0x07, channel)
    assert len(index) == 3 * 4
    assert entries == 3 * 250 + 13 + 2 * 2
