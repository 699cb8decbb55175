"""Reading logs: fixed rows against the library's decoder, messages of other writers, parts, unfinished and lying files."""

import io
import json
import os
import resource
import shutil
import struct
import subprocess
import sys
import tracemalloc
import types
import zlib

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Schema
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from numpy.lib.recfunctions import repack_fields

from jtqd.daemon.logs import (
    LogError,
    Table,
    iter_messages,
    iter_topics,
    log_parts,
    read,
    read_attachments,
    read_messages,
    read_topic,
    read_topics,
    topics_of,
)
from jtqd.daemon.logs.export import main as export
from jtqd.daemon.logs.log_file import ChunkError, LogFile, Source
from jtqd.daemon.logs.read import iter_frames
from jtqd.daemon.recording.mcap_file import ChunkBuilder, Head, McapFile, bytes_of
from jtqd.daemon.replay.command import main as replay
from jtqd.daemon.replay.session import replay as replayed
from tests.daemon.logs.log_files import ATTACHMENTS, cycles, foreign, ours, record_starts, write_log
from tests.daemon.recording.recorder_bench import record_of as cycle_record
from tests.daemon.recording.recorder_bench import session_on
from tests.daemon.replay import replay_helpers
from tests.daemon.replay.replay_helpers import cycles as cycle_numbers
from tests.paths import GOLDEN, ROOT

INDEXED = ("/joint/1/state", "/joint/2/state", "/can/frames")
JOINT, FRAMES = "/joint/1/state", "/can/frames"
START_NS = 1_700_000_007_000_000_000


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    ours(path, 130)
    return path


def by_library(path, topic):
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(m.log_time, d) for _, _, m, d in reader.iter_decoded_messages([topic], log_time_order=False)]


def same(value, expected):
    """A value of ours is the one the library's decoder gives."""
    if hasattr(expected, "__slots__"):
        return all(same(value_of(value, name), getattr(expected, name)) for name in expected.__slots__)
    if isinstance(value, bytes) and isinstance(expected, str):
        value = value.decode()
    if not isinstance(value, str) and hasattr(value, "__len__"):
        return len(value) == len(expected) and all(map(same, value, expected))
    return value == expected or (value != value and expected != expected)  # noqa: PLR0124


def value_of(message, name):
    """Field of a row, or of an object of the decoder."""
    return message[name] if isinstance(message, np.void) else getattr(message, name)


@pytest.mark.parametrize("topic", [JOINT, "/joint/2/state", FRAMES, "/joint_states"])
def test_every_field_is_what_the_library_decodes(log, topic):
    found = read_messages(log, (topic,))[topic]
    expected = by_library(log, topic)
    assert found.log_times.tolist() == [time for time, _ in expected]
    assert all(same(*pair) for pair in zip(found.records, [message for _, message in expected], strict=True))


def test_a_path_may_be_text_and_a_topic_that_is_missing_names_those_that_are_there():
    log = GOLDEN / "network.mcap"
    for path in (str(log), [str(log)]):
        assert read_topic(path, "/joint/1/state").tobytes() == read_topic(log, "/joint/1/state").tobytes()
    assert topics_of(str(log)) == topics_of(log)
    assert read_attachments(str(log)) == read_attachments(log)
    words = "no message on /joint/3/state, expected one of /can/frames, /diagnostics"
    with pytest.raises(LogError, match=words):
        read_topic(str(log), "/joint/3/state")


def test_fixed_messages_are_never_decoded_one_by_one(log, monkeypatch):
    def refuse(*_):
        raise AssertionError("decoded one by one")

    monkeypatch.setattr(read, "_decoder", refuse)
    found = read_topics(log, (JOINT, FRAMES))
    assert len(found[JOINT]) == len(found[FRAMES]) == 130
    assert found[JOINT]["header"]["stamp"]["sec"].tolist() == [1_700_000_007] * 130


@pytest.mark.parametrize("kind", ["", "lz4", "zstd"])
def test_foreign_files_with_texts_of_any_length(tmp_path, kind):
    path = tmp_path / "a.mcap"
    path.write_bytes(foreign(kind))
    for topic in ("/t0", "/t2"):
        found = read_messages(path, (topic,))[topic]
        expected = by_library(path, topic)
        assert found.log_times.tolist() == [time for time, _ in expected]
        assert all(
            same(*pair) for pair in zip(found.records, [message for _, message in expected], strict=True)
        )


