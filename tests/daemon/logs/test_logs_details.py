"""Corners of reading: indexes that lie, chunks that would grow, the last chunk of a file whose writer died behind it."""

import os
import struct

import can
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode

from jtqd.daemon.logs.batch import believed, read_index
from jtqd.daemon.logs.can_io import McapCanReader, McapCanWriter
from jtqd.daemon.logs.cdr import Decoder
from jtqd.daemon.logs.chunks import ChunkError, unpack_data
from jtqd.daemon.logs.errors import LogError
from jtqd.daemon.logs.export_command import main
from jtqd.daemon.logs.export_table import RunTable
from jtqd.daemon.logs.reader import log_parts, read_topic
from jtqd.daemon.logs.records import Source
from jtqd.daemon.logs.ros2msg import Types
from tests.daemon.logs.campaign_log import Joint, regular, write_log
from tests.daemon.logs.log_files import ours, record_starts

TOPICS = ("/joint/1/state", "/joint/2/state", "/can/frames")


def message(channel, time_ns, payload):
    return struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(payload), channel, 0, time_ns, time_ns) + payload


@pytest.mark.parametrize("cut", range(4))
def test_the_last_chunk_is_read_whole_whatever_of_its_indexes_is_there(tmp_path, cut):
    """The writer was killed between the message indexes of its last chunk: some channels have one, others none."""
    data = ours(tmp_path / "a.mcap")
    starts = record_starts(data)
    last = max(n for n, at in enumerate(starts[:-1]) if data[at] == Opcode.CHUNK)
    end = starts[last + 1 + cut]
    assert data[starts[last + cut]] == (Opcode.MESSAGE_INDEX if cut else Opcode.CHUNK)
    active = tmp_path / "b.mcap.active"
    active.write_bytes(data[:end])
    for topic in TOPICS:
        assert len(read_topic(active, topic)) == 120, topic


def test_an_index_of_another_channel_is_none(tmp_path):
    path = tmp_path / "index"
    entries = struct.pack("<2Q", 5, 0)
    head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), 3, len(entries))
    path.write_bytes(head + entries)
    descriptor = os.open(path, os.O_RDONLY)
    try:
        source = Source(descriptor)
        assert read_index(source, 0, 3).tolist() == [[5, 0]]
        assert read_index(source, 0, 4) is None
    finally:
        os.close(descriptor)


def test_an_index_into_the_inside_of_a_message_is_not_believed():
    """A payload that looks like a message: an index that names both would give its bytes twice."""
    inner = message(1, 7, b"inner")
    data = message(1, 5, inner + bytes(8)) + message(1, 9, b"next")
    outer, second = 0, 31 + len(inner) + 8
    good = believed(data, 1, np.array([[5, outer], [9, second]], np.uint64))
    assert good is not None
    assert good.lengths.tolist() == [len(inner) + 8, 4]
    assert believed(data, 1, np.array([[5, outer], [7, 31], [9, second]], np.uint64)) is None


def test_a_packed_chunk_that_says_it_is_larger_is_not_unpacked():
    """What the frame of zstd says is looked at before a byte is made."""
    packed = zstandard.ZstdCompressor().compress(bytes(100_000))
    assert unpack_data("zstd", packed, 100_000) == bytes(100_000)
    with pytest.raises(ChunkError, match="says 100000 bytes unpacked, expected at most 99999"):
        unpack_data("zstd", packed, 99_999)


def test_parts_beyond_9999_come_in_the_order_of_their_numbers(tmp_path):
    names = [f"r-20260101T000000Z-{n}.mcap" for n in ("9998", "9999", "10000")]
    for name in names:
        (tmp_path / name).touch()
    assert [path.name for path in log_parts(tmp_path)] == names
    assert [path.name for path in log_parts([tmp_path / name for name in names[::-1]])] == names


def test_a_summary_that_fails_its_crc_is_not_believed(tmp_path):
    """One letter of a topic's name in the summary: everything parses."""
    data = bytearray(ours(tmp_path / "a.mcap"))
    at = data.rindex(b"/joint_states")
    data[at + 1] ^= 0x20
    (tmp_path / "b.mcap").write_bytes(data)
    with pytest.raises(LogError, match="its summary is damaged"):
        read_topic(tmp_path / "b.mcap", TOPICS[0])


def test_a_run_table_needs_two_cycles(tmp_path):
    for count in (1, 2):
        write_log(tmp_path / "a.mcap", regular(count, lambda n: (Joint(), Joint())))
        table = RunTable(tmp_path / "a.mcap")
        if count == 2:
            assert [len(block["time_s"]) for block in table.blocks()] == [2]
            continue
        with pytest.raises(LogError, match="found 1 cycles with every column, expected at least 2"):
            list(table.blocks())
        (tmp_path / "a.mcap").unlink()


def test_export_never_writes_over_its_log(tmp_path):
    data = ours(tmp_path / "a.mcap", 10)
    (tmp_path / "link.mcap").symlink_to(tmp_path / "a.mcap")
    for out in ("a.mcap", "link.mcap"):
        with pytest.raises(SystemExit, match="2"):
            main(["candump", str(tmp_path / "a.mcap"), "--out", str(tmp_path / out)])
    assert (tmp_path / "a.mcap").read_bytes() == data


def test_frames_of_half_a_second_ago_are_in_the_file_of_the_logger(tmp_path):
    writer = McapCanWriter(tmp_path / "a.mcap.active")
    for n in range(1200):
        writer.on_message_received(can.Message(timestamp=1.7e9 + n * 1e-3, arbitration_id=1, data=b"x"))
    kept = (tmp_path / "a.mcap.active").read_bytes()  # as a crash would leave it
    writer.stop()
    (tmp_path / "b.mcap.active").write_bytes(kept)
    assert len(list(McapCanReader(tmp_path / "b.mcap.active"))) >= 1000


def test_a_sequence_that_says_it_is_longer_than_its_message():
    decoder = Decoder(Types("string[] a\n"))
    good = b"\0\1\0\0" + struct.pack("<II4s", 1, 4, b"abc\0")
    assert decoder.row(good) == (["abc"],)
    with pytest.raises(LogError, match="found a length of 4000000000 in a message of 12 bytes"):
        decoder.row(good[:4] + struct.pack("<I", 4_000_000_000) + good[8:])
