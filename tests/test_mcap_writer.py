"""The chunk writer on a disk that fails for a while, against the library's reader."""

import errno
import os
import struct

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader
from recorder_bench import messages_of, record_of

from daemon import mcap_schemas as schemas
from daemon.mcap_messages import BLOCK_PARTS, JointStateMessage
from daemon.mcap_writer import McapFile
from daemon.recorder import definitions
from daemon.recording import Recording


def open_file(path):
    schema_records, channels = definitions(None)
    return McapFile(
        path, schemas=schema_records, channels=channels, attachments=[], block_parts=BLOCK_PARTS, time_ns=1
    )


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


def test_disk_that_is_full_for_two_chunks(tmp_path, failing_disk):
    """Chunks of 100 cycles; the third and fourth do not fit. The file is whole all the same, and says what it lacks."""
    said = []
    path = tmp_path / "log.mcap"
    recording = Recording(open_file(path), JointStateMessage(("a", "b"), (1.0, 1.0)), 99_000_000, said.append)
    for n in range(600):
        failing_disk["full"] = 200 <= n < 400
        recording.add(record_of(n))
    assert recording.finish()
    account = recording.account
    assert (account.cycles, account.written, account.lost) == (600, 400, 200)
    found = messages_of(path)
    cycles = [message["cycle"] for _, message in found["/joint/1/state"]]
    assert cycles == [*range(200), *range(400, 600)]
    event = found["/events"][-1][1]
    assert (event["kind"], event["count"]) == (schemas.WRITE_FAILED, 200)
    assert said == [
        "recording fails, cycles are being lost: No space left on device",
        "200 cycles could not be written; recording goes on",
    ]
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count == 4
    with open(path, "rb") as file:
        records = list(StreamReader(file, validate_crcs=True).records)
    assert sum(isinstance(record, Message) for record in records) == summary.statistics.message_count


def test_disk_that_stays_full(tmp_path, failing_disk):
    """No summary fits: the file keeps its whole chunks and nothing behind them."""
    path = tmp_path / "log.mcap"
    recording = Recording(
        open_file(path), JointStateMessage(("a", "b"), (1.0, 1.0)), 99_000_000, lambda _: None
    )
    for n in range(300):
        recording.add(record_of(n))
        if n == 199:
            recording.flush()
            length = path.stat().st_size
            failing_disk["full"] = True
    assert not recording.finish()
    assert path.stat().st_size == length
    assert (recording.account.written, recording.account.lost) == (200, 100)


def test_head_that_cannot_be_written_leaves_no_file(tmp_path, failing_disk):
    failing_disk["full"] = True
    with pytest.raises(OSError, match="No space"):
        open_file(tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_not_touched(tmp_path):
    path = tmp_path / "log.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        open_file(path)
    assert path.read_bytes() == b"precious"


def test_messages_of_several_channels_are_found_by_their_index(tmp_path):
    """Two channels, times out of order: the reader's index finds each message, and sorts them."""
    path = tmp_path / "log.mcap"
    file = McapFile(
        path,
        schemas=[Schema(id=1, name="x", encoding="ros2msg", data=b"uint8 a\n")],
        channels=[
            Channel(id=n, topic=f"/{n}", message_encoding="cdr", metadata={}, schema_id=1) for n in (1, 2)
        ],
        attachments=[],
        block_parts=[],
        time_ns=0,
    )
    for time_ns, channel in ((30, 1), (10, 2), (20, 1)):
        file.add(channel, time_ns, b"\x00\x01\x00\x00" + bytes([time_ns]), sequence=time_ns)
    file.flush()
    file.flush()
    file.add(2, 5, b"\x00\x01\x00\x00\x05", sequence=5)
    file.flush()
    file.finish()
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        found = [(c.topic, m.log_time, m.sequence, m.data[4]) for _, c, m in reader.iter_messages()]
    assert found == [("/2", 5, 5, 5), ("/2", 10, 10, 10), ("/1", 20, 20, 20), ("/1", 30, 30, 30)]
    statistics = summary.statistics
    assert (statistics.message_start_time, statistics.message_end_time, statistics.chunk_count) == (5, 30, 2)


def test_cycles_without_a_file_are_all_lost():
    recording = Recording(None, JointStateMessage(("a", "b"), (1.0, 1.0)), 10**8, lambda _: None)
    recording.add(record_of(0))
    recording.lose(3, 0)
    recording.diagnose(0, 0, 0.0)
    assert not recording.finish()
    assert (recording.account.cycles, recording.account.written, recording.account.lost) == (4, 0, 4)


def test_every_index_entry_points_at_its_message(tmp_path):
    """Readers that go by offset (numpy views of a chunk, seeking) rely on it; the library's reader does not."""
    path = tmp_path / "log.mcap"
    recording = Recording(
        open_file(path), JointStateMessage(("a", "b"), (1.0, 1.0)), 99_000_000, lambda _: None
    )
    for n in range(250):
        recording.add(record_of(n, statuses=(2 + n // 100, 2)))
    recording.finish()
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
    data = path.read_bytes()
    for record in index:
        assert data[record.chunk_start_offset] == 0x06
        for channel, offset in record.message_index_offsets.items():
            assert struct.unpack_from("<BQH", data, offset)[::2] == (0x07, channel)
    assert len(index) == 3
    assert entries == 3 * 250 + 13 + 2 * 2