@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("kind", ["", "lz4", "zstd"])
def test_messages_without_an_index_of_chunks_are_read(tmp_path, kind, chunked):
    """Outside of chunks `ros2 bag record` writes them with its preset `fastwrite`."""
    path = tmp_path / "a.mcap"
    path.write_bytes(foreign(kind, chunked=chunked, count=6000, indexed=False))
    for topic in ("/t0", "/t2"):
        found, expected = read_messages(path, (topic,))[topic], by_library(path, topic)
        assert len(expected) == 2000
        assert found.log_times.tolist() == [time for time, _ in expected]
        assert all(same(*pair) for pair in zip(found.records, [each for _, each in expected], strict=True))
    some = read_messages(path, ("/t0",), start_ns=3_000_000, end_ns=9_000_000)["/t0"]
    assert some.log_times.tolist() == [3_000_000, 6_000_000]


def test_a_bomb_in_a_chunk_without_an_index_takes_no_memory(tmp_path):
    whole = foreign("", count=6000, indexed=False)
    chunks = [at for at in record_starts(whole) if whole[at] == Opcode.CHUNK]
    begin, end = chunks[0], chunks[-1]
    chunk = Chunk.read(ReadDataStream(io.BytesIO(whole[begin + 9 :])))
    chunk.data, chunk.compression = zstandard.ZstdCompressor().compress(bytes(1 << 30)), "zstd"
    room = end - begin - len(bytes_of(chunk)) - 9
    private = bytes([0x80]) + room.to_bytes(8, "little") + bytes(room)
    (tmp_path / "a.mcap").write_bytes(whole[:begin] + bytes_of(chunk) + private + whole[end:])
    tracemalloc.start()
    with pytest.raises(LogError, match="found 1073741824 bytes unpacked in its frame"):
        read_topic(tmp_path / "a.mcap", "/t0")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 << 20


@pytest.mark.parametrize("cut", [1, 40, 5000])
def test_a_file_without_chunks_that_lies_is_one_line(tmp_path, cut):
    data = bytearray(foreign("", chunked=False, count=50))
    starts = [at for at in record_starts(bytes(data)) if data[at] == Opcode.MESSAGE]
    data[starts[10] + 1 : starts[10] + 9] = (cut * 1000).to_bytes(8, "little")
    path = tmp_path / "a.mcap"
    path.write_bytes(bytes(data))
    with pytest.raises(LogError) as error:
        read_topic(path, "/t0")
    assert str(error.value).count("\n") == 0


MIXED = """\
# Everything that ros2msg has.
int32 NUMBER=3
string WORD="a b"
bool flag true
int8 small -1
geometry_msgs/Point[] points
string[2] pair
float32[<=4] few
int64[3] three
std_msgs/Header header
builtin_interfaces/Duration span
uint8[] blob
char letter
================================================================================
MSG: geometry_msgs/Point
float64 x
string name
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""


def write_mixed(path, count):
    from mcap_ros2.writer import Writer as Ros2Writer

    with open(path, "wb") as file:
        writer = Ros2Writer(file)
        schema = writer.register_msgdef("x_msgs/msg/Mixed", MIXED)
        for n in range(count):
            message = {
                "flag": n % 2 == 0,
                "small": -n,
                "points": [{"x": n + k / 8, "name": "p" * k} for k in range(n % 4)],
                "pair": ["a" * n, "ü"],
                "few": [0.5] * (n % 3),
                "three": [n, -n, 1 << 40],
                "header": {"stamp": {"sec": n, "nanosec": 5}, "frame_id": "f" * (n % 5)},
                "span": {"sec": n, "nanosec": 7},
                "blob": bytes(range(n)),
                "letter": 65,
            }
            writer.write_message("/mixed", schema, message, n, n, n)
        writer.finish()


def test_every_kind_of_field(tmp_path):
    path = tmp_path / "a.mcap"
    write_mixed(path, 20)
    found, expected = read_topic(path, "/mixed"), by_library(path, "/mixed")
    assert len(found) == 20
    assert all(same(*pair) for pair in zip(found, [message for _, message in expected], strict=True))


def by_writer(path, schema, *payloads, encoding="ros2msg", message="cdr"):
    """A log of the library's writer: one topic /a with these messages, in plain CDR."""
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "x")
        number = writer.register_schema("a/A", encoding, schema)
        channel = writer.register_channel("/a", message, number)
        for n, payload in enumerate(payloads):
            writer.add_message(channel, n, b"\0\1\0\0" + payload, n)
        writer.finish()
    return path


def test_text_of_another_length_in_the_middle_of_a_topic(tmp_path):
    """Two texts whose lengths change while the message's does not: only their length fields tell."""

    def packed(*texts):
        return b"".join(struct.pack("<I", len(text)) + text for text in texts)

    payloads = [packed(b"abc\0", b"defghij\0")] * 20 + [packed(b"abcdefg\0", b"hij\0")] * 10
    found = read_topic(by_writer(tmp_path / "a.mcap", b"string a\nstring b\n", *payloads), "/a")
    texts = [(row.a, row.b) for row in found[[0, 19, 20, 29]]]
    assert texts == [("abc", "defghij")] * 2 + [("abcdefg", "hij")] * 2


def write_texts(path, messages):
    """(channel, text) in one chunk, which holds no definitions; they stand in the chunk before."""
    schemas = [Schema(id=1, name="x/Text", encoding="ros2msg", data=b"string a\n")]
    channels = [
        Channel(id=n + 1, topic=f"/{n}", message_encoding="cdr", metadata={}, schema_id=1) for n in (0, 1, 2)
    ]
    file = McapFile(path, Head(schemas, channels, []), {}, 0)
    builder = ChunkBuilder(schemas, channels, [], 60)
    builder.add(3, 0, b"\0\1\0\0\1\0\0\0\0")
    file.append(builder.seal())
    for n, (channel, text) in enumerate(messages):
        builder.add(channel + 1, n, b"\0\1\0\0" + struct.pack("<I", len(text) + 1) + text + b"\0")
    file.append(builder.seal())
    file.finish(path.name)


@pytest.mark.parametrize(
    "messages",
    [
        pytest.param([(n % 2, b"text%3d" % n) for n in range(20)], id="two topics of one length"),
        pytest.param([(0, b"x" * length) for length in (8, 5, 11)], id="lengths that fill up a multiple"),
        pytest.param([(0, b"x" * 8)] * 3 + [(1, b"y" * 8)], id="another topic at the end"),
    ],
)
def test_a_chunk_that_only_looks_like_rows_of_one_length(tmp_path, messages):
    """It begins with a message, and is as long as a whole number of such messages."""
    path = tmp_path / "a.mcap"
    write_texts(path, messages)
    for channel in {channel for channel, _ in messages}:
        found = [value_of(row, "a") for row in read_topic(path, f"/{channel}")]
        texts = [each if isinstance(each, bytes) else each.encode() for each in found]
        assert [text.rstrip(b"\0") for text in texts] == [
            text for which, text in messages if which == channel
        ]


def test_a_log_of_before_is_read_alike(tmp_path):
    """All topics in one chunk, or each in its own."""
    paths = [tmp_path / name for name in ("before.mcap", "now.mcap")]
    for path in paths:
        ours(path, together=path is paths[0])
    before, now = (read_messages(path, INDEXED) for path in paths)
    for topic in INDEXED:
        assert before[topic].log_times.tolist() == now[topic].log_times.tolist()
        assert before[topic].records.tobytes() == now[topic].records.tobytes()


def test_several_topics_come_span_by_span(log):
    spans = list(iter_topics(log, (JOINT, "/joint/2/state", FRAMES)))
    assert len(spans) > 3
    for span in spans:
        one, *others = (messages.records["cycle"].tolist() for messages in span.values())
        assert len(others) == 2
        assert others == [one, one]


def test_time_selection(log):
    times = read_messages(log, (JOINT,))[JOINT].log_times
    start, end = START_NS + 17_000_000, START_NS + 45_000_000
    part = read_messages(log, (JOINT, FRAMES), start_ns=start, end_ns=end)
    assert part[JOINT].log_times.tolist() == [t for t in times.tolist() if start <= t < end]
    assert (
        part[JOINT].records["cycle"].tolist()
        == part[FRAMES].records["cycle"].tolist()
        == list(range(117, 145))
    )
    assert len(read_topic(log, JOINT, start_ns=end)) == 85
    with pytest.raises(LogError, match="no message on /joint/1/state in that time"):
        read_topic(log, JOINT, start_ns=START_NS + 10**12)


def test_parts_of_one_run(tmp_path):
    """Given in any order, as a directory, and with the last one still being written."""
    paths = [tmp_path / f"jtqd-can0-20261121T173111Z-{n:04d}.mcap" for n in (1, 2, 10)]
    for n, path in enumerate(paths):
        ours(path, 30, seed=n)
    last = paths[2].with_name(paths[2].name + ".active")
    last.write_bytes(paths[2].read_bytes()[:-2000])
    paths[2].unlink()
    found = read_topic(tmp_path, JOINT)
    assert len(found) == 90
    alone = [read_topic(path, JOINT) for path in (*paths[:2], last)]
    assert np.array_equal(found["current_a"], np.concatenate([each["current_a"] for each in alone]))
    assert np.array_equal(read_topic([last, paths[1], paths[0]], JOINT)["current_a"], found["current_a"])
    (tmp_path / "jtqd-can0-20261121T173112Z-0001.mcap").write_bytes(paths[0].read_bytes())
    with pytest.raises(LogError, match="found 2 runs"):
        log_parts(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match=r"found no \*.mcap"):
        log_parts(tmp_path / "empty")


def test_file_that_is_being_written_is_read_as_far_as_it_is_there(log, tmp_path):
    data = log.read_bytes()
    chunks = [at for at in record_starts(data) if data[at] == 6]
    whole = len(read_topic(log, JOINT))
    for cut, lost in (
        (chunks[-1] + 200, 1),
        (chunks[-1], 1),
        (chunks[-2], 1),
        (chunks[-2] + 200, 1),
        (chunks[4] + 9, None),
        (record_starts(data)[-4] - 3, None),
    ):
        active = tmp_path / "a.mcap.active"
        active.write_bytes(data[:cut])
        counts = [len(read_topic(active, topic)) for topic in (JOINT, "/joint/2/state", FRAMES)]
        assert len(set(counts)) == 1
        count = counts[0]
        assert 0 < count < whole if lost or cut < chunks[5] else 0 < count <= whole
        assert read_attachments(active)["configuration.yaml"] == ATTACHMENTS[0].data
        finished = tmp_path / "a.mcap"
        finished.write_bytes(data[:cut])
        with pytest.raises(LogError, match=r"ends too early.*jtq recover"):
            read_topic(finished, JOINT)


def test_wrong_message_index_is_not_believed(log, tmp_path):
    data = bytearray(log.read_bytes())
    whole = read_topics(log, (JOINT, FRAMES))
    for number in range(3):  # of /joint/1/state, /joint/2/state, /can/frames in the first chunk
        index = [at for at in record_starts(data) if data[at] == 7][number]
        data[index + 9 + 6 + 8] += 7  # offset of the first message
        path = tmp_path / "a.mcap"
        path.write_bytes(data)
        found = read_topics(path, (JOINT, FRAMES))
        assert {topic: rows.tobytes() for topic, rows in found.items()} == {
            topic: rows.tobytes() for topic, rows in whole.items()
        }
        data[index + 9 + 6 + 8] -= 7


def test_attachments_and_topics(log):
    assert read_attachments(log) == {each.name: each.data for each in ATTACHMENTS}
    found = topics_of(log)
    assert found[FRAMES] == "jtqd_msgs/msg/CanFrames"
    assert len(found) == 9


def damage(log, tmp_path, at, byte):
    data = bytearray(log.read_bytes())
    data[at] ^= byte
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    return path


def test_damage_is_one_line(log, tmp_path):
    data = log.read_bytes()
    starts = record_starts(data)
    chunk = next(at for at in starts if data[at] == 6)
    attachment = next(at for at in starts if data[at] == 9)
    for at, words in ((chunk + 400, "chunk at byte"), (chunk + 33, "CRC does not match"), (2, "first bytes")):
        with pytest.raises(LogError, match=words) as error:
            read_topic(damage(log, tmp_path, at, 4), JOINT)
        assert "\n" not in str(error.value)
    with pytest.raises(LogError, match=r"attachment 'configuration\.yaml' is damaged"):
        read_attachments(damage(log, tmp_path, attachment + 80, 1))


@pytest.mark.parametrize(
    ("schema", "payload", "words"),
    [
        ("string a\n", struct.pack("<I", 1 << 31), "length of 2147483648"),
        ("float64[] a\n", struct.pack("<I", 1 << 30), "cannot be decoded"),
        ("float64[900000000000] a\n", b"\0" * 16, "array of 900000000000"),
        ("a/B[] a\n====\nMSG: a/B\na/B[] a\n", struct.pack("<I", 1) * 50, "cannot be decoded"),
        ("a/B a\n====\nMSG: a/B\na/B a\n", b"\0" * 8, "cannot be decoded"),
        ("wstring a\n", b"\0" * 8, "wstring"),
        ("int32\n", b"\0" * 8, "found a schema that cannot be decoded"),
        ("int32 a\nint32 a\n", b"\0" * 8, "found a schema that cannot be decoded"),
        ("float64 a\n", b"\0" * 4, "4 bytes, expected 8"),
    ],
)
def test_schemas_and_messages_that_lie(tmp_path, schema, payload, words):
    path = by_writer(
        tmp_path / "a.mcap", schema.encode(), payload, payload + b"\0"
    )  # two lengths: one by one
    with pytest.raises(LogError, match=words):
        read_topic(path, "/a")


def test_decompression_bomb_takes_no_memory(tmp_path):
    """64 kB that unpack to 4 GB, within 700 MB of address space, in an unfinished file: that chunk is left out."""
    whole = foreign("zstd", count=3)
    starts = record_starts(whole)
    chunk = next(at for at in starts if whole[at] == 6)
    bomb = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 28)) * 16
    body = struct.pack("<QQQII4sQ", 0, 9, 1 << 27, 0, 4, b"zstd", len(bomb)) + bomb
    path = tmp_path / "a.mcap.active"
    path.write_bytes(whole[:chunk] + struct.pack("<BQ", 6, len(body)) + body + whole[chunk : starts[-3]])
    code = (
        "from pathlib import Path; from jtqd.daemon.logs import read_topic\n"
        f"print(len(read_topic(Path({str(path)!r}), '/t0')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (700 << 20, 700 << 20)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_other_encodings_are_named(tmp_path):
    path = by_writer(tmp_path / "a.mcap", b"{}", b"{}", encoding="jsonschema", message="json")
    with pytest.raises(LogError, match="found jsonschema schema, expected ros2msg"):
        read_topic(path, "/a")


def test_without_the_decoder_one_line_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    path = tmp_path / "a.mcap"
    path.write_bytes(foreign())
    with pytest.raises(LogError, match=r"pip install 'jtqd\[ros2\]'") as error:
        read_topic(path, "/t0")
    assert "\n" not in str(error.value)


def test_a_sequence_that_says_it_is_longer_than_its_message(tmp_path):
    rest = struct.pack("<I4s", 4, b"abc\0")
    for count in (1, 4_000_000_000):
        payloads = [struct.pack("<I", number) + rest for number in (1, count)]
        path = by_writer(tmp_path / "a.mcap", b"string[] a\n", *payloads)
        if count == 1:
            assert [row.a for row in read_topic(path, "/a")] == [["abc"], ["abc"]]
    with pytest.raises(LogError, match="/a: found a message that cannot be decoded"):
        read_topic(path, "/a")


# ---- chunks that lie ----


@pytest.mark.parametrize("cut", range(4))
def test_the_last_chunk_is_read_whole_whatever_of_its_indexes_is_there(tmp_path, cut):
    """The writer was killed between the message indexes of its last chunk: some channels have one, others none."""
    data = ours(tmp_path / "a.mcap", together=True)
    starts = record_starts(data)
    last = max(n for n, at in enumerate(starts[:-1]) if data[at] == Opcode.CHUNK)
    end = starts[last + 1 + cut]
    assert data[starts[last + cut]] == (Opcode.MESSAGE_INDEX if cut else Opcode.CHUNK)
    active = tmp_path / "b.mcap.active"
    active.write_bytes(data[:end])
    for topic in INDEXED:
        assert len(read_topic(active, topic)) == 120, topic


PACKED = zstandard.ZstdCompressor().compress(bytes(100_000))


@pytest.mark.parametrize(
    ("compression", "data", "size", "words"),
    [
        ("zstd", PACKED, 99_999, "found 100000 bytes unpacked in its frame, expected 99999"),
        ("zstd", PACKED, 100_001, "found 100000 bytes unpacked, expected 100001"),
        ("zstd", PACKED[:-1], 100_000, "cannot be unpacked"),
        ("zstd", PACKED, 1 << 40, "expected at most 268435456"),
        ("lz4", lz4.frame.compress(bytes(100_000)), 99_999, "found 100000 bytes unpacked, expected 99999"),
        ("lz4", b"nonsense", 8, "cannot be unpacked"),
        ("", bytes(8), 9, "found 8 bytes unpacked, expected 9"),
        ("brotli", bytes(8), 8, "found compression 'brotli', expected zstd, lz4 or none"),
    ],
)
def test_a_chunk_that_cannot_be_unpacked(tmp_path, compression, data, size, words):
    """A size is compared before a byte is unpacked."""
    with open(tmp_path / "a", "w+b") as file:
        source = Source(file.fileno())
    chunk = Chunk(compression, data, 0, 0, 0, size)
    with pytest.raises(ChunkError, match=words):
        source.unpack(chunk)


def test_a_chunk_with_another_crc_is_refused(tmp_path):
    with open(tmp_path / "a", "w+b") as file:
        source = Source(file.fileno())
    assert source.unpack(Chunk("zstd", PACKED, 0, 0, zlib.crc32(bytes(100_000)), 100_000)) == bytes(100_000)
    with pytest.raises(ChunkError, match="CRC"):
        source.unpack(Chunk("zstd", PACKED, 0, 0, 1, 100_000))


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
        read_topic(tmp_path / "b.mcap", INDEXED[0])


# ---- parts of a run: what two of them have comes once ----


GOLDEN_LOG = GOLDEN / "network.mcap"
NAME = "jtqd-can0-20261121T173111Z-{:04d}.mcap"
IN_PARTS = ("/joint/1/state", "/joint/2/state", "/can/frames", "/diagnostics", "/events")


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A run in three parts: 100 cycles are in the first two, one is in the last two; what has no cycle is in all."""
    directory = tmp_path_factory.mktemp("parts")
    first = cycle_numbers(GOLDEN_LOG)[0]
    for n, (begin, end) in enumerate(((0, 700), (600, 1001), (1000, 1 << 30)), start=1):
        replay_helpers.cut(
            GOLDEN_LOG, directory / NAME.format(n), lambda c, b=begin, e=end: b <= c - first < e
        )
    return directory


@pytest.mark.parametrize("topic", IN_PARTS)
def test_every_message_comes_once(parts, topic):
    whole = packed(read_topic(GOLDEN_LOG, topic))
    assert packed(read_topic(parts, topic)) == whole
    pieces = [each.records for each in iter_messages(parts, topic)]
    assert b"".join(map(packed, pieces)) == whole


def packed(records):
    if records.dtype == object:  # texts of changing length: their times
        return b"".join(
            struct.pack("<II", each.header.stamp.sec, each.header.stamp.nanosec) for each in records
        )
    return repack_fields(records, recurse=True).tobytes()


def test_frames_and_tables(parts, tmp_path):
    frames = [sum(len(each.ids) for each in iter_frames(path, "/can/frames")) for path in (GOLDEN_LOG, parts)]
    assert frames[0] == frames[1] > 1000
    tables = []
    for path in (GOLDEN_LOG, parts):
        out = tmp_path / f"{path.name}.csv"
        assert export(["csv", str(path), "--out", str(out), "--all-cycles"]) == 0
        tables.append(out.read_bytes())
    assert tables[0] == tables[1]


def test_what_only_looks_alike_is_kept(parts, tmp_path):
    """Another byte in a message of the same cycle and time: nobody knows which one is right."""
    shutil.copytree(parts, tmp_path, dirs_exist_ok=True)
    cycle = cycle_numbers(GOLDEN_LOG)[0] + 650
    second = tmp_path / NAME.format(2)

    def spoil(topic, at, data):
        return data[:-9] + bytes((data[-9] ^ 1,)) + data[-8:] if at == cycle and "/1/" in topic else data

    replay_helpers.cut(parts / NAME.format(2), second, payload=spoil)
    found = read_topic(tmp_path, "/joint/1/state")["cycle"]
    assert len(found) == len(read_topic(GOLDEN_LOG, "/joint/1/state")) + 1
    assert np.count_nonzero(found == cycle) == 2
    with pytest.raises(LogError, match="given twice"):
        list(replayed([tmp_path]))


def test_replay_of_a_directory(parts, capsys):
    assert replay([str(parts), "--json"]) == 0
    (run,) = json.loads(capsys.readouterr().out)["runs"]
    assert (len(run["logs"]), run["cycles"], run["lost_cycles"]) == (3, len(cycle_numbers(GOLDEN_LOG)), 0)
    assert replay([str(GOLDEN_LOG), "--json"]) == 0
    (alone,) = json.loads(capsys.readouterr().out)["runs"]
    assert run["identity"] == alone["identity"]
    assert run["joints"] == alone["joints"]


def test_a_recorder_that_did_not_report_its_last_chunks(tmp_path):
    """By the recorder's own code: what was written and not settled is written again, in other chunks."""
    for part, numbers in ((1, range(2600)), (2, range(1300, 4000))):
        directory = tmp_path / str(part)
        directory.mkdir()
        session = session_on(directory, run="20250102T030405Z")
        for n in numbers:
            session.recording.add(cycle_record(n))
        session.finish()
        (written,) = (directory / "logs").glob("*.mcap")
        (tmp_path / "both").mkdir(exist_ok=True)
        written.rename(tmp_path / "both" / f"test-20250102T030405Z-{part:04d}.mcap")
    assert read_topic(tmp_path / "both", "/joint/2/state")["cycle"].tolist() == list(range(4000))


@pytest.mark.parametrize("promised", [0, 1, 10**5])
def test_a_summary_that_promises_too_few_or_too_many_messages_changes_nothing(
    tmp_path, monkeypatch, promised
):
    parts = [tmp_path / f"{n}.mcap" for n in (1, 2)]
    for n, part in enumerate(parts):
        write_log(part, list(cycles(2100, seed=n)))
    whole = read_topic(parts, "/joint/1/state")
    opened = LogFile._open

    def promise(log):
        opened(log)
        log.expected = dict.fromkeys(range(1, 20), promised)

    monkeypatch.setattr(LogFile, "_open", promise)
    assert read_topic(parts, "/joint/1/state").tobytes() == whole.tobytes()
    assert len(whole) == 4200


def test_a_topic_is_a_table_of_flat_columns(log):
    table = read_topic(str(log), JOINT)
    columns = table.columns()
    assert list(columns)[:2] == ["header.stamp.sec", "header.stamp.nanosec"]
    assert all(column.shape == (130,) for column in columns.values())
    assert columns["header.stamp.nanosec"].tolist() == table["header"]["stamp"]["nanosec"].tolist()
    assert columns["header.frame_id"][0] == table["header"]["frame_id"][0].decode()
    frames = read_topic(log, FRAMES)
    assert frames.columns()["frames.data[3][7]"].tolist() == frames["frames"]["data"][:, 3, 7].tolist()
    assert len(table[table["cycle"] % 2 == 0].columns()["cycle"]) == 65


def test_one_field_of_a_table_is_a_plain_array(log):
    table = read_topic(log, JOINT)
    assert type(table["torque_nm"]) is np.ndarray
    assert type(table["torque_nm"] - table["reference_nm"]) is np.ndarray
    assert type(table["header"]["stamp"]["sec"]) is np.ndarray
    assert type(table[3:]) is Table


def test_pandas_gets_these_columns_and_is_named_where_it_is_missing(log, monkeypatch):
    table = read_topic(log, JOINT)
    monkeypatch.setitem(sys.modules, "pandas", types.SimpleNamespace(DataFrame=dict))
    assert table.to_pandas().keys() == table.columns().keys()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install pandas$"):
        table.to_pandas()


def test_pandas_itself_takes_them(log):
    pandas = pytest.importorskip("pandas")
    table = read_topic(log, JOINT)
    frame = table.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame["torque_nm"].to_numpy().tolist() == table["torque_nm"].tolist()


def test_a_topic_that_is_missing_lists_those_that_are_there(log):
    for read_one in (read_topic, lambda *of: list(iter_messages(*of))):
        with pytest.raises(LogError, match=r"no message on /nothing, expected one of .*/joint/1/state"):
            read_one(log, "/nothing")
